"""How much of the noise of force and position reaches the command, and what of it comes back to the sensor."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import schur

from ..arrays import FloatArray
from ..compiled import compiled
from ..model.sampled import Controller, SampledLoop, SampledPlant, build_loop, relative_loop
from .noise_spectrum import RelativeSpectrum

# 2^60 ticks: no stable loop in double precision is slower.
_DOUBLINGS = 60
_NOTHING = 1e-30


Noise = tuple[FloatArray, float, float]
"""White noise that enters a loop: b (n,) and d of its input as `SampledLoop` has them of F^d, and its RMS."""


def command_speed_gain(
    sampled: SampledPlant, controller: Controller, spectrum: RelativeSpectrum | None = None
) -> float:
    """Return the RMS of the commanded speed per RMS of noise on the force [m/s per N], white unless a spectrum is said.

    See `speed_rms`.
    """
    loop = build_loop(sampled, controller)
    return (
        spectral_speed_gain(loop, spectrum)
        if spectrum is not None
        else speed_rms(loop, [(loop.b, loop.d_command, 1.0)])
    )


def speed_rms(loop: SampledLoop, noises: Sequence[Noise]) -> float:
    """Return the RMS of the commanded speed [m/s] under independent white noises, without a deadband.

    The speed is (x^d_k − x^d_{k−1})/h of the sampled loop's stationary covariance; the loop must be stable. Noise of
    the force enters the controller as F^d does. Without an environment that holds a position, the loop is looked at
    relative to its translation, in which its command is the sum of steps that are stationary.
    """
    # x^d_{k+1} − x^d_k = c (a − 1) s_k + (c b − d) n_k + d n_{k+1}.
    row = loop.c_command @ loop.a - loop.c_command
    parts = [relative_loop(loop, row, rms * b) for b, _, rms in noises]
    a, _, c = parts[0]
    covariance = _covariance(a, np.stack([b for _, b, _ in parts], axis=1))
    direct = sum(rms**2 * ((float(loop.c_command @ b) - d) ** 2 + d**2) for b, d, rms in noises)
    return math.sqrt(max(0.0, float(c @ covariance @ c)) + direct) / loop.sample_time_s


def spectral_speed_gain(loop: SampledLoop, spectrum: RelativeSpectrum) -> float:
    """Return the RMS of the commanded speed per RMS of force noise of a spectrum [m/s per N], see `speed_rms`.

    It is that under white noise times what a sum of |H|² over frequency says that the spectrum changes, so that a
    resonance too narrow for the sum does no harm. The response H is found by the loop's complex Schur form.
    """
    omega, shares, white = spectrum.nodes(loop.sample_time_s)
    z = np.exp(1j * omega * loop.sample_time_s)
    triangle, basis = schur(loop.a, output="complex")
    drive, row = basis.conj().T @ loop.b, loop.c_command @ basis
    states = np.zeros((len(loop.a), len(z)), dtype=np.complex128)
    for i in range(len(loop.a) - 1, -1, -1):
        states[i] = (drive[i] + triangle[i, i + 1 :] @ states[i + 1 :]) / (z - triangle[i, i])
    power = np.abs((row @ states + loop.d_command) * (1.0 - 1.0 / z)) ** 2
    return speed_rms(loop, [(loop.b, loop.d_command, 1.0)]) * math.sqrt(float(shares @ power) / float(white @ power))


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
    covariance = _covariance(whole, drive[:, None])
    variance = float(row @ covariance @ row)
    return FeltNoise(gain=math.sqrt(variance), correlation=float(row @ whole @ covariance @ row) / variance)


@compiled
def _covariance(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return Σ aᵏ b bᵀ (aᵏ)ᵀ over k ≥ 0 for b (n, k), twice as many terms each time.

    Sums of squares lose no digits, however differently the states are scaled; a linear solve for the whole does.
    """
    n = len(b)
    covariance, power = b @ np.ascontiguousarray(b.T), a
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
