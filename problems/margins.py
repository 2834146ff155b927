"""Margins of the exact sampled loop at both break points; stability is decided apart, by eigenvalues."""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .controller import AdmittanceController
from .errors import AutotuneError
from .plant import build_plant_matrices
from .response import LoopResponse, loop_response
from .sampled import SampledPlant, build_loop, spectral_radius

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

_LOWEST_HZ = 0.02
_BASE_POINTS = 600
_REFINEMENT_ROUNDS = 3
_REFINEMENT_POINTS = 24
_LARGEST_GAIN_DB = 200.0


class UnstableLoopError(AutotuneError):
    """Margins and peaks of an unstable loop are not numbers, so none is given."""

    def __init__(self, spectral_radius: float) -> None:
        super().__init__(
            f"The loop is unstable (largest |z| = {spectral_radius:.6f}); margins and peak forces exist only for a "
            "stable loop. Raise the admittance damping or change the lead gain."
        )
        self.spectral_radius = spectral_radius


@dataclass(frozen=True, kw_only=True)
class Margins:
    """The smaller margin of the two break points, each with the frequency where it is reached.

    `modulus` is min |1 + L|; `gain_db` the smallest change of gain, up or down, that reaches the stability limit;
    `phase_deg` the smallest rotation either way; `delay_s` the smallest extra delay. A margin that no crossover
    limits is infinite.
    """

    modulus: float
    modulus_hz: float
    gain_db: float
    phase_deg: float
    delay_s: float
    spectral_radius: float


class RawMargins(NamedTuple):
    """Margins of many loops at once, shape of the leading axes of the response."""

    modulus: FloatArray
    gain_db: FloatArray
    phase_deg: FloatArray
    delay_s: FloatArray


def margins_on_grid(frequency_rad_per_s: FloatArray, loop: ComplexArray) -> RawMargins:
    """Read the margins of `loop` (..., n) given on an increasing grid (n,) that ends at the Nyquist frequency.

    Crossovers are interpolated linearly in log gain and phase between neighbours.
    """
    modulus = np.min(np.abs(1.0 + loop), axis=-1)
    start, stop = loop[..., :-1], loop[..., 1:]
    # The Tustin form has a zero at z = −1, so the last point may be exactly 0.
    with np.errstate(divide="ignore", invalid="ignore"):
        log_gain = np.log(np.abs(loop))
        turn = np.angle(stop / start)
        # Phase crossovers: the segment passes the negative real axis.
        share = start.imag / (start.imag - stop.imag)
        crossing = (start.imag * stop.imag <= 0.0) & (start.imag != stop.imag)
        real = start.real + share * (stop.real - start.real)
        gain = np.where(crossing & (real < 0.0), np.abs(20.0 * np.log10(np.abs(real))), np.inf)
        last = np.where(loop[..., -1].real < 0.0, np.abs(20.0 * np.log10(np.abs(loop[..., -1].real))), np.inf)
        gain_db = np.minimum(np.min(gain, axis=-1), last)
        # Gain crossovers: |L| passes 1.
        share = log_gain[..., :-1] / (log_gain[..., :-1] - log_gain[..., 1:])
        crossing = (log_gain[..., :-1] * log_gain[..., 1:] <= 0.0) & (log_gain[..., :-1] != log_gain[..., 1:])
        angle = np.angle(-start) + share * turn  # of −L: zero on the critical point
        omega = frequency_rad_per_s[:-1] + share * np.diff(frequency_rad_per_s)
        wrapped = np.angle(np.exp(1j * angle))
        phase = np.min(np.where(crossing, np.abs(wrapped), np.inf), axis=-1)
        lag = np.where(wrapped > 0.0, wrapped, wrapped + 2.0 * np.pi)
        delay_s = np.min(np.where(crossing, lag / omega, np.inf), axis=-1)
    return RawMargins(modulus, gain_db, np.degrees(phase), delay_s)


def frequency_grid(sampled: SampledPlant, points: int = _BASE_POINTS) -> FloatArray:
    """Return frequencies (n,) [rad/s] up to the Nyquist frequency, denser around the plant's resonances."""
    nyquist = np.pi / sampled.sample_time_s
    base = np.geomspace(2.0 * np.pi * _LOWEST_HZ, nyquist, points)
    matrices = build_plant_matrices(sampled.plant, sampled.sample_time_s)
    extra = []
    for pole in np.linalg.eigvals(matrices.a) / sampled.sample_time_s:
        if pole.imag > 0.0:
            width = max(-pole.real, 1e-4 * abs(pole))
            extra.append(pole.imag + width * np.linspace(-6.0, 6.0, 49))
    grid = np.concatenate([base, *extra])
    grid = grid[(grid >= base[0]) & (grid <= nyquist)]
    return np.unique(np.append(grid, nyquist))


def find_margins(sampled: SampledPlant, controller: AdmittanceController) -> Margins:
    """Find the margins of one exact sampled loop, refined around every minimum and crossover.

    Raises UnstableLoopError if the loop is not stable.
    """
    radius = spectral_radius(build_loop(sampled, controller))
    if not radius < 1.0:
        raise UnstableLoopError(radius)
    grid = frequency_grid(sampled)
    for _ in range(_REFINEMENT_ROUNDS):
        grid = _refined(grid, loop_response(sampled, controller, grid))
    response = loop_response(sampled, controller, grid)
    at = [margins_on_grid(grid, loop) for loop in (response.at_force, response.at_command)]
    nearest = [np.abs(1.0 + loop) for loop in (response.at_force, response.at_command)]
    worst = nearest[int(np.argmin([np.min(n) for n in nearest]))]
    return Margins(
        modulus=float(min(m.modulus for m in at)),
        modulus_hz=float(grid[int(np.argmin(worst))] / (2.0 * math.pi)),
        gain_db=_limited(float(min(m.gain_db for m in at))),
        phase_deg=float(min(m.phase_deg for m in at)),
        delay_s=float(min(m.delay_s for m in at)),
        spectral_radius=radius,
    )


def _limited(gain_db: float) -> float:
    """Return infinity for a crossover where the loop gain is rounding only (below 1e-10)."""
    return gain_db if gain_db < _LARGEST_GAIN_DB else math.inf


def _refined(grid: FloatArray, response: LoopResponse) -> FloatArray:
    """Add points on both sides of every local minimum of |1 + L| and across every crossover."""
    segments = np.zeros(len(grid) - 1, dtype=bool)
    for loop in (response.at_force, response.at_command):
        distance = np.abs(1.0 + loop)
        lowest = np.flatnonzero((distance[1:-1] <= distance[:-2]) & (distance[1:-1] <= distance[2:])) + 1
        segments[lowest - 1] = True
        segments[lowest] = True
        size = np.abs(loop) - 1.0
        segments |= size[:-1] * size[1:] <= 0.0
        segments |= (loop.imag[:-1] * loop.imag[1:] <= 0.0) & (loop.real[:-1] < 0.0)
    share = np.linspace(0.0, 1.0, _REFINEMENT_POINTS)[1:-1]
    starts, widths = grid[:-1][segments], np.diff(grid)[segments]
    return np.unique(np.concatenate([grid, (starts[:, None] + widths[:, None] * share).ravel()]))
