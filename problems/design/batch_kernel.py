"""Compiled loops over designs and plants, for `problems.design.batch`."""

import numpy as np
from numpy.typing import NDArray

from ..compiled import compiled
from ..contact.kernel import contact_forces, run_contact, steady_start
from ..contact.kernel_types import CONTACT_PEAK as LARGEST_CONTACT
from ..contact.kernel_types import CONTACT_TIME, FOUND, MOVING, POSITION, Contact, Delay, Traces, Wall
from ..contact.kernel_types import SENSOR_PEAK as LARGEST_SENSOR
from ..model.controller import blocks_of
from ..stability.margin_kernel import MARGINS, MODULUS_ALONE, find_loop_margins
from ..stability.polynomials import CONTROLLER_POWERS, STABLE, controller_polynomials, hurwitz, loop_polynomial

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
ComplexArray = NDArray[np.complex128]

# Polynomials (p, 3, L), their degrees (p,), and the power of w that is divided out (1 for the integrator of a loop
# without anchor).
Loops = tuple[FloatArray, IntArray, IntArray]
# What `find_loop_margins` takes as its grid, all plants one after the other; offsets (p + 1,).
Grids = tuple[FloatArray, FloatArray, ComplexArray, ComplexArray, IntArray]
# What `run_contact` takes, with a leading axis of plants: step, flow, rows, walls, ramps; whole delay and chain;
# fractions; and the rows inside a sample, one after the other, with their offsets.
Contacts = tuple[
    tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray], IntArray, FloatArray, FloatArray, IntArray
]

# Columns of a result.
STABILITY, MODULUS, MODULUS_RAD_PER_S, PEAK_SENSOR, PEAK_CONTACT, TIME_OF_PEAK, COLUMNS = 0, 1, 2, 3, 4, 5, 6


@compiled
def judge_loop(
    loops: Loops, plant: int, controller: FloatArray, degree: int, h: float, theta: float, work: FloatArray
) -> int:
    """Return STABLE, UNSTABLE or DOUBTFUL for one loop."""
    polynomials, sizes, first = loops
    total = loop_polynomial(polynomials[plant, :, : sizes[plant]], controller, degree, h, theta, work)
    return hurwitz(work, total, first[plant])


@compiled
def loop_room(loops: Loops) -> FloatArray:
    """Return an array that any polynomial of these loops fits in; compiled code does not notice where one ends."""
    return np.zeros(loops[0].shape[2] + CONTROLLER_POWERS)


@compiled
def judge_stability(loops: Loops, designs: FloatArray, h: float, theta: float, ideal: bool) -> IntArray:
    """Return the verdicts (m, p) of designs (m, 7) on plants (p,)."""
    count = len(loops[1])
    out = np.empty((len(designs), count), dtype=np.int64)
    controller, work = np.zeros((3, CONTROLLER_POWERS)), loop_room(loops)
    for i in range(len(designs)):
        degree = controller_polynomials(designs[i], ideal, controller)
        for j in range(count):
            out[i, j] = judge_loop(loops, j, controller, degree, h, theta, work)
    return out


@compiled
def evaluate_pairs(
    in_contact: Loops,
    in_free_space: Loops,
    responses: FloatArray,
    grids: Grids,
    contacts: Contacts,
    designs: FloatArray,
    sampling: tuple[float, float, bool],
    approach: tuple[float, float, bool, float],
    longest: int,
    wanted: tuple[bool, bool],
    out: FloatArray,
) -> None:
    """Fill `out` (m, p, COLUMNS) with stability, modulus margin and peaks of designs (m, 7) in p scenarios.

    `responses` (p, 4, n) are what `plant_at` takes, `sampling` is (h, θ, ideal), `approach` as `Approach.numbers`,
    `wanted` (margins, peaks). DOUBTFUL verdicts are left to the caller, as are the margins and peaks then.
    """
    controller, work, found = np.zeros((3, CONTROLLER_POWERS)), loop_room(in_contact), np.zeros(MARGINS)
    traces = Traces(np.empty(longest), np.empty(longest))
    h, theta, ideal = sampling
    omega, tangent, force, position, offsets = grids
    for i in range(len(designs)):
        degree = controller_polynomials(designs[i], ideal, controller)
        blocks = blocks_of(designs[i], h, theta, ideal)
        for j in range(len(in_contact[1])):
            out[i, j, :] = np.nan
            verdict = judge_loop(in_contact, j, controller, degree, h, theta, work)
            if verdict == STABLE:
                verdict = judge_loop(in_free_space, j, controller, degree, h, theta, work)
            out[i, j, STABILITY] = verdict
            if verdict != STABLE:
                continue
            if wanted[0]:
                part = slice(offsets[j], offsets[j + 1])
                grid = (omega[part], tangent[part], force[part], position[part])
                find_loop_margins(responses[j], grid, controller, degree, (h, theta), MODULUS_ALONE, found)
                out[i, j, MODULUS], out[i, j, MODULUS_RAD_PER_S] = found[0], found[1]
            if wanted[1]:
                simulate_pair(contacts, j, blocks, designs[i, 1], h, approach, traces, out[i, j])


@compiled
def simulate_pair(
    contacts: Contacts,
    j: int,
    blocks: FloatArray,
    damping: float,
    h: float,
    approach: tuple[float, float, bool, float],
    traces: Traces,
    out: FloatArray,
) -> None:
    """Simulate the impact of one scenario and write its peaks into one row of a result."""
    (step, flow, rows, walls, ramps), delays, fractions, inside, offsets = contacts
    delay, n = Delay(delays[j, 0], delays[j, 1], fractions[j]), step.shape[2]
    wall = Wall(walls[j, 0], walls[j, 1], walls[j, 2], walls[j, 3])
    plant = Contact(step[j], flow[j], rows[j], inside[offsets[j] : offsets[j + 1]], delay, wall)
    speed, push, forces = contact_forces(approach, damping - ramps[j, MOVING, -1] * h)
    start = steady_start(ramps[j], rows[j, POSITION, :n], blocks, delay.chain, h, speed, push, damping * speed)
    found = np.zeros(FOUND)
    run_contact(plant, blocks, start, forces, traces, found, True)
    out[PEAK_SENSOR], out[PEAK_CONTACT] = found[LARGEST_SENSOR], found[LARGEST_CONTACT]
    out[TIME_OF_PEAK] = found[CONTACT_TIME] * h
