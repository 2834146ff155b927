"""How much of the force sensor's noise reaches the position command."""

import math

import numpy as np

from ..arrays import FloatArray
from ..compiled import compiled
from ..model.sampled import Controller, SampledLoop, SampledPlant, build_loop

# 2^60 ticks: no stable loop in double precision is slower.
_DOUBLINGS = 60
_NOTHING = 1e-30


def command_speed_gain(sampled: SampledPlant, controller: Controller) -> float:
    """Return the RMS of the commanded speed per RMS of white noise on the force [m/s per N], without a deadband.

    The speed is (x^d_k − x^d_{k−1})/h of the sampled loop's stationary covariance; the loop must be stable. The noise
    enters the controller as F^d does. Without an environment that holds a position, the loop is looked at relative to
    its translation, in which its command is the sum of steps that are stationary.
    """
    loop = build_loop(sampled, controller)
    # x^d_{k+1} − x^d_k = c (a − 1) s_k + (c b − d) n_k + d n_{k+1}.
    row = loop.c_command @ loop.a - loop.c_command
    direct = np.array([float(loop.c_command @ loop.b) - loop.d_command, loop.d_command])
    return math.sqrt(_variance(loop, row, direct)) / loop.sample_time_s


def _variance(loop: SampledLoop, row: FloatArray, direct: FloatArray) -> float:
    """Return the variance of an output under white noise of variance 1, in coordinates without translation."""
    a, b, c = loop.a, loop.b, row
    if not loop.is_anchored:
        pivot = int(np.argmax(np.abs(loop.translation)))
        shift = loop.translation / loop.translation[pivot]
        keep = np.arange(len(a)) != pivot
        # A difference does not see the translation, so c·shift is zero and dropping the pivot loses nothing.
        a = (a - np.outer(shift, a[pivot]))[np.ix_(keep, keep)]
        b, c = (b - shift * b[pivot])[keep], c[keep]
    covariance = _covariance(np.ascontiguousarray(a), np.ascontiguousarray(b))
    return max(0.0, float(c @ covariance @ c)) + float(direct @ direct)


@compiled
def _covariance(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return Σ aᵏ b bᵀ (aᵏ)ᵀ over k ≥ 0, twice as many terms each time.

    Sums of squares lose no digits, however differently the states are scaled; a linear solve for the whole does.
    """
    n = len(b)
    covariance, power = np.outer(b, b), a
    for _ in range(_DOUBLINGS):
        covariance = covariance + power @ covariance @ np.ascontiguousarray(power.T)
        power = power @ power
        largest = 0.0
        for i in range(n):
            for j in range(n):
                largest = max(largest, abs(power[i, j]))
        if largest < _NOTHING:
            break
    return covariance
