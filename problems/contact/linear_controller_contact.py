"""The contact transient of any linear law: the steps of `problems.model.sampled` in equal parts of a sample.

The motion between two events is exact; contact begins and ends on the grid of the parts, which is far finer than what
the force does between them. `problems.contact.transient` has the paper's law with every event located.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..compiled import compiled
from ..errors import ParameterError
from ..model.linear_controllers import LinearController
from ..model.sampled import SampledPlant, build_loop, hold, spectral_radius
from ..stability.margins import UnstableLoopError
from .transient import Approach, SampledContact

FloatArray = NDArray[np.float64]

_PARTS = 20
_DECAY_EXPONENTS = 7.0
_SHORTEST_S, _LONGEST_S = 0.4, 10.0

# The parts of a sample with their counts, rows of x, F and F_e, what the command adds to F at once, whole samples and
# length of the chain of the delay, and the law's matrix; what changes on the way is (plant, past commands, law).
_Loop = tuple[FloatArray, NDArray[np.int64], FloatArray, float, tuple[int, int], FloatArray]
_Moment = tuple[FloatArray, FloatArray, FloatArray]


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
    radius = spectral_radius(build_loop(pair.contact, law))
    if not radius < 1.0:
        raise UnstableLoopError(radius)
    h, samples = pair.contact.sample_time_s, _samples(radius, pair.contact.sample_time_s)
    found, (loop, moment, force, speed) = np.zeros(4), begin_linear_contact(pair, law, approach)
    run_linear_contact(loop, moment, force, samples, True, found)
    # A force that only creeps up to its value at rest counts with that value.
    return LinearContact(
        peak_sensor_force_n=max(float(found[0]), force),
        peak_contact_force_n=max(float(found[1]), force),
        time_of_peak_s=float(found[2]) * h,
        contact_speed_m_s=speed,
        driving_force_n=force,
    )


def begin_linear_contact(
    pair: SampledContact, law: LinearController, approach: Approach
) -> tuple[_Loop, _Moment, float, float]:
    """Return the loop and its state at the impact, F^d of the approach and its speed."""
    if approach.driven_by != "desired_force":
        raise ParameterError("approach", approach, "driven by the desired force")
    contact, h = pair.contact, pair.contact.sample_time_s
    if contact.plant.environment.mass_kg != 0.0:
        raise ParameterError("environment.mass_kg", contact.plant.environment.mass_kg, "0")
    per_newton = _steady(pair, law, 1.0)[1]
    force = approach.force_n if approach.force_n is not None else (approach.speed_m_s or 0.0) / per_newton
    control, speed = _steady(pair, law, force)
    moved, (n, chain) = pair.ramp[0] * (speed * h), (contact.state_count, contact.chain_length)
    past = moved[n] - speed * h * np.arange(1.0, max(chain, 1) + 1.0)
    rows = np.array([contact.c_position, contact.c_force, contact.c_contact])
    loop = (*_parts(pair), rows, contact.d_force, (contact.whole_delay, chain), law.matrix)
    return loop, (moved[:n].copy(), past, control), force, speed


def _samples(radius: float, h: float) -> int:
    decay = _DECAY_EXPONENTS / -math.log(radius) if radius > 0.0 else 0.0
    return math.ceil(max(_SHORTEST_S / h, min(decay, _LONGEST_S / h)))


def _steady(pair: SampledContact, law: LinearController, force: float) -> tuple[FloatArray, float]:
    """Return the law's state and the speed of a steady approach under F^d, at the tick at which x_p = 0."""
    h, r, m = law.sample_time_s, law.state_count, law.steady()
    n = pair.free.state_count
    state, command, sensed = pair.ramp[0][:n], pair.ramp[0][n], pair.ramp[0][n + 1]
    position = float(pair.free.c_position @ state)
    system, right = np.zeros((r + 1, r + 1)), -m[:, r] * force
    system[:, :r] = m[:, :r]
    system[:r, :r] -= np.eye(r)
    # Per metre and sample: the states that are positions go along, and e falls by what the motion takes.
    system[:, r] = m[:, r] * sensed + m[:, r + 1] * position
    system[:r, r] -= law.rest
    system[r, r] -= command
    found = np.asarray(np.linalg.solve(system, right), dtype=np.float64)
    return found[:r].copy(), float(found[r]) / h


def _parts(pair: SampledContact) -> tuple[FloatArray, NDArray[np.int64]]:
    """Return (phi, gamma) of one part (2, 2, n, n + 1), in contact or not, under the older or newer command."""
    contact, n = pair.contact, pair.contact.state_count
    early = math.ceil(_PARTS * contact.fraction)
    counts = np.array([early, max(1, _PARTS - early)], dtype=np.int64)
    spans = (contact.fraction, 1.0 - contact.fraction)
    steps = np.zeros((2, 2, n, n + 1))
    for i, plant in enumerate((pair.contact, pair.free)):
        for j in range(2):
            if counts[j] > 0:
                steps[i, j] = _step(plant, spans[j] / int(counts[j]))
    return steps, counts


def _step(plant: SampledPlant, duration: float) -> FloatArray:
    phi, gamma = hold(plant.rate, plant.drive, duration)
    return np.column_stack([phi, gamma])


@compiled
def run_linear_contact(
    loop: _Loop, moment: _Moment, force: float, samples: int, touching: bool, found: FloatArray
) -> bool:
    """Step on from a moment, which is advanced, and return whether it touches then.

    `found` gets the largest sensor force, contact force and its time in samples, and in how many samples the contact
    was other than before.
    """
    (steps, counts, rows, direct, delay, law), (state, past, control) = loop, moment
    whole, chain = delay
    for k in range(samples):
        held = direct * past[chain - 1] if chain > 0 else 0.0
        # Without delay the command acts on the force of its own tick.
        position, sensed = np.dot(rows[0], state), np.dot(rows[1], state) + held
        command = _tick(law, control, force + sensed, position, direct if chain == 0 else 0.0)
        if chain == 0:
            sensed += direct * command
        found[0] = max(found[0], -sensed)
        newer = command if whole == 0 else past[whole - 1]
        older = past[chain - 1] if chain > whole else newer
        before = touching
        touching = _sample(steps, counts, rows[2], state, (older, newer), touching, k, found)
        found[3] += 1.0 if touching != before else 0.0
        for i in range(chain - 1, 0, -1):
            past[i] = past[i - 1]
        if chain > 0:
            past[0] = command
    return touching


@compiled
def _tick(law: FloatArray, control: FloatArray, e: float, position: float, direct: float) -> float:
    """Return the command and advance the law's states; `direct` is what the command adds to e at once."""
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
    steps: FloatArray,
    counts: NDArray[np.int64],
    contact: FloatArray,
    state: FloatArray,
    inputs: tuple[float, float],
    touching: bool,
    k: int,
    found: FloatArray,
) -> bool:
    """Advance the plant by a sample, note the contact force, and return whether it touches at the end."""
    n, done, parts = len(state), 0, counts[0] + counts[1]
    moved = np.empty(n)
    for half in range(2):
        acting = inputs[half]
        for _ in range(counts[half]):
            step = steps[0 if touching else 1, half]
            for i in range(n):
                moved[i] = step[i, n] * acting
                for j in range(n):
                    moved[i] += step[i, j] * state[j]
            state[:] = moved
            done += 1
            pressed = np.dot(contact, state)
            touching = pressed > 0.0 and (touching or state[n - 2] > 0.0)
            if touching and pressed > found[1]:
                found[1], found[2] = pressed, k + done / parts
    return touching
