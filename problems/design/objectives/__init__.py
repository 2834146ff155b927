"""Objectives of a design: one number each that should be small, or large."""

from .admittance import Admittance, HandForce, admittance_target
from .base import BatchColumn, Direction, Objective, RequirementObjective
from .command_noise import CommandNoise
from .peak_force import CONTACT_FORCE, PLACES, ContactForce, PeakForce, PeakForces, PeakObjective, SensorForce, force_of
from .registry import BUILT_IN
from .robustness import Robustness

__all__ = [
    "BUILT_IN",
    "CONTACT_FORCE",
    "PLACES",
    "Admittance",
    "BatchColumn",
    "CommandNoise",
    "ContactForce",
    "Direction",
    "HandForce",
    "Objective",
    "PeakForce",
    "PeakForces",
    "PeakObjective",
    "RequirementObjective",
    "Robustness",
    "SensorForce",
    "admittance_target",
    "force_of",
]
