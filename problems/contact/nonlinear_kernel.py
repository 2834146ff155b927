"""Compiled stepping of the full simulation: Runge–Kutta between the ticks, `full_control` at them.

No matrix exponential enters here, so that this is a second method to the exact transient of `contact_kernel`.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..compiled import compiled
from .nonlinear_control import TOUCHING, WATCHING, Law, Memory, blocks_at, control_tick, update_damping

FloatArray = NDArray[np.float64]

# Rows of `Recording.traces`: F, F as the controller sees it, F_e, x, v, x_p, v_p, x^d, B_a.
TRACES = 9


class Motion(NamedTuple):
    """The continuous plant without environment over one period, its wall and its delay.

    `flow` (n, n + 2) is (rate, drive, push), `rows` (3, n + 1) are x, F and v h over (state, held command); `stiffness`
    K_e and `damping` B_e/h act on x_p and v_p h. `steps` are those before and after the command changes in a sample.
    """

    flow: FloatArray
    rows: FloatArray
    stiffness: float
    damping: float
    whole: int
    chain: int
    fraction: float
    steps: tuple[int, int]


class Recording(NamedTuple):
    """Outputs: `traces` (9, samples), `flags` (samples,) and `found`.

    `found`: 0 largest pressing sensor force, 1 its tick, 2 largest contact force, 3 its time, 4 time of the impact,
    5 v_p h then, 6 tick of the collision (times in samples, not a number when it did not happen).
    """

    traces: FloatArray
    flags: NDArray[np.int64]
    found: FloatArray


@compiled
def wall_force(motion: Motion, position: float, velocity: float) -> float:
    """Return F_e of a massless environment behind x_p = 0; `velocity` is v_p h."""
    if position < 0.0:
        return 0.0
    return max(0.0, motion.stiffness * position + motion.damping * velocity)


@compiled
def runge_kutta(motion: Motion, state: FloatArray, held: float, push: float, step: float, work: FloatArray) -> None:
    """Advance `state` by one classical Runge–Kutta step; every stage asks the wall anew. `work` is (3, n)."""
    flow, n, trial, rate, change = motion.flow, len(state), work[0], work[1], work[2]
    trial[:], change[:] = state, 0.0
    for stage in range(4):
        outside = push - wall_force(motion, trial[n - 2], trial[n - 1])
        reach, weight = step if stage == 2 else 0.5 * step, step / (6.0 if stage % 3 == 0 else 3.0)
        for i in range(n):
            total = flow[i, n] * held + flow[i, n + 1] * outside
            for j in range(n):
                total += flow[i, j] * trial[j]
            rate[i] = total
        for i in range(n):
            change[i] += weight * rate[i]
            trial[i] = state[i] + reach * rate[i]
    for i in range(n):
        state[i] += change[i]


@compiled
def cross_sample(
    motion: Motion,
    state: FloatArray,
    commands: tuple[float, float],
    pushes: tuple[float, float],
    tick: int,
    found: FloatArray,
    work: FloatArray,
) -> None:
    """Advance the plant over one sample; `commands` older and newer, `pushes` before and after the impact."""
    n, start = len(state), float(tick)
    for part in range(2):
        duration, steps = (1.0 - motion.fraction if part == 1 else motion.fraction), motion.steps[part]
        for j in range(steps):
            push = pushes[0] if np.isnan(found[4]) else pushes[1]
            runge_kutta(motion, state, commands[part], push, duration / steps, work)
            pressed, moment = wall_force(motion, state[n - 2], state[n - 1]), start + (j + 1) * (duration / steps)
            if pressed > 0.0 and np.isnan(found[4]):
                found[4], found[5] = moment, state[n - 1]
            if pressed > found[2]:
                found[2], found[3] = pressed, moment
        start += duration


@compiled
def run_full(
    motion: Motion,
    law: Law,
    start: tuple[FloatArray, FloatArray, Memory],
    desired: tuple[float, float],
    pushes: tuple[float, float],
    noise: FloatArray,
    late: NDArray[np.bool_],
    recording: Recording,
) -> None:
    """Step over all samples of the recording.

    `start` is plant state, past commands (newest first) and memory; `desired` and `pushes` are F^d and the hand's force
    before and after the impact; `noise` (samples,) is added to F. Where `late` (samples,) no command arrives at the
    robot, which goes on with the one before. Without delay the velocity that is recorded is the
    one just before the command changes.
    """
    state, past, memory = start[0].copy(), start[1].copy(), start[2]
    n, rows, places, head = len(state), motion.rows, len(start[1]), 0
    traces, found, work = recording.traces, recording.found, np.empty((3, n))
    blocks = blocks_at(law, memory.damping)
    found[2] = wall_force(motion, state[n - 2], state[n - 1])
    acting = past[(head + motion.chain - 1) % places] if motion.chain > 0 else memory.sent
    for k in range(traces.shape[1]):
        # What acts at the tick is the last command that arrived, or with a delay of whole samples the one arriving.
        held = acting
        if motion.chain == motion.whole and motion.whole > 0 and not late[k]:
            held = past[(head + motion.whole - 1) % places]
        position, force, velocity = 0.0, rows[1, n] * held, rows[2, n] * held
        for i in range(n):
            position += rows[0, i] * state[i]
            force += rows[1, i] * state[i]
            velocity += rows[2, i] * state[i]
        memory = update_damping(law, blocks, memory, k, position)
        steering = desired[0] if np.isnan(found[4]) else desired[1]
        watching = memory.phase == WATCHING
        memory, seen, flags = control_tick(law, blocks, memory, (steering, force + noise[k], position))
        if watching and memory.phase != WATCHING:
            found[6] = k
        pressed = wall_force(motion, state[n - 2], state[n - 1])
        traces[0, k], traces[1, k], traces[2, k] = force, seen, pressed
        traces[3, k], traces[4, k] = position, velocity / law.h
        traces[5, k], traces[6, k] = state[n - 2], state[n - 1] / law.h
        traces[7, k], traces[8, k] = memory.sent, memory.damping
        recording.flags[k] = flags | (TOUCHING if pressed > 0.0 else 0)
        if -force > found[0]:
            found[0], found[1] = -force, k
        newer = memory.sent if motion.whole == 0 else past[(head + motion.whole - 1) % places]
        if late[k]:
            newer = acting
        cross_sample(motion, state, (held if motion.chain > motion.whole else newer, newer), pushes, k, found, work)
        acting = newer
        head = (head - 1) % places
        past[head] = memory.sent
