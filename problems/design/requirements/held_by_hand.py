"""The modulus that is left while a hand holds the payload."""

import itertools
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from ..._checks import positive
from ...errors import ParameterError
from ...model.controller import AdmittanceController
from ...model.response import loop_at, plant_response
from ...model.sampled import Controller, SampledPlant, build_loop, build_sampled_plant, spectral_radius
from ...stability.margins import PreparedMargins, frequency_grid, prepare_margins
from ..hand import HandImpedance
from ..stable_design import StableDesign, StableLoop
from .base import LoopRequirement

# Of the grid on which other laws than our own are read.
_POINTS = 2000


@dataclass(frozen=True, kw_only=True)
class HeldByHand(HandImpedance):
    """At least `min_modulus` of |1 + L| with every hand up to this impedance on the payload."""

    min_modulus: float

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "min_modulus", positive("held_by_hand.min_modulus", self.min_modulus))
        if self.stiffness_n_per_m == 0.0:
            raise ParameterError("held_by_hand.stiffness_n_per_m", 0.0, "greater than 0")

    @property
    def hand(self) -> HandImpedance:
        """The impedance alone."""
        return HandImpedance(**{each.name: getattr(self, each.name) for each in fields(HandImpedance)})

    def corners(self) -> tuple[HandImpedance, ...]:
        """Return the hands at the ends, that which is none left out."""
        ends = itertools.product(*((0.0, getattr(self, each.name)) for each in fields(HandImpedance)))
        names = [each.name for each in fields(HandImpedance)]
        return tuple(HandImpedance(**dict(zip(names, end, strict=True))) for end in ends if any(end))


class HeldByHandRequirement(LoopRequirement[HeldByHand]):
    """min |1 + L| over frequency, both break points and the ends of the hand's impedance; 0 of an unstable loop."""

    name, title = "held_by_hand", "modulus held by a hand"
    asked_as = HeldByHand
    must_be_below = (1.0, "|1 + L| tends to 1 at high frequency")

    def threshold(self, asked: HeldByHand) -> float:
        """Return the least modulus."""
        return asked.min_modulus

    def with_threshold(self, asked: HeldByHand, threshold: float) -> HeldByHand:
        """Return the same hand with another modulus."""
        return replace(asked, min_modulus=threshold)

    def turned(self, asked: HeldByHand, lever: float) -> HeldByHand:
        """Return the same hand at a lever in metres."""
        return asked.turned(lever)

    def read(self, entry: Mapping[str, Any]) -> HeldByHand:
        """Return what plain data asks."""
        return HeldByHand(**entry)

    def describe(self, asked: HeldByHand, *, turning: bool = False) -> str:
        """Return modulus and hand in words."""
        return f"{asked.min_modulus:g} with {asked.describe(turning=turning)}"

    def of_loop(self, asked: HeldByHand, loop: StableLoop) -> float:
        """Return the least modulus over the hands."""
        return min(_modulus(each, loop.controller) for each in held_plants(asked, loop.sampled))

    def achieved(self, asked: HeldByHand, design: StableDesign, row: int) -> float:
        """Return the least modulus of one plant, whose held twins are sampled once for all controllers."""
        key = (self.name, row, asked.hand)
        held = design.prepared.once(key, lambda: held_plants(asked, design.prepared.plants[row].sampled))
        return min(_modulus(each, design.controller) for each in held)


def held_plants(asked: HeldByHand, sampled: SampledPlant) -> tuple[PreparedMargins, ...]:
    """Return a plant in the hands at the ends of the impedance, ready for margins."""
    h = sampled.sample_time_s
    return tuple(prepare_margins(build_sampled_plant(hand.holding(sampled.plant), h)) for hand in asked.corners())


def _modulus(prepared: PreparedMargins, controller: Controller) -> float:
    """Return min |1 + L| of a loop, 0 where it is unstable; of other laws than our own over the plant's grid."""
    sampled = prepared.sampled
    if spectral_radius(build_loop(sampled, controller)) >= 1.0:
        return 0.0
    if isinstance(controller, AdmittanceController):
        return prepared.find_modulus(controller)
    response = loop_at(plant_response(sampled, frequency_grid(sampled, _POINTS)), controller, sampled.sample_time_s)
    return float(min(np.min(np.abs(1.0 + response.at_force)), np.min(np.abs(1.0 + response.at_command))))
