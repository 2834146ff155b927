"""The peak of a contact that is touched at a given speed, by a hand that pushes on, holds on or lets go."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, Literal, get_args

from ..._checks import non_negative, positive
from ...contact.transient import Approach, SampledContact, build_sampled_contact, transient_from
from ...errors import ParameterError
from ...frozen import FrozenDict
from ...model.controller import AdmittanceController
from ...model.plant import Plant
from ...model.plant_parameters import PARAMETERS, with_values
from ...model.sampled import build_loop, build_sampled_plant, spectral_radius
from ...text import rounded_down
from ..hand import HandImpedance
from ..stable_design import PreparedPlants, StableDesign
from ..uncertainty import MASS, Scenario
from .base import Requirement

Hand = Literal["pushes_on", "lets_go", "holds"]
HANDS: tuple[Hand, ...] = get_args(Hand)

BODY_REGIONS: Mapping[str, float] = FrozenDict(
    {
        "skull": 130.0,
        "face": 65.0,
        "neck": 150.0,
        "back": 210.0,
        "chest": 140.0,
        "abdomen": 110.0,
        "pelvis": 180.0,
        "upper_arm": 150.0,
        "lower_arm": 160.0,
        "hand": 140.0,
        "thigh": 220.0,
        "lower_leg": 130.0,
    }
)
"""Largest permissible quasi-static force [N] on a clamped part of the body: ISO/TS 15066:2016, Table A.2."""


@dataclass(frozen=True, kw_only=True)
class ContactAtSpeed:
    """At most `max_force_n` [N] on whatever of the certified surfaces is touched at `speed_m_s`.

    What drives the payload goes on after the impact, as a hand that `pushes_on` or F^d does, or the hand `lets_go` at
    the impact, or it `holds`: pushes on with up to `hand_mass_kg` that moves with the payload. A `body_region`
    (`BODY_REGIONS`) gives its force; exactly one of both is given.
    """

    speed_m_s: float
    max_force_n: float = 0.0
    body_region: str | None = None
    hand: Hand = "pushes_on"
    # Made, not plain, so that a file keeps what it was designed for.
    hand_mass_kg: float = field(default_factory=lambda: HandImpedance().mass_kg)

    def __post_init__(self) -> None:
        if self.body_region is not None and self.body_region not in BODY_REGIONS:
            raise ParameterError("contact_at_speed.body_region", self.body_region, f"one of {', '.join(BODY_REGIONS)}")
        if (self.body_region is None) == (self.max_force_n == 0.0):
            said = self.max_force_n if self.body_region is None else self.body_region
            raise ParameterError("contact_at_speed", said, "given exactly one of max_force_n and body_region")
        if self.hand not in HANDS:
            raise ParameterError("contact_at_speed.hand", self.hand, "pushes_on, lets_go or holds")
        force = self.max_force_n if self.body_region is None else BODY_REGIONS[self.body_region]
        object.__setattr__(self, "max_force_n", positive("contact_at_speed.max_force_n", force))
        object.__setattr__(self, "body_region", None)
        object.__setattr__(self, "speed_m_s", positive("contact_at_speed.speed_m_s", self.speed_m_s))
        mass = non_negative("contact_at_speed.hand_mass_kg", self.hand_mass_kg)
        object.__setattr__(self, "hand_mass_kg", mass)

    @property
    def approach(self) -> Approach:
        """How the contact begins."""
        return hand_approach(self.speed_m_s, self.hand)


def hand_approach(speed_m_s: float, hand: Hand) -> Approach:
    """Return the approach of a payload that a hand leads at a steady speed [m/s] until it touches."""
    return Approach(speed_m_s=speed_m_s, driven_by="hand", after_impact_n=0.0 if hand == "lets_go" else None)


def led_plants(plant: Plant, hand: Hand, hand_mass_kg: float) -> tuple[Plant, ...]:
    """Return a plant as a hand leads it: alone, and with the mass of one that `holds` it on its payload.

    The damper and the spring of such a hand, whose aim rests from the impact on, only take from the force that it
    pushed with before.
    """
    if hand != "holds" or hand_mass_kg == 0.0:
        return (plant,)
    return plant, with_values(plant, {MASS: PARAMETERS[MASS].value(plant) + hand_mass_kg})


def led_contacts(pair: SampledContact, hand: Hand, hand_mass_kg: float) -> tuple[SampledContact, ...]:
    """Return the sampled contacts of `led_plants`, the given one first."""
    plant, h = pair.contact.plant, pair.contact.sample_time_s
    others = led_plants(plant, hand, hand_mass_kg)[1:]
    return pair, *(build_sampled_contact(build_sampled_plant(each, h)) for each in others)


def led_peaks(pair: SampledContact, law: AdmittanceController, approaches: Sequence[Approach]) -> list[float]:
    """Return the peak force on the environment [N] of each approach, infinite where the loop is not stable."""
    if max(spectral_radius(build_loop(side, law)) for side in (pair.free, pair.contact)) >= 1.0:
        return [math.inf] * len(approaches)
    return [transient_from(pair, law, each).peak_contact_force_n for each in approaches]


def led_mass_kg(asked: Mapping[str, Any], lever_m: float = 1.0) -> float:
    """Return the mass of the hand that is certified: the one that is asked, else the default at a lever [m]."""
    limit = asked.get("contact_at_speed")
    if isinstance(limit, ContactAtSpeed):
        return limit.hand_mass_kg
    return HandImpedance().turned(lever_m).mass_kg


def _speed_unit(*, turning: bool) -> str:
    return "rad/s" if turning else "m/s"


class ContactAtSpeedLimit(Requirement[ContactAtSpeed]):
    """max F_e of every scenario's contact at that speed [N]."""

    name, title = "contact_at_speed", "contact at a speed"
    asked_as = ContactAtSpeed
    depends_on: ClassVar[Literal["loop", "robot", "contact"]] = "contact"
    unit, turning_unit = "N", "N·m"
    lever_power = 1
    is_upper_limit = True

    def threshold(self, asked: ContactAtSpeed) -> float:
        """Return the largest force [N]."""
        return asked.max_force_n

    def with_threshold(self, asked: ContactAtSpeed, threshold: float) -> ContactAtSpeed:
        """Return the same with another force."""
        return replace(asked, max_force_n=threshold)

    def turned(self, asked: ContactAtSpeed, lever: float) -> ContactAtSpeed:
        """Return the torque and the rotational speed at a lever in metres."""
        speed, mass = (float(f"{number:.9g}") for number in (asked.speed_m_s / lever, asked.hand_mass_kg * lever**2))
        return replace(super().turned(asked, lever), speed_m_s=speed, hand_mass_kg=mass)

    def read(self, entry: Mapping[str, Any]) -> ContactAtSpeed:
        """Return what plain data asks."""
        return ContactAtSpeed(**entry)

    def describe(self, asked: ContactAtSpeed, *, turning: bool = False) -> str:
        """Return force, speed and what the hand does in words."""
        speed = f"{asked.speed_m_s:g} {_speed_unit(turning=turning)}"
        return f"at most {asked.max_force_n:g} {self.unit_on(turning=turning)} at {speed}, the hand " + (
            asked.hand.replace("_", " ")
        )

    def easing_note(self, asked: ContactAtSpeed, possible: float, *, turning: bool = False) -> str:
        """Return the speed at which the force would hold: a contact's force scales with its speed."""
        force = f"{asked.max_force_n:g} {self.unit_on(turning=turning)}"
        speed = f"{rounded_down(asked.speed_m_s * asked.max_force_n / possible):g} {_speed_unit(turning=turning)}"
        return f" A contact's force scales with its speed: {force} would hold at {speed}."

    def count(self, prepared: PreparedPlants) -> int:
        """Return the number of scenarios."""
        return len(prepared.scenarios)

    def achieved(self, asked: ContactAtSpeed, design: StableDesign, row: int) -> float:
        """Return the peak force on the environment in one scenario [N]."""
        pair, key = design.prepared.pairs[row], (self.name, row, asked.hand, asked.hand_mass_kg)
        led = design.prepared.once(key, lambda: led_contacts(pair, asked.hand, asked.hand_mass_kg))
        own = transient_from(pair, design.controller, asked.approach).peak_contact_force_n
        return max([own, *(led_peaks(each, design.controller, [asked.approach])[0] for each in led[1:])])

    def scenario(self, prepared: PreparedPlants, row: int) -> Scenario:
        """Return the scenario."""
        return prepared.scenarios[row]
