"""Passivity of the port F → V: whether the controlled robot ever feeds energy into what it touches."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .controller import AdmittanceController
from .response import free_space_admittance
from .sampled import SampledPlant

FloatArray = NDArray[np.float64]

_LOWEST_HZ = 0.01
_POINTS = 2000
_BISECTIONS = 60


@dataclass(frozen=True, kw_only=True)
class Passivity:
    """Re G(jω) ≥ 0 up to `fails_above_hz` (None: up to the Nyquist frequency).

    `worst_real_m_s_per_n` is the smallest Re G, reached at `worst_hz`.
    """

    fails_above_hz: float | None
    worst_real_m_s_per_n: float
    worst_hz: float

    @property
    def is_passive(self) -> bool:
        """Whether the port is passive at every frequency below the Nyquist frequency."""
        return self.fails_above_hz is None


def check_passivity(sampled: SampledPlant, controller: AdmittanceController) -> Passivity:
    """Look where the real part of the rendered admittance G = V/F (sampled, delay and hold included) turns negative.

    The first sign change of a fine grid is located by bisection.
    """
    nyquist = np.pi / sampled.sample_time_s
    omega = np.geomspace(2.0 * np.pi * _LOWEST_HZ, nyquist, _POINTS)
    real = _real_part(sampled, controller, omega)
    worst = int(np.argmin(real))
    negative = np.flatnonzero(real < 0.0)
    fails = None
    if negative.size:
        first = int(negative[0])
        fails = 0.0 if first == 0 else _root(sampled, controller, float(omega[first - 1]), float(omega[first]))
    return Passivity(
        fails_above_hz=None if fails is None else fails / (2.0 * np.pi),
        worst_real_m_s_per_n=float(real[worst]),
        worst_hz=float(omega[worst] / (2.0 * np.pi)),
    )


def _real_part(sampled: SampledPlant, controller: AdmittanceController, omega: FloatArray) -> FloatArray:
    return np.asarray(free_space_admittance(sampled, controller, omega).real)


def _root(sampled: SampledPlant, controller: AdmittanceController, low: float, high: float) -> float:
    for _ in range(_BISECTIONS):
        middle = 0.5 * (low + high)
        inside = _real_part(sampled, controller, np.array([middle]))[0] >= 0.0
        low, high = (middle, high) if inside else (low, middle)
    return high
