"""The registry of objectives; a new one is a file beside this one, its import, and an entry in `BUILT_IN`."""

from collections.abc import Mapping

from ...frozen import FrozenDict
from .admittance import Admittance, HandForce
from .base import Objective
from .command_noise import CommandNoise
from .peak_force import ContactForce, PeakForce, SensorForce
from .robustness import Robustness

BUILT_IN: Mapping[str, Objective] = FrozenDict(
    {
        each.name: each
        for each in (
            ContactForce(),
            SensorForce(),
            PeakForce(),
            Admittance(),
            HandForce(),
            CommandNoise(),
            Robustness(),
        )
    }
)
"""All objectives of this package by name: of `objective` in problem.yaml, and of fronts."""
