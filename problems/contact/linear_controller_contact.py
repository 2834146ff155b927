"""The contact transient of any linear law: the steps of `problems.model.sampled` in equal parts of a sample.

The motion between two events is exact; contact begins and ends on the grid of the parts, which is far finer than what
the force does between them. `problems.contact.transient` has the paper's law with every event located.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ..arrays import FloatArray
from ..compiled import compiled
from ..errors import ParameterError
from ..model.hold import hold
from ..model.linear_controllers import LinearController
from ..model.sampled import build_loop, spectral_radius
from ..stability.margins import UnstableLoopError
from .events import spring_force
from .kernel_types import (
    APART,
    CONTACT_PEAK,
    CONTACT_TIME,
    FOUND,
    IN_CONTACT,
    MOVING,
    NEWEST,
    POSITION,
    PUSHED,
    SENSED,
    SENSOR_PEAK,
    Start,
    Wall,
)
from .transient import Approach, ContactTransient, SampledContact

_PARTS = 20
_DECAY_EXPONENTS = 7.0
_SHORTEST_S, _LONGEST_S = 0.4, 10.0


class LinearLoop(NamedTuple):
    """The plant in equal parts of a sample, and a linear controller.

    `steps` (2, 2, n, n + 1) is (phi, gamma) of one part, in contact or not, under the older or newer command, which
    act for `early` and `late` parts; `rows` are x and F over the state, to which the command adds `direct` at once;
    `matrix` is that of the controller.
    """

    steps: FloatArray
    early: int
    late: int
    rows: FloatArray
    direct: float
    whole: int
    chain: int
    matrix: FloatArray
    wall: Wall


@dataclass(frozen=True, kw_only=True)
class LinearContact:
    """The peaks of one contact, as in `problems.contact.transient.ContactTransient`, and the approach before it.

    `driving_force_n` is F^d, which leads to `contact_speed_m_s` in free space.
    """

    peak_sensor_force_n: float
    peak_contact_force_n: float
    time_of_peak_s: float
    contact_speed_m_s: float
    driving_force_n: float


def force_per_speed(pair: SampledContact, law: LinearController) -> float:
    """Return the steady force [N·s/m] that the law and the payload's drag take per speed in free space."""
    return 1.0 / _steady(pair, law, 1.0)[1]


def simulate_linear_contact(pair: SampledContact, law: LinearController, approach: Approach) -> LinearContact:
    """Simulate one impact after a steady approach by F^d; a spring of the law rests where the wall is.

    The run lasts until the slowest part of the motion in contact has decayed. Raises UnstableLoopError for a loop
    that is not stable in contact, ParameterError for an approach by hand or an environment with mass.
    """
    if approach.driven_by != "desired_force" or approach.after_impact_n is not None:
        raise ParameterError("approach", approach, "driven by the desired force, which stays")
    h, (samples, _) = pair.contact.sample_time_s, _samples(pair, law)
    found, (loop, start, force, speed) = np.zeros(FOUND), begin_linear_contact(pair, law, approach)
    run_linear_contact(loop, start, force, samples, True, found)
    # A force that only creeps up to its value at rest counts with that value.
    return LinearContact(
        peak_sensor_force_n=max(float(found[SENSOR_PEAK]), force),
        peak_contact_force_n=max(float(found[CONTACT_PEAK]), force),
        time_of_peak_s=float(found[CONTACT_TIME]) * h,
        contact_speed_m_s=speed,
        driving_force_n=force,
    )


def trace_linear_contact(
    pair: SampledContact, law: LinearController, approach: Approach, *, samples: int | None = None
) -> ContactTransient:
    """Simulate the same impact with the forces at every tick; F^d may be another one after it.

    A payload that a hand leads is one whose hand lets go at the impact. Raises as `simulate_linear_contact`.
    """
    (longest, is_settled), h = _samples(pair, law), pair.contact.sample_time_s
    count = longest if samples is None else samples
    loop, start, force, speed = begin_linear_contact(pair, law, approach)
    after = force if approach.after_impact_n is None else approach.after_impact_n
    sensor, contact, found = np.empty(count), np.empty(count), np.zeros(FOUND)
    _trace(loop, start, after, sensor, contact, found)
    is_creeping = float(found[SENSOR_PEAK]) < after, float(found[CONTACT_PEAK]) < after
    return ContactTransient(
        time_s=np.asarray(np.arange(count) * h, dtype=np.float64),
        sensor_force_n=sensor,
        contact_force_n=contact,
        contact_speed_m_s=speed,
        driving_force_n=after,
        peak_sensor_force_n=max(float(found[SENSOR_PEAK]), after),
        time_of_sensor_peak_s=h * float(count - 1 if is_creeping[0] else np.argmax(sensor)),
        peak_contact_force_n=max(float(found[CONTACT_PEAK]), after),
        time_of_peak_s=h * float(count - 1 if is_creeping[1] else found[CONTACT_TIME]),
        impulse_n_s=0.0,
        is_settled=samples is not None or is_settled,
    )


def begin_linear_contact(
    pair: SampledContact, law: LinearController, approach: Approach
) -> tuple[LinearLoop, Start, float, float]:
    """Return the loop and its state at the impact, F^d of the approach and its speed.

    Of a hand there is no F^d: it lets go at the impact. One that goes on pushing acts as the F^d of that speed.
    """
    by_hand = approach.driven_by == "hand"
    if by_hand and approach.after_impact_n != 0.0:
        raise ParameterError("approach", approach, "driven by the desired force, or by a hand that lets go")
    contact, h = pair.contact, pair.contact.sample_time_s
    if contact.plant.environment.mass_kg != 0.0:
        raise ParameterError("environment.mass_kg", contact.plant.environment.mass_kg, "0")
    one = (0.0, 1.0) if by_hand else (1.0, 0.0)
    per_newton = _steady(pair, law, *one)[1]
    driving = approach.force_n if approach.force_n is not None else (approach.speed_m_s or 0.0) / per_newton
    force, push = (driving * each for each in one)
    control, speed = _steady(pair, law, force, push)
    moved, (n, chain) = (
        pair.ramp[MOVING] * (speed * h) + pair.ramp[PUSHED] * push,
        (contact.state_count, contact.chain_length),
    )
    past = moved[n] - speed * h * np.arange(1.0, max(chain, 1) + 1.0)
    early = math.ceil(_PARTS * contact.fraction)
    late = max(1, _PARTS - early)
    rows, wall = np.array([contact.c_position, contact.c_force]), pair.arguments.wall
    loop = LinearLoop(
        _parts(pair, (early, late)), early, late, rows, contact.d_force, contact.whole_delay, chain, law.matrix, wall
    )
    return loop, Start(moved[:n].copy(), past, control), force, speed


def _samples(pair: SampledContact, law: LinearController) -> tuple[int, bool]:
    """Return how long a run lasts, and whether all has decayed then; raises UnstableLoopError."""
    radius, h = spectral_radius(build_loop(pair.contact, law)), pair.contact.sample_time_s
    if not radius < 1.0:
        raise UnstableLoopError(radius)
    decay = _DECAY_EXPONENTS / -math.log(radius) if radius > 0.0 else 0.0
    return math.ceil(max(_SHORTEST_S / h, min(decay, _LONGEST_S / h))), decay <= _LONGEST_S / h


def _steady(pair: SampledContact, law: LinearController, force: float, push: float = 0.0) -> tuple[FloatArray, float]:
    """Return the law's state and the speed of a steady approach under F^d and a hand's `push` [N], where x_p = 0."""
    h, r, m = law.sample_time_s, law.state_count, law.steady()
    n = pair.free.state_count
    ramp, pushed = pair.ramp[MOVING], pair.ramp[PUSHED] * push
    state, command, sensed = ramp[:n], ramp[n], ramp[n + 1]
    position = float(pair.free.c_position @ state)
    # The push stretches the coupling: the sensor feels it, and flange and command lie behind the payload.
    behind = float(pair.free.c_position @ pushed[:n])
    system, right = np.zeros((r + 1, r + 1)), -m[:, r] * (force + pushed[n + 1]) - m[:, r + 1] * behind
    right[r] += pushed[n]
    system[:, :r] = m[:, :r]
    system[:r, :r] -= np.eye(r)
    # Per metre and sample: the states that are positions go along, and e falls by what the motion takes.
    system[:, r] = m[:, r] * sensed + m[:, r + 1] * position
    system[:r, r] -= law.rest
    system[r, r] -= command
    found = np.asarray(np.linalg.solve(system, right), dtype=np.float64)
    return found[:r].copy(), float(found[r]) / h


def _parts(pair: SampledContact, counts: tuple[int, int]) -> FloatArray:
    """Return (phi, gamma) of one part (2, 2, n, n + 1), in contact or not, under the older or newer command."""
    contact, n = pair.contact, pair.contact.state_count
    steps = np.zeros((2, 2, n, n + 1))
    for i, plant in ((IN_CONTACT, pair.contact), (APART, pair.free)):
        for j, span in enumerate((contact.fraction, 1.0 - contact.fraction)):
            if counts[j] > 0:
                steps[i, j] = np.column_stack(hold(plant.rate, plant.drive, span / counts[j]))
    return steps


@compiled
def run_linear_contact(
    loop: LinearLoop, start: Start, force: float, samples: int, touching: bool, found: FloatArray
) -> tuple[bool, int]:
    """Step on from `start`, which is advanced; return whether it touches then, and in how many samples that changed.

    `found` (FOUND,) gets the largest sensor force, and the largest contact force with its time in samples.
    """
    (state, past, control), chain, direct, switches = start, loop.chain, loop.direct, 0
    for k in range(samples):
        held = direct * past[chain - 1] if chain > 0 else 0.0
        # Without delay the command acts on the force of its own tick.
        position, sensed = np.dot(loop.rows[POSITION], state), np.dot(loop.rows[SENSED], state) + held
        command = _tick(loop.matrix, control, force + sensed, position, direct if chain == 0 else 0.0)
        if chain == 0:
            sensed += direct * command
        found[SENSOR_PEAK] = max(found[SENSOR_PEAK], -sensed)
        newer = command if loop.whole == 0 else past[loop.whole - 1]
        older, before = past[chain - 1] if chain > loop.whole else newer, touching
        touching = _sample(loop, state, (older, newer), touching, k, found)
        switches += 1 if touching != before else 0
        for i in range(chain - 1, 0, -1):
            past[i] = past[i - 1]
        if chain > 0:
            past[NEWEST] = command
    return touching, switches


@compiled
def _trace(
    loop: LinearLoop, start: Start, force: float, sensor: FloatArray, contact: FloatArray, found: FloatArray
) -> None:
    """Step from the impact, and note the forces at the sensor and at the contact (n,) at every tick."""
    touching, tick = True, np.zeros(FOUND)
    for k in range(len(sensor)):
        state = start.state
        contact[k] = spring_force(loop.wall, state[len(state) - 2], state[len(state) - 1]) if touching else 0.0
        tick[:] = 0.0
        tick[SENSOR_PEAK] = -np.inf
        touching, _ = run_linear_contact(loop, start, force, 1, touching, tick)
        sensor[k] = tick[SENSOR_PEAK]
        found[SENSOR_PEAK] = max(found[SENSOR_PEAK], tick[SENSOR_PEAK])
        if tick[CONTACT_PEAK] > found[CONTACT_PEAK]:
            found[CONTACT_PEAK], found[CONTACT_TIME] = tick[CONTACT_PEAK], k + tick[CONTACT_TIME]


@compiled
def _tick(law: FloatArray, control: FloatArray, e: float, position: float, direct: float) -> float:
    """Return the command and advance the controller's states; `direct` is what the command adds to e at once."""
    r = len(control)
    command = law[r, r] * e + law[r, r + 1] * position
    for i in range(r):
        command += law[r, i] * control[i]
    command = command / (1.0 - law[r, r] * direct)
    following = law[:r, r] * (e + direct * command) + law[:r, r + 1] * position
    for i in range(r):
        for j in range(r):
            following[i] += law[i, j] * control[j]
    control[:] = following
    return float(command)


@compiled
def _sample(
    loop: LinearLoop, state: FloatArray, inputs: tuple[float, float], touching: bool, k: int, found: FloatArray
) -> bool:
    """Advance the plant by a sample, note the contact force, and return whether it touches at the end."""
    n, done, parts = len(state), 0, loop.early + loop.late
    moved = np.empty(n)
    for half in range(2):
        acting = inputs[half]
        for _ in range(loop.early if half == 0 else loop.late):
            step = loop.steps[IN_CONTACT if touching else APART, half]
            for i in range(n):
                moved[i] = step[i, n] * acting
                for j in range(n):
                    moved[i] += step[i, j] * state[j]
            state[:] = moved
            done += 1
            pressed = spring_force(loop.wall, state[n - 2], state[n - 1])
            touching = pressed > 0.0
            if pressed > found[CONTACT_PEAK]:
                found[CONTACT_PEAK], found[CONTACT_TIME] = pressed, k + done / parts
    return touching
