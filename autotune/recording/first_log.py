"""The program of a first log, poses, sweep, taps and contacts, as commands period by period."""

import math
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

from problems.errors import ParameterError
from problems.model.difference import controller_step, write_blocks

Three = tuple[float, float, float]
FirstLogCommands = Generator["FirstLogCommand", Sequence[float], None]

_GOLDEN_ANGLE_RAD = 2.399963
_ZERO: Three = (0.0, 0.0, 0.0)
# The admittance goes on for so long after F^d is taken away: several of its time constants M_a/B_a.
_SLOWING_S = 0.4


class FirstLogCommand(NamedTuple):
    """What the robot is sent in a period, from the pose in which the program began, along and about its tool axes.

    `phase` is rest, poses, sweep, taps, contacts or stopped. The flange's position is p_0 + R_0 · `displacement_m`,
    its orientation R_0 · exp(`rotation_rad`).
    """

    phase: str
    displacement_m: Three
    rotation_rad: Three


class PlainAdmittance:
    """The admittance 1/(M_a s² + B_a s) of the first log, without lead or compensation, in its Tustin form.

    Equation (1) of Haninger et al. with K_l = 0; force to displacement, from rest.

    Parameters
    ----------
    mass_kg, damping_n_s_per_m
        M_a and B_a. More damping is safer in contact: the approach is F^d/B_a.
    period_s
        How often it is stepped.

    Raises
    ------
    ParameterError
        A number that is not above 0.

    """

    def __init__(self, *, mass_kg: float = 20.0, damping_n_s_per_m: float = 2000.0, period_s: float) -> None:
        for name, value in (("mass_kg", mass_kg), ("damping_n_s_per_m", damping_n_s_per_m), ("period_s", period_s)):
            _check_above_zero(name, value)
        self._blocks: dict[Any, float] = {}
        # The filters have no gain here; their corners only have to be some.
        write_blocks(self._blocks, (mass_kg, damping_n_s_per_m, 0.0, 0.0, 1.0, 1.0, 0.0), period_s, 0.5, ideal=False)
        self._state = (0.0, 0.0, 0.0, 0.0)

    def step(self, force_n: float) -> float:
        """Return the displacement [m] that is commanded in this period for F^d + F [N]."""
        command, self._state = controller_step(self._blocks, self._state, force_n, 0.0)
        return float(command)


@dataclass(frozen=True, kw_only=True)
class FirstLog:
    """How long and how strongly each phase of a first log runs; begin where the tool is free all around.

    Parameters
    ----------
    axis
        The tool axis that is swept and along which the tool presses, towards +.
    rest_s
        Rest between phases [s], 1 s or more for a robot that settles slowly.
    pose_count, tilts_rad, pose_move_s, pose_hold_s
        Orientations, smallest and largest tilt [rad], duration of a move and of the rest after it [s].
    sweep_s, sweep_hz, sweep_speed_m_s, robot_bandwidth_hz
        Duration [s], first and last frequency [Hz], speed of the flange [m/s]; above the robot's bandwidth [Hz] the
        command is made larger in the same measure. 0 s leaves the sweep out.
    tap_count
        For how many seconds the robot rests so that somebody knocks on the payload once a second.
    contact_count, contact_force_n, contact_hold_s, approach_s, retract_m
        Contacts, F^d [N], how long to press after the touch [s], how long to wait for it [s], and how far to back off.
    mass_kg, damping_n_s_per_m
        M_a and B_a of the plain admittance with which the tool approaches and presses.
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
    rest_s: float = 1.0
    pose_count: int = 8
    tilts_rad: tuple[float, float] = (0.5, 1.1)
    pose_move_s: float = 1.0
    pose_hold_s: float = 1.0
    sweep_s: float = 12.0
    sweep_hz: tuple[float, float] = (0.5, 50.0)
    sweep_speed_m_s: float = 0.005
    robot_bandwidth_hz: float = 3.0
    tap_count: int = 0
    contact_count: int = 3
    contact_force_n: float = 30.0
    contact_hold_s: float = 1.5
    approach_s: float = 6.0
    retract_m: float = 0.01
    mass_kg: float = 20.0
    damping_n_s_per_m: float = 2000.0
    stop_force_n: float = 200.0

    def __post_init__(self) -> None:
        if self.axis not in "xyz" or len(self.axis) != 1:
            raise ParameterError("axis", self.axis, "x, y or z")
        for name in ("pose_count", "tap_count", "contact_count", "sweep_s"):
            if not getattr(self, name) >= 0:
                raise ParameterError(name, getattr(self, name), "not below 0")
        for name in (
            *("rest_s", "pose_move_s", "pose_hold_s", "sweep_speed_m_s", "robot_bandwidth_hz", "contact_force_n"),
            *("contact_hold_s", "approach_s", "retract_m", "mass_kg", "damping_n_s_per_m"),
        ):
            _check_above_zero(name, getattr(self, name))
        if not 0.0 < self.sweep_hz[0] < self.sweep_hz[1]:
            raise ParameterError("sweep_hz", self.sweep_hz, "an increasing pair above 0")
        if not 0.0 < self.tilts_rad[0] <= self.tilts_rad[1] < math.pi / 2.0:
            raise ParameterError("tilts_rad", self.tilts_rad, "an increasing pair between 0 and π/2")
        if not self.stop_force_n > self.contact_force_n:
            raise ParameterError("stop_force_n", self.stop_force_n, f"above contact_force_n = {self.contact_force_n}")

    def commands(self, *, period_s: float) -> FirstLogCommands:
        """Yield the command of each period; after the first send the raw wrench (6,) [N, N·m] of the period before.

        The weight and the bias of the sensor are those of the first rest, which nothing may touch, so no payload has
        to be known: forces are used at the working orientation only.
        """
        _check_above_zero("period_s", period_s)
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


Steps = Generator[tuple[float, Three], float, None]


def _phases(program: FirstLog, h: float) -> Iterator[tuple[str, Steps]]:
    """Yield the phases, of each the way along the axis and the rotation vector, driven by the force along the axis."""
    last = [0.0]
    rest = round(program.rest_s / h)
    yield "poses", _poses(program, h)
    yield "sweep", _sweep(program, h)
    yield "rest", _hold(last, rest)
    yield "taps", _hold(last, round(program.tap_count / h))
    for _ in range(program.contact_count):
        yield "contacts", _contact(program, h, last)
        yield "rest", _hold(last, rest)


def _hold(last: list[float], samples: int) -> Steps:
    for _ in range(samples):
        yield last[0], _ZERO


def _smooth(t: float) -> float:
    """Return a minimum-jerk ramp from 0 to 1."""
    return t**3 * (10.0 - 15.0 * t + 6.0 * t * t)


def _poses(program: FirstLog, h: float) -> Steps:
    """Tilt to well spread orientations and rest at each, back through the first one: every move has one fixed axis."""
    moving, holding = max(1, round(program.pose_move_s / h)), round(program.pose_hold_s / h)
    low, high = program.tilts_rad
    for i in range(program.pose_count):
        # Golden angle and golden ratio spread any number of directions and tilts.
        tilt, direction = low + (high - low) * (0.618034 * i % 1.0), _GOLDEN_ANGLE_RAD * i
        there = (tilt * math.cos(direction), tilt * math.sin(direction), 0.0)
        ramp = [_smooth((k + 1) / moving) for k in range(moving)]
        for share in (*ramp, *[1.0] * holding, *[1.0 - each for each in ramp]):
            yield 0.0, (there[0] * share, there[1] * share, 0.0) if share > 0.0 else _ZERO
    for _ in range(round(program.rest_s / h) if program.pose_count else 0):
        yield 0.0, _ZERO


def _sweep(program: FirstLog, h: float) -> Steps:
    """Command a logarithmic sweep at one speed of the flange, tapered to rest at both ends."""
    samples = round(program.sweep_s / h)
    low, high = program.sweep_hz
    edge = max(2, samples // 20)
    for k in range(samples):
        rate = math.log(high / low) / program.sweep_s
        frequency = low * math.exp(rate * k * h)
        phase = 2.0 * math.pi * low * math.expm1(rate * k * h) / rate
        speed = program.sweep_speed_m_s * math.hypot(1.0, frequency / program.robot_bandwidth_hz)
        window = _smooth(min(1.0, k / edge, (samples - 1 - k) / edge))
        yield window * speed / (2.0 * math.pi * frequency) * math.sin(phase), _ZERO


def _contact(program: FirstLog, h: float, last: list[float]) -> Steps:
    """Press with F^d until the touch and `contact_hold_s` beyond it, back off by `retract_m`, and slow down."""
    admittance = PlainAdmittance(mass_kg=program.mass_kg, damping_n_s_per_m=program.damping_n_s_per_m, period_s=h)
    start, sensed = last[0], 0.0

    def run(desired_n: float, periods: int, until: Callable[[], bool]) -> Steps:
        nonlocal sensed
        for _ in range(periods):
            if until():
                return
            last[0] = start + admittance.step(desired_n + sensed)
            sensed = yield last[0], _ZERO

    yield from run(
        program.contact_force_n, round(program.approach_s / h), lambda: sensed < -0.5 * program.contact_force_n
    )
    yield from run(program.contact_force_n, round(program.contact_hold_s / h), lambda: False)
    held = last[0]
    away = lambda: last[0] < held - program.retract_m  # noqa: E731 - one expression
    yield from run(-0.5 * program.contact_force_n, round(program.approach_s / h), away)
    yield from run(0.0, round(_SLOWING_S / h), lambda: False)


def _check_above_zero(name: str, value: float) -> None:
    if not (math.isfinite(value) and value > 0.0):
        raise ParameterError(name, value, "a finite number above 0")
