"""Compiled loops over designs and plants, for `problems.design.batch_evaluation`, and the arrays that they take."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ..arrays import ComplexArray, FloatArray, IntArray
from ..compiled import compiled, released
from ..contact.kernel import contact_forces, run_contact, steady_start
from ..contact.kernel_types import (
    CONTACT_PEAK,
    CONTACT_TIME,
    FOUND,
    MOVING,
    POSITION,
    SENSOR_PEAK,
    SENSOR_TICK,
    Contact,
    Delay,
    Forces,
    Start,
    Traces,
    Wall,
)
from ..contact.transient import SampledContact
from ..model.controller import blocks_of
from ..model.difference import DAMPING
from ..model.response import controller_gains
from ..model.sampled import SampledPlant
from ..stability.margin_kernel import (
    DELAY_S,
    GAIN_DB,
    MARGINS,
    MODULUS,
    MODULUS_ALONE,
    MODULUS_BREAK,
    MODULUS_RAD_PER_S,
    PHASE_RAD,
    WITH_CROSSOVERS,
    PolynomialLoop,
    find_loop_margins,
    plant_at,
)
from ..stability.margins import PreparedMargins, loop_polynomials
from ..stability.polynomial_noise import command_speed_rms, controller_at, spectral_ratio
from ..stability.polynomials import (
    CONTROLLER_POWERS,
    DOUBTFUL,
    STABLE,
    controller_polynomials,
    hurwitz,
    loop_polynomial,
)

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

# Plants whose loops are judged: polynomials, response polynomials (p, 4, n) and grids.
Plants = tuple[Loops, FloatArray, Grids]
# ω, z and x/x^d over the band of the admittance, or over all frequencies, the lowest first.
Band = tuple[FloatArray, ComplexArray, ComplexArray]
# Of noise that is not white tan(ωh/2), its power and that of white noise (k,), both times the square of speed per
# command, F/x^d and x/x^d (p, k).
Spectrum = tuple[FloatArray, tuple[FloatArray, FloatArray], ComplexArray, ComplexArray]

# Columns of a pair of controller and scenario, as `simulate_pair` writes them: the peaks, and the samples until each,
# AT_REST for a force that only creeps up to its value at rest.
PEAK_SENSOR, PEAK_CONTACT, SENSOR_AT, CONTACT_AT, PEAK_COLUMNS = 0, 1, 2, 3, 4
AT_REST = -1.0
# Columns of a design; those of each of its plants are MARGINS, as `find_loop_margins` writes them.
VERDICT, FAILED, ADMITTANCE, ADMITTANCE_PEAK, COLUMNS = 0, 1, 2, 3, 4
# Columns of a plant in a hand: the modulus, and where it was found.
HELD_MODULUS, HELD_RAD_PER_S, HELD_BREAK, HELD_COLUMNS = 0, 1, 2, 3
_NUMBERS = (MODULUS, GAIN_DB, PHASE_RAD, DELAY_S)


@compiled
def judge_loop(
    loops: Loops, plant: int, controller: FloatArray, degree: int, h: float, theta: float, work: FloatArray
) -> int:
    """Return STABLE, UNSTABLE or DOUBTFUL for one loop."""
    polynomials, sizes, first = loops
    total = loop_polynomial(polynomials[plant, :, : sizes[plant]], controller, degree, h, theta, work)
    return hurwitz(work, total, first[plant])


@compiled
def polynomial_workspace(loops: Loops) -> FloatArray:
    """Return an array that any polynomial of these loops fits in; compiled code does not notice where one ends."""
    polynomials, _, _ = loops
    return np.zeros(polynomials.shape[2] + CONTROLLER_POWERS)


@compiled
def grid_of(grids: Grids, plant: int) -> tuple[FloatArray, FloatArray, ComplexArray, ComplexArray]:
    """Return the grid of one plant."""
    omega, tangent, force, position, offsets = grids
    part = slice(offsets[plant], offsets[plant + 1])
    return omega[part], tangent[part], force[part], position[part]


@compiled
def judge_stability(loops: Loops, designs: FloatArray, h: float, theta: float, ideal: bool) -> IntArray:
    """Return the verdicts (m, p) of designs (m, 7) on plants (p,)."""
    _, sizes, _ = loops
    count = len(sizes)
    out = np.empty((len(designs), count), dtype=np.int64)
    controller, work = np.zeros((3, CONTROLLER_POWERS)), polynomial_workspace(loops)
    for i in range(len(designs)):
        degree = controller_polynomials(designs[i], ideal, controller)
        for j in range(count):
            out[i, j] = judge_loop(loops, j, controller, degree, h, theta, work)
    return out


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
    """Simulate the impact of one scenario until it has settled and write its peaks into one row of a result."""
    plant, start, forces = begin_pair(contacts, j, blocks, damping, h, approach)
    found = np.zeros(FOUND)
    last = run_contact(plant, blocks, start, forces, traces, found, True) - 1
    out[PEAK_SENSOR], out[PEAK_CONTACT] = found[SENSOR_PEAK], found[CONTACT_PEAK]
    rests = found[SENSOR_TICK] == last and found[SENSOR_PEAK] == forces.desired
    out[SENSOR_AT] = AT_REST if rests else found[SENSOR_TICK]
    rests = found[CONTACT_TIME] == last and found[CONTACT_PEAK] == forces.desired + forces.push
    out[CONTACT_AT] = AT_REST if rests else found[CONTACT_TIME]


@compiled
def begin_pair(
    contacts: Contacts,
    j: int,
    blocks: FloatArray,
    damping: float,
    h: float,
    approach: tuple[float, float, bool, float],
) -> tuple[Contact, Start, Forces]:
    """Return plant, start and forces of the impact of one scenario, as `run_contact` takes them."""
    (step, flow, rows, walls, ramps), delays, fractions, inside, offsets = contacts
    (whole, chain), n = (delays[j, 0], delays[j, 1]), step.shape[2]
    delay = Delay(whole, chain, fractions[j])
    wall = Wall(walls[j, 0], walls[j, 1], walls[j, 2], walls[j, 3])
    plant = Contact(step[j], flow[j], rows[j], inside[offsets[j] : offsets[j + 1]], delay, wall)
    speed, push, forces = contact_forces(approach, damping - ramps[j, MOVING, n + 1] * h)
    start = steady_start(ramps[j], rows[j, POSITION, :n], blocks, delay.chain, h, speed, push, damping * speed)
    return plant, start, forces


@released
def evaluate_designs(
    plants: Plants,
    contacts: Contacts,
    bands: tuple[Band, Band],
    designs: FloatArray,
    sampling: tuple[float, float, bool],
    approach: tuple[float, float, bool, float],
    longest: int,
    required: tuple[FloatArray, float, float, bool],
    if_missed: tuple[bool, bool],
    out: tuple[FloatArray, FloatArray, FloatArray],
) -> None:
    """Fill `out` for designs (m, 7 or 11): (m, COLUMNS), by plant (m, p, MARGINS), scenario (m, s, PEAK_COLUMNS).

    `plants` are those in contact, as many as `contacts` has, then those in free space. `required` has what must hold of
    each margin and of the admittance, 0 where nothing must, what its peak over all frequencies may be, and whether
    crossovers are wanted. Of a design that misses
    something no more is judged (margins stay infinite, peaks NaN), unless `if_missed` asks for its margins, and for its
    peaks; where a verdict is not STABLE, at plant FAILED, the rest is NaN.
    """
    loops, responses, grids = plants
    h, theta, ideal = sampling
    controller, work, found = np.zeros((3, CONTROLLER_POWERS)), polynomial_workspace(loops), np.zeros(MARGINS)
    traces = Traces(np.empty(longest), np.empty(longest))
    margins, admittance, admittance_peak, crosses = required
    margins_if_missed, peaks_if_missed = if_missed
    shallowest = MODULUS_ALONE if margins[MODULUS] > 0.0 else WITH_CROSSOVERS
    deepest = WITH_CROSSOVERS if crosses else MODULUS_ALONE
    whole, by_plant, by_pair = out
    whole[:], by_plant[:], by_pair[:] = np.nan, np.nan, np.nan
    for i in range(len(designs)):
        degree = controller_polynomials(designs[i], ideal, controller)
        verdict = STABLE
        for j in range(len(responses)):
            verdict = judge_loop(loops, j, controller, degree, h, theta, work)
            if verdict != STABLE:
                whole[i, FAILED] = j
                break
        whole[i, VERDICT] = verdict
        if verdict != STABLE:
            continue
        blocks = blocks_of(designs[i], h, theta, ideal)
        by_plant[i] = np.inf
        least_and_peak(bands, blocks, whole[i])
        missed = whole[i, ADMITTANCE] < admittance or whole[i, ADMITTANCE_PEAK] > admittance_peak
        # The cheap margin of all plants comes first: most designs miss it, and the rest of those is not needed.
        for depth in range(deepest if margins_if_missed else shallowest, deepest + 1):
            if missed and not margins_if_missed:
                break
            for j in range(len(responses)):
                loop = PolynomialLoop(responses[j], controller, degree, h, theta)
                find_loop_margins(loop, grid_of(grids, j), depth, found)
                missed = _keep_margins(found, margins, by_plant[i, j]) or missed
        if missed and not peaks_if_missed:
            continue
        for j in range(by_pair.shape[1]):
            simulate_pair(contacts, j, blocks, designs[i, DAMPING], h, approach, traces, by_pair[i, j])


@released
def find_moduli(plants: Plants, designs: FloatArray, sampling: tuple[float, float, bool], out: FloatArray) -> None:
    """Fill `out` (m, p, HELD_COLUMNS) with min |1 + L| of designs (m, 7 or 11) on plants, and where it was found.

    The modulus is 0 where unstable, NaN where doubtful.
    """
    loops, responses, grids = plants
    h, theta, ideal = sampling
    controller, work, found = np.zeros((3, CONTROLLER_POWERS)), polynomial_workspace(loops), np.zeros(MARGINS)
    for i in range(len(designs)):
        degree = controller_polynomials(designs[i], ideal, controller)
        for j in range(len(responses)):
            verdict = judge_loop(loops, j, controller, degree, h, theta, work)
            if verdict != STABLE:
                out[i, j], out[i, j, HELD_MODULUS] = np.nan, 0.0 if verdict != DOUBTFUL else np.nan
                continue
            loop = PolynomialLoop(responses[j], controller, degree, h, theta)
            find_loop_margins(loop, grid_of(grids, j), MODULUS_ALONE, found)
            out[i, j, HELD_MODULUS] = found[MODULUS]
            out[i, j, HELD_RAD_PER_S], out[i, j, HELD_BREAK] = found[MODULUS_RAD_PER_S], found[MODULUS_BREAK]


@released
def find_speed_noises(
    loops: Loops, designs: FloatArray, sampling: tuple[float, float, bool], noises: tuple[float, float], out: FloatArray
) -> None:
    """Fill `out` (m, p) with the commanded speed's RMS of designs that are stable on all plants, NaN where doubtful."""
    polynomials, sizes, first = loops
    h, theta, ideal = sampling
    controller = np.zeros((3, CONTROLLER_POWERS))
    for i in range(len(designs)):
        degree = controller_polynomials(designs[i], ideal, controller)
        for j in range(len(sizes)):
            plant = polynomials[j, :, : sizes[j]]
            out[i, j] = command_speed_rms(plant, first[j], controller, degree, (h, theta), noises)


@compiled
def responses_at(responses: FloatArray, tangent: FloatArray) -> tuple[ComplexArray, ComplexArray]:
    """Return F/x^d and x/x^d (p, k) of plants at w = j tan(ωh/2) (k,)."""
    force = np.empty((len(responses), len(tangent)), dtype=np.complex128)
    position = np.empty_like(force)
    for j in range(len(responses)):
        for k in range(len(tangent)):
            force[j, k], position[j, k] = plant_at(responses[j], 1j * tangent[k])
    return force, position


@released
def times_spectral_ratios(
    spectrum: Spectrum, designs: FloatArray, sampling: tuple[float, float, bool], out: FloatArray
) -> None:
    """Multiply the commanded speed's RMS under white noise of the force (m, p) by what its spectrum makes of it."""
    tangent, shares, forces, positions = spectrum
    h, theta, ideal = sampling
    controller = np.zeros((3, CONTROLLER_POWERS))
    for i in range(len(designs)):
        degree = controller_polynomials(designs[i], ideal, controller)
        at = controller_at(controller, degree, tangent, h, theta)
        for j in range(len(forces)):
            out[i, j] *= spectral_ratio(at, forces[j], positions[j], shares)


@released
def find_contact_peaks(
    loops: Loops,
    contacts: Contacts,
    designs: FloatArray,
    sampling: tuple[float, float, bool],
    approach: tuple[float, float, bool, float],
    longest: int,
    out: FloatArray,
) -> None:
    """Fill `out` (m, s) with peaks on the environment of designs (m, 7 or 11): infinite if unstable, NaN if doubtful.

    `loops` are those of the contacts, then those of each before it touches.
    """
    h, theta, ideal = sampling
    controller, work, peaks = np.zeros((3, CONTROLLER_POWERS)), polynomial_workspace(loops), np.empty(PEAK_COLUMNS)
    traces, count = Traces(np.empty(longest), np.empty(longest)), out.shape[1]
    for i in range(len(designs)):
        degree = controller_polynomials(designs[i], ideal, controller)
        blocks = blocks_of(designs[i], h, theta, ideal)
        for j in range(count):
            touching = judge_loop(loops, j, controller, degree, h, theta, work)
            free = judge_loop(loops, count + j, controller, degree, h, theta, work)
            if touching != STABLE or free != STABLE:
                out[i, j] = np.nan if DOUBTFUL in (touching, free) else np.inf
                continue
            simulate_pair(contacts, j, blocks, designs[i, DAMPING], h, approach, traces, peaks)
            out[i, j] = peaks[PEAK_CONTACT]


@compiled
def _keep_margins(found: FloatArray, required: FloatArray, row: FloatArray) -> bool:
    """Write a loop's margins into a row and return whether one is missed, as one that is not a number is."""
    row[:], missed = found, False
    for column in _NUMBERS:
        row[column] = 0.0 if np.isnan(found[column]) else found[column]
        missed = missed or row[column] < required[column]
    return missed


@compiled
def least_and_peak(bands: tuple[Band, Band], blocks: FloatArray, out: FloatArray) -> None:
    """Write min |G| [m/s/N] over the first band and max |G| per |G| at rest over the second into the row of a design.

    G is that of `problems.model.response.rendered_admittance`.
    """
    band, everywhere = bands
    omega, z, position = band
    least = np.inf
    for k in range(len(omega)):
        least = min(least, _admittance(omega[k], z[k], position[k], blocks))
    out[ADMITTANCE] = least
    omega, z, position = everywhere
    most, at_rest = 0.0, 1.0
    for k in range(len(omega)):
        gain = _admittance(omega[k], z[k], position[k], blocks)
        if k == 0:
            at_rest = gain
        most = max(most, gain)
    out[ADMITTANCE_PEAK] = most / at_rest


@compiled
def _admittance(omega: float, z: complex, position: complex, blocks: FloatArray) -> float:
    """Return |G| at one frequency."""
    forward, feedback = controller_gains(blocks, z)
    return float(abs(forward * (1j * omega) * position / (1.0 + feedback * position)))


def stack_loops(plants: Sequence[SampledPlant]) -> Loops:
    """Return the polynomials of plants of one robot order and sample time, as `judge_loop` takes them."""
    found = [loop_polynomials(plant) for plant in plants]
    sizes = np.array([each.shape[1] for each in found], dtype=np.int64)
    first = np.array([0 if plant.plant.environment.is_anchored else 1 for plant in plants], dtype=np.int64)
    return stacked(found), sizes, first


def stacked(polynomials: Sequence[FloatArray]) -> FloatArray:
    """Return one array of polynomials of different length: the higher powers of the shorter ones are zero."""
    most = max(each.shape[1] for each in polynomials)
    return np.array([np.pad(each, ((0, 0), (0, most - each.shape[1]))) for each in polynomials])


def stack_responses(plants: Sequence[PreparedMargins]) -> FloatArray:
    """Return the response polynomials (p, 4, n) of plants, as `find_loop_margins` takes them."""
    return stacked([plant.polynomials for plant in plants])


def stack_grids(plants: Sequence[PreparedMargins]) -> Grids:
    """Return the grids of plants one after the other."""
    grids = [plant.grid for plant in plants]
    return (
        np.concatenate([grid[0] for grid in grids]),
        np.concatenate([grid[1] for grid in grids]),
        np.concatenate([grid[2] for grid in grids]),
        np.concatenate([grid[3] for grid in grids]),
        offsets_of([len(grid[0]) for grid in grids]),
    )


def stack_contacts(pairs: Sequence[SampledContact]) -> Contacts:
    """Return what `run_contact` takes of every pair, with a leading axis."""
    plants = [pair.arguments for pair in pairs]
    return (
        (
            np.array([plant.step for plant in plants]),
            np.array([plant.flow for plant in plants]),
            np.array([plant.rows for plant in plants]),
            np.array([plant.wall for plant in plants]),
            np.array([pair.ramp for pair in pairs]),
        ),
        np.array([(plant.delay.whole, plant.delay.chain) for plant in plants], dtype=np.int64),
        np.array([plant.delay.fraction for plant in plants]),
        np.concatenate([plant.inside for plant in plants]),
        offsets_of([len(plant.inside) for plant in plants]),
    )


def offsets_of(lengths: Sequence[int]) -> NDArray[np.int64]:
    """Return where each of several pieces begins, and where the last one ends."""
    return np.concatenate([[0], np.cumsum(lengths)]).astype(np.int64)
