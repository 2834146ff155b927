"""From identified parameters and wishes to one design problem per axis."""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from autotune.errors import UsageError
from autotune.files.problem import ProblemSpec
from identification.errors import EstimateError
from identification.result import AxisEstimate, Estimate, Identified, Status, VectorEstimate
from problems.contact import Approach
from problems.design import DesignProblem
from problems.plant import Coupling
from problems.robot import RobotModel

Interval = tuple[float, float]

# The default range of a parameter: what the log allows, and not less than a cell changes from day to day.
_STDS = 3.0
_LEAST_STIFFNESS_SHARE = 0.2
_LEAST_MASS_SHARE = 0.02
_DEFAULT_APPROACH_N = 30.0


@dataclass(frozen=True, kw_only=True)
class Wishes:
    """What the command line adds to `problem.yaml`; None where nothing was said."""

    payload_mass_kg: Interval | None = None
    environment_stiffness_n_per_m: Interval | None = None


def build_problems(identified: Identified, spec: ProblemSpec, wishes: Wishes) -> dict[str, DesignProblem]:
    """Return a design problem for every axis that the log identified (or for the one that `spec` names).

    The command line wins over `problem.yaml`, and that over the identified value with its uncertainty. Raises
    UsageError for an axis that is not there, EstimateError for a parameter that is missing and was not given.
    """
    if not identified.axes:
        raise EstimateError("The identified file holds no axis, so there is nothing to tune.")
    names = list(identified.axes) if spec.axis is None else [spec.axis]
    unknown = [name for name in names if name not in identified.axes]
    if unknown:
        raise UsageError(f"Axis {unknown[0]} is not in the identified file; it holds {', '.join(identified.axes)}.")
    rotational = [name for name in names if name.startswith("r")]
    if rotational:
        raise UsageError(
            f"Axis {rotational[0]} is rotational, which this release does not tune; name a translational one in "
            "problem.yaml."
        )
    return {name: _build_problem(identified, name, spec, wishes) for name in names}


def runtime_mass_kg(identified: Identified, certified: Interval) -> float:
    """Return the mass that the runtime's gravity compensation takes: one that the certificate holds for.

    The identified mass where the range holds it, else the one mass that was asked for. Raises UsageError for a range
    that leaves the identified mass out: nobody could say which weight to compensate.
    """
    mass = _value(identified.payload.mass_kg, "payload.mass_kg")
    low, high = certified
    if low <= mass <= high:
        return mass
    if low == high:
        return low
    raise UsageError(
        f"The payload range {low:g} to {high:g} kg leaves out the identified payload of {mass:.4g} kg, so the weight "
        "compensate is not known; widen the range, or name the one mass that the cell will carry."
    )


def _build_problem(identified: Identified, name: str, spec: ProblemSpec, wishes: Wishes) -> DesignProblem:
    axis = identified.axes[name]
    stiffness = wishes.environment_stiffness_n_per_m or spec.environment_stiffness_n_per_m
    mass = wishes.payload_mass_kg or spec.payload_mass_kg
    return DesignProblem(
        robot=_robot(axis, name),
        coupling=Coupling(
            stiffness_n_per_m=_value(axis.coupling.stiffness_n_per_m, f"axes.{name}.coupling.stiffness_n_per_m"),
            damping_n_s_per_m=max(
                _value(axis.coupling.damping_n_s_per_m, f"axes.{name}.coupling.damping_n_s_per_m"), 0.0
            ),
        ),
        drag_n_s_per_m=max(_value(axis.drag_n_s_per_m, f"axes.{name}.drag_n_s_per_m"), 0.0),
        environment_stiffness_n_per_m=stiffness or _stiffness_range(axis, name),
        payload_mass_kg=mass or _range(identified.payload.mass_kg, "payload.mass_kg", _LEAST_MASS_SHARE),
        sample_time_s=_value(identified.sample_time_s, "sample_time_s"),
        approach=spec.approach or Approach(force_n=_DEFAULT_APPROACH_N),
        bounds=spec.bounds,
        requirements=spec.requirements,
        objective=spec.objective,
    )


def _robot(axis: AxisEstimate, name: str) -> RobotModel:
    return RobotModel(
        numerator=_vector(axis.robot.numerator, f"axes.{name}.robot.numerator"),
        denominator=_vector(axis.robot.denominator, f"axes.{name}.robot.denominator"),
        delay_s=_value(axis.robot.delay_s, f"axes.{name}.robot.delay_s"),
    )


def _stiffness_range(axis: AxisEstimate, name: str) -> Interval:
    if not axis.environments:
        raise EstimateError(
            f"Axis {name} has no identified environment; record contacts, or say --environment-stiffness LO:HI."
        )
    ranges = [
        _range(e.stiffness_n_per_m, f"axes.{name}.environments[{e.name}].stiffness_n_per_m", _LEAST_STIFFNESS_SHARE)
        for e in axis.environments
    ]
    return min(low for low, _ in ranges), max(high for _, high in ranges)


def _range(estimate: Estimate, where: str, least_share: float) -> Interval:
    value = _value(estimate, where)
    half = max(_STDS * (estimate.std or 0.0), least_share * value)
    return _rounded(max(value - half, 1e-3 * value), math.floor), _rounded(value + half, math.ceil)


def _rounded(value: float, towards: Callable[[float], int]) -> float:
    """Return the value with three digits, rounded outwards: a domain that people can read and compare."""
    unit = 10.0 ** (math.floor(math.log10(value)) - 2)
    # Dividing by the reciprocal keeps 0.1 at 0.1; a power of ten below one is not exact.
    return towards(value / unit) * unit if unit >= 1.0 else towards(value / unit) / round(1.0 / unit)


def _value(estimate: Estimate, where: str) -> float:
    if estimate.value is None or estimate.status is Status.UNIDENTIFIABLE:
        raise EstimateError(_absent(where, estimate.note))
    return estimate.value


def _vector(estimate: VectorEstimate, where: str) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    if estimate.value is None:
        raise EstimateError(_absent(where, estimate.note))
    return np.array(estimate.value)


def _absent(where: str, note: str) -> str:
    told = f" ({note})" if note else ""
    return f"{where} is not identified{told}, and no controller is tuned on a guess; record what is missing."
