"""A zero-order hold: the matrix exponential of a continuous plant and the integral of its inputs."""

from typing import Any

import numpy as np
from scipy.linalg import expm

from ..arrays import FloatArray
from ..compiled import compiled, equation

# With a norm of at most 1/2 the series below is exact to rounding.
_TAYLOR_TERMS = 14
_MOST_SQUARINGS, _HOPELESS_SQUARINGS = 12, 60


@equation
def exponential(matrix: Any, identity: Any, squarings: int) -> Any:
    """Return exp(matrix): the Taylor series of matrix/2^squarings (norm at most 1/2 for full precision), squared."""
    small = matrix / 2.0**squarings
    out = identity + small
    term = small
    for k in range(2, _TAYLOR_TERMS + 1):
        term = (term @ small) / k
        out = out + term
    for _ in range(squarings):
        out = out @ out
    return out


@compiled
def squarings_for(matrix: FloatArray) -> int:
    """Return how often the argument of `exponential` must be halved."""
    largest = 0.0
    for i in range(len(matrix)):
        largest = max(largest, np.sum(np.abs(matrix[i])))
    return max(0, int(np.ceil(np.log2(max(2.0 * largest, 1e-300)))))


@compiled
def hold_columns(a: FloatArray, columns: FloatArray, duration: float) -> FloatArray:
    """Return exp of (a, columns; 0, 0) times `duration`: its upper part is exp(a·t) beside ∫ exp(a σ) columns dσ."""
    n, inputs = columns.shape
    augmented = np.zeros((n + inputs, n + inputs))
    augmented[:n, :n] = a * duration
    augmented[:n, n:] = columns * duration
    whole: FloatArray = exponential(augmented, np.eye(n + inputs), squarings_for(augmented))
    return whole


def hold(a: FloatArray, b: FloatArray, duration: float) -> tuple[FloatArray, FloatArray]:
    """Return exp(a·duration) and ∫ exp(a σ) b dσ over [0, duration]; `b` is (n,) or (n, inputs)."""
    n, a, columns = len(a), np.ascontiguousarray(a), np.ascontiguousarray(b).reshape(len(a), -1)
    if _MOST_SQUARINGS < squarings_for(a) <= _HOPELESS_SQUARINGS:
        # So stiff a plant loses digits in repeated squaring; scipy scales it more carefully. Beyond all reason the
        # squaring overflows, and what is not finite is refused.
        whole = expm(np.pad(np.hstack([a, columns]) * duration, ((0, columns.shape[1]), (0, 0))))
    else:
        whole = hold_columns(a, columns, duration)
    return np.ascontiguousarray(whole[:n, :n]), np.ascontiguousarray(whole[:n, n:]).reshape(b.shape)
