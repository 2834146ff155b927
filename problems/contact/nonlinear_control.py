"""The controller as it runs in the cell, one tick at a time: what is done to its input, its output and its B_a."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..compiled import compiled, equation
from ..model import difference
from ..model.controller import controller_step, write_blocks
from ..model.difference import Entry

FloatArray = NDArray[np.float64]

# What the collision response does; `Memory.phase` starts at WATCHING.
REPORTING, RESETTING, STOPPING = 0, 1, 2
WATCHING, BRAKING, OVER, STOPPED = 0, 1, 2, 3
# Bits of a tick's flags.
TOUCHING, CLIPPED, DEAD, LIMITED = 1, 2, 4, 8

_SCAN = 512
_BISECTIONS = 60
# An update falls on a tick that is this close to its time (in samples).
_ON_TICK = 1e-9

resume = equation(difference.resume)
measured_motion = equation(difference.measured_motion)
through_deadband = equation(difference.through_deadband)
opposes = equation(difference.opposes)


class Law(NamedTuple):
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

    control: tuple[float, float, float, float]
    recent: Entry
    older: Entry
    sent: float
    step: float
    damping: float
    due: float
    phase: int


@compiled
def seen_force(law: Law, force: float) -> tuple[float, int]:
    """Return the force that the controller works with, clipped and then through the deadband, and its flags."""
    flags = 0
    if abs(force) > law.force_limit:
        force, flags = np.copysign(law.force_limit, force), CLIPPED
    if abs(force) <= law.deadband:
        return 0.0, flags | (DEAD if law.deadband > 0.0 else 0)
    return through_deadband(force, law.deadband, law.subtractive), flags


@compiled
def damping_at(law: Law, speed: float) -> float:
    """Return B_a(|v|) = max(scale·exp(−decay·|v|), floor), or the constant B_a."""
    if np.isinf(law.period):
        return float(law.parameters[1])
    return float(max(law.scale * np.exp(-law.decay * abs(speed)), law.floor))


@compiled
def blocks_at(law: Law, damping: float) -> FloatArray:
    """Return the controller's blocks (6, 3) at this B_a."""
    blocks, parameters = np.zeros((6, 3)), law.parameters.copy()
    parameters[1] = damping
    write_blocks(blocks, parameters, law.h, law.theta, law.ideal)
    return blocks


@compiled
def keep_within(law: Law, sent: float, last_step: float, command: float) -> tuple[float, int]:
    """Return the command within the limits on its speed and acceleration, and whether they changed it."""
    step = command - sent
    low = max(-law.longest_step, last_step - law.largest_change)
    high = min(law.longest_step, last_step + law.largest_change)
    if low <= step <= high:
        return command, 0
    return sent + (low if step < low else high), LIMITED


@compiled
def update_damping(law: Law, blocks: FloatArray, memory: Memory, tick: int, position: float) -> Memory:
    """Let B_a follow the speed when an update is due: `blocks` are rewritten, the command goes on where it was."""
    if tick < memory.due - _ON_TICK:
        return memory
    speed = (position - memory.recent[2]) / law.h
    change = min(max(damping_at(law, speed) - memory.damping, -law.change), law.change)
    damping = memory.damping + change
    blocks[:] = blocks_at(law, damping)
    integral, lag = resume(blocks, memory.recent, memory.older)
    return Memory(
        (integral, lag, memory.control[2], memory.control[3]),
        memory.recent,
        memory.older,
        memory.sent,
        memory.step,
        damping,
        memory.due + law.period,
        memory.phase,
    )


@compiled
def next_phase(law: Law, memory: Memory, seen: float, position: float) -> int:
    """Return the phase of the collision response: it begins once, where the force opposes the motion too much."""
    if memory.phase != WATCHING or not opposes(seen, position - memory.recent[2], law.threshold):
        return memory.phase
    if law.response == STOPPING:
        return STOPPED
    return BRAKING if law.response == RESETTING else OVER


@compiled
def control_tick(
    law: Law, blocks: FloatArray, memory: Memory, inputs: tuple[float, float, float]
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
    phase, older, drive = next_phase(law, memory, seen, position), memory.recent, desired + seen + inertial
    resting = phase in (BRAKING, STOPPED)
    command, limited = keep_within(law, memory.sent, memory.step, memory.sent if resting else wanted)
    recent = (command - added, drive, position)
    if resting:
        older = (recent[0], older[1], older[2])
    if resting or limited != 0:
        integral, lag = resume(blocks, recent, older)
        control = (integral, lag, control[2], control[3])
    step = command - memory.sent
    if phase == BRAKING and step == 0.0:
        phase = OVER
    memory = Memory(control, recent, older, command, step, memory.damping, memory.due, phase)
    return memory, seen, flags | limited


@compiled
def steady_speed(law: Law, force: float, drag: float, by_hand: bool) -> float:
    """Return the lowest speed at which this force and the drag (F per speed) leave B_a(v) v to the admittance.

    Where a deadband of the threshold kind switches there and back, it is the speed at which it does; 0 if the force
    does not get through the deadband.
    """
    if _surplus(law, force, drag, by_hand, 0.0) <= 0.0:
        return 0.0
    top = force / (law.parameters[1] if np.isinf(law.period) else law.floor)
    low = 0.0
    for i in range(1, _SCAN + 1):
        high = top * i / _SCAN
        if _surplus(law, force, drag, by_hand, high) <= 0.0:
            break
        low = high
    for _ in range(_BISECTIONS):
        middle = 0.5 * (low + high)
        if _surplus(law, force, drag, by_hand, middle) > 0.0:
            low = middle
        else:
            high = middle
    return 0.5 * (low + high)


@compiled
def _surplus(law: Law, force: float, drag: float, by_hand: bool, speed: float) -> float:
    if by_hand:
        driving = seen_force(law, force - drag * speed)[0]
    else:
        driving = force + seen_force(law, -drag * speed)[0]
    return float(driving - damping_at(law, speed) * speed)
