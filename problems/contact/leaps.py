"""The plant of the nonlinear simulation, and samples of it in which nothing happens, crossed by its exponentials.

`leap_sample` writes the equations as they are; `leap_three_states` is the same for the plant with three states (a robot
of one pole), kept in scalars.
"""

from typing import NamedTuple

import numpy as np

from ..arrays import FloatArray
from ..compiled import compiled, inlined
from .event_free_steps import FLANGE, PAYLOAD, VELOCITY
from .events import SUBSTEPS_PER_RADIAN, spring_force
from .kernel_types import APART, CONTACT_PEAK, CONTACT_TIME, IN_CONTACT, Wall

# Parts of a sample, before and behind the change of the command.
EARLY, LATE = 0, 1
# In a motion this slow (radians or e-foldings) the force turns no oftener than two looks at it show, and as many terms
# of a series are exact to rounding: ‖A²‖ bounds every second power, and 0.5¹⁶/16! is far below it.
SLOW, _SERIES_TERMS = 1.0 / SUBSTEPS_PER_RADIAN, 16


class Motion(NamedTuple):
    """The continuous plant without environment over one period, its wall and its delay.

    `flow` (n, n + 2) is (rate, drive, push), `rows` (3, n + 1) are x, F and v h over (state, held command). `steps` are
    those before and after the command changes in a sample. `leap` (2, 2, n, n + 2) is (phi, gamma, gamma_push) in
    contact and apart, of the part of a sample before the command changes and of that behind it, or (0, 2, n, n + 2)
    where every sample is crossed in steps.
    """

    flow: FloatArray
    rows: FloatArray
    wall: Wall
    whole: int
    chain: int
    fraction: float
    steps: tuple[int, int]
    leap: FloatArray


@compiled
def write_part(flow: FloatArray, duration: float, turn: float, out: FloatArray) -> None:
    """Write (phi, gamma, gamma_push) of a part of a sample: their series over pieces so short that it is exact.

    `flow` is that of `Motion`, `turn` the bound of its rate, see `rate_bound`.
    """
    n, inputs = flow.shape
    pieces = max(1, int(np.ceil(turn * duration / SLOW)))
    piece, term, following = np.zeros((n, inputs)), np.zeros((n, inputs)), np.zeros((n, inputs))
    for i in range(n):
        for j in range(inputs):
            term[i, j] = piece[i, j] = (duration / pieces) * flow[i, j]
            out[i, j] = 0.0
        piece[i, i], out[i, i] = piece[i, i] + 1.0, 1.0
    for k in range(2, _SERIES_TERMS + 1):
        multiply(flow, term, following)
        for i in range(n):
            for j in range(inputs):
                term[i, j] = following[i, j] * (duration / pieces / k)
                piece[i, j] += term[i, j]
    for _ in range(pieces):
        multiply(piece, out, following)
        for i in range(n):
            for j in range(inputs):
                out[i, j] = following[i, j] + (piece[i, j] if j >= n else 0.0)


@compiled
def multiply(left: FloatArray, right: FloatArray, out: FloatArray) -> None:
    """Write the product of the square part of one (n, n + 2) array with another."""
    n, inputs = right.shape
    for i in range(n):
        for j in range(inputs):
            total = 0.0
            for m in range(n):
                total += left[i, m] * right[m, j]
            out[i, j] = total


@compiled
def wall_force(motion: Motion, position: float, velocity: float) -> float:
    """Return F_e of a massless environment behind x_p = 0; `velocity` is v_p h."""
    return max(0.0, spring_force(motion.wall, position, velocity))


@inlined
def may_be_missed(rates: tuple[float, float], forces: tuple[float, float], duration: float, largest: float) -> bool:
    """Return whether K_e x_p + B_e v_p may pass its largest value, or 0, between two moments.

    The plant's motion turns by less than half a radian in a sample, so that it may only where the slope changes its
    sign.
    """
    (before, behind), (first, last) = rates, forces
    if before * behind > 0.0:
        return False
    rise = max(abs(before), abs(behind)) * duration
    if last > 0.0:
        return max(first, last) + rise > largest or min(first, last) <= rise
    return max(first, last) + rise > 0.0


@inlined
def force_slope(motion: Motion, states: FloatArray, row: int, held: float, push: float, pressed: float) -> float:
    """Return the rate of K_e x_p + B_e v_p per sample in a row of states, of which it is `pressed`.

    The damper counts behind the surface only.
    """
    n, wall, flow = states.shape[1], motion.wall, motion.flow
    slope = float(wall.stiffness * states[row, n - 1])
    if wall.damping == 0.0 or states[row, n - 2] < 0.0:
        return slope
    change = flow[n - 1, n] * held + flow[n - 1, n + 1] * (push - max(0.0, pressed))
    for j in range(n):
        change += flow[n - 1, j] * states[row, j]
    return float(slope + wall.damping * change)


@inlined
def leap_sample(
    motion: Motion,
    state: FloatArray,
    commands: tuple[float, float],
    push: float,
    tick: int,
    found: FloatArray,
    work: FloatArray,
) -> bool:
    """Advance the plant over one sample by its exponentials; return False, nothing done, where something may happen.

    That is where contact begins or ends, and where the force may be missed (`may_be_missed`). `work` is (3, n).
    """
    n, wall, leap, largest, moment = len(state), motion.wall, motion.leap, found[CONTACT_PEAK], -1.0
    pressed, row = spring_force(wall, state[n - 2], state[n - 1]), 0
    mode = IN_CONTACT if pressed > 0.0 else APART
    for i in range(n):
        work[row, i] = state[i]
    for part in range(2):
        duration = 1.0 - motion.fraction if part == 1 else motion.fraction
        if duration == 0.0:
            continue
        held = commands[part]
        before = force_slope(motion, work, row, held, push, pressed)
        for i in range(n):
            total = leap[mode, part, i, n] * held + leap[mode, part, i, n + 1] * push
            for j in range(n):
                total += leap[mode, part, i, j] * work[row, j]
            work[row + 1, i] = total
        row += 1
        pressing = spring_force(wall, work[row, n - 2], work[row, n - 1])
        behind = force_slope(motion, work, row, held, push, pressing)
        if (pressing > 0.0) != (pressed > 0.0):
            return False
        if may_be_missed((before, behind), (pressed, pressing), duration, largest):
            return False
        if pressing > largest:
            largest, moment = pressing, tick + (motion.fraction if part == 0 else 1.0)
        pressed = pressing
    for i in range(n):
        state[i] = work[row, i]
    if moment >= 0.0:
        found[CONTACT_PEAK], found[CONTACT_TIME] = largest, moment
    return True


class LeapRow(NamedTuple):
    """What x, x_p or v_p h, or its rate, takes of x, x_p, v_p h, the held command and the outside force."""

    x: float
    p: float
    v: float
    held: float
    push: float


@inlined
def _row(of: FloatArray) -> LeapRow:
    return LeapRow(of[0], of[1], of[2], of[3], of[4])


@inlined
def _of(row: LeapRow, x: float, p: float, v: float, held: float, push: float) -> float:
    return (row.x * x + row.p * p) + (row.v * v + (row.held * held + row.push * push))


@inlined
def leap_three_states(
    motion: Motion, state: FloatArray, commands: tuple[float, float], push: float, tick: int, found: FloatArray
) -> bool:
    """Do what `leap_sample` does for a state (x, x_p, v_p h) with everything in scalars."""
    wall, leap, largest, moment = motion.wall, motion.leap, found[CONTACT_PEAK], -1.0
    x, p, v, rate = state[FLANGE], state[PAYLOAD], state[VELOCITY], _row(motion.flow[VELOCITY])
    pressed = spring_force(wall, p, v)
    mode = IN_CONTACT if pressed > 0.0 else APART
    for part in range(2):
        duration = 1.0 - motion.fraction if part == 1 else motion.fraction
        if duration == 0.0:
            continue
        held, before = commands[part], wall.stiffness * v
        if wall.damping > 0.0 and p >= 0.0:
            before += wall.damping * _of(rate, x, p, v, held, push - max(0.0, pressed))
        of_x, of_p, of_v = (
            _row(leap[mode, part, FLANGE]),
            _row(leap[mode, part, PAYLOAD]),
            _row(leap[mode, part, VELOCITY]),
        )
        x, p, v = _of(of_x, x, p, v, held, push), _of(of_p, x, p, v, held, push), _of(of_v, x, p, v, held, push)
        pressing, behind = spring_force(wall, p, v), wall.stiffness * v
        if (pressing > 0.0) != (pressed > 0.0):
            return False
        if wall.damping > 0.0 and p >= 0.0:
            behind += wall.damping * _of(rate, x, p, v, held, push - max(0.0, pressing))
        if may_be_missed((before, behind), (pressed, pressing), duration, largest):
            return False
        if pressing > largest:
            largest, moment = pressing, tick + (motion.fraction if part == 0 else 1.0)
        pressed = pressing
    state[FLANGE], state[PAYLOAD], state[VELOCITY] = x, p, v
    if moment >= 0.0:
        found[CONTACT_PEAK], found[CONTACT_TIME] = largest, moment
    return True
