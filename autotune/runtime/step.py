"""One period of the six-axis controller: from the raw wrench and the measured pose to how the command goes on."""

import math
from collections.abc import Iterable, Sequence
from enum import IntEnum
from numbers import Integral
from typing import NamedTuple

from autotune.formats.limits import CollisionResponse
from problems.errors import ParameterError
from problems.model.difference import (
    ControlState,
    Entry,
    controller_step,
    measured_motion,
    opposes_motion,
    resume,
    shaped_drive,
    through_deadband,
    varied_damping,
)

from .controller import RuntimeController
from .frames import Nine, Place, Six, external_wrench, is_rotation, way_between
from .guard import MOST_HELD, MOST_PERIODS, UNFELT_WAY, UNSEEN_WAY, Guard, Watch, rest, see, send, weigh
from .law import AxisLaw, Blocks

NOTHING: Six = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)

TICKS = 2**32
"""A count of periods begins again at 0 after so many, as one of 32 bits does."""

# What can be iterated over and yet gives no axis its number.
_UNORDERED = (dict, set, frozenset)


class Fault(IntEnum):
    """Why the command is held. A fault lasts until the controller is started again from `START`, at rest."""

    NONE = 0
    NOT_FINITE = 1
    """A number of the reading, or of the command that follows from it, is not finite."""
    NOT_A_ROTATION = 2
    """R_WS is no rotation."""
    JUMP = 3
    """The measured pose went faster than `limits.pose_speed_m_s` or `limits.pose_speed_rad_s`."""
    FORCE_RANGE = 4
    """A component of the raw force reached `limits.force_n`."""
    TORQUE_RANGE = 5
    """A component of the raw torque reached `limits.torque_n_m`."""
    SPEED = 6
    """The command of an axis would be faster than `limits.axes.<axis>.speed`, or behind the lag `followed_speed`."""
    ACCELERATION = 7
    """The speed of the command of an axis would change faster than `limits.axes.<axis>.acceleration`."""
    STALE_WRENCH = 8
    """The wrench did not change for `limits.stale_wrench_s` while the command moved."""
    STALE_POSE = 9
    """The pose did not change for `limits.stale_pose_s` while the command moved."""
    RESIDUAL_WRENCH = 10
    """At the start the compensation left more than `limits.rest_force_n` or `limits.rest_torque_n_m`."""
    OTHER_PAYLOAD = 11
    """A constant weight that is not compensated moves the command: the payload is gone, or is another one."""
    MISSED_TICK = 12
    """The caller's count went on by more than one period, or is not given any more."""
    REPEATED_TICK = 13
    """The caller's count did not go on."""


class Phase(IntEnum):
    """Where the collision response is; it responds once and then waits for `rearm`."""

    WATCHING = 0
    RESPONDED = 1
    STOPPED = 2


class AxisState(NamedTuple):
    """What one axis keeps: the states of the difference equation, the last drive, x and x^d as sent.

    `output` is the admittance's own share of x^d, `older` output, drive and x a period before. `damping` and `blocks`
    are those in use where B_a varies, None before it did; they are `periods` old.
    """

    control: ControlState = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    drive: float = 0.0
    position: float = 0.0
    command: float = 0.0
    output: float = 0.0
    older: Entry = (0.0, 0.0, 0.0)
    damping: float | None = None
    blocks: Blocks | None = None
    periods: int = 0


class State(NamedTuple):
    """What the controller keeps from one period to the next; x and x^d count from the pose at the start.

    `twist` is the command's last speed, `followed` that behind the lag of `limits.axes`; `tick` is the caller's last
    count, None without one; `since_change` periods ago another controller took over (`change`).
    """

    place: Place | None = None
    axes: tuple[AxisState, ...] = (AxisState(),) * 6
    phase: Phase = Phase.WATCHING
    fault: Fault = Fault.NONE
    twist: Six = NOTHING
    followed: Six = NOTHING
    watch: Watch = Watch()
    tick: int | None = None
    since_change: int = MOST_PERIODS


START = State()
"""Before the first period: the robot is at rest, nothing touches it, and its motion follows from the next poses."""


class Command(NamedTuple):
    """How the commanded pose goes on, (6,) each: x y z, then rx ry rz, in the axes of S as measured.

    `increment_S` is x^d_k − x^d_{k−1} in m and rad, `twist_S` the same per second. Axes that the file does not tune
    do not move. `wrench_S` is the measured wrench without weight and bias, before the deadband. `is_started` is False
    while the first readings are held against rest, and nothing moves. `missing_mass_kg` is what the compensation leaves
    along gravity as a mass: of the mean of these readings, later of the last ones. Positive: the cell carries more.
    """

    increment_S: Six
    twist_S: Six
    wrench_S: Six
    phase: Phase
    fault: Fault
    is_started: bool
    missing_mass_kg: float


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
    tick: int | None = None,
) -> tuple[State, Command]:
    """Return the state after this period and the command in it; call it once per `sample_time_s`.

    `wrench_S` (6,) is the raw F/T sensor, N and N·m: what the payload puts on the flange, in the sensor's axes about
    its origin. `position_W_m` (3,) and `R_WS` (3, 3), v_W = R_WS v_S, are the measured pose of the sensor frame.
    `desired_S` (6,) is F^d, positive presses along the axis. `tick` is the caller's count of the periods, one more in
    each (a counter of 32 bits may begin again at 0); without it periods that are left out are not noticed. Per axis,
    with F out of gravity compensation and deadband, u = F^d + F + P̂ O_a x and x^d = A(1 + C_ff) N u − C_fb x in their
    Tustin form (docs/method.md, "The loop"); x is how far the sensor frame went along, or turned about, its own axis
    since the start.

    The first `limits.rest_samples` readings move nothing: their mean must be that of a robot at rest which nothing
    touches. After a collision, the first F that opposes the motion of x, y or z beyond the threshold, all axes hold
    their command for one period and go on from rest ("reset"), or hold it until `rearm` ("stop"). What is not within
    `controller.limits`, not finite or no pose holds the command of all axes from then on, see `Fault`.

    Raises ParameterError: an argument has another shape, or holds something that is no number.
    """
    check_kind("controller", controller, RuntimeController)
    check_kind("state", state, State)
    wrench, desired = six("wrench_S", wrench_S), six("desired_S", desired_S)
    place, count = place_of(position_W_m, R_WS), tick_of(tick)
    if state.fault is not Fault.NONE:
        return _held(state, state.fault)
    fault = _unsound(controller, state, wrench, desired, place, count)
    way = None if fault is not Fault.NONE else _way(controller, state, place)
    if way is None:
        return _held(state, fault or Fault.JUMP)
    seen = state._replace(place=place, tick=count, watch=see(state.watch, wrench, state.place, place))
    external = external_wrench(controller.payload, wrench, place[1])
    if not all(map(math.isfinite, external)):
        return _held(state, Fault.NOT_FINITE)
    if seen.watch.resting < controller.limits.rest_samples:
        return _at_rest(controller, seen, external, place[1])
    fault = _stale(controller.guard, seen.watch)
    if fault is not Fault.NONE:
        return _held(seen, fault)
    return _moved(controller, seen, desired, external, way)


def _at_rest(controller: RuntimeController, state: State, external: Six, R: Nine) -> tuple[State, Command]:
    """Return what follows one of the first readings, which move nothing."""
    watch, is_loaded = rest(controller.guard, controller.payload, state.watch, external, R)
    state = state._replace(watch=watch)
    if is_loaded:
        return _held(state, Fault.RESIDUAL_WRENCH)
    return state, Command(NOTHING, NOTHING, external, state.phase, Fault.NONE, False, watch.missing_kg)


def _moved(controller: RuntimeController, state: State, desired: Six, external: Six, way: Six) -> tuple[State, Command]:
    """Return what follows a sound reading: the law of every axis, and the command unless a limit forbids it."""
    ticks = [
        _tick(axis, state.axes[axis.index], desired[axis.index], external[axis.index], way[axis.index])
        for axis in controller.axes
    ]
    phase, resting = _phase(controller, state.phase, ticks)
    axes = list(state.axes)
    for axis, tick in zip(controller.axes, ticks, strict=True):
        axes[axis.index] = _rest(axis, state.axes[axis.index], tick) if resting else tick.following
    increment = _differences(axes, state.axes)
    twist = each_of(value / controller.sample_time_s for value in increment)
    if not all(map(math.isfinite, (*twist, *(each for axis in axes for each in axis.control)))):
        return _held(state, Fault.NOT_FINITE)
    followed = _followed(controller, twist, state.followed)
    fault = Fault.NONE if resting else _too_fast(controller, twist, state.twist, followed)
    watch, is_other = state.watch, False
    if fault is Fault.NONE and state.place is not None:
        watch, is_other = weigh(controller.guard, controller.payload, watch, external, state.place[1], increment)
    state = state._replace(watch=watch)
    if fault is not Fault.NONE or is_other:
        return _held(state, fault or Fault.OTHER_PAYLOAD)
    since = state.since_change if state.since_change >= MOST_PERIODS else state.since_change + 1
    following = state._replace(
        axes=tuple(axes),
        phase=phase,
        twist=twist,
        followed=followed,
        watch=send(watch, increment),
        since_change=since,
    )
    return following, Command(increment, twist, external, phase, Fault.NONE, True, watch.missing_kg)


def _unsound(
    controller: RuntimeController, state: State, wrench: Six, desired: Six, place: Place, count: int | None
) -> Fault:
    """Return what is wrong with a reading by itself, and with its count."""
    fault = _out_of_step(state.tick, count)
    if fault is not Fault.NONE:
        return fault
    if not all(map(math.isfinite, (*wrench, *desired, *place[0], *place[1]))):
        return Fault.NOT_FINITE
    if not is_rotation(place[1]):
        return Fault.NOT_A_ROTATION
    if not all(abs(each) < controller.limits.force_n for each in wrench[:3]):
        return Fault.FORCE_RANGE
    within = all(abs(each) < controller.limits.torque_n_m for each in wrench[3:])
    return Fault.NONE if within else Fault.TORQUE_RANGE


def _out_of_step(before: int | None, count: int | None) -> Fault:
    """Return what is wrong with the caller's count; None is no count."""
    if before is None:
        return Fault.NONE
    further = 2 if count is None else (count - before) % TICKS
    if further == 1:
        return Fault.NONE
    return Fault.MISSED_TICK if 1 < further < TICKS // 2 else Fault.REPEATED_TICK


def _way(controller: RuntimeController, state: State, place: Place) -> Six | None:
    """Return how far the pose went since the last reading, None for farther than it can in the time since it moved."""
    periods = float(min(state.watch.pose_same + 1, MOST_HELD))
    guard = controller.guard
    return way_between(state.place or place, place, guard.way_m * periods, guard.way_rad * periods)


def _stale(guard: Guard, watch: Watch) -> Fault:
    """Return which reading does not change though the command moves."""
    if watch.wrench_same >= guard.wrench_periods and watch.wrench_way > UNFELT_WAY:
        return Fault.STALE_WRENCH
    if watch.pose_same >= guard.pose_periods and watch.pose_way > UNSEEN_WAY:
        return Fault.STALE_POSE
    return Fault.NONE


def _followed(controller: RuntimeController, twist: Six, before: Six) -> Six:
    """Return the speeds behind the lags of the limits."""
    found = list(before)
    for axis, weight in zip(controller.axes, controller.guard.weights, strict=True):
        found[axis.index] = before[axis.index] + weight * (twist[axis.index] - before[axis.index])
    return each_of(found)


def _too_fast(controller: RuntimeController, twist: Six, before: Six, followed: Six) -> Fault:
    """Return which limit of the command a twist breaks."""
    guard, places = controller.guard, [axis.index for axis in controller.axes]
    if any(abs(twist[i]) > speed for i, speed in zip(places, guard.speeds, strict=True)):
        return Fault.SPEED
    if any(abs(followed[i]) > speed for i, speed in zip(places, guard.followed, strict=True)):
        return Fault.SPEED
    if any(abs(twist[i] - before[i]) > change for i, change in zip(places, guard.changes, strict=True)):
        return Fault.ACCELERATION
    return Fault.NONE


def rearm(state: State) -> State:
    """Return the state in which the next collision is watched for again, and a full stop is over."""
    return state._replace(phase=Phase.WATCHING)


def _tick(axis: AxisLaw, before: AxisState, desired: float, external: float, way: float) -> _Tick:
    position, seen = before.position + way, through_deadband(external, axis.deadband, axis.is_subtractive)
    if axis.variable_damping is not None:
        before = _varied(axis, before, way)
    blocks = before.blocks or axis.blocks
    added, inertial = measured_motion(blocks, before.control, position)
    wanted, control = controller_step(blocks, before.control, desired + seen, position)
    older = (before.output, before.drive, before.position)
    following = before._replace(
        control=control,
        drive=shaped_drive(blocks, before.control, desired + seen + inertial),
        position=position,
        command=wanted,
        output=wanted - added,
        older=older,
        periods=before.periods + 1,
    )
    return _Tick(seen, way, added, following)


def _varied(axis: AxisLaw, before: AxisState, way: float) -> AxisState:
    """Return the axis with the B_a of its speed, once an update is due; the equation goes on from its last entries."""
    variable = axis.variable_damping
    if variable is None or before.periods < variable.update_periods:
        return before
    damping = varied_damping(
        axis.start_damping if before.damping is None else before.damping,
        way / axis.sample_time_s,
        variable.highest,
        variable.lowest,
        variable.decay_s_per_m,
        variable.largest_change,
    )
    blocks = axis.blocks_at(damping)
    integral, lag = resume(blocks, (before.output, before.drive, before.position), before.older)
    control = (integral, lag, *before.control[2:])
    return before._replace(control=control, damping=damping, blocks=blocks, periods=0)


def _phase(controller: RuntimeController, phase: Phase, ticks: Sequence[_Tick]) -> tuple[Phase, bool]:
    """Return the phase from here on, and whether the command rests in this period (Algorithm 1 of the paper)."""
    if phase is Phase.WATCHING and controller.response is not CollisionResponse.NONE:
        met = any(
            opposes_motion(tick.seen, tick.way, controller.threshold_n)
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
    following, output = tick.following, before.command - tick.added
    older = (output, before.drive, before.position)
    blocks = following.blocks or axis.blocks
    integral, lag = resume(blocks, (output, following.drive, following.position), older)
    control = (integral, lag, *following.control[2:])
    return following._replace(control=control, command=before.command, output=output, older=older)


def _held(state: State, fault: Fault) -> tuple[State, Command]:
    held = Command(NOTHING, NOTHING, NOTHING, state.phase, fault, False, state.watch.missing_kg)
    return state._replace(fault=fault), held


def _differences(now: Sequence[AxisState], before: Sequence[AxisState]) -> Six:
    return each_of(new.command - old.command for new, old in zip(now, before, strict=True))


def six(name: str, values: Sequence[float]) -> Six:
    """Return 6 numbers; raises ParameterError."""
    numbers = _floats(name, values)
    if len(numbers) != 6:
        raise ParameterError(name, f"{len(numbers)} of them", "6 numbers")
    return each_of(numbers)


def each_of(values: Iterable[float]) -> Six:
    """Return six values as a tuple of six."""
    x, y, z, rx, ry, rz = values
    return x, y, z, rx, ry, rz


def place_of(position: Sequence[float], rows: Sequence[Sequence[float]]) -> Place:
    """Return position (3,) and R_WS (3, 3) as a place; raises ParameterError."""
    p = _floats("position_W_m", position)
    if len(p) != 3:
        raise ParameterError("position_W_m", f"{len(p)} of them", "3 numbers")
    if isinstance(rows, _UNORDERED) or not hasattr(rows, "__len__"):
        raise ParameterError("R_WS", type(rows).__name__, "3 rows of 3 numbers")
    try:
        lines = [_floats("R_WS", row) for row in rows]
    except TypeError as reason:
        raise ParameterError("R_WS", type(rows).__name__, "3 rows of 3 numbers") from reason
    sizes = [len(line) for line in lines]
    if sizes != [3, 3, 3]:
        found = f"rows of {', '.join(map(str, sizes[:9]))} numbers" if sizes else "no row"
        raise ParameterError("R_WS", found, "3 rows of 3 numbers")
    x, y, z = p
    (a, b, c), (d, e, f), (g, h, i) = lines
    return (x, y, z), (a, b, c, d, e, f, g, h, i)


def check_kind(name: str, value: object, kind: type) -> None:
    """Raise ParameterError unless a value is of a kind."""
    if not isinstance(value, kind):
        raise ParameterError(name, type(value).__name__, f"of type {kind.__name__}")


def _floats(name: str, values: Sequence[float]) -> list[float]:
    # A text is no number, although `float` reads it; what is refused may be too long to be shown.
    try:
        if isinstance(values, str | bytes) or any(isinstance(value, str | bytes) for value in values):
            raise ParameterError(name, "text", "numbers only")
        if isinstance(values, _UNORDERED):
            raise ParameterError(name, type(values).__name__, "a sequence of numbers")
        return [float(value) for value in values]
    except OverflowError as reason:
        raise ParameterError(name, "a number beyond double precision", "numbers only") from reason
    except (TypeError, ValueError) as reason:
        if isinstance(reason, ParameterError):
            raise
        raise ParameterError(name, f"another thing ({reason})", "numbers only") from reason


def tick_of(tick: int | None) -> int | None:
    """Return the caller's count as one of 32 bits; raises ParameterError for what is no whole number."""
    if tick is None:
        return None
    known: object = tick
    if isinstance(known, bool) or not isinstance(known, Integral):
        raise ParameterError("tick", type(known).__name__, "a whole number, or None")
    return int(tick) % TICKS
