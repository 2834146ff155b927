"""What a peak may be between the samples that a log holds of it."""

import numpy as np

from problems.arrays import FloatArray

_ENTERED_SHARE = 0.1
_LARGEST_SHARE = 2.0


def bound_peak(pressing: FloatArray, onset: int, peak: int) -> tuple[float, float, int]:
    """Return the least and largest force that the peak may have, and the samples from a tenth of it to the peak.

    `pressing` (n,) has its largest sample at `peak`, of a contact whose first sample is `onset`. The peak is no lower
    than that sample. Between it and each neighbour a force that bends down (is concave) lies below the lines through
    the two samples on either side, extended. A line counts only where both of its samples touch: a contact may begin
    and end anywhere between two samples. Where lines leave it open the peak is taken to be at most twice its sample.
    """
    highest = float(pressing[peak])
    low = _ENTERED_SHARE * highest
    before = np.flatnonzero(pressing[max(0, onset - 1) : peak] < low)
    rise = peak - (max(0, onset - 1) + int(before[-1])) if before.size else peak - onset

    def sample(index: int) -> float | None:
        is_touched = onset <= index < len(pressing) and pressing[index] >= low
        return float(pressing[index]) if is_touched else None

    sides = [_side(highest, *(sample(peak + step) for step in steps)) for steps in ((1, -1, -2), (-1, 1, 2))]
    return highest, min(max(sides), _LARGEST_SHARE * highest), int(rise)


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
