"""How much of the force sensor's noise reaches the velocity command."""

from typing import Any, ClassVar

from ..requirements import NoiseLimit, NoiseRequirement, Requirement, Requirements
from .base import Direction, RequirementObjective

_NOISE, _OF_ONE_NEWTON = NoiseRequirement(), NoiseLimit(max_speed_rms_m_s=1.0, force_noise_rms_n=1.0)


class CommandNoise(RequirementObjective):
    """RMS of the velocity command per RMS of white noise on the force signal, worst over contact and free space.

    (x^d_k − x^d_{k−1})/h under noise of 1 N.
    """

    name: ClassVar[str] = "command_noise"
    unit: ClassVar[str] = "m/s per N"
    rotational_unit: ClassVar[str | None] = "rad/s per N·m"
    direction: ClassVar[Direction] = "minimize"

    def limited(self, asked: Requirements) -> tuple[Requirement[Any], Any]:
        """Return the requirement of the command's noise, under noise of 1 N."""
        del asked
        return _NOISE, _OF_ONE_NEWTON
