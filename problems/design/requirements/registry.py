"""The registry of requirements; a new one is a file beside this one, its import, and an entry in `BUILT_IN`."""

from collections.abc import Mapping
from typing import Any

from ...frozen import FrozenDict
from .admittance import AdmittanceRequirement
from .admittance_peak import AdmittancePeak
from .base import Requirement
from .command_noise import NoiseRequirement
from .contact_at_speed import ContactAtSpeedLimit
from .damping_ratio import DampingRatio
from .held_by_hand import HeldByHandRequirement
from .margins import DecayRate, DelayMargin, GainMargin, Margin, ModulusMargin, PhaseMargin
from .multiplicative_error import ErrorRequirement
from .passivity import PassivityRequirement
from .peak_force import PeakForceLimit

BUILT_IN: Mapping[str, Requirement[Any]] = FrozenDict(
    {
        each.name: each
        for each in (
            ModulusMargin(),
            GainMargin(),
            PhaseMargin(),
            DelayMargin(),
            DecayRate(),
            PeakForceLimit(),
            ContactAtSpeedLimit(),
            AdmittanceRequirement(),
            NoiseRequirement(),
            PassivityRequirement(),
            DampingRatio(),
            ErrorRequirement(),
            HeldByHandRequirement(),
            AdmittancePeak(),
        )
    }
)
"""All requirements of this package by name, in the order in which they are listed to people."""
MARGINS: tuple[Margin, ...] = tuple(each for each in BUILT_IN.values() if isinstance(each, Margin))
"""The margins among them, one for each of `Margins` that people are shown."""
