"""The phases of a log."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import StrEnum

_SAME_ONSET_S = 0.3


class Kind(StrEnum):
    """What a phase of a log is."""

    REST = "rest"
    TURNING = "turning"
    FREE_MOTION = "free-motion"
    COMMANDED_MOTION = "commanded-motion"
    HAND_LED_MOTION = "hand-led-motion"
    CONTACT = "contact"
    UNKNOWN = "unknown"


@dataclass(frozen=True, kw_only=True)
class ContactPhase:
    """What happens in a contact, in s after the start of the log, None where it is not shown.

    `hold_s` from when to when the payload rested on the surface; `bounces_s` when it left the surface before that;
    `surface` is the name of what was touched, None until told (`tell_surfaces`); `hand_suspected` that somebody pushed
    meanwhile, None where the log does not tell.
    """

    onset_s: float | None
    peak_s: float
    peak_force_n: float
    hold_s: tuple[float, float] | None
    release_s: float | None
    bounces_s: tuple[float, ...]
    surface: str | None
    hand_suspected: bool | None


@dataclass(frozen=True, kw_only=True)
class Phase:
    """One stretch of a log, `start_s` to `stop_s` after its start; `axis` of S where it goes along or about one.

    A contact begins with the first touch and ends with the last.
    """

    kind: Kind
    start_s: float
    stop_s: float
    axis: str | None = None
    contact: ContactPhase | None = None


@dataclass(frozen=True, kw_only=True)
class Timeline:
    """What happened when in one log, each instant told once; `log` is its name where there are several."""

    phases: tuple[Phase, ...]
    log: str = ""


def tell_surfaces(phases: Sequence[Phase], axis: str, onsets_s: Sequence[Sequence[float]]) -> tuple[Phase, ...]:
    """Give the contacts of an axis the names of their surfaces, `x1` for the first one on axis x.

    `onsets_s` holds for each surface when it was touched, in s after the start of the log.
    """

    def surface(phase: Phase) -> str | None:
        within = [
            f"{axis}{index + 1}"
            for index, onsets in enumerate(onsets_s)
            if any(phase.start_s - _SAME_ONSET_S <= onset < phase.stop_s for onset in onsets)
        ]
        return within[0] if len(within) == 1 else None

    return tuple(
        replace(phase, contact=replace(phase.contact, surface=surface(phase)))
        if phase.contact is not None and phase.axis == axis
        else phase
        for phase in phases
    )
