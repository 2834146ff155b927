"""The state of the loop at the moment of contact: a steady approach in free space, in closed form."""

import numpy as np
from numpy.typing import NDArray

from ..compiled import compiled

FloatArray = NDArray[np.float64]


@compiled
def contact_forces(approach: tuple[float, float, bool, float], resistance: float) -> tuple[float, float, float, float]:
    """Return (v, hand force before the impact, F^d after it, hand force after it).

    `approach` is (force or 0, speed, whether a hand drives, force after the impact or NaN); `resistance` [N·s/m] is
    the force that the loop needs per speed in free space.
    """
    given, speed, by_hand, after = approach
    force = given if given > 0.0 else speed * resistance
    held = force if np.isnan(after) else after
    if by_hand:
        return force / resistance, force, 0.0, held
    return force / resistance, 0.0, held, 0.0


@compiled
def steady_start(
    ramp: FloatArray,
    c_position: FloatArray,
    blocks: FloatArray,
    chain: int,
    h: float,
    speed: float,
    push: float,
    force: float,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return plant state, past commands (a ring, newest first) and controller states of a steady approach.

    Everything moves at `speed` (m/s) under the outside force `push`; `force` is e = F^d + F, which is B_a v. The
    filters see a steady speed, the lag a steady force (and, with ideal compensation, a ramp).
    """
    n = ramp.shape[1] - 2
    moved = ramp[0] * (speed * h) + ramp[1] * push
    state, command = moved[:n].copy(), moved[n]
    places = 1
    while places < chain:
        places *= 2
    past = np.zeros(places)
    for i in range(chain):
        past[i] = command - (i + 1) * speed * h
    position = np.sum(c_position * state)
    ideal = blocks[4, 2]
    acceleration = ideal * speed
    control = np.empty(4)
    control[2] = speed - blocks[2, 0] * position
    control[3] = acceleration - blocks[3, 0] * (ideal * position + (1.0 - ideal) * speed)
    share = 1.0 / (1.0 - blocks[1, 1])
    slope = blocks[5, 2] * share
    control[1] = (blocks[1, 2] * force - slope * speed * h) * share + slope * position
    direct = (blocks[0, 0] + blocks[1, 0]) * force - blocks[4, 0] * speed
    control[0] = command - control[1] - direct - blocks[5, 0] * acceleration - blocks[5, 1] * position
    return state, past, control
