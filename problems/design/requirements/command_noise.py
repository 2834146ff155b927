"""The noise of the velocity command: what white noise on the force signal makes of it."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

from ..._checks import non_negative, positive
from ...errors import ParameterError
from ...stability.noise import speed_gain_of
from ..stable_design import StableLoop
from .base import LoopRequirement


@dataclass(frozen=True, kw_only=True)
class NoiseLimit:
    """The commanded speed's RMS [m/s] under white force noise of `force_noise_rms_n`, at most `max_speed_rms_m_s`.

    The noise is None until somebody knows the sensor; a problem needs the number. (`problems.stability.noise`)
    """

    max_speed_rms_m_s: float
    force_noise_rms_n: float | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "max_speed_rms_m_s", positive("max_speed_rms_m_s", self.max_speed_rms_m_s))
        if self.force_noise_rms_n is not None:
            object.__setattr__(self, "force_noise_rms_n", non_negative("force_noise_rms_n", self.force_noise_rms_n))

    def speed_rms_m_s(self, gain_m_s_per_n: float) -> float:
        """Return the speed RMS for a speed RMS per newton of noise."""
        return (self.force_noise_rms_n or 0.0) * gain_m_s_per_n


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
        """Return the limit about an axis; the torque's noise is the sensor's and still to be said."""
        return replace(super().turned(asked, lever), force_noise_rms_n=None)

    def read(self, entry: Mapping[str, Any]) -> NoiseLimit:
        """Return what plain data asks."""
        return NoiseLimit(**entry)

    def check_sampling(self, asked: NoiseLimit, sample_time_s: float) -> None:
        """Raise ParameterError while the sensor's noise is not known."""
        del sample_time_s
        if asked.force_noise_rms_n is None:
            raise ParameterError("command_noise.force_noise_rms_n", None, "the force sensor's noise")

    def describe(self, asked: NoiseLimit, *, turning: bool = False) -> str:
        """Return the limit in words."""
        limit = f"speed RMS at most {asked.max_speed_rms_m_s:.4g} {self.unit_on(turning=turning)}"
        force = "N·m" if turning else "N"
        return (
            limit if asked.force_noise_rms_n is None else f"{limit} under noise of {asked.force_noise_rms_n:g} {force}"
        )

    def of_loop(self, asked: NoiseLimit, loop: StableLoop) -> float:
        """Return the speed RMS [m/s]."""
        return asked.speed_rms_m_s(speed_gain_of(loop.matrices))
