"""What differs between the parts of one log: gain and lag of a predicted velocity, deviations of coloured residuals."""

from dataclasses import dataclass

import numpy as np
from scipy.special import stdtrit

from problems.arrays import FloatArray

from ..verdicts import scatter

_PART_S, _MOST_PARTS, _BLOCK_S = 5.0, 12, 1.0
_FEWEST_BLOCKS = 3
_FEWEST_OF_ALL = 8
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


def coloured_covariance(jacobian: FloatArray, residual: FloatArray, time: FloatArray) -> FloatArray:
    """Return H⁻¹ Ω H⁻¹, H = JᵀJ and Ω the scores Jᵀr summed over blocks of a second: true for any colour within it.

    A log below 8 s has eight blocks, and its deviations Student's factor for so few. The larger of this and of a white
    residual's counts, parameter by parameter.
    """
    count = jacobian.shape[1]
    size = np.linalg.norm(jacobian, axis=0)
    size[size == 0.0] = 1.0
    inverse = np.linalg.pinv((jacobian / size).T @ (jacobian / size), rcond=1e-12)
    scores = jacobian / size * residual[:, None]
    length_s = min(_BLOCK_S, float(time[-1] - time[0]) / _FEWEST_OF_ALL)
    starts = np.flatnonzero(np.diff(np.floor((time - time[0]) / length_s), prepend=-1.0))
    sums = np.add.reduceat(scores, starts, axis=0)
    blocks = len(sums)
    freedom = max(blocks - count, 1)
    coloured = inverse @ (sums.T @ sums) @ inverse * blocks / freedom
    if blocks <= 2 * _FEWEST_OF_ALL:
        coloured *= (float(stdtrit(freedom, 0.975)) / 1.96) ** 2
    white = inverse * float(residual @ residual) / max(len(residual) - count, 1)
    widening = np.sqrt(np.maximum(np.diag(white) / np.maximum(np.diag(coloured), 1e-300), 1.0))
    return np.asarray(coloured * np.outer(widening / size, widening / size))
