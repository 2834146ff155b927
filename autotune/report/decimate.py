"""Fewer points for a picture, so that no peak is lost."""

from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.floating[Any]]

MOST_POINTS = 2800
"""Of a curve, as many as any drawing of it holds."""


def decimate(x: FloatArray, y: FloatArray, most: int) -> tuple[FloatArray, FloatArray]:
    """Return at most `most` points of a curve over rising x (n,), with the smallest and largest y of every stretch.

    Of each of most/2 stretches of as many points, the point where y is smallest and the one where it is largest are
    kept in their order; where a stretch has a NaN, the curve stays broken there. The first and the last x are kept.
    """
    if len(x) <= most or most < 4:
        return x, y
    count = (most - 2) // 2
    edges = np.linspace(1, len(x) - 1, count + 1).astype(np.int64)
    kept = np.empty(2 * count + 2, dtype=np.int64)
    kept[0], kept[-1] = 0, len(x) - 1
    for i, (low, high) in enumerate(pairwise(edges.tolist())):
        part = y[low:high]
        broken = np.isnan(part)
        if broken.any():
            # One number that is none, and the largest of the others, so that a gap neither closes nor hides a peak.
            best = int(np.nanargmax(np.abs(part))) if not broken.all() else 0
            pair = (int(np.argmax(broken)), best)
        else:
            pair = (int(np.argmin(part)), int(np.argmax(part)))
        kept[2 * i + 1], kept[2 * i + 2] = low + min(pair), low + max(pair)
    kept = np.unique(kept)
    return x[kept], y[kept]
