"""What one kind of motion says about the offset between two clocks."""

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class Told:
    """The wrench's clock is ahead of the pose's by `offset_s` ± `std_s` (one deviation); `spans` of motion say so."""

    offset_s: float
    std_s: float
    spans: int
    method: str


@dataclass(frozen=True, kw_only=True)
class Untold:
    """Why one kind of motion says nothing, and what to record instead."""

    reason: str
    advice: str
