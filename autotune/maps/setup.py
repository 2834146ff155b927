"""Set up a map: the loop at its fixed values, and the ranges, around the design where none is given."""

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

from autotune.errors import UsageError
from identification.errors import EstimateError
from problems.contact.transient import Approach
from problems.frozen import freeze
from problems.maps.maps import MapAxis, MapRequest, check_varied
from problems.maps.parameters import (
    CONTROLLER_FIELDS,
    MAP_PARAMETERS,
    PLANT_NAMES,
    STANDS_FOR,
    MapParameter,
    MapQuantity,
    check_together,
    controller_at,
    plant_at,
    value_of,
)
from problems.maps.search import IntervalCase, IntervalRequest
from problems.model.controller import AdmittanceController
from problems.model.plant import Plant
from problems.model.plant_parameters import build_plant

from .options import STABLE_DAMPING, STABLE_LEAD, MapOptions, parse_range, parse_search, parse_settings
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


# What a controller must be given; the rest of it is off, or as in the paper, until somebody says otherwise.
_NEEDED = {"mass": "M_a", "damping": "B_a"}
_OF_PLANT = ("payload_mass", "drag", "coupling_stiffness", "coupling_damping", "environment_stiffness")
# In place of a value that every point of the map replaces.
_REPLACED = 1.0


@dataclass(frozen=True, kw_only=True)
class Base:
    """Plant and controller at the values that are fixed; `derived` are the settings that determine others everywhere.

    What is varied, or determined by what is varied, has some value in `plant` and `controller` that nobody sees.
    """

    plant: Plant
    controller: AdmittanceController
    derived: Mapping[str, float]

    def __post_init__(self) -> None:
        freeze(self, "derived")

    def value(self, name: str) -> float:
        """Return the value of a parameter that does not vary."""
        return value_of(name, plant_at(self.plant, self.derived), self.controller)

    def fixed(self, varied: Collection[str]) -> dict[str, float]:
        """Return the parameters that do not vary, and say the payload as the varied and the derived ones do."""
        spoken = {*varied, *self.derived}
        unsaid = {direct if derived in spoken else derived for derived, direct in STANDS_FOR.items()}
        found = {name: self.value(name) for name in MAP_PARAMETERS if name not in {*varied, *unsaid}}
        return {name: value for name, value in found.items() if not math.isnan(value)}


def known_values(source: MapSource, settings: Mapping[str, float]) -> dict[str, float]:
    """Return every parameter that the source or a setting gives, or that follows from those."""
    known = dict(source.known) | {"delay_s": source.robot.delay_s}
    if source.robot.order == 1:
        known["robot_bandwidth_rad_per_s"] = float(source.robot.denominator[-1])
    if source.controller is not None:
        known |= {name: float(getattr(source.controller, field)) for name, field in CONTROLLER_FIELDS.items()}
    known |= settings
    if "payload_frequency_rad_per_s" in settings and "coupling_stiffness" in known:
        known["payload_mass"] = known["coupling_stiffness"] / settings["payload_frequency_rad_per_s"] ** 2
    stiffness, mass = known.get("coupling_stiffness", 0.0), known.get("payload_mass", 0.0)
    if stiffness > 0.0 and mass > 0.0:
        known.setdefault("payload_frequency_rad_per_s", math.sqrt(stiffness / mass))
        if "drag" in known:
            known.setdefault("payload_damping_ratio", known["drag"] / (2.0 * math.sqrt(stiffness * mass)))
    return known


def build_base(source: MapSource, settings: Mapping[str, float], varied: Collection[str], *, touches: bool) -> Base:
    """Build plant and controller from what is known; `touches`: the environment matters.

    Raises UsageError for a controller value that is neither known nor varied, EstimateError for such a plant
    parameter, ParameterError for values out of range.
    """
    known = known_values(source, settings)
    determined = {direct for derived, direct in STANDS_FOR.items() if derived in varied or derived in settings}
    gains = [name for name in _NEEDED if name not in known and name not in varied]
    if gains:
        listed = " and ".join(f"{name} ({_NEEDED[name]})" for name in gains)
        settings_to_add = " ".join(f"--set {name}=VALUE" for name in gains)
        raise UsageError(
            f"{source.path} holds no controller, so that the gains must be given, and nothing gives {listed} of the "
            f"controller; say {settings_to_add}, or --controller FILE."
        )
    for name in _OF_PLANT:
        if name in known or name in varied or name in determined:
            continue
        if name == "environment_stiffness" and not touches:
            continue
        reason = source.missing.get(name, "the file does not have it")
        raise EstimateError(
            f"{source.path}: {name} of axis {source.axis} is not identified ({reason}); say --set {name}=VALUE."
        )
    values = {name: known.get(name, _REPLACED) for name in _OF_PLANT}
    if not touches:
        values["environment_stiffness"] = known.get("environment_stiffness", 0.0)
    kind = source.controller or AdmittanceController(mass_kg=_REPLACED, damping_n_s_per_m=_REPLACED)
    direct = {name: value for name, value in settings.items() if name not in STANDS_FOR}
    # The environment is without damping and mass unless something is known of them.
    values |= {name: known[name] for name in PLANT_NAMES if name in known}
    plant = build_plant(source.robot, {PLANT_NAMES[name]: each for name, each in values.items()}, source.wrench_filter)
    return Base(
        plant=plant_at(plant, direct),
        controller=controller_at(kind, {name: known.get(name, _REPLACED) for name in _NEEDED} | direct),
        derived={name: value for name, value in settings.items() if name in STANDS_FOR and name not in varied},
    )


@dataclass(frozen=True, kw_only=True)
class MapSetup:
    """What is computed, and what is written around it.

    `fixed` is every parameter that does not vary; `design` the values that source and settings give to those that do,
    None where they do not give all of them or no whole controller.
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


def build_setup(options: MapOptions, source: MapSource) -> MapSetup:
    """Return what is to be computed; a setting of what varies says where the design lies.

    Raises UsageError for a request that contradicts itself or leaves a controller value open, EstimateError for a
    plant parameter that the source does not have and nobody set, ParameterError for values out of range.
    """
    settings = parse_settings(options.settings)
    check_together(settings)
    known = known_values(source, settings)
    if options.show in {STABLE_DAMPING, STABLE_LEAD}:
        return _interval_setup(options, source, settings, known)
    if options.search is not None:
        raise UsageError(f"--search goes with --show {STABLE_DAMPING} or {STABLE_LEAD}; here say --x and --y.")
    x, y = _map_axes(options, known)
    base = build_base(source, settings, (x.name, y.name), touches=options.where != "free_space")
    request = MapRequest(
        plant=base.plant,
        controller=base.controller,
        sample_time_s=source.sample_time_s,
        x=x,
        y=y,
        quantity=MapQuantity(options.show),
        where=options.where,
        approach=source.approach if options.approach_force is None else Approach(force_n=options.approach_force),
        fixed=base.derived,
    )
    return _setup(source, request, base, known, (x, y))


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


def _interval_setup(
    options: MapOptions, source: MapSource, settings: Mapping[str, float], known: Mapping[str, float]
) -> MapSetup:
    searched, along = _searched(options, known), _along(options, known)
    curves = _curves(options, settings, along, known)
    varied = [along, searched] if curves is None else [along, searched, curves]
    names = [axis.name for axis in varied]
    base = build_base(source, settings, names, touches=options.where != "free_space")
    check_varied(varied, base.derived)
    if curves is not None:
        cases = _cases(source, base, curves)
    else:
        laws = controller_family(base.controller) if options.show == STABLE_DAMPING else {"all": base.controller}
        cases = {name: IntervalCase(controller=law, fixed=base.derived) for name, law in laws.items()}
    request = IntervalRequest(
        plant=base.plant,
        sample_time_s=source.sample_time_s,
        cases=cases,
        along=along,
        searched=searched,
        where=options.where,
    )
    return _setup(source, request, base, known, varied)


def _setup(
    source: MapSource,
    request: MapRequest | IntervalRequest,
    base: Base,
    known: Mapping[str, float],
    varied: Sequence[MapAxis],
) -> MapSetup:
    names = [axis.name for axis in varied]
    fixed = base.fixed(names)
    if request.where == "free_space":
        fixed = {name: value for name, value in fixed.items() if not name.startswith("environment_")}
    whole = all(name in known for name in ("mass", "damping", *names))
    return MapSetup(
        source=source,
        request=request,
        fixed=fixed,
        design={name: known[name] for name in names} if whole else None,
    )


def _map_axes(options: MapOptions, known: Mapping[str, float]) -> tuple[MapAxis, MapAxis]:
    """Return the axes that were asked for; lead over damping where nothing was said."""
    x = None if options.x is None else parse_range(options.x, count=COLUMNS)
    y = None if options.y is None else parse_range(options.y, count=ROWS)
    if x is None:
        x = _damping(known, COLUMNS) if y is None or y.name != "damping" else _lead(known, COLUMNS)
    if y is None:
        y = _lead(known, ROWS) if x.name != "lead_s" else _damping(known, ROWS)
    return x, y


def _searched(options: MapOptions, known: Mapping[str, float]) -> MapAxis:
    name = "damping" if options.show == STABLE_DAMPING else "lead_s"
    if options.search is not None:
        return parse_search(options.search, name, count=SEARCHED)
    if name == "damping":
        return _log_axis(name, known, _SEARCHED_DAMPING, _WIDE_DAMPING, SEARCHED)
    high = max(_SEARCHED_LEAD_S, 2.0 * known.get("lead_s", 0.0))
    return MapAxis(name=name, low=0.0, high=_rounded(high), count=SEARCHED)


def _along(options: MapOptions, known: Mapping[str, float]) -> MapAxis:
    if options.x is not None:
        return parse_range(options.x, count=ALONG)
    if options.show == STABLE_DAMPING:
        return _log_axis("environment_stiffness", known, _AROUND_STIFFNESS, _STIFFNESS, ALONG)
    return _log_axis("payload_frequency_rad_per_s", known, _AROUND_FREQUENCY, _FREQUENCY, ALONG)


def _curves(
    options: MapOptions, settings: Mapping[str, float], along: MapAxis, known: Mapping[str, float]
) -> MapAxis | None:
    """Return the parameter of which several values are compared; for the lead it is ζ, unless that is spoken for."""
    if options.y is not None:
        curves = parse_range(options.y, count=CURVES)
        if curves.count > MOST_CURVES:
            raise UsageError(f"{curves.count} values of {curves.name} are too many curves; say at most {MOST_CURVES}.")
        return curves
    ratio = known.get("payload_damping_ratio", 0.0)
    spoken = {along.name, *settings} & {"payload_damping_ratio", "drag"}
    if options.show == STABLE_DAMPING or spoken or ratio <= 0.0:
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
