"""Verdicts on estimates from a value and its standard deviation, and the scatter of several."""

from dataclasses import replace

import numpy as np

from problems.arrays import FloatArray

from .result import AxisEstimate, CouplingEstimate, Estimate, Finding, RobotEstimate, Status, VectorEstimate

IDENTIFIED_SHARE = 0.05
WEAK_SHARE = 0.2
_BOUND_SHARE = 0.25
TWO_SIDED = 1.96
# The share to which a cell repeats from one recording to the next: less scatter than this is no disagreement.
_REPEATABILITY = 0.0005
_HALVINGS = 100


def judged(
    value: float,
    std: float,
    *,
    method: str,
    note: str = "",
    identified: float = IDENTIFIED_SHARE,
    weak: float = WEAK_SHARE,
    floor: float = 0.0,
    ci95: tuple[float, float] | None = None,
) -> Estimate:
    """Return an estimate whose status follows from std over value; nothing is claimed above `weak`'s limit.

    `floor` is a size below which the value itself does not matter (a damping near zero is not badly known).
    """
    size = max(abs(value), floor)
    share = std / size if size > 0.0 and np.isfinite(std) else np.inf
    if share <= max(weak, identified):
        status = Status.IDENTIFIED if share <= identified else Status.WEAK
        return Estimate(value=float(value), std=float(std), status=status, method=method, note=note, ci95=ci95)
    spread = f"standard deviation {std:.3g} for a value of {value:.3g}"
    return unidentifiable(method=method, note=f"{note}; {spread}" if note else spread)


def judged_damping(
    value: float, std: float, floor: float, *, method: str, ci95: tuple[float, float] | None = None
) -> Estimate:
    """Return the verdict on a damping: the value itself as any other, else an interval where that says enough.

    A damping near zero is not identified to a share of itself, though it may be known well beside `floor`, a size that
    matters: up to a deviation of a quarter of it the 95 % interval is stated, without a value.
    """
    estimate = judged(value, std, method=method, ci95=ci95)
    if estimate.status is not Status.UNIDENTIFIABLE or not std <= _BOUND_SHARE * floor:
        return estimate
    interval = (max(value - TWO_SIDED * std, 0.0), max(value, 0.0) + TWO_SIDED * std) if ci95 is None else ci95
    return replace(estimate, ci95=interval)


# The note of a payload's mass in a log without its weight.
MASS_THAT_MOVES = "what moves behind the sensor, from acceleration; the weight was removed before recording"


def weak_at_best(estimate: Estimate, why: str) -> Estimate:
    """Return the estimate, `weak` with the reason where it was `identified`."""
    if estimate.status is not Status.IDENTIFIED:
        return estimate
    return replace(estimate, status=Status.WEAK, note=f"{estimate.note}; {why}" if estimate.note else why)


def unidentifiable(*, method: str = "", note: str = "") -> Estimate:
    """Return a parameter about which the log says nothing."""
    return Estimate(value=None, std=None, status=Status.UNIDENTIFIABLE, method=method, note=note)


def vector(values: FloatArray, stds: FloatArray, *, method: str, status: Status = Status.IDENTIFIED) -> VectorEstimate:
    """Return a vector parameter with its standard deviations."""
    return VectorEstimate(
        value=tuple(float(v) for v in values), std=tuple(float(s) for s in stds), status=status, method=method
    )


def unidentifiable_robot(note: str) -> RobotEstimate:
    """Return a robot about which the log says nothing."""
    vector_of, number = unidentifiable_vector(note), unidentifiable(note=note)
    return RobotEstimate(numerator=vector_of, denominator=vector_of, delay_s=number, bandwidth_hz=number)


def without_coupling(robot: RobotEstimate, note: str) -> AxisEstimate:
    """Return an axis about which the log says nothing but what it shows of the robot."""
    none = unidentifiable(note=note)
    return AxisEstimate(
        coupling=CouplingEstimate(stiffness_n_per_m=none, damping_n_s_per_m=none),
        drag_n_s_per_m=none,
        environments=(),
        robot=robot,
    )


def unidentifiable_vector(note: str) -> VectorEstimate:
    """Return a vector about which the log says nothing."""
    return VectorEstimate(value=None, std=None, status=Status.UNIDENTIFIABLE, note=note)


def missing(code: str, message: str, advice: str = "") -> Finding:
    """Return the finding that a parameter which a controller needs is not identified."""
    return Finding(code=code, severity="error", message=message, advice=advice)


def scatter(values: FloatArray, noise: FloatArray) -> tuple[float, float]:
    """Return χ² of values (n,) about their weighted mean, and the variance τ² that they have beyond their noise.

    With τ² in each of them χ² is n − 1 (Paule and Mandel 1982); it is 0 where the noise alone explains the scatter.
    Noise below what a cell repeats to counts as that.
    """
    noise = np.maximum(noise, np.maximum(_REPEATABILITY * np.abs(values), 1e-300))
    freedom, square = len(values) - 1, _chi_square(values, noise, 0.0)
    if square <= freedom:
        return square, 0.0
    low, high = 0.0, float(np.ptp(values)) ** 2
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if _chi_square(values, noise, middle) > freedom else (low, middle)
    return square, high


def _chi_square(values: FloatArray, noise: FloatArray, beyond: float) -> float:
    weights = 1.0 / (noise**2 + beyond)
    mean = float(np.sum(weights * values) / np.sum(weights))
    return float(np.sum(weights * (values - mean) ** 2))
