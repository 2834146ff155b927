"""The peak of a contact that is touched at a given speed, by a hand that pushes on or lets go."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Literal, get_args

from ..._checks import positive
from ...contact.transient import Approach, transient_from
from ...errors import ParameterError
from ...frozen import FrozenDict
from ..stable_design import PreparedPlants, StableDesign
from ..uncertainty import Scenario
from .base import Requirement

Hand = Literal["pushes_on", "lets_go"]
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
    the impact. A `body_region` (`BODY_REGIONS`) gives its force; exactly one of both is given.
    """

    speed_m_s: float
    max_force_n: float = 0.0
    body_region: str | None = None
    hand: Hand = "pushes_on"

    def __post_init__(self) -> None:
        if self.body_region is not None and self.body_region not in BODY_REGIONS:
            raise ParameterError("contact_at_speed.body_region", self.body_region, f"one of {', '.join(BODY_REGIONS)}")
        if (self.body_region is None) == (self.max_force_n == 0.0):
            said = self.max_force_n if self.body_region is None else self.body_region
            raise ParameterError("contact_at_speed", said, "given exactly one of max_force_n and body_region")
        if self.hand not in HANDS:
            raise ParameterError("contact_at_speed.hand", self.hand, "pushes_on or lets_go")
        force = self.max_force_n if self.body_region is None else BODY_REGIONS[self.body_region]
        object.__setattr__(self, "max_force_n", positive("contact_at_speed.max_force_n", force))
        object.__setattr__(self, "body_region", None)
        object.__setattr__(self, "speed_m_s", positive("contact_at_speed.speed_m_s", self.speed_m_s))

    @property
    def approach(self) -> Approach:
        """How the contact begins."""
        return hand_approach(self.speed_m_s, self.hand)


def hand_approach(speed_m_s: float, hand: Hand) -> Approach:
    """Return the approach of a payload that a hand leads at a steady speed [m/s] until it touches."""
    return Approach(speed_m_s=speed_m_s, driven_by="hand", after_impact_n=0.0 if hand == "lets_go" else None)


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
        return replace(super().turned(asked, lever), speed_m_s=float(f"{asked.speed_m_s / lever:.9g}"))

    def read(self, entry: Mapping[str, Any]) -> ContactAtSpeed:
        """Return what plain data asks."""
        return ContactAtSpeed(**entry)

    def describe(self, asked: ContactAtSpeed, *, turning: bool = False) -> str:
        """Return force, speed and what the hand does in words."""
        speed = f"{asked.speed_m_s:g} {'rad/s' if turning else 'm/s'}"
        return f"at most {asked.max_force_n:g} {self.unit_on(turning=turning)} at {speed}, the hand " + (
            asked.hand.replace("_", " ")
        )

    def easing_note(self, asked: ContactAtSpeed, possible: float) -> str:
        """Return the speed at which the force would hold: a contact's force scales with its speed."""
        speed = asked.speed_m_s * asked.max_force_n / possible
        return f" A contact's force scales with its speed: {asked.max_force_n:g} would hold at {speed:.2g}."

    def count(self, prepared: PreparedPlants) -> int:
        """Return the number of scenarios."""
        return len(prepared.scenarios)

    def achieved(self, asked: ContactAtSpeed, design: StableDesign, row: int) -> float:
        """Return the peak force on the environment in one scenario [N]."""
        return transient_from(design.prepared.pairs[row], design.controller, asked.approach).peak_contact_force_n

    def scenario(self, prepared: PreparedPlants, row: int) -> Scenario:
        """Return the scenario."""
        return prepared.scenarios[row]
