"""How much of the noise of force and position reaches the command, and what of it comes back to the sensor."""

import math
from dataclasses import dataclass, replace

import numpy as np

from ..arrays import FloatArray
from ..compiled import compiled
from ..model.sampled import Controller, SampledLoop, SampledPlant, build_loop, position_input, relative_loop

# 2^60 ticks: no stable loop in double precision is slower.
_DOUBLINGS = 60
_NOTHING = 1e-30


def command_speed_gain(sampled: SampledPlant, controller: Controller) -> float:
    """Return what `speed_gain_of` does for a plant and its controller."""
    return speed_gain_of(build_loop(sampled, controller))


def speed_gain_of(loop: SampledLoop) -> float:
    """Return the RMS of the commanded speed per RMS of white noise on the force [m/s per N], without a deadband.

    The speed is (x^d_k − x^d_{k−1})/h of the sampled loop's stationary covariance; the loop must be stable. The noise
    enters the controller as F^d does. Without an environment that holds a position, the loop is looked at relative to
    its translation, in which its command is the sum of steps that are stationary.
    """
    # x^d_{k+1} − x^d_k = c (a − 1) s_k + (c b − d) n_k + d n_{k+1}.
    row = loop.c_command @ loop.a - loop.c_command
    direct = np.array([float(loop.c_command @ loop.b) - loop.d_command, loop.d_command])
    return math.sqrt(_variance(loop, row, direct)) / loop.sample_time_s


def position_speed_gain(sampled: SampledPlant, controller: Controller) -> float:
    """Return the RMS of the commanded speed per RMS of white noise on the position that the controller reads [1/s]."""
    b, d = position_input(sampled, controller)
    if d == 0.0 and not np.any(b):
        return 0.0
    return speed_gain_of(replace(build_loop(sampled, controller), b=b, d_command=d))


@dataclass(frozen=True, kw_only=True)
class FeltNoise:
    """Noise as the controller reads it: its RMS per RMS of the sensor's own, and its correlation between two ticks."""

    gain: float
    correlation: float


def felt_noise(sampled: SampledPlant, controller: Controller, correlation: float) -> FeltNoise:
    """Return what the sensor's noise n is in the closed loop: F + n, since the robot moves by n and F answers.

    n has this correlation from one tick to the next (of the first order); the loop must be stable.
    """
    loop = build_loop(sampled, controller)
    a, b, c = relative_loop(loop, loop.c_force)
    n = len(a)
    # n_{k+1} = ρ n_k + w_k beside the loop.
    whole, drive = np.zeros((n + 1, n + 1)), np.zeros(n + 1)
    whole[:n, :n], whole[:n, n], whole[n, n] = a, b, correlation
    drive[n] = math.sqrt(1.0 - correlation**2)
    row = np.append(c, 1.0 + loop.d_force)
    covariance = _covariance(np.ascontiguousarray(whole), drive)
    variance = float(row @ covariance @ row)
    return FeltNoise(gain=math.sqrt(variance), correlation=float(row @ whole @ covariance @ row) / variance)


def _variance(loop: SampledLoop, row: FloatArray, direct: FloatArray) -> float:
    """Return the variance of an output under white noise of variance 1, in coordinates without translation."""
    a, b, c = relative_loop(loop, row)
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
