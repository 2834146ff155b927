"""Compiled stepping of one contact: the equations of `problems.model.sampled`, tick by tick."""

import numpy as np
from numpy.typing import NDArray

from ..compiled import compiled
from ..model.controller import controller_step
from .event_free_steps import SETTLED, SHORTEST_QUARTER, step_three_states, step_without_events
from .events import (
    Wall,
    advance_surface,
    apply_impact,
    contact_force,
    contact_force_rate,
    is_in_contact,
    largest_in_sample,
    substeps_apart,
    switch_within,
)

FloatArray = NDArray[np.float64]
# The plant in contact and in free space: `step` (2, n, n + 3) is (phi, gamma, gamma_old, gamma_push) of one sample,
# `flow` (2, n, n + 2) is (rate, drive, push) of the continuous plant over one period.
Motion = tuple[FloatArray, FloatArray]
# Rows of x, F and F_e (3, n + 2) over (state, held command, outside force); then F_e inside a sample, rows (m, n + 3)
# over (state, newer command, older command, outside force).
Outputs = tuple[FloatArray, FloatArray]
# whole samples, length of the chain of past commands, fraction of a sample
Delay = tuple[int, int, float]
# The plant's part of the arguments.
Contact = tuple[Motion, Outputs, Delay, Wall]
# Plant state, past commands (a ring of 2^k places, newest first), controller states.
Start = tuple[FloatArray, FloatArray, FloatArray]
# The same with position and speed of the environment; `flags` beside it are (head of the ring, touching, samples in
# which the contact began or ended).
Moment = tuple[FloatArray, FloatArray, FloatArray, FloatArray]
Traces = tuple[FloatArray, FloatArray]

_FIRST_LOOK = 96
# Looks are half a radian of the fastest oscillation apart: they miss at most 3 % of its amplitude (which the force may
# exceed only in part), and a parabola through three of them 0.15 %.
_MISSED_BETWEEN_LOOKS = 0.2
_MISSED_BY_PARABOLA = 3e-3

# `found`: 0 largest pressing sensor force, 1 its tick, 2 largest contact force, 3 its time in samples, 4 impulse.


@compiled
def run_contact(
    plant: Contact,
    blocks: FloatArray,
    start: Start,
    forces: tuple[float, float],
    traces: Traces,
    found: FloatArray,
    until_settled: bool,
) -> int:
    """Step from the impact on and return the number of samples: all of the traces', or fewer when settled.

    `forces` are F^d and the outside force on the payload after the impact. `traces` get F and F_e at every tick;
    `found` the peaks.
    """
    now, flags = first_moment(start, plant[3], found)
    total, crest = len(traces[0]), np.full((2, len(now[0]) + 3), -1.0)
    done, look = 0, min(_FIRST_LOOK, total) if until_settled else total
    while True:
        done = walk(plant, blocks, now, flags, forces, (done, look, total), traces, found, crest)
        if done == total or _settled(traces[0], done, forces, flags[1] == 1, plant[3][0] > 0.0, found[0]):
            break
        look = min(total, done + done // 3)
    if _is_plain(plant):
        _refine_peak(plant, blocks, start, forces, traces, done, found, crest)
    # Only an environment with stiffness brings the payload to rest.
    if flags[1] == 1 and plant[3][0] > 0.0:
        _add_rest(forces, done, found)
    return done


@compiled
def first_moment(start: Start, wall: Wall, found: FloatArray) -> tuple[Moment, NDArray[np.int64]]:
    """Copy the start, with the environment at rest beside it, and let the impact happen."""
    state, surface_state = start[0].copy(), np.zeros(2)
    found[4] = apply_impact(state, surface_state, wall, False)
    return (state, start[1].copy(), start[2].copy(), surface_state), np.array([0, 1, 0])


@compiled
def _is_plain(plant: Contact) -> bool:
    """Tell whether ticks are enough: a delay (else the command acts on the force at once), no mass, not stiff."""
    _, (_, inside), delay, wall = plant
    return delay[1] > 0 and wall[2] == 0.0 and len(inside) == 0


@compiled
def walk(
    plant: Contact,
    blocks: FloatArray,
    now: Moment,
    flags: NDArray[np.int64],
    forces: tuple[float, float],
    span: tuple[int, int, int],
    traces: Traces,
    found: FloatArray,
    crest: FloatArray,
) -> int:
    """Step over the ticks of `span` and return the tick that was reached: its aim or one behind it.

    Between stretches in which nothing switches lie the samples that are crossed one by one.
    """
    (motion, outputs, delay, wall), (done, aim, end), plain = plant, span, _is_plain(plant)
    while done < aim:
        if plain:
            step, part = motion[0][0 if flags[1] == 1 else 1], (done, aim, end)
            if len(now[0]) == 3:
                done, aim = step_three_states(
                    step, outputs[0], delay, wall, blocks, now, flags, forces, part, traces, found, crest
                )
            else:
                done, aim = step_without_events(
                    step, outputs[0], delay, wall, blocks, now, flags, forces, part, traces, found, crest
                )
        if done < aim:
            _step(plant, blocks, now, flags, forces, done, traces, found)
            done += 1
    return done


@compiled
def _step(
    plant: Contact,
    blocks: FloatArray,
    now: Moment,
    flags: NDArray[np.int64],
    forces: tuple[float, float],
    k: int,
    traces: Traces,
    found: FloatArray,
) -> None:
    """Step over one sample with all that may happen in it."""
    (motion, (rows, inside), delay, wall), (state, past, control, surface_state), n = plant, now, len(now[0])
    law = (control[0], control[1], control[2], control[3])
    sensed, command, pressed, law = _outputs(rows, blocks, law, state, _held(past, flags[0], delay), delay, forces)
    control[0], control[1], control[2], control[3] = law
    newer, older = _commands(past, flags[0], delay, command)
    touching, mode = flags[1] == 1, 0 if flags[1] == 1 else 1
    traces[0][k], traces[1][k] = sensed, max(0.0, pressed) if touching else 0.0
    if -sensed > found[0]:
        found[0], found[1] = -sensed, k
    if traces[1][k] > found[2]:
        found[2], found[3] = traces[1][k], k
    following, swung = np.empty(n), surface_state.copy()
    for i in range(n):
        total = motion[0][mode, i, n] * newer + motion[0][mode, i, n + 1] * older
        total += motion[0][mode, i, n + 2] * forces[1]
        for j in range(n):
            total += motion[0][mode, i, j] * state[j]
        following[i] = total
    if not touching:
        advance_surface(swung, wall, 1.0)
    # At the end of the sample the newer command is held.
    inputs, stays = (older, newer, forces[1]), is_in_contact(following, swung, wall, rows, (newer, forces[1]), touching)
    low, high = _looks(inside, state, inputs)
    apart = substeps_apart(wall)
    # A step of the command may tear the payload from a mass at the tick, and a mass apart may come and go in between.
    alone = low > 0.0 and (wall[2] == 0.0 or pressed >= 0.0) if touching else apart == 1
    if stays == touching and alone:
        high = max(high, contact_force(following, rows, (newer, forces[1])))
        if touching and max(pressed, high) >= (1.0 - _MISSED_BETWEEN_LOOKS) * found[2]:
            _note(found, k, largest_in_sample(motion[1][0], rows, inputs, state, delay[2]))
        state[:], surface_state[:] = following, swung
    else:
        touching, impulse, largest, moment = switch_within(
            motion[1], state, surface_state, wall, rows, inputs, delay[2], touching, max(len(inside) + 1, apart)
        )
        _note(found, k, (largest, moment))
        found[4], flags[1] = max(found[4], impulse), 1 if touching else 0
        flags[2] += 1
    if delay[1] > 0:
        flags[0] = (flags[0] - 1) & (len(past) - 1)
        past[flags[0]] = command


@compiled
def _looks(inside: FloatArray, state: FloatArray, inputs: tuple[float, float, float]) -> tuple[float, float]:
    """Return the smallest and the largest F_e that is seen inside a sample (1 and 0 where nobody looks)."""
    low, high, n = 1.0, 0.0, len(state)
    for j in range(len(inside)):
        value = inside[j, n] * inputs[1] + inside[j, n + 1] * inputs[0] + inside[j, n + 2] * inputs[2]
        for i in range(n):
            value += inside[j, i] * state[i]
        low, high = min(low, value), max(high, value)
    return low, high


@compiled
def _note(found: FloatArray, k: int, largest: tuple[float, float]) -> None:
    """Keep a contact force and its moment in sample k if it is the largest so far."""
    if largest[0] > found[2]:
        found[2], found[3] = largest[0], k + largest[1]


@compiled
def _held(past: FloatArray, head: int, delay: Delay) -> float:
    """Return the oldest command in the chain, which the hold shows at the tick."""
    return float(past[(head + delay[1] - 1) & (len(past) - 1)])


@compiled
def _commands(past: FloatArray, head: int, delay: Delay, command: float) -> tuple[float, float]:
    """Return the command that acts from the fraction of the sample on, and the one before it."""
    newer = command if delay[0] == 0 else past[(head + delay[0] - 1) & (len(past) - 1)]
    return newer, _held(past, head, delay) if delay[1] > delay[0] else newer


@compiled
def _outputs(
    rows: FloatArray,
    blocks: FloatArray,
    control: tuple[float, float, float, float],
    state: FloatArray,
    held: float,
    delay: Delay,
    forces: tuple[float, float],
) -> tuple[float, float, float, tuple[float, float, float, float]]:
    """Return F, x^d, F_e and the next controller states at a tick; without delay the command acts on F at once."""
    n, delayed = len(state), delay[1] > 0
    position, sensed, pressed = 0.0, 0.0, rows[2, n + 1] * forces[1]
    for i in range(n):
        position += rows[0, i] * state[i]
        sensed += rows[1, i] * state[i]
        pressed += rows[2, i] * state[i]
    if not delayed and rows[1, n] != 0.0:
        rest, _ = controller_step(blocks, control, forces[0] + sensed, position)
        held = rest / (1.0 - (blocks[0, 0] + blocks[1, 0]) * rows[1, n])
    if delayed or rows[1, n] != 0.0:
        sensed += rows[1, n] * held
    command, following = controller_step(blocks, control, forces[0] + sensed, position)
    return sensed, command, pressed + rows[2, n] * (held if delayed else command), following


@compiled
def _settled(
    force: FloatArray, count: int, forces: tuple[float, float], touching: bool, anchored: bool, largest: float
) -> bool:
    """Tell whether the force has come to rest in the last quarter of the run.

    On an environment with stiffness e = F^d + F must have stayed at 0; elsewhere the force must have been flat, and
    away from such an environment nothing may drive the payload back.
    """
    band, at_rest = SETTLED * max(largest, abs(force[0]), abs(forces[0]), abs(forces[1])), touching and anchored
    if anchored and not touching and forces[0] + forces[1] > 0.0:
        return False
    low, high, tick, first = force[count - 1], force[count - 1], count - 1, count - max(count // 4, SHORTEST_QUARTER)
    if at_rest:
        while tick >= first and abs(forces[0] + force[tick]) < 0.5 * band:
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
    forces: tuple[float, float],
    traces: Traces,
    count: int,
    found: FloatArray,
    crest: FloatArray,
) -> None:
    """Search the contact force between the ticks, around every tick whose parabola could reach the largest value.

    `crest` is what the stretches kept of the ticks before the largest. Where another tick is asked for, the run is
    repeated up to it; a sample with a switch has been searched when it was crossed.
    """
    pressed, at = traces[1], count
    # No force presses less than 0, so the crest of a parabola is at most a quarter above its middle point.
    floor = found[2] / (1.25 * (1.0 + _MISSED_BY_PARABOLA))
    for tick in range(1, count - 1):
        if pressed[tick] <= floor:
            continue
        bend = 2.0 * pressed[tick] - pressed[tick - 1] - pressed[tick + 1]
        if pressed[tick] < pressed[tick - 1] or pressed[tick] < pressed[tick + 1] or bend <= 0.0:
            continue
        top = pressed[tick] + (pressed[tick + 1] - pressed[tick - 1]) ** 2 / (8.0 * bend)
        if (1.0 + _MISSED_BY_PARABOLA) * top <= found[2]:
            continue
        if crest[tick & 1, -1] != tick or crest[1 - tick & 1, -1] != tick - 1:
            if at >= tick:
                ignored, at = np.zeros(5), 0
                now, flags = first_moment(start, plant[3], ignored)
            walk(plant, blocks, now, flags, forces, (at, tick - 1, tick - 1), traces, ignored, crest)
            # With nothing before them to be compared with, both ticks are kept.
            ignored[2], at = -1.0, tick + 1
            walk(plant, blocks, now, flags, forces, (tick - 1, at, at), traces, ignored, crest)
        _search_around(plant, tick, forces[1], crest, found)


@compiled
def _search_around(plant: Contact, tick: int, push: float, crest: FloatArray, found: FloatArray) -> None:
    """Search the force of the samples before and behind a tick, as far as they were kept.

    Without a step of the command inside the samples the slopes at the tick tell in which of them it is largest. A
    payload that leaves in the sample behind has passed the largest force before.
    """
    flow, rows, delay, n = plant[0][1][0], plant[1][0], plant[2], crest.shape[1] - 3
    behind, before = crest[tick & 1], crest[1 - tick & 1]
    whole, state = delay[2] == 0.0, behind[:n]
    if before[n + 2] == tick - 1:
        falls = contact_force_rate(flow, rows, (before[n], push), state) < 0.0
        if not whole or behind[n + 2] != tick or falls:
            inputs = (before[n + 1], before[n], push)
            _note(found, tick - 1, largest_in_sample(flow, rows, inputs, before[:n], delay[2]))
    if behind[n + 2] == tick and not (whole and contact_force_rate(flow, rows, (behind[n], push), state) <= 0.0):
        _note(found, tick, largest_in_sample(flow, rows, (behind[n + 1], behind[n], push), state, delay[2]))


@compiled
def _add_rest(forces: tuple[float, float], count: int, found: FloatArray) -> None:
    """Let the force at rest count, which a transient without overshoot only approaches: e = 0 and F_e = F^d + f."""
    if forces[0] > found[0]:
        found[0], found[1] = forces[0], count - 1
    if forces[0] + forces[1] > found[2]:
        found[2], found[3] = forces[0] + forces[1], count - 1


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
