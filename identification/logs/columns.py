"""What the values of a column look like: a time, a unit quaternion, poses at rest, a smooth travel."""

import numpy as np

from problems.arrays import FloatArray

_LEAP_SHARE = 0.05
_NORM_TOLERANCE = 2e-3


def path_length(values: FloatArray) -> float:
    """Return how often a signal goes its whole range: noise and what rings do so many times."""
    return float(np.sum(np.abs(np.diff(values)))) / max(float(np.ptp(values)), 1e-300)


def unevenness(values: FloatArray) -> float:
    """Return the deviation of the steps of a column (n,) over their mean."""
    steps = np.diff(values)
    return float(np.std(steps) / np.mean(steps))


def rises(values: FloatArray) -> bool:
    """Return whether a column (n,) is known throughout and never falls."""
    steps = np.diff(values)
    return bool(np.all(np.isfinite(values)) and np.all(steps >= 0.0) and values[-1] > values[0])


def is_unit(four: FloatArray) -> bool:
    """Return whether every row of four columns (n, 4) has the norm 1."""
    return bool(np.all(np.abs(np.linalg.norm(four, axis=1) - 1.0) < _NORM_TOLERANCE))


def leaps(values: FloatArray) -> bool:
    """Return whether columns (n, k) go far from row to row, as of poses at rest that were averaged."""
    moved = np.ptp(values, axis=0)
    steps = np.median(np.abs(np.diff(values, axis=0)), axis=0)
    return bool(np.median(steps[moved > 0.0] / moved[moved > 0.0]) > _LEAP_SHARE) if np.any(moved > 0.0) else False
