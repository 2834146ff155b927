"""The steady approach of the nonlinear simulation: which force makes which speed, and the states at the impact."""

from typing import NamedTuple

import numpy as np

from ..arrays import FloatArray
from ..compiled import compiled
from ..model.difference import DAMPING as PLACE_OF_DAMPING
from ..model.difference import DERIVATIVE_GAIN, FEEDBACK_DAMPING, IS_IDEAL
from .kernel import steady_start
from .kernel_types import MOVING, PUSHED
from .nonlinear_kernel import (
    WATCHING,
    BeforeAfter,
    Memory,
    NonlinearController,
    blocks_at,
    damping_at,
    resume,
    seen_force,
)

# What is wrong with an approach: nothing, the speed passes the limit on the command, the force does not pass the
# deadband, or the hand's force is clipped.
POSSIBLE, TOO_FAST, TOO_WEAK, CLIPPED_HAND = 0, 1, 2, 3

# Places of the filters' and the biquad's states among those of the controller.
_OF_VELOCITY, _OF_ACCELERATION, _BIQUAD_1, _BIQUAD_2 = 2, 3, 4, 5
_SCAN = 512
_BISECTIONS = 60


class Drive(NamedTuple):
    """Speed and force of an approach, and F^d and the hand's force before and after the impact."""

    speed: float
    force: float
    desired: BeforeAfter
    push: BeforeAfter


@compiled
def drag_of(ramp: FloatArray, h: float) -> float:
    """Return F per speed [N·s/m], which is B_p but for the ripple of F between the ticks."""
    return float(-ramp[MOVING, ramp.shape[1] - 1] * h)


@compiled
def find_drive(law: NonlinearController, drag: float, approach: tuple[float, float, bool, float]) -> tuple[Drive, int]:
    """Return the steady speed of the approach's force, or the force of its speed, and what is wrong with it.

    The effects are in the balance. `approach` is that of `Approach.numbers`.
    """
    force, speed, by_hand, held = approach
    fastest, wrong = law.longest_step / law.h, POSSIBLE
    if speed > 0.0:
        if speed > fastest:
            wrong = TOO_FAST
        force = needed_force(law, speed, drag, by_hand)
        if by_hand and force - drag * speed > law.force_limit:
            wrong = CLIPPED_HAND
    else:
        speed = min(steady_speed(law, force, drag, by_hand), fastest)
        if not speed > 0.0:
            wrong = TOO_WEAK
    both, nothing = BeforeAfter(force, force if np.isnan(held) else held), BeforeAfter(0.0, 0.0)
    return Drive(speed, force, nothing if by_hand else both, both if by_hand else nothing), wrong


@compiled
def needed_force(law: NonlinearController, speed: float, drag: float, by_hand: bool) -> float:
    """Return the force that sustains a speed: F^d, or that of a hand on the payload."""
    needed = damping_at(law, speed) * speed
    if not by_hand:
        seen, _ = seen_force(law, -drag * speed)
        return float(needed - seen)
    return float((needed + law.deadband if law.subtractive else max(needed, law.deadband)) + drag * speed)


@compiled
def steady_speed(law: NonlinearController, force: float, drag: float, by_hand: bool) -> float:
    """Return the lowest speed at which this force and the drag (F per speed) leave B_a(v) v to the admittance.

    Where a deadband of the threshold kind switches there and back, it is the speed at which it does; 0 if the force
    does not get through the deadband.
    """
    if _surplus(law, force, drag, by_hand, 0.0) <= 0.0:
        return 0.0
    top = force / (law.parameters[PLACE_OF_DAMPING] if np.isinf(law.period) else law.floor)
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
def _surplus(law: NonlinearController, force: float, drag: float, by_hand: bool, speed: float) -> float:
    seen, _ = seen_force(law, (force if by_hand else 0.0) - drag * speed)
    driving = seen if by_hand else force + seen
    return float(driving - damping_at(law, speed) * speed)


@compiled
def begin_steadily(
    law: NonlinearController, drive: Drive, ramp: FloatArray, c_position: FloatArray, chain: int
) -> tuple[tuple[FloatArray, FloatArray, Memory], float]:
    """Return plant state, past commands and memory at the impact, as if the approach had gone on for ever.

    Then F as the controller sees it until there. `ramp` is that of `SampledContact`, position and chain are those of
    the plant in free space.
    """
    h, speed, push = law.h, drive.speed, drive.push.before
    way, damping = speed * h, damping_at(law, speed)
    blocks, n = blocks_at(law, damping), len(c_position)
    seen, _ = seen_force(law, ramp[MOVING, n + 1] * way + ramp[PUSHED, n + 1] * push)
    # On average over the ticks, where a deadband switches there and back. Behind a speed limit more than that drives
    # the admittance, which the first two ticks make up for while the limit holds.
    used = damping * speed
    state, past, control = steady_start(ramp, c_position, blocks, chain, h, speed, push, used)
    state[n - 2] = 0.0
    command = ramp[MOVING, n] * way + ramp[PUSHED, n] * push
    position = 0.0
    for i in range(n):
        position += c_position[i] * state[i]
    # What the admittance itself puts out: C_fb and the derivative of the ideal compensation see a steady speed.
    output = command + (blocks[FEEDBACK_DAMPING] - blocks[DERIVATIVE_GAIN] * blocks[IS_IDEAL]) * speed
    recent, older = (output - way, used, position - way), (output - 2.0 * way, used, position - 2.0 * way)
    integral, lag = resume(blocks, recent, older)
    memory = Memory(
        (integral, lag, control[_OF_VELOCITY], control[_OF_ACCELERATION], control[_BIQUAD_1], control[_BIQUAD_2]),
        recent,
        older,
        command - way,
        way,
        damping,
        law.period,
        WATCHING,
    )
    return (state, past, memory), seen
