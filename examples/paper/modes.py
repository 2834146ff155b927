"""The modes of the sampled loop: how fast each decays, how it oscillates, and how far the loop is from instability."""

import math
from dataclasses import dataclass

import numpy as np

from problems.model.sampled import SampledLoop, stability_matrix


@dataclass(frozen=True, kw_only=True)
class Mode:
    """One eigenvalue z = exp(s h) of the loop, conjugates counted once.

    `frequency_hz` |s|/2π, `oscillation_hz` |Im s|/2π, `damping_ratio` −Re s/|s| (negative when the mode grows),
    `decay_rate_per_s` −Re s (infinite for z = 0, which the delay chain brings).
    """

    z: complex
    frequency_hz: float
    oscillation_hz: float
    damping_ratio: float
    decay_rate_per_s: float


@dataclass(frozen=True, kw_only=True)
class ModalAnalysis:
    """All modes, slowest decay first; the integrator of a loop without anchor is not among them.

    `distance` is 1 − max |z|: positive is stable.
    """

    modes: tuple[Mode, ...]
    distance: float

    @property
    def is_stable(self) -> bool:
        """Whether every mode decays."""
        return self.distance > 0.0


def analyse_modes(loop: SampledLoop) -> ModalAnalysis:
    """Return the modes of the loop from the eigenvalues of its stability matrix."""
    values = np.linalg.eigvals(stability_matrix(loop))
    kept = [complex(z) for z in values if z.imag >= 0.0]
    modes = sorted((_mode(z, loop.sample_time_s) for z in kept), key=lambda mode: mode.decay_rate_per_s)
    return ModalAnalysis(modes=tuple(modes), distance=float(1.0 - np.max(np.abs(values))))


def _mode(z: complex, sample_time_s: float) -> Mode:
    if abs(z) == 0.0:
        return Mode(z=z, frequency_hz=math.inf, oscillation_hz=0.0, damping_ratio=1.0, decay_rate_per_s=math.inf)
    s = complex(math.log(abs(z)), math.atan2(z.imag, z.real)) / sample_time_s
    size = abs(s)
    return Mode(
        z=z,
        frequency_hz=size / (2.0 * math.pi),
        oscillation_hz=abs(s.imag) / (2.0 * math.pi),
        damping_ratio=-s.real / size if size > 0.0 else 0.0,
        decay_rate_per_s=-s.real,
    )
