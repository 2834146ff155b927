"""The fast part of the contact transient: ticks between which the contact neither begins nor ends.

For plants with a delay and a massless environment. `step_without_events` writes the equations as they
stand; `step_three_states` is the same for the plant with three states (a robot of one pole), kept in scalars, and three
times as fast.
"""

import numpy as np
from numpy.typing import NDArray

from ..compiled import compiled
from ..model.controller import controller_step

FloatArray = NDArray[np.float64]

# A force has come to rest when it has stayed within this share of the largest force for a quarter of the run.
SETTLED = 1e-3
SHORTEST_QUARTER = 32


@compiled
def length_of(loud: int) -> int:
    """Return how many ticks a run takes whose force was away from its rest at tick `loud` for the last time."""
    return loud + 1 + max((loud + 3) // 3, SHORTEST_QUARTER)


@compiled
def _quiet(
    touching: bool, wall: tuple[float, float, float, float], forces: tuple[float, float], first: float, largest: float
) -> float:
    """Return how near e = F^d + F is to 0 at rest on a spring; where nobody knows the rest, everything is near."""
    if not touching or wall[0] == 0.0:
        return np.inf
    return 0.5 * SETTLED * max(largest, abs(first), abs(forces[0]), abs(forces[1]))


@compiled
def _move(
    step: FloatArray,
    wall: tuple[float, float, float, float],
    state: FloatArray,
    inputs: tuple[float, float, float],
    following: FloatArray,
) -> float:
    """Write the state at the next tick and return what the payload presses there."""
    n = len(state)
    for i in range(n):
        total = step[i, n] * inputs[0] + step[i, n + 1] * inputs[1] + step[i, n + 2] * inputs[2]
        for j in range(n):
            total += step[i, j] * state[j]
        following[i] = total
    return float(wall[0] * following[n - 2] + (wall[1] * following[n - 1] if following[n - 2] >= 0.0 else 0.0))


@compiled
def _keep(crest: FloatArray, x: float, p: float, v: float, newer: float, held: float, k: int) -> None:
    row = k & 1
    crest[row, 0], crest[row, 1], crest[row, 2] = x, p, v
    crest[row, 3], crest[row, 4], crest[row, 5] = newer, held, k


@compiled
def _leave(
    found: FloatArray,
    flags: NDArray[np.int64],
    control: FloatArray,
    sensor: tuple[float, int],
    contact: tuple[float, int],
    head: int,
    law: tuple[float, float, float, float],
) -> None:
    """Hand on new peaks (tick −1 without one), the head of the ring and the controller's states."""
    if sensor[1] >= 0:
        found[0], found[1] = sensor
    if contact[1] >= 0:
        found[2], found[3] = contact
    flags[0] = head
    control[0], control[1], control[2], control[3] = law


@compiled
def step_without_events(
    step: FloatArray,
    rows: FloatArray,
    delay: tuple[int, int, float],
    wall: tuple[float, float, float, float],
    blocks: FloatArray,
    now: tuple[FloatArray, FloatArray, FloatArray, FloatArray],
    flags: NDArray[np.int64],
    forces: tuple[float, float],
    span: tuple[int, int, int],
    traces: tuple[FloatArray, FloatArray],
    found: FloatArray,
    crest: FloatArray,
) -> tuple[int, int]:
    """Step from tick to tick, write F and F_e and update their peaks; return the tick that was reached and the aim.

    `span` is (first, aim, last). A tick before the aim is to be crossed with care. On a spring the aim is moved on,
    towards `last`, until the force has been near its rest for a quarter of the run. Row k mod 2 of `crest` (2, n + 3)
    gets state, newer and older command and k of the last ticks at which F_e was the largest so far.
    """
    (state, past, control, _), (whole, chain, _), (force, contact) = now, delay, traces
    n, head, last, touching, (k, aim, end) = len(state), flags[0], len(past) - 1, flags[1] == 1, span
    law = (control[0], control[1], control[2], control[3])
    following = np.empty(n)
    pressed = wall[0] * state[n - 2] + wall[1] * state[n - 1]
    (sensor_peak, contact_peak), sensor_tick, contact_tick = (found[0], found[2]), -1, -1
    loud, quiet = -1, _quiet(touching, wall, forces, force[0] if k > 0 else 0.0, sensor_peak)
    while k < aim:
        held = past[(head + chain - 1) & last]
        position, sensed = 0.0, rows[1, n] * held
        for i in range(n):
            position += rows[0, i] * state[i]
            sensed += rows[1, i] * state[i]
        command, law_after = controller_step(blocks, law, forces[0] + sensed, position)
        newer = command if whole == 0 else past[(head + whole - 1) & last]
        pressing = _move(step, wall, state, (newer, held, forces[1]), following)
        if (pressing > 0.0) != touching:
            break
        shown = max(0.0, pressed) if touching else 0.0
        force[k], contact[k] = sensed, shown
        if -sensed > sensor_peak:
            sensor_peak, sensor_tick = -sensed, k
            quiet = max(quiet, 0.5 * SETTLED * sensor_peak)
        if shown > contact_peak:
            contact_peak, contact_tick = shown, k
            crest[k & 1, :n], crest[k & 1, n], crest[k & 1, n + 1], crest[k & 1, n + 2] = state, newer, held, k
        if abs(forces[0] + sensed) >= quiet:
            loud = k
        pressed, law = pressing, law_after
        for i in range(n):
            state[i] = following[i]
        head = (head - 1) & last
        past[head] = command
        k += 1
        if k == aim:
            aim = max(aim, min(end, length_of(loud)))
    _leave(found, flags, control, (sensor_peak, sensor_tick), (contact_peak, contact_tick), head, law)
    return k, aim


@compiled
def step_three_states(
    step: FloatArray,
    rows: FloatArray,
    delay: tuple[int, int, float],
    wall: tuple[float, float, float, float],
    blocks: FloatArray,
    now: tuple[FloatArray, FloatArray, FloatArray, FloatArray],
    flags: NDArray[np.int64],
    forces: tuple[float, float],
    span: tuple[int, int, int],
    traces: tuple[FloatArray, FloatArray],
    found: FloatArray,
    crest: FloatArray,
) -> tuple[int, int]:
    """Do what `step_without_events` does for a state (x, x_p, v_p h) with everything in scalars."""
    (state, past, control, _), (whole, chain, _), (force, contact) = now, delay, traces
    head, last, touching, (k, aim, end) = flags[0], len(past) - 1, flags[1] == 1, span
    plain = blocks[4, 0] == 0.0 and blocks[4, 1] == 0.0 and blocks[4, 2] == 0.0
    a, b, c = step[0, 0], (step[1, 0], step[1, 1], step[1, 2]), (step[2, 0], step[2, 1], step[2, 2])
    new, old = (step[0, 3], step[1, 3], step[2, 3]), (step[0, 4], step[1, 4], step[2, 4])
    f, rest = (rows[1, 0], rows[1, 1], rows[1, 2], rows[1, 3]), (step[1, 5] * forces[1], step[2, 5] * forces[1])
    direct, pole, gain, integral = blocks[0, 0] + blocks[1, 0], blocks[1, 1], blocks[1, 2], blocks[0, 2]
    law, x, p, v = (control[0], control[1], control[2], control[3]), state[0], state[1], state[2]
    pressed, sensor_peak, contact_peak = wall[0] * p + wall[1] * v, found[0], found[2]
    sensor_tick, contact_tick, loud = -1, -1, -1
    quiet = _quiet(touching, wall, forces, force[0] if k > 0 else 0.0, sensor_peak)
    while k < aim:
        held = past[(head + chain - 1) & last]
        sensed = (f[0] * x + f[1] * p) + (f[2] * v + f[3] * held)
        e = forces[0] + sensed
        if plain:
            command = (law[0] + law[1]) + direct * e
            law_after = (law[0] + integral * e, pole * law[1] + gain * e, 0.0, 0.0)
        else:
            command, law_after = controller_step(blocks, law, e, rows[0, 0] * x)
        newer = command if whole == 0 else past[(head + whole - 1) & last]
        x_after = a * x + (new[0] * newer + old[0] * held)
        # What hangs on this tick's state comes last: a sum waits for its slowest term.
        p_after = (b[0] * x + b[1] * p) + (b[2] * v + ((new[1] * newer + old[1] * held) + rest[0]))
        v_after = (c[0] * x + c[1] * p) + (c[2] * v + ((new[2] * newer + old[2] * held) + rest[1]))
        pressing = wall[0] * p_after + (wall[1] * v_after if p_after >= 0.0 else 0.0)
        if (pressing > 0.0) != touching:
            break
        force[k], contact[k] = sensed, max(0.0, pressed) if touching else 0.0
        if -sensed > sensor_peak:
            sensor_peak, sensor_tick, quiet = -sensed, k, max(quiet, -0.5 * SETTLED * sensed)
        if touching and pressed > contact_peak:
            contact_peak, contact_tick = pressed, k
            _keep(crest, x, p, v, newer, held, k)
        loud = k if abs(e) >= quiet else loud
        pressed, law, x, p, v = pressing, law_after, x_after, p_after, v_after
        head, k = (head - 1) & last, k + 1
        past[head], aim = command, aim if k < aim else max(aim, min(end, length_of(loud)))
    state[0], state[1], state[2] = x, p, v
    _leave(found, flags, control, (sensor_peak, sensor_tick), (contact_peak, contact_tick), head, law)
    return k, aim
