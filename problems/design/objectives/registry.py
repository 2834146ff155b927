"""The registry of objectives; a new one is a file beside this one and a line in `BUILT_IN`."""

from collections.abc import Mapping

from ...frozen import FrozenDict
from .admittance import Admittance, HandForce
from .base import Objective
from .command_noise import CommandNoise
from .peak_force import PeakForce
from .robustness import Robustness

BUILT_IN: Mapping[str, type[Objective]] = FrozenDict(
    {
        each.name: each
        for each in (
            PeakForce,
            Admittance,
            HandForce,
            CommandNoise,
            Robustness,
        )
    }
)
"""All objectives of this package by name; each is made anew for every front."""
