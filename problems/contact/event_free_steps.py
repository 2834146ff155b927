"""The fast part of the contact transient: ticks between which the contact neither begins nor ends.

For plants with a delay and a massless environment. `step_without_events` writes the equations as they are;
`step_three_states` is the same for the plant with three states (a robot of one pole), kept in scalars, and three
times as fast.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..arrays import FloatArray
from ..compiled import compiled
from ..model.controller import control_tuple, controller_step, keep_control
from ..model.difference import (
    BIQUAD_POLE_1,
    BIQUAD_POLE_2,
    COMPENSATION,
    FEEDBACK_DAMPING,
    INTEGRATOR_DIRECT,
    INTEGRATOR_GAIN,
    IS_IDEAL,
    LAG_DIRECT,
    LAG_GAIN,
    LAG_POLE,
    ControlState,
)
from .events import spring_force
from .kernel_types import (
    APART,
    CONTACT_PEAK,
    CONTACT_TIME,
    HEAD,
    IN_CONTACT,
    POSITION,
    SENSED,
    SENSOR_PEAK,
    SENSOR_TICK,
    TOUCHING,
    Contact,
    Forces,
    Inputs,
    Moment,
    RunResults,
    TickRange,
    Wall,
)
from .peaks import keep_state, keep_three_states

# A force has come to rest when it has stayed within this share of the largest force for a quarter of the run.
SETTLED = 1e-3
SHORTEST_QUARTER = 32
# The three states of a robot of one pole with its payload.
FLANGE, PAYLOAD, VELOCITY = 0, 1, 2


@compiled
def settled_length(last_unsettled: int) -> int:
    """Return how many ticks a run takes whose force was away from its rest at this tick for the last time."""
    return last_unsettled + 1 + max((last_unsettled + 3) // 3, SHORTEST_QUARTER)


@compiled
def _settling_threshold(touching: bool, wall: Wall, forces: Forces, first: float, largest: float) -> float:
    """Return how near e = F^d + F is to 0 at rest on a spring; infinite where the force at rest is unknown."""
    if not touching or wall.stiffness == 0.0:
        return np.inf
    return 0.5 * SETTLED * max(largest, abs(first), abs(forces.desired), abs(forces.push))


@compiled
def _move(step: FloatArray, wall: Wall, state: FloatArray, inputs: Inputs, following: FloatArray) -> float:
    """Write the state at the next tick and return the force of the environment's spring there."""
    n = len(state)
    for i in range(n):
        total = step[i, n] * inputs.newer + step[i, n + 1] * inputs.older + step[i, n + 2] * inputs.push
        for j in range(n):
            total += step[i, j] * state[j]
        following[i] = total
    return spring_force(wall, following[n - 2], following[n - 1])


@compiled
def _leave(
    found: FloatArray,
    flags: NDArray[np.int64],
    control: FloatArray,
    sensor: tuple[float, int],
    contact: tuple[float, int],
    head: int,
    law: ControlState,
) -> None:
    """Hand on new peaks (tick −1 without one), the head of the ring and the controller's states."""
    (sensor_peak, sensor_tick), (contact_peak, contact_tick) = sensor, contact
    if sensor_tick >= 0:
        found[SENSOR_PEAK], found[SENSOR_TICK] = sensor_peak, sensor_tick
    if contact_tick >= 0:
        found[CONTACT_PEAK], found[CONTACT_TIME] = contact_peak, contact_tick
    flags[HEAD] = head
    keep_control(control, law)


@compiled
def step_without_events(
    plant: Contact,
    blocks: FloatArray,
    now: Moment,
    flags: NDArray[np.int64],
    forces: Forces,
    span: TickRange,
    results: RunResults,
) -> tuple[int, int]:
    """Step from tick to tick, write F and F_e and update their peaks; return the tick that was reached and the aim.

    A tick before the aim is to be crossed with care. On a spring the aim is moved on, towards the last tick of `span`,
    until the force has been near its rest for a quarter of the run. Kept are the last ticks at which F_e was the
    largest so far.
    """
    (state, past, control, _), ((force, contact), found, crest) = now, results
    (_, _, rows, _, (whole, chain, _), wall), step = plant, plant.step[IN_CONTACT if flags[TOUCHING] == 1 else APART]
    n, head, last, touching, (k, aim, end) = len(state), flags[HEAD], len(past) - 1, flags[TOUCHING] == 1, span
    law = control_tuple(control)
    following = np.empty(n)
    pressed = wall.stiffness * state[n - 2] + wall.damping * state[n - 1]
    (sensor_peak, contact_peak), sensor_tick, contact_tick = (found[SENSOR_PEAK], found[CONTACT_PEAK]), -1, -1
    first = force[0] if k > 0 else 0.0
    last_unsettled, threshold = -1, _settling_threshold(touching, wall, forces, first, sensor_peak)
    while k < aim:
        held = past[(head + chain - 1) & last]
        position, sensed = 0.0, rows[SENSED, n] * held
        for i in range(n):
            position += rows[POSITION, i] * state[i]
            sensed += rows[SENSED, i] * state[i]
        command, law_after = controller_step(blocks, law, forces.desired + sensed, position)
        newer = command if whole == 0 else past[(head + whole - 1) & last]
        pressing = _move(step, wall, state, Inputs(held, newer, forces.push), following)
        if (pressing > 0.0) != touching:
            break
        shown = max(0.0, pressed) if touching else 0.0
        force[k], contact[k] = sensed, shown
        if -sensed > sensor_peak:
            sensor_peak, sensor_tick = -sensed, k
            threshold = max(threshold, 0.5 * SETTLED * sensor_peak)
        if shown > contact_peak:
            contact_peak, contact_tick = shown, k
            keep_state(crest, state, newer, held, k)
        if abs(forces.desired + sensed) >= threshold:
            last_unsettled = k
        pressed, law = pressing, law_after
        for i in range(n):
            state[i] = following[i]
        head = (head - 1) & last
        past[head] = command
        k += 1
        if k == aim:
            aim = max(aim, min(end, settled_length(last_unsettled)))
    _leave(found, flags, control, (sensor_peak, sensor_tick), (contact_peak, contact_tick), head, law)
    return k, aim


class _Row(NamedTuple):
    """What the next x, x_p or v_p h takes of x, x_p, v_p h, both commands and the outside force."""

    x: float
    p: float
    v: float
    newer: float
    older: float
    push: float


@compiled
def _row(of: FloatArray) -> _Row:
    return _Row(of[0], of[1], of[2], of[3], of[4], of[5])


@compiled
def _three_rows(step: FloatArray) -> tuple[_Row, _Row, _Row]:
    return _row(step[FLANGE]), _row(step[PAYLOAD]), _row(step[VELOCITY])


@compiled
def _is_plain(blocks: FloatArray) -> bool:
    """Return whether the law is A(1 + C_ff) alone."""
    reads_force_alone = blocks[FEEDBACK_DAMPING] == 0.0 and blocks[COMPENSATION] == 0.0 and blocks[IS_IDEAL] == 0.0
    return bool(reads_force_alone and blocks[BIQUAD_POLE_1] == 0.0 and blocks[BIQUAD_POLE_2] == 0.0)


@compiled
def step_three_states(
    plant: Contact,
    blocks: FloatArray,
    now: Moment,
    flags: NDArray[np.int64],
    forces: Forces,
    span: TickRange,
    results: RunResults,
) -> tuple[int, int]:
    """Do what `step_without_events` does for a state (x, x_p, v_p h) with everything in scalars."""
    (state, past, control, _), ((force, contact), found, crest) = now, results
    steps, _, rows, _, (whole, chain, _), wall = plant
    head, last, touching, (k, aim, end) = flags[HEAD], len(past) - 1, flags[TOUCHING] == 1, span
    plain = _is_plain(blocks)
    of_x, of_p, of_v = _three_rows(steps[IN_CONTACT if touching else APART])
    f_x, f_p, f_v, f_held = rows[SENSED, 0], rows[SENSED, 1], rows[SENSED, 2], rows[SENSED, 3]
    p_rest, v_rest, c_x, gain = (
        of_p.push * forces.push,
        of_v.push * forces.push,
        rows[POSITION, FLANGE],
        blocks[LAG_GAIN],
    )
    direct, integral, pole = blocks[INTEGRATOR_DIRECT] + blocks[LAG_DIRECT], blocks[INTEGRATOR_GAIN], blocks[LAG_POLE]
    law, (x, p, v) = control_tuple(control), (state[0], state[1], state[2])
    pressed, sensor_peak, contact_peak = wall.stiffness * p + wall.damping * v, found[SENSOR_PEAK], found[CONTACT_PEAK]
    sensor_tick, contact_tick, last_unsettled = -1, -1, -1
    threshold = _settling_threshold(touching, wall, forces, force[0] if k > 0 else 0.0, sensor_peak)
    while k < aim:
        held, (a, b, _, _, _, _) = past[(head + chain - 1) & last], law
        sensed = (f_x * x + f_p * p) + (f_v * v + f_held * held)
        e = forces.desired + sensed
        if plain:
            command, law_after = (a + b) + direct * e, (a + integral * e, pole * b + gain * e, 0.0, 0.0, 0.0, 0.0)
        else:
            command, law_after = controller_step(blocks, law, e, c_x * x)
        newer = command if whole == 0 else past[(head + whole - 1) & last]
        x_after = of_x.x * x + (of_x.newer * newer + of_x.older * held)
        # What hangs on this tick's state comes last: a sum waits for its slowest term.
        p_after = (of_p.x * x + of_p.p * p) + (of_p.v * v + ((of_p.newer * newer + of_p.older * held) + p_rest))
        v_after = (of_v.x * x + of_v.p * p) + (of_v.v * v + ((of_v.newer * newer + of_v.older * held) + v_rest))
        pressing = spring_force(wall, p_after, v_after)
        if (pressing > 0.0) != touching:
            break
        force[k], contact[k] = sensed, max(0.0, pressed) if touching else 0.0
        if -sensed > sensor_peak:
            sensor_peak, sensor_tick, threshold = -sensed, k, max(threshold, -0.5 * SETTLED * sensed)
        if touching and pressed > contact_peak:
            contact_peak, contact_tick = pressed, k
            keep_three_states(crest, x, p, v, newer, held, k)
        last_unsettled = k if abs(e) >= threshold else last_unsettled
        pressed, law, x, p, v = pressing, law_after, x_after, p_after, v_after
        head, k = (head - 1) & last, k + 1
        past[head], aim = command, aim if k < aim else max(aim, min(end, settled_length(last_unsettled)))
    state[0], state[1], state[2] = x, p, v
    _leave(found, flags, control, (sensor_peak, sensor_tick), (contact_peak, contact_tick), head, law)
    return k, aim
