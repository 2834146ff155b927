"""The fast part of the contact transient: ticks between which the contact neither begins nor ends.

For plants with a delay and a massless environment. `stretch` is the equations as they stand; `stretch_of_three` is the
same for the plant with three states (a robot of one pole), kept in scalars, and three times as fast.
"""

import numpy as np
from numpy.typing import NDArray

from .compiled import compiled
from .controller import controller_step

FloatArray = NDArray[np.float64]


@compiled
def stretch(
    step: FloatArray,
    rows: FloatArray,
    delay: tuple[int, int, float],
    wall: tuple[float, float, float, float],
    blocks: FloatArray,
    now: tuple[FloatArray, FloatArray, FloatArray, FloatArray],
    flags: NDArray[np.int64],
    forces: tuple[float, float],
    span: tuple[int, int],
    traces: tuple[FloatArray, FloatArray],
    found: FloatArray,
) -> int:
    """Step from tick to tick, write F and F_e and update their peaks; return the tick to be crossed with care."""
    (state, past, control, _), (whole, chain, _), (force, contact) = now, delay, traces
    n, head, last, touching, k = len(state), flags[0], len(past) - 1, flags[1] == 1, span[0]
    law = (control[0], control[1], control[2], control[3])
    following = np.empty(n)
    pressed = wall[0] * state[n - 2] + wall[1] * state[n - 1]
    (sensor_peak, contact_peak), sensor_tick, contact_tick = (found[0], found[2]), -1, -1
    while k < span[1]:
        held = past[(head + chain - 1) & last]
        position, sensed = 0.0, rows[1, n] * held
        for i in range(n):
            position += rows[0, i] * state[i]
            sensed += rows[1, i] * state[i]
        command, law_after = controller_step(blocks, law, forces[0] + sensed, position)
        newer = command if whole == 0 else past[(head + whole - 1) & last]
        for i in range(n):
            total = step[i, n] * newer + step[i, n + 1] * held + step[i, n + 2] * forces[1]
            for j in range(n):
                total += step[i, j] * state[j]
            following[i] = total
        pressing = wall[0] * following[n - 2]
        if following[n - 2] >= 0.0:
            pressing += wall[1] * following[n - 1]
        if (pressing > 0.0) != touching:
            break
        shown = max(0.0, pressed) if touching else 0.0
        force[k], contact[k] = sensed, shown
        if -sensed > sensor_peak:
            sensor_peak, sensor_tick = -sensed, k
        if shown > contact_peak:
            contact_peak, contact_tick = shown, k
        pressed, law = pressing, law_after
        for i in range(n):
            state[i] = following[i]
        head = (head - 1) & last
        past[head] = command
        k += 1
    if sensor_tick >= 0:
        found[0], found[1] = sensor_peak, sensor_tick
    if contact_tick >= 0:
        found[2], found[3] = contact_peak, contact_tick
    flags[0] = head
    control[0], control[1], control[2], control[3] = law
    return k


@compiled
def stretch_of_three(
    step: FloatArray,
    rows: FloatArray,
    delay: tuple[int, int, float],
    wall: tuple[float, float, float, float],
    blocks: FloatArray,
    now: tuple[FloatArray, FloatArray, FloatArray, FloatArray],
    flags: NDArray[np.int64],
    forces: tuple[float, float],
    span: tuple[int, int],
    traces: tuple[FloatArray, FloatArray],
    found: FloatArray,
) -> int:
    """Do what `stretch` does for a state (x, x_p, v_p h) with everything in scalars."""
    (state, past, control, _), (whole, chain, _), (force, contact) = now, delay, traces
    head, last, touching, k = flags[0], len(past) - 1, flags[1] == 1, span[0]
    plain = blocks[4, 0] == 0.0 and blocks[4, 1] == 0.0 and blocks[4, 2] == 0.0
    a, b, c = step[0, 0], (step[1, 0], step[1, 1], step[1, 2]), (step[2, 0], step[2, 1], step[2, 2])
    new, old = (step[0, 3], step[1, 3], step[2, 3]), (step[0, 4], step[1, 4], step[2, 4])
    f, rest = (rows[1, 0], rows[1, 1], rows[1, 2], rows[1, 3]), (step[1, 5] * forces[1], step[2, 5] * forces[1])
    direct, pole, gain, integral = blocks[0, 0] + blocks[1, 0], blocks[1, 1], blocks[1, 2], blocks[0, 2]
    law, x, p, v = (control[0], control[1], control[2], control[3]), state[0], state[1], state[2]
    pressed, sensor_peak, sensor_tick = wall[0] * p + wall[1] * v, found[0], -1
    contact_peak, contact_tick = found[2], -1
    while k < span[1]:
        held = past[(head + chain - 1) & last]
        sensed = (f[0] * x + f[1] * p) + (f[2] * v + f[3] * held)
        if plain:
            command = (law[0] + law[1]) + direct * (forces[0] + sensed)
            law_after = (
                law[0] + integral * (forces[0] + sensed),
                pole * law[1] + gain * (forces[0] + sensed),
                0.0,
                0.0,
            )
        else:
            command, law_after = controller_step(blocks, law, forces[0] + sensed, rows[0, 0] * x)
        newer = command if whole == 0 else past[(head + whole - 1) & last]
        x_after = a * x + (new[0] * newer + old[0] * held)
        p_after = (b[0] * x + b[1] * p) + (b[2] * v + (new[1] * newer + old[1] * held)) + rest[0]
        v_after = (c[0] * x + c[1] * p) + (c[2] * v + (new[2] * newer + old[2] * held)) + rest[1]
        pressing = wall[0] * p_after + (wall[1] * v_after if p_after >= 0.0 else 0.0)
        if (pressing > 0.0) != touching:
            break
        force[k], contact[k] = sensed, max(0.0, pressed) if touching else 0.0
        if -sensed > sensor_peak:
            sensor_peak, sensor_tick = -sensed, k
        if touching and pressed > contact_peak:
            contact_peak, contact_tick = pressed, k
        pressed, law, x, p, v = pressing, law_after, x_after, p_after, v_after
        head, k = (head - 1) & last, k + 1
        past[head] = command
    if sensor_tick >= 0:
        found[0], found[1] = sensor_peak, sensor_tick
    if contact_tick >= 0:
        found[2], found[3] = contact_peak, contact_tick
    flags[0], state[0], state[1], state[2] = head, x, p, v
    control[0], control[1], control[2], control[3] = law
    return k
