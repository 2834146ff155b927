"""From a source and a request to what the ground floor computes, with ranges around the design where none is given."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from autotune.errors import UsageError
from problems.contact.transient import Approach
from problems.frozen import freeze
from problems.maps.maps import MapAxis, MapRequest, check_varied
from problems.maps.parameters import MapParameter, MapQuantity, check_together
from problems.maps.search import IntervalCase, IntervalRequest
from problems.model.controller import AdmittanceController

from .ask import STABLE_DAMPING, STABLE_LEAD, MapAsk, parse_range, parse_search, parse_settings
from .base import Base, build_base, known_values
from .source import MapSource
from .text import number, with_unit

COLUMNS, ROWS, ALONG, SEARCHED, CURVES = 120, 90, 160, 401, 4
MOST_CURVES = 8
# Default ranges, as factors around the design, or in the paper's cell where there is no design.
_AROUND_DAMPING, _DAMPING = 5.0, (100.0, 10_000.0)
_AROUND_STIFFNESS, _STIFFNESS = 10.0, (1e4, 1e6)
_AROUND_FREQUENCY, _FREQUENCY = 4.0, (30.0, 500.0)
_SEARCHED_DAMPING, _WIDE_DAMPING = 100.0, (10.0, 1e5)
_LEAD_S, _SEARCHED_LEAD_S = 0.05, 0.1


@dataclass(frozen=True, kw_only=True)
class MapPlan:
    """What is computed, and what is told around it.

    `fixed` is every parameter that does not vary; `design` the values that source and settings give to those that do,
    None where they do not tell all of them or no whole controller.
    """

    source: MapSource
    request: MapRequest | IntervalRequest
    fixed: Mapping[str, float]
    design: Mapping[str, float] | None

    def __post_init__(self) -> None:
        freeze(self, "fixed")

    def unit(self, parameter: MapParameter) -> str:
        """Return the unit of a parameter on this axis."""
        return parameter.unit_of(rotational=self.source.is_rotational)


def build_plan(ask: MapAsk, source: MapSource) -> MapPlan:
    """Return what is to be computed; a setting of what varies says where the design lies.

    Raises UsageError for a request that contradicts itself or leaves a controller value open, EstimateError for a
    plant parameter that the source does not tell and nobody set, ParameterError for values out of range.
    """
    settings = parse_settings(ask.settings)
    check_together(settings)
    known = known_values(source, settings)
    if ask.show in {STABLE_DAMPING, STABLE_LEAD}:
        return _plan_intervals(ask, source, settings, known)
    if ask.search is not None:
        raise UsageError(f"--search goes with --show {STABLE_DAMPING} or {STABLE_LEAD}; here say --x and --y.")
    x, y = _map_axes(ask, known)
    base = build_base(source, settings, (x.name, y.name), touches=ask.where != "free_space")
    request = MapRequest(
        plant=base.plant,
        controller=base.controller,
        sample_time_s=source.sample_time_s,
        x=x,
        y=y,
        quantity=MapQuantity(ask.show),
        where=ask.where,
        approach=source.approach if ask.approach_force is None else Approach(force_n=ask.approach_force),
        fixed=base.derived,
    )
    return _plan(source, request, base, known, (x, y))


def controller_family(controller: AdmittanceController) -> dict[str, AdmittanceController]:
    """Return standard admittance control, each of the controller's extensions alone, and all of them together."""
    standard = replace(controller, lead_s=0.0, feedback_damping_s=0.0, compensation_mass_kg=0.0)
    alone = {
        "lead": replace(standard, lead_s=controller.lead_s),
        "feedback damping": replace(standard, feedback_damping_s=controller.feedback_damping_s),
        "compensation": replace(standard, compensation_mass_kg=controller.compensation_mass_kg),
    }
    used = {name: each for name, each in alone.items() if each != standard}
    together = {" + ".join(used): controller} if len(used) > 1 else {}
    return {"standard": standard} | used | together


def _plan_intervals(
    ask: MapAsk, source: MapSource, settings: Mapping[str, float], known: Mapping[str, float]
) -> MapPlan:
    searched, along = _searched(ask, known), _along(ask, known)
    curves = _curves(ask, settings, along, known)
    varied = [along, searched] if curves is None else [along, searched, curves]
    names = [axis.name for axis in varied]
    base = build_base(source, settings, names, touches=ask.where != "free_space")
    check_varied(varied, base.derived)
    if curves is not None:
        cases = _cases(source, base, curves)
    else:
        laws = controller_family(base.controller) if ask.show == STABLE_DAMPING else {"all": base.controller}
        cases = {name: IntervalCase(controller=law, fixed=base.derived) for name, law in laws.items()}
    request = IntervalRequest(
        plant=base.plant,
        sample_time_s=source.sample_time_s,
        cases=cases,
        along=along,
        searched=searched,
        where=ask.where,
    )
    return _plan(source, request, base, known, varied)


def _plan(
    source: MapSource,
    request: MapRequest | IntervalRequest,
    base: Base,
    known: Mapping[str, float],
    varied: Sequence[MapAxis],
) -> MapPlan:
    names = [axis.name for axis in varied]
    fixed = base.fixed(names)
    if request.where == "free_space":
        fixed = {name: value for name, value in fixed.items() if not name.startswith("environment_")}
    whole = all(name in known for name in ("mass", "damping", *names))
    return MapPlan(
        source=source,
        request=request,
        fixed=fixed,
        design={name: known[name] for name in names} if whole else None,
    )


def _map_axes(ask: MapAsk, known: Mapping[str, float]) -> tuple[MapAxis, MapAxis]:
    """Return the axes that were asked for; lead over damping where nothing was said."""
    x = None if ask.x is None else parse_range(ask.x, count=COLUMNS)
    y = None if ask.y is None else parse_range(ask.y, count=ROWS)
    if x is None:
        x = _damping(known, COLUMNS) if y is None or y.name != "damping" else _lead(known, COLUMNS)
    if y is None:
        y = _lead(known, ROWS) if x.name != "lead_s" else _damping(known, ROWS)
    return x, y


def _searched(ask: MapAsk, known: Mapping[str, float]) -> MapAxis:
    name = "damping" if ask.show == STABLE_DAMPING else "lead_s"
    if ask.search is not None:
        return parse_search(ask.search, name, count=SEARCHED)
    if name == "damping":
        return _log_axis(name, known, _SEARCHED_DAMPING, _WIDE_DAMPING, SEARCHED)
    high = max(_SEARCHED_LEAD_S, 2.0 * known.get("lead_s", 0.0))
    return MapAxis(name=name, low=0.0, high=_rounded(high), count=SEARCHED)


def _along(ask: MapAsk, known: Mapping[str, float]) -> MapAxis:
    if ask.x is not None:
        return parse_range(ask.x, count=ALONG)
    if ask.show == STABLE_DAMPING:
        return _log_axis("environment_stiffness", known, _AROUND_STIFFNESS, _STIFFNESS, ALONG)
    return _log_axis("payload_frequency_rad_per_s", known, _AROUND_FREQUENCY, _FREQUENCY, ALONG)


def _curves(ask: MapAsk, settings: Mapping[str, float], along: MapAxis, known: Mapping[str, float]) -> MapAxis | None:
    """Return the parameter of which several values are compared; for the lead it is ζ, unless that is spoken for."""
    if ask.y is not None:
        curves = parse_range(ask.y, count=CURVES)
        if curves.count > MOST_CURVES:
            raise UsageError(f"{curves.count} values of {curves.name} are too many curves; say at most {MOST_CURVES}.")
        return curves
    ratio = known.get("payload_damping_ratio", 0.0)
    spoken = {along.name, *settings} & {"payload_damping_ratio", "drag"}
    if ask.show == STABLE_DAMPING or spoken or ratio <= 0.0:
        return None
    return MapAxis(name="payload_damping_ratio", low=0.5 * ratio, high=4.0 * ratio, count=CURVES, spacing="log")


def _cases(source: MapSource, base: Base, curves: MapAxis) -> dict[str, IntervalCase]:
    parameter = curves.parameter
    unit = parameter.unit_of(rotational=source.is_rotational)
    return {
        with_unit(f"{parameter.symbol} = {number(float(value))}", unit): IntervalCase(
            controller=base.controller, fixed={**base.derived, curves.name: float(value)}
        )
        for value in curves.values()
    }


def _damping(known: Mapping[str, float], count: int) -> MapAxis:
    return _log_axis("damping", known, _AROUND_DAMPING, _DAMPING, count)


def _lead(known: Mapping[str, float], count: int) -> MapAxis:
    return MapAxis(name="lead_s", low=0.0, high=_rounded(max(_LEAD_S, 2.0 * known.get("lead_s", 0.0))), count=count)


def _log_axis(
    name: str, known: Mapping[str, float], factor: float, otherwise: tuple[float, float], count: int
) -> MapAxis:
    middle = known.get(name, 0.0)
    low, high = otherwise if middle <= 0.0 else (_rounded(middle / factor), _rounded(middle * factor))
    return MapAxis(name=name, low=low, high=high, count=count, spacing="log")


def _rounded(value: float) -> float:
    """Return the value with two digits, as people write the end of a range."""
    return float(f"{value:.1e}") if math.isfinite(value) else value
