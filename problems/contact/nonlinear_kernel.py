"""Compiled stepping of the nonlinear simulation: the controller as it runs in the cell, and Runge–Kutta between ticks.

No matrix exponential enters here, so that this is a second method to the exact transient of `contact.kernel`; but for
many plants at once (`contact.many_contacts`), which cross by it the samples in which nothing happens.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..arrays import FloatArray
from ..compiled import compiled, equation, inlined
from ..model import difference
from ..model.controller import controller_step, write_blocks
from ..model.difference import BLOCK_ROWS, ControlState, Entry
from ..model.difference import DAMPING as PLACE_OF_DAMPING
from .events import advance_surface
from .kernel_types import (
    CONTACT_PEAK,
    CONTACT_TIME,
    NEWEST,
    SENSOR_PEAK,
    SENSOR_TICK,
)
from .leaps import Motion, leap_sample, leap_three_states, wall_force

# What the collision response does; `Memory.phase` starts at WATCHING.
REPORTING, RESETTING, STOPPING = 0, 1, 2
WATCHING, BRAKING, OVER, STOPPED = 0, 1, 2, 3
# Bits of a tick's flags.
TOUCHING, CLIPPED, DEAD, LIMITED = 1, 2, 4, 8

# An update falls on a tick that is this close to its time (in samples).
_ON_TICK = 1e-9

resume = equation(difference.resume)
measured_motion = equation(difference.measured_motion)
shaped_drive = equation(difference.shaped_drive)
through_deadband = equation(difference.through_deadband)
opposes_motion = equation(difference.opposes_motion)


class NonlinearController(NamedTuple):
    """The controller with all that is done to its input and its output; infinite is "none", steps are per sample.

    `parameters` are those of the controller. `floor`, `scale`, `decay`, `period` (samples) and `change` are the
    variable damping, whose period is infinite when B_a is constant.
    """

    parameters: FloatArray
    h: float
    theta: float
    ideal: bool
    deadband: float
    subtractive: bool
    force_limit: float
    longest_step: float
    largest_change: float
    response: int
    threshold: float
    floor: float
    scale: float
    decay: float
    period: float
    change: float


class Memory(NamedTuple):
    """What the controller keeps from tick to tick: block states, two entries, the command sent and its last step."""

    control: ControlState
    recent: Entry
    older: Entry
    sent: float
    step: float
    damping: float
    due: float
    phase: int


@inlined
def seen_force(law: NonlinearController, force: float) -> tuple[float, int]:
    """Return the force that the controller works with, clipped and then through the deadband, and its flags."""
    flags = 0
    if abs(force) > law.force_limit:
        force, flags = np.copysign(law.force_limit, force), CLIPPED
    if abs(force) <= law.deadband:
        return 0.0, flags | (DEAD if law.deadband > 0.0 else 0)
    return through_deadband(force, law.deadband, law.subtractive), flags


@compiled
def damping_at(law: NonlinearController, speed: float) -> float:
    """Return B_a(|v|) = max(scale·exp(−decay·|v|), floor), or the constant B_a."""
    if np.isinf(law.period):
        return float(law.parameters[PLACE_OF_DAMPING])
    return float(max(law.scale * np.exp(-law.decay * abs(speed)), law.floor))


@compiled
def blocks_at(law: NonlinearController, damping: float) -> FloatArray:
    """Return the controller's blocks (BLOCK_ROWS, 3) at this B_a."""
    blocks, parameters = np.zeros((BLOCK_ROWS, 3)), law.parameters.copy()
    parameters[PLACE_OF_DAMPING] = damping
    write_blocks(blocks, parameters, law.h, law.theta, law.ideal)
    return blocks


@inlined
def keep_within(law: NonlinearController, sent: float, last_step: float, command: float) -> tuple[float, int]:
    """Return the command within the limits on its speed and acceleration, and whether they changed it."""
    step = command - sent
    low = max(-law.longest_step, last_step - law.largest_change)
    high = min(law.longest_step, last_step + law.largest_change)
    if low <= step <= high:
        return command, 0
    return sent + (low if step < low else high), LIMITED


@compiled
def update_damping(law: NonlinearController, blocks: FloatArray, memory: Memory, position: float) -> Memory:
    """Let B_a follow the speed: `blocks` are rewritten, the command goes on where it was."""
    (_, _, before), (_, _, of_velocity, of_acceleration, b_1, b_2) = memory.recent, memory.control
    speed = (position - before) / law.h
    change = min(max(damping_at(law, speed) - memory.damping, -law.change), law.change)
    damping = memory.damping + change
    blocks[:] = blocks_at(law, damping)
    integral, lag = resume(blocks, memory.recent, memory.older)
    return Memory(
        (integral, lag, of_velocity, of_acceleration, b_1, b_2),
        memory.recent,
        memory.older,
        memory.sent,
        memory.step,
        damping,
        memory.due + law.period,
        memory.phase,
    )


@inlined
def next_phase(law: NonlinearController, memory: Memory, seen: float, position: float) -> int:
    """Return the phase of the collision response: it begins once, where the force opposes the motion too much."""
    _, _, before = memory.recent
    if memory.phase != WATCHING or not opposes_motion(seen, position - before, law.threshold):
        return memory.phase
    if law.response == STOPPING:
        return STOPPED
    return BRAKING if law.response == RESETTING else OVER


@inlined
def control_tick(
    law: NonlinearController, blocks: FloatArray, memory: Memory, inputs: tuple[float, float, float]
) -> tuple[Memory, float, int]:
    """Return the memory with the command sent at this tick, the force the controller saw, and flags.

    `inputs` are F^d, F (noise included) and x. The collision response (Algorithm 1 of the paper) holds the command and
    lets the admittance rest, both of its past outputs the same; the filters of the robot's motion run on. A command
    that was limited or held is what the difference equation goes on from. With a limit on the acceleration the
    response lasts until the command has come to rest.
    """
    desired, force, position = inputs
    seen, flags = seen_force(law, force)
    added, inertial = measured_motion(blocks, memory.control, position)
    wanted, control = controller_step(blocks, memory.control, desired + seen, position)
    drive = shaped_drive(blocks, memory.control, desired + seen + inertial)
    phase, older = next_phase(law, memory, seen, position), memory.recent
    resting = phase in (BRAKING, STOPPED)
    command, limited = keep_within(law, memory.sent, memory.step, memory.sent if resting else wanted)
    recent = (command - added, drive, position)
    if resting:
        _, driven, place = older
        older = (command - added, driven, place)
    if resting or limited != 0:
        (integral, lag), (_, _, of_velocity, of_acceleration, b_1, b_2) = resume(blocks, recent, older), control
        control = (integral, lag, of_velocity, of_acceleration, b_1, b_2)
    step = command - memory.sent
    if phase == BRAKING and step == 0.0:
        phase = OVER
    memory = Memory(control, recent, older, command, step, memory.damping, memory.due, phase)
    return memory, seen, flags | limited


# Rows of `KernelOutputs.traces`: F, F as the controller sees it, F_e, x, v, x_p, v_p, x^d, B_a.
FORCE, SEEN, CONTACT, FLANGE, FLANGE_SPEED, PAYLOAD, PAYLOAD_SPEED, COMMAND, DAMPING = 0, 1, 2, 3, 4, 5, 6, 7, 8
TRACES = 9
# Entries of `KernelOutputs.found` behind the peaks (see `kernel_types`): time of the impact, v_p h then, tick of the
# collision (times in samples, not a number when it did not happen).
IMPACT_TIME, IMPACT_SPEED, COLLISION_TICK, FOUND = 4, 5, 6, 7
# Rows of `Motion.rows`.
_POSITION, _SENSED, _VELOCITY = 0, 1, 2


class BeforeAfter(NamedTuple):
    """A force before and after the impact."""

    before: float
    after: float


class SampleInputs(NamedTuple):
    """Over one sample: `commands` older and newer, `pushes` before and after the impact.

    `pulls` is a further force at the beginning and at the end of the sample.
    """

    commands: tuple[float, float]
    pushes: BeforeAfter
    pulls: BeforeAfter


class KernelOutputs(NamedTuple):
    """Outputs: `traces` (TRACES, samples), `flags` (samples,), both perhaps of no sample, and `found` (FOUND,)."""

    traces: FloatArray
    flags: NDArray[np.int64]
    found: FloatArray


# How a step is made: against a wall without mass, as one mass with a wall, or away from it.
UNILATERAL, JOINED, AWAY = 0, 1, 2
# Of a wall with mass: its place and speed, 1 while it is touched and else 0, and F_e.
_WALL_PLACE, _WALL_SPEED, _TOUCHED, _PRESSED, WALL = 0, 1, 2, 3, 4


@compiled
def runge_kutta(
    motion: Motion, state: FloatArray, held: float, push: float, step: float, work: FloatArray, mode: int
) -> None:
    """Advance `state` by one classical Runge–Kutta step; every stage asks the wall anew. `work` is (3, n).

    `mode` is UNILATERAL for a wall without mass, JOINED or AWAY for one with.
    """
    flow, wall, n, trial, rate, change = motion.flow, motion.wall, len(state), work[0], work[1], work[2]
    trial[:], change[:] = state, 0.0
    for stage in range(4):
        outside = push
        if mode == UNILATERAL:
            outside -= wall_force(motion, trial[n - 2], trial[n - 1])
        elif mode == JOINED:
            outside -= wall.stiffness * trial[n - 2] + wall.damping * trial[n - 1]
        advance, weight = step if stage == 2 else 0.5 * step, step / (6.0 if stage % 3 == 0 else 3.0)
        for i in range(n):
            total = flow[i, n] * held + flow[i, n + 1] * outside
            for j in range(n):
                total += flow[i, j] * trial[j]
            rate[i] = total
        if mode == JOINED:
            rate[n - 1] *= wall.share
        for i in range(n):
            change[i] += weight * rate[i]
            trial[i] = state[i] + advance * rate[i]
    for i in range(n):
        state[i] += change[i]


@compiled
def cross_sample(
    motion: Motion,
    state: FloatArray,
    inputs: SampleInputs,
    tick: int,
    found: FloatArray,
    work: FloatArray,
) -> None:
    """Advance the plant over one sample."""
    n, start, (commands, pushes, pulls) = len(state), float(tick), inputs
    for part in range(2):
        duration, steps = (1.0 - motion.fraction if part == 1 else motion.fraction), motion.steps[part]
        for j in range(steps):
            push = pushes.before if np.isnan(found[IMPACT_TIME]) else pushes.after
            passed = start - tick + (j + 0.5) * (duration / steps)
            push += pulls.before + passed * (pulls.after - pulls.before)
            runge_kutta(motion, state, commands[part], push, duration / steps, work, UNILATERAL)
            pressed, moment = wall_force(motion, state[n - 2], state[n - 1]), start + (j + 1) * (duration / steps)
            if pressed > 0.0 and np.isnan(found[IMPACT_TIME]):
                found[IMPACT_TIME], found[IMPACT_SPEED] = moment, state[n - 1]
            if pressed > found[CONTACT_PEAK]:
                found[CONTACT_PEAK], found[CONTACT_TIME] = pressed, moment
        start += duration


@compiled
def joined_force(motion: Motion, state: FloatArray, held: float, push: float) -> float:
    """Return F_e = M_e dv_p/dt + B_e v_p + K_e x_p of a payload that moves with the wall's mass."""
    flow, wall, n = motion.flow, motion.wall, len(state)
    spring = wall.stiffness * state[n - 2] + wall.damping * state[n - 1]
    rate = flow[n - 1, n] * held + flow[n - 1, n + 1] * (push - spring)
    for i in range(n):
        rate += flow[n - 1, i] * state[i]
    return float(wall.mass * wall.share * rate + spring)


@compiled
def cross_with_mass(
    motion: Motion,
    state: FloatArray,
    surface: FloatArray,
    inputs: SampleInputs,
    tick: int,
    found: FloatArray,
    work: FloatArray,
) -> None:
    """Advance plant and wall (WALL,) over one sample where the wall has a mass, met without rebound; `cross_sample`."""
    n, start, wall, (commands, pushes, pulls) = len(state), float(tick), motion.wall, inputs
    for part in range(2):
        duration, steps = (1.0 - motion.fraction if part == 1 else motion.fraction), motion.steps[part]
        for j in range(steps):
            step = duration / steps
            push = pushes.before if np.isnan(found[IMPACT_TIME]) else pushes.after
            push += pulls.before + (start - tick + (j + 0.5) * step) * (pulls.after - pulls.before)
            mode = JOINED if surface[_TOUCHED] == 1.0 else AWAY
            runge_kutta(motion, state, commands[part], push, step, work, mode)
            moment = start + (j + 1) * step
            if mode == JOINED:
                surface[_PRESSED] = joined_force(motion, state, commands[part], push)
                surface[_WALL_PLACE], surface[_WALL_SPEED] = state[n - 2], state[n - 1]
                if surface[_PRESSED] <= 0.0:
                    surface[_TOUCHED], surface[_PRESSED] = 0.0, 0.0
            else:
                advance_surface(surface, wall, step)
                if state[n - 2] > surface[_WALL_PLACE]:
                    if np.isnan(found[IMPACT_TIME]):
                        found[IMPACT_TIME], found[IMPACT_SPEED] = moment, state[n - 1]
                    state[n - 1] = wall.share * state[n - 1] + (1.0 - wall.share) * surface[_WALL_SPEED]
                    surface[_TOUCHED] = 1.0
            if surface[_PRESSED] > found[CONTACT_PEAK]:
                found[CONTACT_PEAK], found[CONTACT_TIME] = surface[_PRESSED], moment
        start += duration


@compiled
def write_motion(
    motion: Motion, state: FloatArray, surface: FloatArray, held: float, h: float, traces: FloatArray, tick: int
) -> int:
    """Write F_e, v, x_p and v_p of a tick, and return its flag of contact."""
    n, rows = len(state), motion.rows
    velocity, pressed = rows[_VELOCITY, n] * held, surface[_PRESSED]
    if motion.wall.mass == 0.0:
        pressed = wall_force(motion, state[n - 2], state[n - 1])
    for i in range(n):
        velocity += rows[_VELOCITY, i] * state[i]
    traces[CONTACT, tick], traces[FLANGE_SPEED, tick] = pressed, velocity / h
    traces[PAYLOAD, tick], traces[PAYLOAD_SPEED, tick] = state[n - 2], state[n - 1] / h
    return TOUCHING if pressed > 0.0 else 0


@compiled
def meet_wall(motion: Motion, state: FloatArray, found: FloatArray) -> FloatArray:
    """Return the wall (WALL,) at the start; a run that begins at the impact meets a mass at rest without rebound."""
    surface, n = np.zeros(WALL), len(state)
    if motion.wall.mass == 0.0:
        found[CONTACT_PEAK] = wall_force(motion, state[n - 2], state[n - 1])
    elif not np.isnan(found[IMPACT_TIME]):
        state[n - 1], surface[_TOUCHED] = motion.wall.share * state[n - 1], 1.0
    return surface


@compiled
def advance_plant(
    motion: Motion,
    state: FloatArray,
    surface: FloatArray,
    inputs: SampleInputs,
    tick: int,
    found: FloatArray,
    work: FloatArray,
) -> None:
    """Advance the plant over one sample; at once where nothing switches in it, under the mean of the pulls."""
    if motion.wall.mass > 0.0:
        cross_with_mass(motion, state, surface, inputs, tick, found, work)
        return
    commands, pushes, pulls = inputs
    push = 0.5 * (pulls.before + pulls.after) + (pushes.before if np.isnan(found[IMPACT_TIME]) else pushes.after)
    leaps = len(motion.leap) > 0
    if leaps:
        leaps = (
            leap_three_states(motion, state, commands, push, tick, found)
            if len(state) == 3
            else leap_sample(motion, state, commands, push, tick, found, work)
        )
    if not leaps:
        cross_sample(motion, state, inputs, tick, found, work)


@compiled
def run_nonlinear(
    motion: Motion,
    law: NonlinearController,
    start: tuple[FloatArray, FloatArray, Memory],
    desired: BeforeAfter,
    pushes: BeforeAfter,
    noise: FloatArray,
    late: NDArray[np.bool_],
    pulls: FloatArray,
    recording: KernelOutputs,
) -> None:
    """Step over all samples of the noise.

    `start` is plant state, past commands (newest first) and memory; `desired` and `pushes` are F^d and the hand's force
    before and after the impact; `noise` (samples,) is added to F. Where `late` (samples,) no command arrives at the
    robot, which goes on with the one before. `pulls` (samples + 1,) is a force on the payload at the ticks. Without
    delay the velocity that is recorded is the one just before the command changes.
    """
    first, commands, memory = start
    state, past, rows = first.copy(), commands.copy(), motion.rows
    n, places, head = len(state), len(past), NEWEST
    traces, found, work = recording.traces, recording.found, np.empty((3, n))
    blocks = blocks_at(law, memory.damping)
    surface = meet_wall(motion, state, found)
    acting = past[(head + motion.chain - 1) % places] if motion.chain > 0 else memory.sent
    for k in range(len(noise)):
        # What acts at the tick is the last command that arrived, or with a delay of whole samples the one arriving.
        held = acting
        if motion.chain == motion.whole and motion.whole > 0 and not late[k]:
            held = past[(head + motion.whole - 1) % places]
        position, force = 0.0, rows[_SENSED, n] * held
        for i in range(n):
            position += rows[_POSITION, i] * state[i]
            force += rows[_SENSED, i] * state[i]
        if k >= memory.due - _ON_TICK:
            memory = update_damping(law, blocks, memory, position)
        steering = desired.before if np.isnan(found[IMPACT_TIME]) else desired.after
        watching = memory.phase == WATCHING
        memory, seen, flags = control_tick(law, blocks, memory, (steering, force + noise[k], position))
        if watching and memory.phase != WATCHING:
            found[COLLISION_TICK] = k
        if k < traces.shape[1]:
            traces[FORCE, k], traces[SEEN, k], traces[FLANGE, k] = force, seen, position
            traces[COMMAND, k], traces[DAMPING, k] = memory.sent, memory.damping
            recording.flags[k] = flags | write_motion(motion, state, surface, held, law.h, traces, k)
        if -force > found[SENSOR_PEAK]:
            found[SENSOR_PEAK], found[SENSOR_TICK] = -force, k
        arriving = memory.sent if motion.whole == 0 else past[(head + motion.whole - 1) % places]
        newer = acting if late[k] else arriving
        acts, pull = (held if motion.chain > motion.whole else newer, newer), BeforeAfter(pulls[k], pulls[k + 1])
        advance_plant(motion, state, surface, SampleInputs(acts, pushes, pull), k, found, work)
        acting = newer
        head = (head - 1) % places
        past[head] = memory.sent
