"""The program of a first log, poses, sweep, taps and contacts, as commands period by period."""

import math
from collections.abc import Generator, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Literal, NamedTuple

from problems.errors import ParameterError

from .guarded_contacts import GuardedContacts, Steps
from .motions import FreeMotions, Three, check_above_zero

FirstLogCommands = Generator["FirstLogCommand", Sequence[float], None]

_ZERO: Three = (0.0, 0.0, 0.0)
# The sweep is levelled to this share of its largest force: a resonance swings on while the sweep gets smaller.
_LEVEL = 0.6
_STEEPNESS, _ENVELOPE_S, _SMALLER_S, _LARGER_S = 3, 0.2, 0.03, 0.4


class FirstLogCommand(NamedTuple):
    """What the robot is sent in a period, from the pose in which the program began, along and about its tool axes.

    `phase` is rest, poses, sweep, taps, contacts or stopped. The flange's position is p_0 + R_0 · `displacement_m`,
    its orientation R_0 · exp(`rotation_rad`).
    """

    phase: str
    displacement_m: Three
    rotation_rad: Three


@dataclass(frozen=True, kw_only=True)
class FirstLog(FreeMotions):
    """How long and how strongly each phase of a first log runs; begin where the tool is free all around.

    Parameters
    ----------
    rest_s, pose_count, tilts_rad, pose_move_s, pose_hold_s, sweep_s, sweep_hz, sweep_speed_m_s, robot_bandwidth_hz
        The free motions, as `FreeMotions` has them.
    axis
        The tool axis that is swept and along which the tool presses, towards +.
    tap_count
        For how many seconds the robot rests so that somebody knocks on the payload once a second.
    contact_count, contact_force_n, contact_hold_s
        Contacts, F^d [N], and for how long to press with it [s].
    approach_speed_m_s, fastest_approach_m_s, approach_m, retract_m
        Speed of the first approach, which is slow since nobody knows the surface, and the largest of the others [m/s]
        (see `GuardedContacts`); how far to look for a surface, after which no further contact is made, and how far to
        back off [m].
    sweep_force_n
        Largest force of the sweep along the axis [N], where `sweep_speed_m_s` alone would make more.
    stop_force_n
        Largest change of the sensor's force since the start [N] at working orientation; beyond it the program holds the
        command and ends.

    Raises
    ------
    ParameterError
        A number of the program is out of range.

    Examples
    --------
    >>> from autotune.recording import FirstLog
    >>> commands = FirstLog(axis="z", contact_count=0).commands(period_s=8e-4)
    >>> next(commands).phase
    'rest'

    """

    axis: Literal["x", "y", "z"] = "z"
    tap_count: int = 0
    contact_count: int = 3
    contact_force_n: float = 30.0
    contact_hold_s: float = 2.0
    approach_speed_m_s: float = 0.003
    fastest_approach_m_s: float = 0.02
    approach_m: float = 0.03
    retract_m: float = 0.01
    sweep_force_n: float = 80.0
    stop_force_n: float = 200.0

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.axis not in "xyz" or len(self.axis) != 1:
            raise ParameterError("axis", self.axis, "x, y or z")
        for name in ("tap_count", "contact_count"):
            if not getattr(self, name) >= 0:
                raise ParameterError(name, getattr(self, name), "not below 0")
        for name in (
            "contact_force_n",
            "contact_hold_s",
            "approach_speed_m_s",
            "approach_m",
            "retract_m",
            "sweep_force_n",
        ):
            check_above_zero(name, getattr(self, name))
        if not self.fastest_approach_m_s >= self.approach_speed_m_s:
            limit = f"not below approach_speed_m_s = {self.approach_speed_m_s}"
            raise ParameterError("fastest_approach_m_s", self.fastest_approach_m_s, limit)
        for name in ("contact_force_n", "sweep_force_n"):
            if not self.stop_force_n > getattr(self, name):
                raise ParameterError("stop_force_n", self.stop_force_n, f"above {name} = {getattr(self, name)}")

    def commands(self, *, period_s: float) -> FirstLogCommands:
        """Yield the command of each period; after the first send the raw wrench (6,) [N, N·m] of the period before.

        The weight and the bias of the sensor are those of the first rest, which nothing may touch, so no payload has
        to be known: forces are used at the working orientation only.
        """
        check_above_zero("period_s", period_s)
        return _commands(self, period_s)


def _commands(program: FirstLog, h: float) -> FirstLogCommands:
    index, rest = "xyz".index(program.axis), max(1, round(program.rest_s / h))
    sums = _ZERO
    for _ in range(rest):
        force = _force((yield FirstLogCommand("rest", _ZERO, _ZERO)))
        sums = (sums[0] + force[0], sums[1] + force[1], sums[2] + force[2])
    for phase, steps in _phases(program, h):
        with suppress(StopIteration):
            along, rotation = next(steps)
            while True:
                displacement = (along * (index == 0), along * (index == 1), along * (index == 2))
                force = _force((yield FirstLogCommand(phase, displacement, rotation)))
                change = [each - total / rest for each, total in zip(force, sums, strict=True)]
                if rotation == _ZERO and math.hypot(*change) > program.stop_force_n:
                    for _ in range(rest):
                        yield FirstLogCommand("stopped", displacement, _ZERO)
                    return
                along, rotation = steps.send(change[index])


def _force(wrench: Sequence[float] | None) -> Three:
    """Return the force of what was sent, which must be the six numbers of the sensor."""
    if wrench is None or len(wrench) != 6:
        raise ParameterError("wrench", wrench, "the raw wrench (6,) of this period: commands.send(wrench), not next()")
    return float(wrench[0]), float(wrench[1]), float(wrench[2])


def _phases(program: FirstLog, h: float) -> Iterator[tuple[str, Steps]]:
    """Yield the phases, driven by the force along the axis."""
    contacts = GuardedContacts(
        force_n=program.contact_force_n,
        hold_s=program.contact_hold_s,
        speed_m_s=program.approach_speed_m_s,
        fastest_m_s=program.fastest_approach_m_s,
        approach_m=program.approach_m,
        retract_m=program.retract_m,
        period_s=h,
    )
    yield "poses", _poses(program, h)
    yield "sweep", _sweep(program, h)
    yield "rest", contacts.dwell(program.rest_s)
    yield "taps", contacts.dwell(program.tap_count)
    for _ in range(program.contact_count):
        if contacts.has_touched:
            yield "contacts", contacts.contact()
            yield "rest", contacts.dwell(program.rest_s)


def _poses(program: FirstLog, h: float) -> Steps:
    for rotation in program.rotations(h):
        yield 0.0, rotation
    for _ in range(round(program.rest_s / h) if program.pose_count else 0):
        yield 0.0, _ZERO


def _sweep(program: FirstLog, h: float) -> Steps:
    """Sweep, smaller where the payload's resonance would make the force larger than `sweep_force_n`."""
    share, envelope, level = 1.0, 0.0, _LEVEL * program.sweep_force_n
    for displacement in program.sweep(h):
        force = yield share * displacement, _ZERO
        envelope = max(abs(force), envelope * math.exp(-h / _ENVELOPE_S))
        wanted = min(1.0, share * (level / max(envelope, 1e-9)) ** _STEEPNESS)
        share += (wanted - share) * (1.0 - math.exp(-h / (_SMALLER_S if wanted < share else _LARGER_S)))
