"""The noise of the velocity command: what noise on force and position makes of it."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ..._checks import non_negative, positive
from ...arrays import FloatArray
from ...errors import ParameterError
from ...model.sampled import position_input
from ...stability.noise import spectral_speed_gain, speed_rms
from ...stability.noise_spectrum import RelativeSpectrum
from ..stable_design import StableLoop
from .base import LoopRequirement


@dataclass(frozen=True, kw_only=True)
class NoiseLimit:
    """The commanded speed's RMS [m/s], at most `max_speed_rms_m_s` under noise of `force_noise_rms_n`.

    That noise is None until somebody knows the sensor; a problem needs the number. It is white unless its
    `noise_spectrum` is known. White noise of the position that
    the controller reads, `position_noise_rms_m`, comes on top where it is known. (`problems.stability.noise`)
    """

    max_speed_rms_m_s: float
    force_noise_rms_n: float | None = None
    position_noise_rms_m: float | None = None
    noise_spectrum: RelativeSpectrum | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "max_speed_rms_m_s", positive("max_speed_rms_m_s", self.max_speed_rms_m_s))
        for name in ("force_noise_rms_n", "position_noise_rms_m"):
            if getattr(self, name) is not None:
                object.__setattr__(self, name, non_negative(name, getattr(self, name)))

    def speed_rms_m_s(
        self, gain_m_s_per_n: FloatArray | float, gain_per_s: FloatArray | float = 0.0
    ) -> FloatArray | float:
        """Return the speed RMS for the speed RMS per newton and per metre of noise."""
        force, position = self.force_noise_rms_n or 0.0, self.position_noise_rms_m or 0.0
        return np.hypot(force * gain_m_s_per_n, position * gain_per_s)


class NoiseRequirement(LoopRequirement[NoiseLimit]):
    """RMS of (x^d_k − x^d_{k−1})/h in every loop; smooth, so that central differences give all digits that matter."""

    name, title = "command_noise", "command noise"
    asked_as = NoiseLimit
    unit, turning_unit = "m/s", "rad/s"
    lever_power = -1
    is_upper_limit = True

    def threshold(self, asked: NoiseLimit) -> float:
        """Return the largest speed RMS [m/s]."""
        return asked.max_speed_rms_m_s

    def with_threshold(self, asked: NoiseLimit, threshold: float) -> NoiseLimit:
        """Return the same noise with another limit."""
        return replace(asked, max_speed_rms_m_s=threshold)

    def turned(self, asked: NoiseLimit, lever: float) -> NoiseLimit:
        """Return the limit about an axis; the torque's noise is the sensor's and still to be said, as the angle's."""
        return replace(
            super().turned(asked, lever), force_noise_rms_n=None, position_noise_rms_m=None, noise_spectrum=None
        )

    def read(self, entry: Mapping[str, Any]) -> NoiseLimit:
        """Return what plain data asks."""
        spectrum = entry.get("noise_spectrum")
        return NoiseLimit(**{**entry, "noise_spectrum": None if spectrum is None else RelativeSpectrum(**spectrum)})

    def check_sampling(self, asked: NoiseLimit, sample_time_s: float) -> None:
        """Raise ParameterError while the sensor's noise is not known."""
        del sample_time_s
        if asked.force_noise_rms_n is None:
            raise ParameterError("command_noise.force_noise_rms_n", None, "the force sensor's noise")

    def describe(self, asked: NoiseLimit, *, turning: bool = False) -> str:
        """Return the limit in words."""
        limit = f"speed RMS at most {asked.max_speed_rms_m_s:.4g} {self.unit_on(turning=turning)}"
        if asked.force_noise_rms_n is None:
            return limit
        force, place = ("N·m", "µrad") if turning else ("N", "µm")
        position = asked.position_noise_rms_m
        also = f" and {1e6 * position:.3g} {place}" if position else ""
        spread = ", its spectrum as logged" if asked.noise_spectrum is not None else ""
        return f"{limit} under noise of {asked.force_noise_rms_n:g} {force}{spread}{also}"

    def of_loop(self, asked: NoiseLimit, loop: StableLoop) -> float:
        """Return the speed RMS [m/s]."""
        force, noises, spectral = asked.force_noise_rms_n or 0.0, [], 0.0
        if asked.noise_spectrum is None:
            noises.append((loop.matrices.b, loop.matrices.d_command, force))
        else:
            spectral = force * spectral_speed_gain(loop.matrices, asked.noise_spectrum)
        if asked.position_noise_rms_m:
            noises.append((*position_input(loop.sampled, loop.controller), asked.position_noise_rms_m))
        return math.hypot(spectral, speed_rms(loop.matrices, noises)) if noises else spectral
