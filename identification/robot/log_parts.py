"""What differs between the parts of one log: the gain and the lag of a predicted velocity."""

from dataclasses import dataclass

import numpy as np

from problems.arrays import FloatArray

from ..verdicts import scatter

_PART_S, _MOST_PARTS, _BLOCK_S = 5.0, 12, 1.0
_FEWEST_BLOCKS = 3
# A part with less of the motion's energy than this share of the usual says more of what else goes on.
_INFORMATIVE_SHARE = 0.2


@dataclass(frozen=True, kw_only=True)
class PartSpread:
    """Standard deviations between parts of a log beyond their noise, 0 without two parts with enough motion."""

    gain: float
    lag_s: float


def spread_of_parts(moved: FloatArray, predicted: FloatArray, time_s: FloatArray) -> PartSpread:
    """Fit moved = g predicted − δ d(predicted)/dt to each part of 5 s or more; arrays (n,), time increasing.

    The noise of g and δ comes from the scores of blocks of a second within each part.
    """
    count = min(int((time_s[-1] - time_s[0]) / _PART_S), _MOST_PARTS)
    if count < 2:
        return PartSpread(gain=0.0, lag_s=0.0)
    columns = np.column_stack([predicted, -np.gradient(predicted, time_s)])
    edges = np.searchsorted(time_s, np.linspace(time_s[0], time_s[-1], count + 1)[1:-1])
    parts = list(
        zip(np.split(columns, edges), np.split(moved, edges), np.split(np.floor(time_s / _BLOCK_S), edges), strict=True)
    )
    energy = np.array([float(np.sum(rows[:, 0] ** 2)) for rows, _, _ in parts])
    is_informative = energy > _INFORMATIVE_SHARE * float(np.mean(energy))
    found = [_fit(*part) for part, use in zip(parts, is_informative, strict=True) if use]
    known = np.array([each for each in found if each is not None])
    if len(known) < 2:
        return PartSpread(gain=0.0, lag_s=0.0)
    gain, lag = (float(np.sqrt(scatter(known[:, 0, i], known[:, 1, i])[1])) for i in (0, 1))
    return PartSpread(gain=gain, lag_s=lag)


def _fit(columns: FloatArray, moved: FloatArray, block: FloatArray) -> FloatArray | None:
    """Return gain and lag with their deviations (2, 2), None where the part has too few seconds."""
    starts = np.flatnonzero(np.diff(block, prepend=-1.0))
    square = columns.T @ columns
    if len(starts) < _FEWEST_BLOCKS or np.linalg.matrix_rank(columns) < 2:
        return None
    inverse = np.linalg.inv(square)
    values = inverse @ (columns.T @ moved)
    scores = np.add.reduceat(columns * (moved - columns @ values)[:, None], starts, axis=0)
    spread = inverse @ (scores.T @ scores) @ inverse * len(starts) / max(len(starts) - 2, 1)
    return np.array([values, np.sqrt(np.maximum(np.diag(spread), 0.0))])
