"""How much of the force sensor's noise reaches the position command."""

import math
from dataclasses import dataclass

import numpy as np

from .._checks import non_negative
from ..arrays import FloatArray
from ..model.sampled import Controller, SampledLoop, SampledPlant, build_loop, spectral_radius
from .margins import UnstableLoopError

# 2^60 ticks: no stable loop in double precision is slower.
_DOUBLINGS = 60
_NOTHING = 1e-30


@dataclass(frozen=True, kw_only=True)
class CommandNoiseRms:
    """RMS of what white noise on the force signal does to the command, from tick to tick.

    `speed_rms_m_s` is that of (x^d_k − x^d_{k−1})/h, `acceleration_rms_m_s2` of its difference over h.
    `position_rms_m` is infinite in free space, where the command walks at random.
    """

    position_rms_m: float
    speed_rms_m_s: float
    acceleration_rms_m_s2: float


def predict_command_noise(sampled: SampledPlant, controller: Controller, force_noise_rms_n: float) -> CommandNoiseRms:
    """Predict the command's noise from the sampled loop's stationary covariance (no deadband).

    The noise enters the controller as F^d does. Without an environment that holds a position, the loop is looked at
    relative to its translation, in which its command is the sum of steps that are stationary. Raises
    UnstableLoopError if the loop is not stable.
    """
    noise = non_negative("force_noise_rms_n", force_noise_rms_n)
    loop = build_loop(sampled, controller)
    radius = spectral_radius(loop)
    if not radius < 1.0:
        raise UnstableLoopError(radius)
    h = loop.sample_time_s
    variances = [
        _variance(loop, *_difference(loop, order)) if order > 0 or loop.is_anchored else math.inf for order in range(3)
    ]
    position, speed, acceleration = (noise * math.sqrt(variance) if noise > 0.0 else 0.0 for variance in variances)
    return CommandNoiseRms(position_rms_m=position, speed_rms_m_s=speed / h, acceleration_rms_m_s2=acceleration / h**2)


def command_speed_gain(sampled: SampledPlant, controller: Controller) -> float:
    """Return the RMS of the commanded speed per RMS of force noise [m/s per N] in a loop that is known to be stable.

    The `speed_rms_m_s` of `predict_command_noise` for 1 N, without asking for stability again.
    """
    loop = build_loop(sampled, controller)
    return math.sqrt(_variance(loop, *_difference(loop, 1))) / loop.sample_time_s


def _difference(loop: SampledLoop, order: int) -> tuple[FloatArray, FloatArray]:
    """Return y = c s_k + Σ d_j n_{k+j} for the difference of the command of this order, over ticks k to k + order."""
    weights = ((1.0,), (-1.0, 1.0), (1.0, -2.0, 1.0))[order]
    row, direct = np.zeros(len(loop.a)), np.zeros(order + 1)
    reached, impulses = loop.c_command, [loop.d_command]
    for j, weight in enumerate(weights):
        row += weight * reached
        # The noise of tick i reaches tick j through i steps of the loop fewer.
        for i in range(j + 1):
            direct[i] += weight * impulses[j - i]
        impulses.append(float(reached @ loop.b))
        reached = reached @ loop.a
    return row, direct


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
    return max(0.0, float(c @ _covariance(a, b) @ c)) + float(direct @ direct)


def _covariance(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return Σ aᵏ b bᵀ (aᵏ)ᵀ over k ≥ 0, twice as many terms each time.

    Sums of squares lose no digits, however differently the states are scaled; a linear solve for the whole does.
    """
    covariance, power = np.outer(b, b), a
    for _ in range(_DOUBLINGS):
        covariance = covariance + power @ covariance @ power.T
        power = power @ power
        if np.max(np.abs(power)) < _NOTHING:
            break
    return covariance
