"""What a touch's peak may be behind the samples that a log holds of it, and whether F^d turned round before it."""

import numpy as np
from scipy.integrate import cumulative_trapezoid

from problems.arrays import FloatArray

from .signals import TO_DEVIATION, AxisSignals

_ENTERED_SHARE = 0.1
# Of half sines, triangles, bells and exponentials at any phase, the bounds hold where three samples reach half of the
# largest, and in 55 to 97 of 100 cases where fewer do.
_WIDE_SHARE, _FEWEST_WIDE = 0.5, 3
_CREST_SHARE = 0.9
# A mean over more than this share of the crest would flatten a crest that is no arc.
_BLOCKS_ON_CREST = 8
# The largest of the means over a crest, and the narrowest of the bounds, are picked: two deviations would not do.
_DEVIATIONS = 3.0
_FEWEST_QUIET = 12
# Steps between neighbours do not show noise that changes slowly; those between longer means do.
_WIDER = 2 ** np.arange(6)

_BEFORE_S, _AFTER_S, _LONGEST_S = 0.15, 0.3, 2.0
_FEWEST, _MOST_TRIED = 12, 100
# An admittance whose deadband, filters and lead are not known explains its own travel to this share.
_UNEXPLAINED = 0.02
# What a turn of F^d must explain of what one constant F^d leaves.
_EXPLAINED = 0.5


def bound_peak(
    pressing: FloatArray, onset: int, peak: int, *, quiet: FloatArray | None = None, noise: float = 0.0
) -> tuple[float, float | None, int]:
    """Return the least and largest force that the peak may have, and the samples from a tenth of it to the peak.

    The largest is None where fewer than three samples reach half of the highest one: between them a peak may be of any
    height.

    `pressing` (n,) has its largest sample at `peak`, of a contact whose first sample is `onset`. The peak is the one of
    the force on the sensor without the sensor's noise; that is taken from `quiet` (k,), samples without a contact, or
    is at least `noise`, the deviation of one sample. No mean over neighbours exceeds the peak, so it is no lower than
    the largest mean less three deviations. Between the largest mean and each neighbour a force that bends down (is
    concave) lies below the lines through the two means on either side, extended, and three deviations. Means over 1, 2,
    4, … samples are tried, up to an eighth of the crest: the narrowest bound on each side counts. A line counts only
    where both of its means touch: a contact may begin and end anywhere between two samples.
    """
    highest = float(pressing[peak])
    low = _ENTERED_SHARE * highest
    before = np.flatnonzero(pressing[max(0, onset - 1) : peak] < low)
    rise = peak - (max(0, onset - 1) + int(before[-1])) if before.size else peak - onset
    below = np.asarray(pressing < _CREST_SHARE * highest - _DEVIATIONS * noise)
    entered, left = np.flatnonzero(below[onset:peak]), np.flatnonzero(below[peak:])
    first = onset + int(entered[-1]) + 1 if entered.size else onset
    last = peak + int(left[0]) if left.size else len(pressing)
    lower, upper = [], []
    for block in 2 ** np.arange(max(1, (last - first) // _BLOCKS_ON_CREST).bit_length()):
        means = block_means(pressing[onset:], int(block))
        margin = _DEVIATIONS * max(noise / float(np.sqrt(block)), _deviation(quiet, int(block), last - first))
        begin = max(0, first - onset - int(block) + 1)
        top = begin + int(np.argmax(means[begin : last - onset]))
        lower.append(float(means[top]) - margin)
        upper.append(_largest(means, top, int(block), low) + margin)
    # A mean exceeds its largest sample by rounding alone.
    least = min(max(0.0, *lower), highest)
    most = max(least, min(upper))
    return least, most if _is_wide(pressing, peak) and np.isfinite(most) else None, int(rise)


def _is_wide(pressing: FloatArray, peak: int) -> bool:
    """Return whether three neighbours, the peak among them, reach half of it."""
    low = np.flatnonzero(pressing < _WIDE_SHARE * pressing[peak])
    before, after = low[low < peak], low[low > peak]
    first = int(before[-1]) + 1 if before.size else 0
    last = int(after[0]) if after.size else len(pressing)
    return last - first >= _FEWEST_WIDE


def block_means(values: FloatArray, block: int) -> FloatArray:
    """Return the mean of each `block` neighbours of values (n,), (n - block + 1,)."""
    if block == 1:
        return values
    total = np.concatenate([np.zeros(1), np.cumsum(values)])
    return np.asarray((total[block:] - total[:-block]) / block)


def _deviation(quiet: FloatArray | None, block: int, crest: int) -> float:
    """Return the deviation of a mean over `block` samples: no less than that of a mean over more, up to the crest.

    What changes more slowly than the crest is no noise: before a contact the payload's inertia makes such a force.
    """
    if quiet is None or len(quiet) < max(_FEWEST_QUIET, 4 * block):
        return 0.0
    wider = [each for each in block * _WIDER if each == block or (each <= crest and 4 * each <= len(quiet))]
    steps = [np.abs((means := block_means(quiet, int(each)))[each:] - means[:-each]) for each in wider]
    return TO_DEVIATION * max(float(np.median(step)) for step in steps)


def _largest(means: FloatArray, top: int, block: int, low: float) -> float:
    """Return the bound of lines through the means around the largest one, `top`, `block` samples apart."""

    def mean(steps: int) -> float | None:
        index = top + steps * block
        is_touched = 0 <= index < len(means) and means[index] >= low
        return float(means[index]) if is_touched else None

    return max(_side(float(means[top]), *(mean(step) for step in steps)) for steps in ((1, -1, -2), (-1, 1, 2)))


def _side(highest: float, across: float | None, near: float | None, far: float | None) -> float:
    """Return the bound between the largest sample and its neighbour `near`, behind which is `far`."""
    slope = None if across is None else highest - across
    bend = None
    if near is not None and far is not None and 2.0 * near - far >= highest:
        bend = near - far
    if slope is None:
        return np.inf if bend is None or near is None else near + bend
    if bend is None or near is None:
        return highest + slope
    # highest + w slope = near + (1 - w) bend, w samples away from the largest.
    share = (near + bend - highest) / (slope + bend) if slope + bend > 0.0 else 0.0
    return highest + min(max(share, 0.0), 1.0) * slope


def is_withdrawn(axis: AxisSignals, sign: int, onset: int, peak: int, stop: int) -> bool:
    """Return whether F^d turned away from what is touched before the largest force; False where nothing shows it.

    F^d in the log shows it, else the command of an admittance: M_a dv/dt + B_a v = F^d + F, integrated twice over
    time, is linear in B_a/M_a, 1/M_a, F^d/M_a and its step, so that least squares show the step and, by trial of every
    instant, when.

    Parameters
    ----------
    axis
        Force [N] and command [m] of the axis.
    sign
        +1 where the payload presses towards +axis.
    onset, peak, stop
        The samples of the first and of the largest force, and the one behind the last.

    """
    desired = axis.desired_n[max(0, onset - 1) : peak + 1]
    if np.any(desired[:1] * desired < 0.0):
        return True
    if axis.commanded_m is None or stop >= len(axis.time_s) - 1:
        return False
    first = int(np.searchsorted(axis.time_s, axis.time_s[onset] - _BEFORE_S))
    last = min(
        int(np.searchsorted(axis.time_s, axis.time_s[stop] + _AFTER_S)),
        int(np.searchsorted(axis.time_s, axis.time_s[onset] + _LONGEST_S)),
    )
    if onset - first < 3 or last - first < _FEWEST or last <= stop:
        return False
    used = slice(first, last)
    turned_at = _turn(axis.time_s[used], sign * axis.commanded_m[used], -sign * axis.force_n[used])
    # A stiff robot lets the force fall in the very sample in which F^d turns.
    open_s = axis.period_s * max(1, (last - first) // _MOST_TRIED)
    return turned_at is not None and bool(turned_at <= axis.time_s[peak] + open_s)


def _turn(time: FloatArray, command: FloatArray, pressing: FloatArray) -> float | None:
    """Return when F^d of an admittance turned away from the touch [s], None where it did not."""
    since, travel = time - time[0], command - command[0]
    if not (np.all(np.isfinite(travel)) and travel[-1] < travel[-2] and travel[1] > 0.0):
        return None
    # v_0, B_a/M_a, 1/M_a and F^d/M_a; the travel alone is never differentiated.
    known = np.column_stack(
        [since, -_integral(travel, time), -_integral(_integral(pressing, time), time), 0.5 * since**2]
    )
    constant = _left(known, travel)[0]
    tried = [
        (*_left(np.column_stack([known, 0.5 * np.maximum(time - at, 0.0) ** 2]), travel), float(at))
        for at in time[1 : -1 : max(1, len(time) // _MOST_TRIED)]
    ]
    left, (_, damping, compliance, before, step), at = min(tried, key=lambda each: each[0])
    is_admittance = damping > 0.0 and compliance > 0.0 and left <= _UNEXPLAINED * float(np.ptp(travel))
    return at if is_admittance and before > 0.0 > before + step and left <= _EXPLAINED * constant else None


def _integral(values: FloatArray, time: FloatArray) -> FloatArray:
    return np.asarray(cumulative_trapezoid(values, time, initial=0.0))


def _left(columns: FloatArray, travel: FloatArray) -> tuple[float, FloatArray]:
    """Return the deviation that least squares leave of a travel (n,), and the factors of the columns (n, k)."""
    scale = np.linalg.norm(columns, axis=0)
    scale[scale == 0.0] = 1.0
    factors = np.linalg.lstsq(columns / scale, travel, rcond=None)[0] / scale
    return float(np.std(travel - columns @ factors)), np.asarray(factors)
