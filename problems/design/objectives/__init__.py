"""Objectives of a design: one number each that should be small, or large."""

from .admittance import Admittance, HandForce
from .base import Direction, Objective, admittance_band_hz, contact_plants, free_plants
from .command_noise import CommandNoise
from .peak_force import PeakForce
from .registry import BUILT_IN

__all__ = [
    "BUILT_IN",
    "Admittance",
    "CommandNoise",
    "Direction",
    "HandForce",
    "Objective",
    "PeakForce",
    "admittance_band_hz",
    "contact_plants",
    "free_plants",
]
