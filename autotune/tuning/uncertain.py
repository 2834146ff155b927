"""What of the plant is uncertain beyond K_e and M_p: ranges that were said, and the confidence set of the identified.

Where nothing is said, K_s, B_s, B_p, T_d and the robot's bandwidth take the joint confidence set of `identified.yaml`,
and B_e takes everything from none to the upper end of what was identified.
"""

import math
from collections.abc import Iterator, Mapping
from dataclasses import replace

import numpy as np

from autotune.formats.problem import Interval, Uncertain
from autotune.formats.units import ROTATIONAL_AXES, axis_key
from identification.errors import EstimateError
from identification.measured_response import MeasuredResponse
from identification.result import RESPONSE_DIFFERS, AxisEstimate, Covariance, Estimate, Identified, Status
from problems.arrays import ComplexArray, FloatArray
from problems.design.problem import DesignProblem
from problems.design.requirements import MultiplicativeError
from problems.design.uncertainty import ENVIRONMENT_MASS, FURTHER_UNCERTAIN, SYMBOLS, Ellipsoid
from problems.model.plant import FREE_SPACE
from problems.model.plant_parameters import PARAMETERS, with_values
from problems.model.response import plant_response
from problems.model.robot import bandwidth_share, has_damping_ratio
from problems.model.sampled import build_sampled_plant

LEVEL = 0.95
# The symbols of identification's covariance: a robot's are those of its poles.
_SYMBOLS = {
    name: {"robot_bandwidth_hz": "omega", "robot_damping_ratio": "zeta"}.get(name, SYMBOLS[name])
    for name in FURTHER_UNCERTAIN
    if PARAMETERS[name].part in {"coupling", "payload", "robot"}
}
_WALL_DAMPING = "environment_damping_n_s_per_m"
# Standard deviations to the upper end of a damping that has no covariance: one side of 95 % and more.
_DEVIATIONS = 2.0
# However little the log holds, a stiffness stays positive.
_LEAST_SHARE = 1e-3
_DIGITS = 5
# Of a deviation: what was written and read again is the same number.
_SAME = 0.01
_STEP = 1e-6

_NAME = "multiplicative_error"
# Of the circles of 95 %, and of the response: what lies within is the parameters' own uncertainty.
_CIRCLES, _SMALL_SHARE = 1.54, 0.03
_ERROR_DIGITS = 3


def with_uncertainty(problem: DesignProblem, axis: AxisEstimate, name: str, said: Uncertain) -> DesignProblem:
    """Return the problem with the ranges that were said and the confidence set of what is identified.

    A nominal value outside of a range that was said moves to its nearer end. Raises EstimateError for `identified`
    where the file holds no covariance of it.
    """
    origins = {key: value for key, value in said.items() if isinstance(value, str)}
    ranges = {key: value for key, value in said.items() if not isinstance(value, str)}
    problem = _moved(problem, ranges)
    asked = [key for key in _SYMBOLS if origins.get(key) == "identified"]
    by_default = [key for key in _SYMBOLS if key not in said]
    ellipsoid = _ellipsoid(problem, axis, name, asked, by_default)
    if origins.get(_WALL_DAMPING) == "identified":
        ranges[_WALL_DAMPING] = _environment_damping(axis, name)
        problem = _moved(problem, ranges)
    if origins.get(ENVIRONMENT_MASS) == "identified":
        ranges[ENVIRONMENT_MASS] = _environment_mass(axis, name)
        problem = _moved(problem, ranges)
    if _WALL_DAMPING not in said and (largest := _largest_environment_damping(axis)) > 0.0:
        # Less damping is mostly the harder case, but not always; another surface than those of the log may have none.
        ranges[_WALL_DAMPING] = (0.0, largest)
    if ellipsoid is not None:
        ranges |= {key: _readable(key, ellipsoid, i) for i, key in enumerate(ellipsoid.names)}
    return replace(problem, plants=replace(problem.plants.with_ranges(ranges), ellipsoid=ellipsoid))


def _moved(problem: DesignProblem, ranges: Mapping[str, Interval]) -> DesignProblem:
    """Return the problem with its nominal values inside the ranges."""
    nominal = {ENVIRONMENT_MASS: problem.plants.nominal.environment.mass_kg, **problem.plants.nominal_values()}
    inside = {key: min(max(nominal[key], low), high) for key, (low, high) in ranges.items() if key in nominal}
    return replace(problem, plants=replace(problem.plants, nominal=with_values(problem.plants.nominal, inside)))


def _ellipsoid(
    problem: DesignProblem, axis: AxisEstimate, name: str, asked: list[str], by_default: list[str]
) -> Ellipsoid | None:
    """Return the joint confidence set of the parameters, around the problem's nominal values; None without any."""
    known, matrix = _known(problem, axis)
    for key in asked:
        if key not in known:
            where = f"axes.{name}.covariance"
            why = (
                f"{where} is not in it; identify the log again with this release, or give a range [low, high]."
                if axis.covariance is None
                else f"{where} says nothing of it; give a range [low, high], or {{from: nominal}}."
            )
            raise EstimateError(f"problem.yaml takes {key} from the identified file, and {why}")
    nominal = problem.plants.nominal_values()
    chosen = [
        key
        for i, key in enumerate(known)
        if (key in asked or key in by_default)
        and key in nominal
        and matrix[i, i] > 0.0
        and (PARAMETERS[key].may_be_zero or nominal[key] > 0.0)
    ]
    if not chosen:
        return None
    places = [known.index(key) for key in chosen]
    part = matrix[np.ix_(places, places)]
    return Ellipsoid(
        names=tuple(chosen),
        centre=tuple(nominal[key] for key in chosen),
        covariance=tuple(tuple(row) for row in (0.5 * (part + part.T)).tolist()),
        level=LEVEL,
    )


def _known(problem: DesignProblem, axis: AxisEstimate) -> tuple[list[str], FloatArray]:
    """Return what is known with its covariance: the log's, and of what is given the variance that was given with it.

    A prior that took part in the fit is in the log's covariance. One that did not, or a value that was corrected by
    hand, is known to whoever gave it, independently of the log; without a deviation it is exact.
    """
    known, fitted = ([], np.zeros((0, 0))) if axis.covariance is None else _transformed(problem, axis.covariance)
    given = {key: e.std or 0.0 for key, e in axis.plant_estimates().items() if _is_given(e)}
    if given.get("robot_bandwidth_hz") == 0.0:
        # The damping ratio is known together with the bandwidth.
        given["robot_damping_ratio"] = 0.0
    in_fit = {key for key in given if key in known and _is_in_fit(axis, key, given[key])}
    keys = [key for key in _SYMBOLS if key in known or key in given]
    matrix = np.zeros((len(keys), len(keys)))
    theirs = [key for key in known if key not in given or key in in_fit]
    places, own = [keys.index(key) for key in theirs], [known.index(key) for key in theirs]
    matrix[np.ix_(places, places)] = fitted[np.ix_(own, own)]
    for key in given.keys() - in_fit:
        matrix[keys.index(key), keys.index(key)] = given[key] ** 2
    return keys, matrix


def _is_in_fit(axis: AxisEstimate, key: str, std: float) -> bool:
    """Whether the covariance has a given value and its deviation: what was given took part in the fit."""
    covariance, estimate = axis.covariance, axis.plant_estimates().get(key)
    if covariance is None or estimate is None or estimate.value is None or std == 0.0:
        return False
    place = covariance.names.index(_SYMBOLS[key])
    fitted = math.sqrt(max(covariance.matrix[place][place], 0.0))
    return abs(covariance.values[place] - estimate.value) <= _SAME * std and abs(fitted - std) <= _SAME * std


def _is_given(estimate: Estimate) -> bool:
    return estimate.status is Status.GIVEN


def _transformed(problem: DesignProblem, covariance: Covariance) -> tuple[list[str], FloatArray]:
    """Return the covariance under this floor's names, ω (and ζ) of the robot made into its bandwidth in Hz."""
    two_poles = has_damping_ratio(problem.plants.nominal.robot) and "zeta" in covariance.names
    keys = [
        key
        for key, symbol in _SYMBOLS.items()
        if symbol in covariance.names and (key != "robot_damping_ratio" or two_poles)
    ]
    places = [covariance.names.index(_SYMBOLS[key]) for key in keys]
    matrix = np.array(covariance.matrix)[np.ix_(places, places)]
    jacobian = np.eye(len(keys))
    if "robot_bandwidth_hz" in keys:
        row = keys.index("robot_bandwidth_hz")
        values = dict(zip(covariance.names, covariance.values, strict=True))
        share, turned = 1.0, 0.0
        if two_poles:
            ratio = values["zeta"]
            share = bandwidth_share(ratio)
            turned = (bandwidth_share(ratio + _STEP) - bandwidth_share(ratio - _STEP)) / (2.0 * _STEP)
            jacobian[row, keys.index("robot_damping_ratio")] = values["omega"] * turned / (2.0 * math.pi)
        jacobian[row, row] = share / (2.0 * math.pi)
    return keys, jacobian @ matrix @ jacobian.T


def _environment_damping(axis: AxisEstimate, name: str) -> Interval:
    """Return the range that holds B_e of every surface with its confidence."""
    found = []
    for surface in axis.environments:
        symbol = f"{surface.name}.B_e"
        if axis.covariance is None or symbol not in axis.covariance.names:
            key = axis_key(name, _WALL_DAMPING)
            raise EstimateError(
                f"problem.yaml takes {key} from the identified "
                f"file, and axes.{name}.covariance says nothing of {symbol}; give a range [low, high]."
            )
        found.append(_within(axis.covariance, symbol))
    if not found:
        raise EstimateError(f"Axis {name} has no identified environment, so there is no damping of it to take.")
    return min(low for low, _ in found), max(high for _, high in found)


def _environment_mass(axis: AxisEstimate, name: str) -> Interval:
    """Return the range that holds M_e of every surface with its deviation: from 0 where one of them has none."""
    found = [(each.mass_kg.value, each.mass_kg.std or 0.0) for each in axis.environments]
    known = [(value, std) for value, std in found if value is not None]
    if not known:
        key = axis_key(name, ENVIRONMENT_MASS)
        raise EstimateError(
            f"problem.yaml takes {key} from the identified file, and no surface of axis {name} has a mass there; give "
            "a range [low, high]."
        )
    low = min(max(value - _DEVIATIONS * std, 0.0) for value, std in known) if len(known) == len(found) else 0.0
    return _digits(low, down=True), _digits(max(value + _DEVIATIONS * std for value, std in known), down=False)


def _within(covariance: Covariance, symbol: str) -> Interval:
    """Return the confidence range of one surface's B_e."""
    place = covariance.names.index(symbol)
    alone = Ellipsoid(
        names=(_WALL_DAMPING,),
        centre=(max(covariance.values[place], 0.0),),
        covariance=((covariance.matrix[place][place],),),
        level=LEVEL,
    )
    return _readable(_WALL_DAMPING, alone, 0)


def _largest_environment_damping(axis: AxisEstimate) -> float:
    """Return the upper end of B_e over all surfaces, 0 where none is known.

    As for the rest of the plant, an identified value speaks of its deviation by the axis's covariance.
    """
    ends = [0.0]
    for surface in axis.environments:
        estimate, symbol = surface.damping_n_s_per_m, f"{surface.name}.B_e"
        if estimate.status is Status.UNIDENTIFIABLE or (axis.covariance is None and not _is_given(estimate)):
            continue
        if estimate.ci95 is not None:
            ends.append(_digits(max(estimate.ci95[1], 0.0), down=False))
        if estimate.value is None:
            continue
        ends.append(_digits(max(estimate.value + _DEVIATIONS * (estimate.std or 0.0), 0.0), down=False))
        if axis.covariance is not None and symbol in axis.covariance.names and not _is_given(estimate):
            place = axis.covariance.names.index(symbol)
            if axis.covariance.matrix[place][place] > 0.0:
                ends.append(_within(axis.covariance, symbol)[1])
    return max(ends)


def _readable(key: str, ellipsoid: Ellipsoid, place: int) -> Interval:
    """Return the ellipsoid's range of one parameter with five digits, outwards."""
    low, high = ellipsoid.box()[key]
    if not PARAMETERS[key].may_be_zero:
        low = max(low, _LEAST_SHARE * ellipsoid.centre[place])
    return _digits(low, down=True), _digits(high, down=False)


def _digits(value: float, *, down: bool) -> float:
    if value == 0.0:
        return 0.0
    exponent = math.floor(math.log10(value)) - _DIGITS + 1
    whole = value / 10.0**exponent
    return float(f"{math.floor(whole) if down else math.ceil(whole)}e{exponent}")


def with_measured_error(identified: Identified, problems: Mapping[str, DesignProblem]) -> dict[str, DesignProblem]:
    """Return the problems with the modulus margin asked beside the measured error of the straight axes.

    Only where identification found that model and measurement differ, nobody says a `multiplicative_error` and a
    modulus margin is asked. Straight axes share their requirements, so each is asked for the error of all of them. One
    without points asks for nothing: so it is declined.
    """
    straight = {name: each for name, each in problems.items() if name not in ROTATIONAL_AXES}
    points = _joined([row for name, each in straight.items() for row in _error(identified, name, each)])
    changed = dict(problems)
    for name, each in straight.items():
        said, modulus = each.requirements.multiplicative_error, each.requirements.modulus_margin
        error = said
        if said is None and points and modulus is not None:
            error = MultiplicativeError(min_modulus=modulus, points=points)
        elif said is not None and not said.points:
            error = None
        if error != said:
            changed[name] = replace(each, requirements=each.requirements.with_asked(_NAME, error))
    return changed


def _error(identified: Identified, name: str, problem: DesignProblem) -> Iterator[tuple[float, float]]:
    """Yield frequency [Hz] and (|F_measured − F| + radius)/|F| where that is beyond the circle; F is of free space."""
    response = identified.axes[name].frequency_response
    measured = None if response is None else response.command_to_force
    if measured is None or not any(f.code == RESPONSE_DIFFERS and f.axis == name for f in identified.findings):
        return
    h = problem.sample_time_s
    below = measured.frequency_hz < 0.5 / h
    frequency, size = measured.frequency_hz[below], _modelled(problem, measured)[below]
    apart, radius = np.abs(measured.values[below] - size), measured.radius_95[below]
    for f, modelled, difference, circle in zip(frequency, np.abs(size), apart, radius, strict=True):
        if difference > _CIRCLES * circle + _SMALL_SHARE * modelled:
            yield float(f), float(f"{(difference + circle) / modelled:.{_ERROR_DIGITS}g}")


def _modelled(problem: DesignProblem, measured: MeasuredResponse) -> ComplexArray:
    """Return command → force (k,) of the identified plant, without hold and filter as it was measured."""
    plant, h = problem.plants.nominal.in_contact_with(FREE_SPACE), problem.sample_time_s
    omega = 2.0 * np.pi * measured.frequency_hz
    hold = -np.expm1(-1j * omega * h) / (1j * omega * h)
    return np.asarray(
        plant_response(build_sampled_plant(plant, h), omega).force / (plant.wrench_filter.response(omega) * hold)
    )


def _joined(points: list[tuple[float, float]]) -> tuple[tuple[float, float], ...]:
    """Return the largest error of each frequency, by frequency."""
    largest: dict[float, float] = {}
    for frequency, share in points:
        largest[frequency] = max(share, largest.get(frequency, 0.0))
    return tuple(sorted(largest.items()))
