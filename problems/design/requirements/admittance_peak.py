"""How far the admittance rises above what it is at rest: a payload that starts runs ahead of its steady speed by it."""

from typing import Any, ClassVar, Literal

import numpy as np

from ...arrays import FloatArray
from ...errors import ParameterError
from ...model.response import PlantResponse, plant_response, rendered_admittance
from ...model.sampled import SampledPlant
from ..stable_design import PreparedPlants, StableDesign
from ..uncertainty import Scenario
from .base import Requirement

# From where the loop follows as at rest up to where the robot follows no more, or near half the sampling frequency.
_LOWEST_HZ, _HIGHEST_HZ, _BELOW_NYQUIST = 0.02, 50.0, 0.8
_POINTS = 60
_AROUND_A_POLE = np.linspace(-2.0, 2.0, 9)


class AdmittancePeak(Requirement[float]):
    """max |G| over frequency per |G| at rest, of the robot alone; 1 where no force moves faster than a steady one.

    Predicted contacts begin with a steady approach. Where |G| rises, a payload that a force has just set in motion is
    faster than that, and hits a near wall harder than any of them.
    """

    name, title = "admittance_peak", "admittance peak"
    depends_on: ClassVar[Literal["loop", "robot", "contact"]] = "robot"
    is_upper_limit = True

    def checked(self, asked: float) -> float:
        """Return what is asked; raises ParameterError below 1, which every law has at rest."""
        value = super().checked(asked)
        if value < 1.0:
            raise ParameterError(self.name, asked, "at least 1, what |G| is at rest")
        return value

    def count(self, prepared: PreparedPlants) -> int:
        """Return 1: all robots together."""
        del prepared
        return 1

    def achieved(self, asked: float, design: StableDesign, row: int) -> float:
        """Return the largest ratio of all robots."""
        del asked, row
        h = design.prepared.sample_time_s
        gains = [np.abs(rendered_admittance(each, design.controller, h)) for each in peak_responses(design.prepared)]
        return max(float(np.max(gain) / gain[0]) for gain in gains)

    def scenario(self, prepared: PreparedPlants, row: int) -> Scenario:
        """Return any scenario; `worst_scenario` knows better."""
        del row
        return prepared.scenarios[0]

    def worst_scenario(self, asked: float, design: StableDesign) -> Scenario:
        """Return a scenario of the robot of the largest ratio."""
        del asked
        h, robots = design.prepared.sample_time_s, design.prepared.robots.values()
        gains = [np.abs(rendered_admittance(each, design.controller, h)) for each in peak_responses(design.prepared)]
        worst = int(np.argmax([np.max(gain) / gain[0] for gain in gains]))
        return list(robots)[worst][1]


def peak_responses(prepared: PreparedPlants) -> tuple[PlantResponse, ...]:
    """Return the responses of all different robots over all frequencies, the lowest first."""

    def respond() -> tuple[PlantResponse, ...]:
        return tuple(plant_response(plant, _frequencies(plant)) for plant, _ in prepared.robots.values())

    found: tuple[PlantResponse, ...] = prepared.once(("admittance_peak",), respond)
    return found


def _frequencies(sampled: SampledPlant) -> FloatArray:
    """Return frequencies [rad/s], evenly in their logarithm and around lightly damped poles of r(s)."""
    highest = min(_HIGHEST_HZ, _BELOW_NYQUIST * 0.5 / sampled.sample_time_s)
    low, high = 2.0 * np.pi * _LOWEST_HZ, 2.0 * np.pi * highest
    poles: Any = [pole for pole in np.roots(sampled.plant.robot.denominator) if low <= pole.imag <= high]
    peaks = [pole.imag + max(abs(pole.real), 1e-4 * pole.imag) * _AROUND_A_POLE for pole in poles]
    return np.unique(np.clip(np.concatenate([np.geomspace(low, high, _POINTS), *peaks]), low, high))
