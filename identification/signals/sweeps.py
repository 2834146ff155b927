"""Kernels that go over a long log once, each for an array expression that would go over it many times.

They give the same numbers to the last bit, and let go of the interpreter's lock.
"""

import numpy as np
from numpy.typing import NDArray

from problems.arrays import BoolArray, FloatArray
from problems.compiled import unlocked


def second_differences(values: FloatArray) -> FloatArray:
    """Return |diff(values, n=2)| of (n, k) along its rows, one row (n − 2) per column."""
    found = np.empty((values.shape[1], max(len(values) - 2, 0)))
    _second_differences(values, found)
    return found


@unlocked
def _second_differences(values: FloatArray, found: FloatArray) -> None:
    for k in range(found.shape[0]):
        for i in range(found.shape[1]):
            found[k, i] = abs((values[i + 2, k] - values[i + 1, k]) - (values[i + 1, k] - values[i, k]))


def steps(values: FloatArray, width: int, limits: FloatArray) -> BoolArray:
    """Return where (n − width,) any column of `values` (n, k) changes by more than its limit in `width` rows."""
    found = np.zeros(len(values) - width, dtype=np.bool_)
    _mark_steps(values, width, limits, found)
    return found


@unlocked
def _mark_steps(values: FloatArray, width: int, limits: FloatArray, found: BoolArray) -> None:
    for i in range(found.size):
        for k in range(values.shape[1]):
            if abs(values[i + width, k] - values[i, k]) > limits[k]:
                found[i] = True


@unlocked
def goes_and_returns(values: FloatArray, least: float) -> bool:
    """Return whether any value of (n, k) is away from both neighbours by more than `least`, and these less apart."""
    for i in range(1, values.shape[0] - 1):
        for k in range(values.shape[1]):
            before, after = values[i, k] - values[i - 1, k], values[i, k] - values[i + 1, k]
            smaller = min(abs(before), abs(after))
            if smaller > least and before * after > 0.0 and abs(before - after) < smaller:
                return True
    return False


def turn_between(before: FloatArray, after: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return |w| and |v| of before⁻¹ · after, (n,) each, of quaternions (n, 4)."""
    cosine, sine = np.empty(len(before)), np.empty(len(before))
    _turn_between(before, after, cosine, sine)
    return cosine, sine


@unlocked
def _turn_between(before: FloatArray, after: FloatArray, cosine: FloatArray, sine: FloatArray) -> None:
    for i in range(cosine.size):
        x, y, z, w = before[i, 0], before[i, 1], before[i, 2], before[i, 3]
        a, b, c, d = after[i, 0], after[i, 1], after[i, 2], after[i, 3]
        first = w * a - d * x - y * c + z * b
        second = w * b - d * y - z * a + x * c
        third = w * c - d * z - x * b + y * a
        cosine[i] = abs(w * d + x * a + y * b + z * c)
        sine[i] = np.sqrt(first * first + second * second + third * third)


def normalised(quaternions: FloatArray) -> FloatArray:
    """Return quaternions (n, 4) of norm 1, w not negative."""
    found = np.empty(quaternions.shape)
    _normalise(quaternions, found)
    return found


@unlocked
def _normalise(quaternions: FloatArray, found: FloatArray) -> None:
    for i in range(found.shape[0]):
        x, y, z, w = quaternions[i, 0], quaternions[i, 1], quaternions[i, 2], quaternions[i, 3]
        norm = np.sqrt(x * x + y * y + z * z + w * w)
        sign = -1.0 if w / norm < 0.0 else 1.0
        found[i, 0], found[i, 1], found[i, 2], found[i, 3] = (
            x / norm * sign,
            y / norm * sign,
            z / norm * sign,
            w / norm * sign,
        )


def continuous(quaternions: FloatArray) -> FloatArray:
    """Return quaternions (n, 4) with signs such that neighbours are on the same side."""
    found = np.empty(quaternions.shape)
    _make_continuous(quaternions, found)
    return found


@unlocked
def _make_continuous(quaternions: FloatArray, found: FloatArray) -> None:
    sign = 1.0
    for i in range(found.shape[0]):
        if i:
            along = 0.0
            for k in range(4):
                along += quaternions[i, k] * quaternions[i - 1, k]
            if along < 0.0:
                sign = -sign
        for k in range(4):
            found[i, k] = sign * quaternions[i, k]


def finite_rows(values: FloatArray) -> BoolArray:
    """Return which rows of (n, k) hold finite numbers only."""
    found = np.ones(len(values), dtype=np.bool_)
    _mark_finite(values, found)
    return found


@unlocked
def _mark_finite(values: FloatArray, found: BoolArray) -> None:
    for i in range(found.size):
        for k in range(values.shape[1]):
            found[i] &= np.isfinite(values[i, k])


@unlocked
def are_unit(values: FloatArray, tolerance: float) -> bool:
    """Return whether the last four of (n, 7) have norm 1 in each row, well within a tolerance."""
    low, high = (1.0 - 0.9 * tolerance) ** 2, (1.0 + 0.9 * tolerance) ** 2
    for i in range(values.shape[0]):
        square = 0.0
        for k in range(3, 7):
            square += values[i, k] * values[i, k]
        if not low < square < high:
            return False
    return True


def repeats(values: FloatArray) -> BoolArray:
    """Return which rows (n − 1,) of (n, k) are followed by the same."""
    found = np.empty(max(len(values) - 1, 0), dtype=np.bool_)
    _mark_repeats(values, found)
    return found


@unlocked
def _mark_repeats(values: FloatArray, found: BoolArray) -> None:
    for i in range(found.size):
        is_same = True
        for k in range(values.shape[1]):
            is_same &= values[i + 1, k] == values[i, k]
        found[i] = is_same


def batch_means(values: FloatArray, count: int) -> FloatArray:
    """Return the means (count, k) of batches of (n, k) in a row, with sizes as `array_split` has them."""
    found = np.empty((count, values.shape[1]))
    _batch_means(values, found)
    return found


@unlocked
def _batch_means(values: FloatArray, found: FloatArray) -> None:
    size, rest = divmod(values.shape[0], found.shape[0])
    start = 0
    for batch in range(found.shape[0]):
        stop = start + size + (1 if batch < rest else 0)
        for k in range(found.shape[1]):
            total = 0.0
            for i in range(start, stop):
                total += values[i, k]
            found[batch, k] = total / (stop - start)
        start = stop


@unlocked
def keep_between(
    values: NDArray[np.float64] | NDArray[np.int64],
    low: float,
    high: float,
    near: NDArray[np.float64] | NDArray[np.int64],
    counts: NDArray[np.int64],
) -> None:
    """Fill in `near` with what of (n,) is from `low` to `high`; `counts` (3,): how many are below, between, above."""
    below = between = above = 0
    # Without branches, which nobody could foresee.
    for i in range(values.size):
        value = values[i]
        near[between] = value
        below += value < low
        above += value > high
        between += (value >= low) & (value <= high)
    counts[0], counts[1], counts[2] = below, between, above
