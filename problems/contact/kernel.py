"""Compiled stepping of one contact: the equations of `problems.model.sampled`, tick by tick."""

import numpy as np
from numpy.typing import NDArray

from ..arrays import FloatArray
from ..compiled import compiled
from ..model.controller import control_tuple, controller_step, keep_control, steady_states
from ..model.difference import BIQUAD_0, INTEGRATOR_DIRECT, LAG_DIRECT, ControlState
from .event_free_steps import SETTLED, SHORTEST_QUARTER, step_three_states, step_without_events
from .events import (
    advance_surface,
    apply_impact,
    contact_force,
    is_in_contact,
    moved_within,
    substeps_apart,
    switch_moment,
)
from .kernel_types import (
    APART,
    CONTACT_PEAK,
    CONTACT_TIME,
    FLAGS,
    FOUND,
    HEAD,
    IMPULSE,
    IN_CONTACT,
    MOVING,
    POSITION,
    PRESSED,
    PUSHED,
    SENSED,
    SENSOR_PEAK,
    SENSOR_TICK,
    SWITCHES,
    TOUCHING,
    Contact,
    Crossing,
    Delay,
    Forces,
    HeldInputs,
    Inputs,
    Moment,
    RunResults,
    Start,
    TickRange,
    Traces,
    Wall,
)
from .peaks import is_kept, keep_peak, largest_force, largest_in_sample, may_hide_peak, may_pass, search_around

_FIRST_LOOK = 96
_SWITCHES_PER_SAMPLE = 8


@compiled
def run_contact(
    plant: Contact,
    blocks: FloatArray,
    start: Start,
    forces: Forces,
    traces: Traces,
    found: FloatArray,
    until_settled: bool,
) -> int:
    """Step from the impact on and return the number of samples: all of the traces', or fewer when settled.

    `traces` get F and F_e at every tick, `found` (FOUND,) the peaks.
    """
    now, flags = first_moment(start, plant, found)
    total, crest = len(traces.sensed), np.full((2, len(now.state) + 3), -1.0)
    results = RunResults(traces, found, crest)
    done, look = 0, min(_FIRST_LOOK, total) if until_settled else total
    while True:
        done = walk(plant, blocks, now, flags, forces, TickRange(done, look, total), results)
        touching, anchored = flags[TOUCHING] == 1, plant.wall.stiffness > 0.0
        if done == total or _settled(traces.sensed, done, forces, touching, anchored, found[SENSOR_PEAK]):
            break
        look = min(total, done + done // 3)
    if _is_plain(plant):
        _refine_peak(plant, blocks, start, forces, traces, done, found, crest)
    # Only an environment with stiffness brings the payload to rest.
    if touching and anchored:
        _add_rest(forces, done, found)
    return done


@compiled
def first_moment(start: Start, plant: Contact, found: FloatArray) -> tuple[Moment, NDArray[np.int64]]:
    """Copy the start, with the environment at rest beside it, and let the impact happen; return it with its flags."""
    state, surface, flags = start.state.copy(), np.zeros(2), np.zeros(FLAGS, dtype=np.int64)
    found[IMPULSE], flags[TOUCHING] = apply_impact(state, surface, plant.wall, False), 1
    return Moment(state, start.past.copy(), start.control.copy(), surface), flags


@compiled
def _is_plain(plant: Contact) -> bool:
    """Return whether ticks are enough: a delay (else the command acts on the force at once), no mass, not stiff."""
    return plant.delay.chain > 0 and plant.wall.mass == 0.0 and len(plant.inside) == 0


@compiled
def walk(
    plant: Contact,
    blocks: FloatArray,
    now: Moment,
    flags: NDArray[np.int64],
    forces: Forces,
    span: TickRange,
    results: RunResults,
) -> int:
    """Step over the ticks of `span` and return the tick that was reached: its aim or one behind it.

    Between stretches in which nothing switches lie the samples that are crossed one by one.
    """
    (done, aim, end), plain = span, _is_plain(plant)
    while done < aim:
        if plain:
            part = TickRange(done, aim, end)
            if len(now.state) == 3:
                done, aim = step_three_states(plant, blocks, now, flags, forces, part, results)
            else:
                done, aim = step_without_events(plant, blocks, now, flags, forces, part, results)
        if done < aim:
            _step(plant, blocks, now, flags, forces, done, results.traces, results.found)
            done += 1
    return done


@compiled
def _step(
    plant: Contact,
    blocks: FloatArray,
    now: Moment,
    flags: NDArray[np.int64],
    forces: Forces,
    k: int,
    traces: Traces,
    found: FloatArray,
) -> None:
    """Step over one sample with all that may happen in it."""
    (step, flow, rows, inside, delay, wall), (state, past, control, surface), n = plant, now, len(now.state)
    law = control_tuple(control)
    held = _held(past, flags[HEAD], delay)
    sensed, command, pressed, law = _outputs(rows, blocks, law, state, held, delay, forces)
    keep_control(control, law)
    newer, older = _commands(past, flags[HEAD], delay, command)
    inputs, touching, mode = Inputs(older, newer, forces.push), flags[TOUCHING] == 1, IN_CONTACT
    if not touching:
        mode = APART
    traces.sensed[k], traces.pressed[k] = sensed, max(0.0, pressed) if touching else 0.0
    if -sensed > found[SENSOR_PEAK]:
        found[SENSOR_PEAK], found[SENSOR_TICK] = -sensed, k
    keep_peak(found, k, (traces.pressed[k], 0.0))
    following, swung = np.empty(n), surface.copy()
    for i in range(n):
        total = step[mode, i, n] * newer + step[mode, i, n + 1] * older
        total += step[mode, i, n + 2] * forces.push
        for j in range(n):
            total += step[mode, i, j] * state[j]
        following[i] = total
    if not touching:
        advance_surface(swung, wall, 1.0)
    # At the end of the sample the newer command is held.
    after = HeldInputs(newer, forces.push)
    stays = is_in_contact(following, swung, wall, rows, after, touching)
    low, high = _between(inside, state, inputs)
    apart = substeps_apart(wall)
    # A step of the command may tear the payload from a mass at the tick, and a mass apart may come and go in between.
    alone = low > 0.0 and (wall.mass == 0.0 or pressed >= 0.0) if touching else apart == 1
    if stays == touching and alone:
        high = max(high, contact_force(following, rows, after))
        if touching and may_hide_peak(max(pressed, high), found[CONTACT_PEAK]):
            keep_peak(found, k, largest_in_sample(flow[IN_CONTACT], rows, inputs, state, delay.fraction))
        state[:], surface[:] = following, swung
    else:
        parts = max(len(inside) + 1, apart)
        crossed = switch_within(flow, state, surface, wall, rows, inputs, delay.fraction, touching, parts)
        keep_peak(found, k, (crossed.largest, crossed.moment))
        found[IMPULSE], flags[TOUCHING] = max(found[IMPULSE], crossed.impulse), 1 if crossed.touching else 0
        flags[SWITCHES] += 1
    if delay.chain > 0:
        flags[HEAD] = (flags[HEAD] - 1) & (len(past) - 1)
        past[flags[HEAD]] = command


@compiled
def switch_within(
    flow: FloatArray,
    state: FloatArray,
    surface_state: FloatArray,
    wall: Wall,
    outputs: FloatArray,
    inputs: Inputs,
    fraction: float,
    touching: bool,
    substeps: int,
) -> Crossing:
    """Advance `state` over one sample in which the contact begins or ends, locating each event by bisection.

    The sample is crossed in `substeps`, so that a contact that ends and begins again within it is seen;
    `surface_state` is advanced as well.
    """
    impulse, best, moment, switches = 0.0, 0.0, 0.0, 0
    for part in range(2):
        at, stop = (0.0, fraction) if part == 0 else (fraction, 1.0)
        held = HeldInputs(inputs.older if part == 0 else inputs.newer, inputs.push)
        while at < stop:
            torn = touching and wall.mass > 0.0 and contact_force(state, outputs, held) < 0.0
            if torn and switches < _SWITCHES_PER_SAMPLE:
                apply_impact(state, surface_state, wall, touching)
                touching, switches = False, switches + 1
            piece = min(stop - at, 1.0 / substeps)
            end, swung = moved_within(flow, state, surface_state, wall, held, touching, piece)
            # Whatever the limit, nothing passes through the environment.
            switched = is_in_contact(end, swung, wall, outputs, held, touching) != touching
            if switched and touching and switches >= _SWITCHES_PER_SAMPLE:
                switched = False
            if switched:
                piece = switch_moment(flow, state, surface_state, wall, outputs, held, touching, piece)
                end, swung = moved_within(flow, state, surface_state, wall, held, touching, piece)
            if touching:
                value, where = largest_force(flow[IN_CONTACT], outputs, held, state, piece)
                if value > best:
                    best, moment = value, at + where
            state[:], surface_state[:] = end, swung
            at += piece
            if switched:
                impulse = max(impulse, apply_impact(state, surface_state, wall, touching))
                touching = not touching
                switches += 1
    return Crossing(touching, impulse, best, moment)


@compiled
def _between(inside: FloatArray, state: FloatArray, inputs: Inputs) -> tuple[float, float]:
    """Return the smallest and the largest F_e at the substeps inside a sample (1 and 0 where there are none)."""
    low, high, n = 1.0, 0.0, len(state)
    for j in range(len(inside)):
        value = inside[j, n] * inputs.newer + inside[j, n + 1] * inputs.older + inside[j, n + 2] * inputs.push
        for i in range(n):
            value += inside[j, i] * state[i]
        low, high = min(low, value), max(high, value)
    return low, high


@compiled
def _held(past: FloatArray, head: int, delay: Delay) -> float:
    """Return the oldest command in the chain, which the hold shows at the tick."""
    return float(past[(head + delay.chain - 1) & (len(past) - 1)])


@compiled
def _commands(past: FloatArray, head: int, delay: Delay, command: float) -> tuple[float, float]:
    """Return the command that acts from the fraction of the sample on, and the one before it."""
    newer = command if delay.whole == 0 else past[(head + delay.whole - 1) & (len(past) - 1)]
    return newer, _held(past, head, delay) if delay.chain > delay.whole else newer


@compiled
def _outputs(
    rows: FloatArray,
    blocks: FloatArray,
    control: ControlState,
    state: FloatArray,
    held: float,
    delay: Delay,
    forces: Forces,
) -> tuple[float, float, float, ControlState]:
    """Return F, x^d, F_e and the next controller states at a tick; without delay the command acts on F at once."""
    n, delayed, direct = len(state), delay.chain > 0, rows[SENSED, len(state)]
    position, sensed, pressed = 0.0, 0.0, rows[PRESSED, n + 1] * forces.push
    for i in range(n):
        position += rows[POSITION, i] * state[i]
        sensed += rows[SENSED, i] * state[i]
        pressed += rows[PRESSED, i] * state[i]
    if not delayed and direct != 0.0:
        rest, _ = controller_step(blocks, control, forces.desired + sensed, position)
        held = rest / (1.0 - (blocks[INTEGRATOR_DIRECT] + blocks[LAG_DIRECT]) * blocks[BIQUAD_0] * direct)
    if delayed or direct != 0.0:
        sensed += direct * held
    command, following = controller_step(blocks, control, forces.desired + sensed, position)
    return sensed, command, pressed + rows[PRESSED, n] * (held if delayed else command), following


@compiled
def _settled(force: FloatArray, count: int, forces: Forces, touching: bool, anchored: bool, largest: float) -> bool:
    """Return whether the force has come to rest in the last quarter of the run.

    On an environment with stiffness e = F^d + F must have stayed at 0; elsewhere the force must have been flat, and
    away from such an environment nothing may drive the payload back.
    """
    band, at_rest = SETTLED * max(largest, abs(force[0]), abs(forces.desired), abs(forces.push)), touching and anchored
    if anchored and not touching and forces.desired + forces.push > 0.0:
        return False
    low, high, tick, first = force[count - 1], force[count - 1], count - 1, count - max(count // 4, SHORTEST_QUARTER)
    if at_rest:
        while tick >= first and abs(forces.desired + force[tick]) < 0.5 * band:
            tick -= 1
        return tick < first
    while tick >= first and high - low < band:
        low, high = min(low, force[tick]), max(high, force[tick])
        tick -= 1
    return bool(high - low < band)


@compiled
def _refine_peak(
    plant: Contact,
    blocks: FloatArray,
    start: Start,
    forces: Forces,
    traces: Traces,
    count: int,
    found: FloatArray,
    crest: FloatArray,
) -> None:
    """Search the contact force between the ticks, around every tick whose parabola could reach the largest value.

    `crest` is what the stretches kept of the ticks before the largest. Where another tick is asked for, the run is
    repeated up to it; a sample with a switch has been searched when it was crossed.
    """
    pressed, at = traces.pressed, count
    for tick in range(1, count - 1):
        if not may_pass(pressed, tick, found[CONTACT_PEAK]):
            continue
        if not is_kept(crest, tick):
            if at >= tick:
                ignored, at = RunResults(traces, np.zeros(FOUND), crest), 0
                now, flags = first_moment(start, plant, ignored.found)
            walk(plant, blocks, now, flags, forces, TickRange(at, tick - 1, tick - 1), ignored)
            # With nothing before them to be compared with, both ticks are kept.
            ignored.found[CONTACT_PEAK], at = -1.0, tick + 1
            walk(plant, blocks, now, flags, forces, TickRange(tick - 1, at, at), ignored)
        search_around(plant, tick, forces.push, crest, found)


@compiled
def _add_rest(forces: Forces, count: int, found: FloatArray) -> None:
    """Let the force at rest count, which a transient without overshoot only approaches: e = 0 and F_e = F^d + f."""
    if forces.desired > found[SENSOR_PEAK]:
        found[SENSOR_PEAK], found[SENSOR_TICK] = forces.desired, count - 1
    if forces.desired + forces.push > found[CONTACT_PEAK]:
        found[CONTACT_PEAK], found[CONTACT_TIME] = forces.desired + forces.push, count - 1


@compiled
def contact_forces(approach: tuple[float, float, bool, float], resistance: float) -> tuple[float, float, Forces]:
    """Return v, the hand's force before the impact, and the forces after it.

    `approach` is (force or 0, speed, whether a hand drives, force after the impact or NaN); `resistance` [N·s/m] is
    the force that the loop needs per speed in free space.
    """
    given, speed, by_hand, after = approach
    force = given if given > 0.0 else speed * resistance
    held = force if np.isnan(after) else after
    if by_hand:
        return force / resistance, force, Forces(0.0, held)
    return force / resistance, 0.0, Forces(held, 0.0)


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
) -> Start:
    """Return plant state, past commands (a ring, newest first) and controller states of a steady approach.

    Everything moves at `speed` (m/s) under the outside force `push`; `force` is e = F^d + F, which is B_a v. The
    filters see a steady speed, the lag a steady force (and, with ideal compensation, a ramp).
    """
    n = ramp.shape[1] - 2
    moved = ramp[MOVING] * (speed * h) + ramp[PUSHED] * push
    state, command = moved[:n].copy(), moved[n]
    places = 1
    while places < chain:
        places *= 2
    past = np.zeros(places)
    for i in range(chain):
        past[i] = command - (i + 1) * speed * h
    position = np.sum(c_position * state)
    control = steady_states(blocks, command, position, speed, h, force)
    return Start(state, past, np.array(control))
