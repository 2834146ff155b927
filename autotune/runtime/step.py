"""One period of the six-axis controller: from the raw wrench and the measured pose to how the command goes on."""

import math
from collections.abc import Iterable, Sequence
from enum import IntEnum
from typing import NamedTuple

from problems.difference import controller_step, measured_motion, opposes, resume, through_deadband
from problems.errors import ParameterError

from .frames import Nine, Place, Six, external_wrench, is_rotation, way_between
from .law import AxisLaw, CollisionResponse, RuntimeController

NOTHING: Six = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


class Fault(IntEnum):
    """Why the command is held. A fault lasts until the controller is started again from `START`."""

    NONE = 0
    NOT_FINITE = 1
    """A number of the reading, or of the command that follows from it, is not finite."""
    NOT_A_ROTATION = 2
    """R_WS is no rotation."""
    JUMP = 3
    """The pose went farther in one period than a robot goes."""


class Phase(IntEnum):
    """Where the collision response is; it responds once and then waits for `rearm`."""

    WATCHING = 0
    RESPONDED = 1
    STOPPED = 2


class AxisState(NamedTuple):
    """What one axis keeps: the four states of the difference equation, the last drive, x and x^d as sent."""

    control: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    drive: float = 0.0
    position: float = 0.0
    command: float = 0.0


class State(NamedTuple):
    """What the controller keeps from one period to the next; x and x^d count from the pose at the start."""

    place: Place | None = None
    axes: tuple[AxisState, ...] = (AxisState(),) * 6
    phase: Phase = Phase.WATCHING
    fault: Fault = Fault.NONE


START = State()
"""Before the first period; the robot should stand, since its motion is told by the poses from here on."""


class Command(NamedTuple):
    """How the commanded pose goes on, (6,) each: x y z, then rx ry rz, in the axes of S as measured.

    `increment_S` is x^d_k − x^d_{k−1} in m and rad, `twist_S` the same per second. Axes that the file does not tune
    stand still. `wrench_S` is the measured wrench without weight and bias, before the deadband.
    """

    increment_S: Six
    twist_S: Six
    wrench_S: Six
    phase: Phase
    fault: Fault


class _Tick(NamedTuple):
    """One axis in one period: what was seen, what the robot's motion adds, what is wanted and what follows then."""

    seen: float
    way: float
    added: float
    following: AxisState


def step(
    controller: RuntimeController,
    state: State,
    *,
    wrench_S: Sequence[float],
    position_W_m: Sequence[float],
    R_WS: Sequence[Sequence[float]],
    desired_S: Sequence[float] = NOTHING,
) -> tuple[State, Command]:
    """Return the state after this period and the command in it; call it once per `sample_time_s`.

    `wrench_S` (6,) is the raw F/T sensor, N and N·m: what the payload puts on the flange, in the sensor's axes about
    its origin. `position_W_m` (3,) and `R_WS` (3, 3), v_W = R_WS v_S, are the measured pose of the sensor frame.
    `desired_S` (6,) is F^d, positive presses along the axis. Per axis, with F out of gravity compensation and deadband,
    u = F^d + F + P̂ O_a x and x^d = A(1 + C_ff) u − C_fb x in their Tustin form (MODEL.md, "Continuous blocks"); x is
    how far the sensor frame went along, or turned about, its own axis since the start.

    After a collision, the first F that opposes the motion of x, y or z beyond the threshold, all axes hold their
    command for one period and go on from rest ("reset"), or hold it until `rearm` ("stop"). A reading that is not
    finite, no pose or a jump holds the command of all axes from then on, see `Fault`.

    Raises ParameterError: an argument has another shape, or holds something that is no number.
    """
    wrench, desired = _six("wrench_S", wrench_S), _six("desired_S", desired_S)
    place = _place(position_W_m, R_WS)
    if state.fault is not Fault.NONE:
        return _held(state, state.fault)
    if not all(map(math.isfinite, (*wrench, *desired, *place[0], *place[1]))):
        return _held(state, Fault.NOT_FINITE)
    if not is_rotation(place[1]):
        return _held(state, Fault.NOT_A_ROTATION)
    way = way_between(state.place or place, place)
    if way is None:
        return _held(state, Fault.JUMP)
    external = external_wrench(controller.payload, wrench, place[1])
    ticks = [
        _tick(axis, state.axes[axis.index], desired[axis.index], external[axis.index], way[axis.index])
        for axis in controller.axes
    ]
    phase, resting = _phase(controller, state.phase, ticks)
    axes = list(state.axes)
    for axis, tick in zip(controller.axes, ticks, strict=True):
        axes[axis.index] = _rest(axis, state.axes[axis.index], tick) if resting else tick.following
    following = State(place, tuple(axes), phase, Fault.NONE)
    increment = _differences(following, state)
    if not all(map(math.isfinite, (*external, *increment, *(each for axis in axes for each in axis.control)))):
        return _held(state, Fault.NOT_FINITE)
    twist = _each(value / controller.sample_time_s for value in increment)
    return following, Command(increment, twist, external, phase, Fault.NONE)


def rearm(state: State) -> State:
    """Return the state in which the next collision is watched for again, and a full stop is over."""
    return state._replace(phase=Phase.WATCHING)


def _tick(axis: AxisLaw, before: AxisState, desired: float, external: float, way: float) -> _Tick:
    position, seen = before.position + way, through_deadband(external, axis.deadband, axis.is_subtractive)
    added, inertial = measured_motion(axis.blocks, before.control, position)
    wanted, control = controller_step(axis.blocks, before.control, desired + seen, position)
    return _Tick(seen, way, added, AxisState(control, desired + seen + inertial, position, wanted))


def _phase(controller: RuntimeController, phase: Phase, ticks: Sequence[_Tick]) -> tuple[Phase, bool]:
    """Return the phase from here on, and whether the command rests in this period (Algorithm 1 of the paper)."""
    if phase is Phase.WATCHING and controller.response is not CollisionResponse.NONE:
        met = any(
            opposes(tick.seen, tick.way, controller.threshold_n)
            for axis, tick in zip(controller.axes, ticks, strict=True)
            if not axis.turns
        )
        if met and controller.response is CollisionResponse.RESET:
            return Phase.RESPONDED, True
        if met:
            return Phase.STOPPED, True
    return phase, phase is Phase.STOPPED


def _rest(axis: AxisLaw, before: AxisState, tick: _Tick) -> AxisState:
    """Return the axis with its command held: both past outputs of the admittance are the same from here on."""
    control, drive, position, _ = tick.following
    output = before.command - tick.added
    integral, lag = resume(axis.blocks, (output, drive, position), (output, before.drive, before.position))
    return AxisState((integral, lag, control[2], control[3]), drive, position, before.command)


def _held(state: State, fault: Fault) -> tuple[State, Command]:
    return state._replace(fault=fault), Command(NOTHING, NOTHING, NOTHING, state.phase, fault)


def _differences(now: State, before: State) -> Six:
    return _each(new.command - old.command for new, old in zip(now.axes, before.axes, strict=True))


def _each(values: Iterable[float]) -> Six:
    x, y, z, rx, ry, rz = values
    return x, y, z, rx, ry, rz


def _six(name: str, values: Sequence[float]) -> Six:
    numbers = _floats(name, values)
    if len(numbers) != 6:
        raise ParameterError(name, values, "6 numbers")
    return _each(numbers)


def _place(position: Sequence[float], rows: Sequence[Sequence[float]]) -> Place:
    p = _floats("position_W_m", position)
    nine = [value for row in rows for value in _floats("R_WS", row)]
    if len(p) != 3:
        raise ParameterError("position_W_m", position, "3 numbers")
    if len(rows) != 3 or len(nine) != 9:
        raise ParameterError("R_WS", rows, "3 rows of 3 numbers")
    R: Nine = (nine[0], nine[1], nine[2], nine[3], nine[4], nine[5], nine[6], nine[7], nine[8])
    return (p[0], p[1], p[2]), R


def _floats(name: str, values: Sequence[float]) -> list[float]:
    try:
        return [float(value) for value in values]
    except (TypeError, ValueError) as reason:
        raise ParameterError(name, values, "numbers only") from reason
