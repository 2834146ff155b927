"""What a peak of the sensor's force may be behind the samples that a log holds of it."""

import numpy as np

from problems.arrays import FloatArray

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
_TO_DEVIATION = float(1.4826 / np.sqrt(2.0))


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
    return _TO_DEVIATION * max(float(np.median(step)) for step in steps)


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
