"""The plants of one prediction: the most likely one, and those that it may be instead."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.special import ndtri

from autotune.errors import UsageError
from autotune.formats.identified import IdentifiedFile
from autotune.formats.units import ROTATIONAL_AXES, axis_units
from identification.errors import EstimateError
from identification.result import TICK_S, AxisEstimate, EnvironmentEstimate, Estimate, Identified, Status
from problems.arrays import FloatArray
from problems.design.uncertainty import PlantSet, Scenario
from problems.model.plant import Coupling, Environment, PayloadDynamics, Plant, WrenchFilter
from problems.model.robot import RobotModel, bandwidth_hz, bandwidth_share, has_damping_ratio, vary_robot
from problems.sobol import sobol_points

from .model_error import ModelError, model_error
from .series_plant import series_plant

DRAWS = 128
# Of the unit interval, so that a normal draw is finite.
_WITHIN = 1e-6, 1.0 - 1e-6
_FIRST_BLOW = (
    "robot or stiffness of surface {surface} on axis {axis} is not identified: predicted is the first blow alone, the "
    "force per speed that the log shows times the speed, and nothing of what follows it"
)
# A deviation larger than this share of its value says no more than that the value is of this size.
_LARGEST_SHARE = 1.0
# Of the lag of the poles.
_LEAST_LAG = 0.3
# A moving mass of the surface below this many deviations is none.
_STDS = 2.0
# What is left out where the payload is not known.
_BEHIND = frozenset({"K_s", "B_s", "B_p", "M_p"})
_POSITIVE = frozenset({"K_s", "K_e", "M_p", "omega", "zeta", "corner", "blow"})


@dataclass(frozen=True, kw_only=True)
class Surface:
    """What is touched: the `name` of an identified surface, or a stiffness [N/m, N·m/rad] with its deviation."""

    name: str = ""
    stiffness: float | None = None
    std: float = 0.0

    def label(self, axis: str) -> str:
        """Return what the surface is called in a table."""
        factor, unit = axis_units(axis).shown_stiffness
        return self.name if self.stiffness is None else f"{factor * self.stiffness:.4g} {unit}"


@dataclass(frozen=True, kw_only=True)
class PlantEnsemble:
    """The `nominal` plant of an axis in contact with a surface, and `others` that it may be instead.

    With `is_range` the others are corners and samples of ranges that must all be safe, so that the extremes count;
    otherwise they are draws from the joint distribution of what was identified. `neglected` says in sentences what is
    not known and left out; `has_payload` is False where payload and coupling are: then `blow` and `other_blows` are the
    force of the first blow over the speed [N·s/m, N·m·s/rad], 0 where it is not known. `model_error` is how far a peak
    of the identified model is from a measured one beyond its parameters, None where no log shows anything of it.
    `nominal` is None, and `others` empty, where not even the robot or the stiffness is known and the first blow alone
    can be predicted.
    """

    axis: str
    surface: str
    sample_time_s: float
    nominal: Plant | None
    others: tuple[Plant, ...]
    is_range: bool
    has_payload: bool = True
    neglected: tuple[str, ...] = ()
    model_error: ModelError | None = None
    blow: float = 0.0
    other_blows: tuple[float, ...] = ()


def find_axis(result: Identified, axis: str | None, surface: Surface) -> str:
    """Return the axis that was named, or that of the surface, or the only one; raises UsageError otherwise."""
    held = ", ".join(result.axes) or "none"
    if axis is not None:
        if axis not in result.axes:
            raise UsageError(f"The plant holds the axes {held}, not {axis}.")
        return axis
    owners = [name for name, each in result.axes.items() if surface.name in {e.name for e in each.environments}]
    if surface.name and len(owners) == 1:
        return owners[0]
    if len(result.axes) == 1:
        return next(iter(result.axes))
    raise UsageError(f"The plant holds the axes {held}; say which one is meant.")


def find_surface(axis: AxisEstimate, name: str, surface: Surface) -> EnvironmentEstimate | None:
    """Return the identified surface that is meant, None for one whose stiffness was given.

    Without a name it is the only surface of the axis. Raises UsageError where there is no such surface.
    """
    if surface.stiffness is not None:
        return None
    known = {each.name: each for each in axis.environments}
    if not surface.name and len(known) == 1:
        return next(iter(known.values()))
    if surface.name not in known:
        found = f"holds the surfaces {', '.join(known)}" if known else "holds no surface"
        what = f"and not {surface.name}" if surface.name else "and none was named"
        raise UsageError(f"Axis {name} {found}, {what}; name one of them, or give a stiffness such as 20N/mm.")
    return known[surface.name]


def build_plants(
    source: IdentifiedFile,
    surface: Surface,
    *,
    axis: str | None = None,
    payload_mass: float | None = None,
    sample_time_s: float | None = None,
    seed: int = 0,
) -> PlantEnsemble:
    """Return the plants of an `identified.yaml` or `plant.yaml` against a surface.

    Where payload and coupling are not known (their gravity was taken off), the plant is the robot in series with the
    stiffness over robot travel, and `neglected` says so. Raises EstimateError where the robot, the surface's stiffness
    or the period of the controller is not known, UsageError for an axis or a surface that is not there.
    """
    result = source.result
    name = find_axis(result, axis, surface)
    estimates = result.axes[name]
    touched = find_surface(estimates, name, surface)
    label = touched.name if touched is not None else surface.label(name)
    period = sample_time_s if sample_time_s is not None else _control_period(result.sample_time_s)
    if touched is not None and _is_blow_only(estimates, touched):
        return _blow_only(name, touched, period or 0.0, model_error(estimates.held_out), seed)
    if period is None:
        raise EstimateError("The controller's period is not known, and nothing can be computed without it; say it.")
    known = _Known(result, name, estimates, touched, surface, payload_mass)
    nominal = known.plant({}, period)
    if source.domain:
        others, is_range = _of_ranges(source.domain, nominal, surface, payload_mass, seed), True
        error = None
        draws: tuple[dict[str, float], ...] = ()
    else:
        draws = _draws(known, seed)
        others, is_range = tuple(known.plant(draw, period) for draw in draws), False
        error = model_error(estimates.held_out)
    return PlantEnsemble(
        axis=name,
        surface=label,
        sample_time_s=period,
        nominal=nominal,
        others=others,
        is_range=is_range,
        has_payload=known.has_payload,
        neglected=known.neglected,
        model_error=error,
        blow=known.value("blow", {}),
        other_blows=tuple(known.value("blow", draw) for draw in draws),
    )


def _control_period(estimate: Estimate) -> float | None:
    """Return the period of the controller [s]; that of a slow log without a command is no more than the log's own.

    Half a control period is in the delay that such a log shows, so that a short period adds little to it.
    """
    period = _number(estimate)
    return min(period, TICK_S) if period is not None and estimate.status is Status.WEAK else period


def _is_blow_only(axis: AxisEstimate, touched: EnvironmentEstimate) -> bool:
    """Whether nothing but the first blow of a surface can be predicted: robot or stiffness are not known."""
    has_plant = axis.robot.numerator.value is not None and _number(touched.secant_stiffness_n_per_m) is not None
    return not has_plant and bool(_number(touched.impact_n_s_per_m))


def _blow_only(axis: str, touched: EnvironmentEstimate, period_s: float, error: ModelError, seed: int) -> PlantEnsemble:
    """Return the ensemble of a surface of which the log shows the first blow alone."""
    blow, std = _number(touched.impact_n_s_per_m) or 0.0, _std(touched.impact_n_s_per_m)
    unit = sobol_points(1, DRAWS, seed=seed)[:, 0]
    return PlantEnsemble(
        axis=axis,
        surface=touched.name,
        sample_time_s=period_s,
        nominal=None,
        others=(),
        is_range=False,
        has_payload=False,
        neglected=(_FIRST_BLOW.format(surface=touched.name, axis=axis),),
        model_error=error,
        blow=blow,
        other_blows=tuple(shifted("blow", blow, std * each) for each in ndtri(np.clip(unit, *_WITHIN)).tolist()),
    )


def _of_ranges(
    domain: Mapping[str, tuple[float, float]], nominal: Plant, surface: Surface, mass: float | None, seed: int
) -> tuple[Plant, ...]:
    """Return corners and samples of the ranges of `plant.yaml`; what was said of surface and payload is exact."""
    ranges = dict(domain)
    if surface.stiffness is not None:
        half = 3.0 * surface.std
        ranges["environment_stiffness_n_per_m"] = (
            max(surface.stiffness - half, 1e-3 * surface.stiffness),
            (surface.stiffness + half),
        )
    if mass is not None:
        ranges["payload_mass_kg"] = mass, mass
    return range_plants(PlantSet(nominal=nominal, ranges=ranges), seed)


def range_plants(plants: PlantSet, seed: int = 0) -> tuple[Plant, ...]:
    """Return the plants at the corners of a set and at samples inside of it, in contact."""
    scenarios: tuple[Scenario, ...] = (*plants.corners(), *plants.samples(DRAWS // 4, seed=seed))
    return tuple(each.plant(plants.nominal) for each in dict.fromkeys(scenarios))


def _number(estimate: Estimate | None) -> float | None:
    """Return the value; the middle of the interval of a damping or mass near 0 where that is all that is shown."""
    if estimate is None:
        return None
    if estimate.value is None and estimate.ci95 is not None:
        return 0.5 * (estimate.ci95[0] + estimate.ci95[1])
    return None if estimate.status is Status.UNIDENTIFIABLE else estimate.value


def _std(estimate: Estimate | None) -> float:
    if estimate is None:
        return 0.0
    if estimate.value is None and estimate.ci95 is not None:
        return 0.25 * (estimate.ci95[1] - estimate.ci95[0])
    return estimate.std or 0.0


def _is_seen(estimate: Estimate) -> bool:
    """Whether a mass differs from none."""
    return (_number(estimate) or 0.0) > _STDS * _std(estimate)


class _Known:
    """What is known of an axis and its surface: numbers by symbol, deviations, and the plant that they make."""

    def __init__(
        self,
        result: Identified,
        name: str,
        axis: AxisEstimate,
        touched: EnvironmentEstimate | None,
        surface: Surface,
        mass: float | None,
    ) -> None:
        self.name, self.axis, self.touched = name, axis, touched
        self.robot = _robot(name, axis)
        weighed = axis.mass_kg if name in ROTATIONAL_AXES else result.payload.mass_kg
        payload = weighed if mass is None else Estimate(value=mass, std=0.0, status=Status.GIVEN)
        late = result.sensor.wrench_filter
        corner = None if late is None else late.corner_hz
        self.estimates: dict[str, Estimate | None] = {
            "K_s": axis.coupling.stiffness_n_per_m,
            "B_s": axis.coupling.damping_n_s_per_m,
            "B_p": axis.drag_n_s_per_m,
            "M_p": payload,
            "T_d": axis.robot.delay_s,
            "theta": None if late is None else late.delay_s,
            "corner": corner,
        }
        self.neglected: tuple[str, ...] = ()
        given = surface.stiffness
        lacking = [symbol for symbol in ("K_s", "M_p", "B_p") if _number(self.estimates[symbol]) is None]
        alone = touched is not None and _number(touched.stiffness_n_per_m) is None
        self.has_payload = not lacking and not alone
        if given is not None:
            self.estimates["K_e"] = Estimate(value=given, std=surface.std, status=Status.GIVEN)
        elif touched is not None:
            of = touched.stiffness_n_per_m if self.has_payload else touched.secant_stiffness_n_per_m
            self.estimates |= {"K_e": of, "B_e": touched.damping_n_s_per_m}
            if not self.has_payload:
                self.estimates["blow"] = touched.impact_n_s_per_m
            elif _is_seen(touched.mass_kg):
                self.estimates["M_e"] = touched.mass_kg
            if _number(of) is None:
                raise EstimateError(f"The stiffness of surface {touched.name} is not identified ({of.note}).")
        if not self.has_payload:
            missing = ", ".join(lacking) or "K_e apart from K_s"
            self.neglected = (
                f"Not known of axis {name}: {missing}. Payload, its drag and the coupling are left out, and the "
                "stiffness is that over robot travel"
                + ("" if _number(self.estimates.get("blow")) else "; a first blow of the masses is not predicted"),
            )

    def value(self, symbol: str, draw: Mapping[str, float]) -> float:
        """Return a parameter, 0 where nothing is known of it, moved by its error in a draw."""
        nominal = max(_number(self.estimates.get(symbol)) or 0.0, 0.0)
        return shifted(symbol, nominal, draw.get(symbol, 0.0))

    def plant(self, draw: Mapping[str, float], period_s: float) -> Plant:
        """Return the plant of a draw of errors by symbol."""
        robot, surface = self._moved_robot(draw), self.value("K_e", draw)
        corner = self.value("corner", draw)
        wrench = WrenchFilter(
            time_constant_s=1.0 / (2.0 * math.pi * corner) if corner > 0.0 else 0.0, delay_s=self.value("theta", draw)
        )
        damping = self.value("B_e", draw)
        if not self.has_payload:
            return series_plant(robot, surface, period_s, damping_n_s_per_m=damping, wrench_filter=wrench)
        return Plant(
            robot=robot,
            coupling=Coupling(stiffness_n_per_m=self.value("K_s", draw), damping_n_s_per_m=self.value("B_s", draw)),
            payload=PayloadDynamics(mass_kg=self.value("M_p", draw), drag_n_s_per_m=self.value("B_p", draw)),
            environment=Environment(
                stiffness_n_per_m=surface, damping_n_s_per_m=damping, mass_kg=self.value("M_e", draw)
            ),
            wrench_filter=wrench,
        )

    def _moved_robot(self, draw: Mapping[str, float]) -> RobotModel:
        own = bandwidth_hz(self.robot)
        delay_s = self.value("T_d", draw)
        faster = math.exp(np.clip(draw.get("omega", 0.0), -_LARGEST_SHARE, _LARGEST_SHARE))
        if not self.has_payload and draw.keys() >= {"omega", "T_d"}:
            faster, delay_s = _of_lag(self.robot, draw["omega"], draw["T_d"])
        changes: dict[str, Any] = {"delay_s": delay_s}
        if "zeta" in draw and has_damping_ratio(self.robot):
            ratio = float(self.robot.denominator[1] / (2.0 * math.sqrt(self.robot.denominator[2])))
            moved = shifted("zeta", ratio, draw["zeta"])
            faster *= bandwidth_share(moved) / bandwidth_share(ratio)
            changes["damping_ratio"] = moved
        if faster != 1.0:
            changes["bandwidth_hz"] = own * faster
        return vary_robot(self.robot, **changes)


def shifted(symbol: str, value: float, error: float) -> float:
    """Return a value moved by an error: by ratios of what is above 0, else not below 0."""
    if symbol not in _POSITIVE:
        return max(value + error, 0.0)
    if value <= 0.0:
        return value
    return value * math.exp(min(max(error / value, -_LARGEST_SHARE), _LARGEST_SHARE))


def _of_lag(robot: RobotModel, faster: float, later_s: float) -> tuple[float, float]:
    """Return factor of ω and delay [s] of a robot whose lag at low frequency is known better than poles and delay.

    To first order the errors of ln ω and T_d change the lag by `later_s` less `faster` times the lag of the poles; that
    lag the robot gets, and of it the poles at most all.
    """
    top, bottom = robot.numerator, robot.denominator
    of_poles = float(bottom[-2] / bottom[-1] - (top[-2] / top[-1] if len(top) > 1 else 0.0))
    lag = max(robot.delay_s + of_poles + later_s - faster * of_poles, _LEAST_LAG * of_poles)
    factor = math.exp(np.clip(faster, -_LARGEST_SHARE, _LARGEST_SHARE))
    delay_s = lag - of_poles / factor
    return (factor, delay_s) if delay_s >= 0.0 else (of_poles / lag, 0.0)


def _robot(name: str, axis: AxisEstimate) -> RobotModel:
    numerator, denominator, delay_s = (
        axis.robot.numerator.value,
        axis.robot.denominator.value,
        _number(axis.robot.delay_s),
    )
    if numerator is None or denominator is None:
        note = axis.robot.numerator.note or axis.robot.bandwidth_hz.note
        because = f" ({note})" if note else ""
        raise EstimateError(
            f"The robot's r(s) on axis {name} is not identified{because}, so no contact can be predicted; record the "
            "position command with a motion, or give r(s) in a plant.yaml."
        )
    return RobotModel(
        numerator=np.array(numerator), denominator=np.array(denominator), delay_s=max(delay_s or 0.0, 0.0)
    )


def _draws(known: _Known, seed: int) -> tuple[dict[str, float], ...]:
    """Return errors by symbol, from the axis's joint covariance and of what is not in it from its own deviation.

    The robot's `omega` is an error of ln ω.
    """
    symbols, matrix = _joint(known)
    varying = [i for i in range(len(symbols)) if matrix[i, i] > 0.0]
    if not varying:
        return ({},)
    part = matrix[np.ix_(varying, varying)]
    deviations = np.sqrt(np.diag(part))
    values, vectors = np.linalg.eigh(part / np.outer(deviations, deviations))
    root = deviations[:, None] * vectors * np.sqrt(np.maximum(values, 0.0))
    unit = sobol_points(len(varying), DRAWS, seed=seed)
    errors = ndtri(np.clip(unit, *_WITHIN)) @ root.T
    return tuple({symbols[i]: float(row[k]) for k, i in enumerate(varying)} for row in errors)


def _joint(known: _Known) -> tuple[list[str], FloatArray]:
    """Return the symbols that vary and their covariance: the fit's, and beside it what has a deviation of its own."""
    stds, places = _deviations(known), _places(known)
    symbols = sorted({*places, *(symbol for symbol, std in stds.items() if std > 0.0)})
    matrix = np.diag([stds.get(symbol, 0.0) ** 2 for symbol in symbols])
    covariance = known.axis.covariance
    if covariance is not None and places:
        rows, own = [symbols.index(symbol) for symbol in places], list(places.values())
        scale = np.array([1.0 / covariance.values[k] if each == "omega" else 1.0 for each, k in places.items()])
        matrix[np.ix_(rows, rows)] = np.array(covariance.matrix)[np.ix_(own, own)] * np.outer(scale, scale)
    for i, symbol in enumerate(symbols):
        # Without a payload poles and delay go together by their lag, and each alone is known less than that.
        if symbol == "T_d" and "T_d" in places and not known.has_payload:
            continue
        # A deviation that was widened since (contacts that differ, logs that disagree) is the one that counts.
        wider = stds.get(symbol, 0.0) / math.sqrt(matrix[i, i]) if matrix[i, i] > 0.0 else 1.0
        if wider > 1.0:
            matrix[i, :] *= wider
            matrix[:, i] *= wider
    return symbols, matrix


def _deviations(known: _Known) -> dict[str, float]:
    """Return standard deviations by symbol, that of ω as a share of it."""
    stds = {symbol: _std(each) for symbol, each in known.estimates.items() if each is not None}
    band = known.axis.robot.bandwidth_hz
    stds["omega"] = _std(band) / band.value if band.value else 0.0
    return stds if known.has_payload else {symbol: std for symbol, std in stds.items() if symbol not in _BEHIND}


def _places(known: _Known) -> dict[str, int]:
    """Return where the axis's covariance holds what is used of it."""
    covariance, touched = known.axis.covariance, known.touched
    found: dict[str, int] = {}
    for place, name in enumerate(() if covariance is None else covariance.names):
        surface, _, symbol = name.rpartition(".")
        estimate = known.estimates.get(symbol)
        if surface and (touched is None or surface != touched.name or not known.has_payload or estimate is None):
            continue
        if estimate is not None and estimate.status is Status.GIVEN:
            continue
        # The payload's mass is that of the rests where there are some, with the deviation that they have.
        if (symbol == "M_p" and estimate is not known.axis.mass_kg) or (symbol in _BEHIND and not known.has_payload):
            continue
        found[symbol] = place
    return found
