"""The covariance of the joint fit, widened where the residuals say more than their size."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .joint_solve import Block, information

FloatArray = NDArray[np.float64]

_CHUNK_S = 0.1


@dataclass(frozen=True, kw_only=True)
class Spread:
    """`covariance` (p, p) in scaled parameters; `plain` is the one that only noise makes; `widening` on a deviation."""

    covariance: FloatArray
    plain: FloatArray
    widening: float


def widened(blocks: Sequence[Block], count: int, period_s: float) -> Spread:
    """Return H⁻¹, H = JᵀJ of the whitened residuals, made larger where the scores Jᵀr scatter more than H says.

    Were the residuals white noise, the scores of pieces of 0.1 s and of whole spans would scatter by H. Directions in
    which they scatter by λ > (1 + √(p/n))², the largest that chance makes of n pieces and p parameters (Marchenko and
    Pastur 1967), have their variance multiplied by λ: a misfit that is no noise counts as n independent ones.
    """
    matrix, _ = information(blocks, count)
    scale = 1.0 / np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    values, vectors = np.linalg.eigh(matrix * np.outer(scale, scale))
    # What nothing tells gets a variance that no verdict can overlook.
    root = vectors / np.sqrt(np.maximum(values, 1e-12))
    pieces = [_scores(block, count, max(1, round(_CHUNK_S / period_s))) for block in blocks]
    factor = np.eye(count)
    for scores in (np.concatenate(pieces), np.array([p.sum(axis=0) for p in pieces])):
        factor = factor + _excess(scores * scale @ root)
    inner = root @ factor @ root.T * np.outer(scale, scale)
    plain = root @ root.T * np.outer(scale, scale)
    widening = float(np.sqrt(np.max(np.diag(inner) / np.diag(plain))))
    return Spread(covariance=inner, plain=plain, widening=widening)


def _scores(block: Block, count: int, length: int) -> FloatArray:
    """Return the score of every piece of a span, (pieces, p)."""
    terms = block.jacobian * block.residual[:, None]
    starts = np.arange(0, max(len(terms) - length // 2, 1), length)
    out = np.zeros((len(starts), count))
    out[:, block.indices] = np.add.reduceat(terms, starts, axis=0)
    return out


def _excess(scores: FloatArray) -> FloatArray:
    """Return Σ (λ − 1) v vᵀ over the directions in which standardised scores scatter beyond chance."""
    used = scores[np.any(scores != 0.0, axis=1)]
    if len(used) < 2:
        return np.zeros((scores.shape[1], scores.shape[1]))
    values, vectors = np.linalg.eigh(used.T @ used)
    limit = (1.0 + np.sqrt(scores.shape[1] / len(used))) ** 2
    return np.asarray((vectors * np.where(values > limit, values - 1.0, 0.0)) @ vectors.T)
