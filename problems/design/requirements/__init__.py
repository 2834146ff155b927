"""Requirements of a design: `Requirements` says what is asked, the registry what can be asked."""

from .admittance import AdmittanceRequirement, AdmittanceTarget, band_frequencies, smallest_admittance, target_response
from .admittance_peak import AdmittancePeak, peak_responses
from .base import LoopRequirement, Requirement
from .command_noise import NoiseLimit, NoiseRequirement
from .contact_at_speed import (
    BODY_REGIONS,
    HANDS,
    ContactAtSpeed,
    Hand,
    hand_approach,
    led_contacts,
    led_mass_kg,
    led_peaks,
    led_plants,
)
from .held_by_hand import HeldByHand
from .margins import DecayRate, Margin
from .multiplicative_error import ErrorRequirement, MultiplicativeError
from .passivity import PassivityRequirement, PassivityTarget
from .peak_force import PeakForceLimit
from .registry import BUILT_IN, MARGINS
from .requirements import FIELDS, LARGEST_PRICE_N, LARGEST_SHARE, Requirements, RequirementValue

__all__ = [
    "BODY_REGIONS",
    "BUILT_IN",
    "FIELDS",
    "HANDS",
    "LARGEST_PRICE_N",
    "LARGEST_SHARE",
    "MARGINS",
    "AdmittancePeak",
    "AdmittanceRequirement",
    "AdmittanceTarget",
    "ContactAtSpeed",
    "DecayRate",
    "ErrorRequirement",
    "Hand",
    "HeldByHand",
    "LoopRequirement",
    "Margin",
    "MultiplicativeError",
    "NoiseLimit",
    "NoiseRequirement",
    "PassivityRequirement",
    "PassivityTarget",
    "PeakForceLimit",
    "Requirement",
    "RequirementValue",
    "Requirements",
    "band_frequencies",
    "hand_approach",
    "led_contacts",
    "led_mass_kg",
    "led_peaks",
    "led_plants",
    "peak_responses",
    "smallest_admittance",
    "target_response",
]
