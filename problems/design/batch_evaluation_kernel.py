"""Compiled loop over designs and all plants of their scenarios, for `problems.design.batch_evaluation`."""

import numpy as np
from numpy.typing import NDArray

from ..compiled import compiled
from ..contact.kernel_types import Traces
from ..model.controller import blocks_of
from ..model.response import controller_gains
from ..stability.margin_kernel import DELAY_S as LOOP_DELAY_S
from ..stability.margin_kernel import GAIN_DB as LOOP_GAIN_DB
from ..stability.margin_kernel import MARGINS, MODULUS_ALONE, WITH_CROSSOVERS, find_loop_margins
from ..stability.margin_kernel import MODULUS as LOOP_MODULUS
from ..stability.margin_kernel import PHASE_RAD as LOOP_PHASE_RAD
from ..stability.polynomials import CONTROLLER_POWERS, STABLE, controller_polynomials
from .batch_kernel import COLUMNS as PAIR_COLUMNS
from .batch_kernel import PEAK_CONTACT as PAIR_CONTACT
from .batch_kernel import PEAK_SENSOR as PAIR_SENSOR
from .batch_kernel import Contacts, Grids, Loops, judge_loop, loop_room, simulate_pair

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
ComplexArray = NDArray[np.complex128]

# Plants whose loops are judged: polynomials, response polynomials (p, 4, n) and grids.
Plants = tuple[Loops, FloatArray, Grids]
# ω, z and x/x^d over the band of the admittance.
Band = tuple[FloatArray, ComplexArray, ComplexArray]

# Columns of a design, of each of its plants, and of each of its scenarios.
VERDICT, FAILED, ADMITTANCE, COLUMNS = 0, 1, 2, 3
MODULUS, GAIN_DB, PHASE_RAD, DELAY_S, PLANT_COLUMNS = 0, 1, 2, 3, 4
SENSOR, CONTACT, PEAK_COLUMNS = 0, 1, 2


@compiled
def evaluate_designs(
    plants: Plants,
    contacts: Contacts,
    band: Band,
    designs: FloatArray,
    sampling: tuple[float, float, bool],
    approach: tuple[float, float, bool, float],
    longest: int,
    required: tuple[FloatArray, float, bool],
    peaks_if_missed: bool,
    out: tuple[FloatArray, FloatArray, FloatArray],
) -> None:
    """Fill `out` for designs (m, 7): (m, COLUMNS), by plant (m, p, PLANT_COLUMNS), by scenario (m, s, PEAK_COLUMNS).

    `plants` are those in contact, as many as `contacts` has, then those in free space. `required` has what must hold of
    each margin and of the admittance, 0 where nothing must, and whether crossovers are wanted. Of a design that misses
    something no more is judged (margins stay infinite, peaks NaN) unless `peaks_if_missed`; where a verdict is not
    STABLE, at plant FAILED, the rest is NaN.
    """
    loops, responses, grids = plants
    h, theta, ideal = sampling
    controller, work, found = np.zeros((3, CONTROLLER_POWERS)), loop_room(loops), np.zeros(MARGINS)
    row, traces = np.empty(PAIR_COLUMNS), Traces(np.empty(longest), np.empty(longest))
    omega, tangent, force, position, offsets = grids
    margins, admittance, crosses = required
    shallowest = MODULUS_ALONE if margins[MODULUS] > 0.0 else WITH_CROSSOVERS
    deepest = WITH_CROSSOVERS if crosses else MODULUS_ALONE
    whole, by_plant, by_pair = out
    whole[:], by_plant[:], by_pair[:] = np.nan, np.nan, np.nan
    for i in range(len(designs)):
        degree = controller_polynomials(designs[i], ideal, controller)
        verdict = STABLE
        for j in range(len(loops[1])):
            verdict = judge_loop(loops, j, controller, degree, h, theta, work)
            if verdict != STABLE:
                whole[i, FAILED] = j
                break
        whole[i, VERDICT] = verdict
        if verdict != STABLE:
            continue
        blocks = blocks_of(designs[i], h, theta, ideal)
        by_plant[i] = np.inf
        whole[i, ADMITTANCE] = _least_admittance(band, blocks)
        missed = whole[i, ADMITTANCE] < admittance
        # The cheap margin of all plants comes first: most designs miss it, and nobody asks for the rest of those.
        for depth in range(shallowest, deepest + 1):
            if missed and not peaks_if_missed:
                break
            for j in range(len(loops[1])):
                part = slice(offsets[j], offsets[j + 1])
                grid = (omega[part], tangent[part], force[part], position[part])
                find_loop_margins(responses[j], grid, controller, degree, (h, theta), depth, found)
                missed = _keep_margins(found, margins, by_plant[i, j]) or missed
        if missed and not peaks_if_missed:
            continue
        for j in range(len(contacts[1])):
            simulate_pair(contacts, j, blocks, designs[i, 1], h, approach, traces, row)
            by_pair[i, j, SENSOR], by_pair[i, j, CONTACT] = row[PAIR_SENSOR], row[PAIR_CONTACT]


@compiled
def _keep_margins(found: FloatArray, required: FloatArray, row: FloatArray) -> bool:
    """Write a loop's margins into a row and tell whether one is missed, as one that is not a number is."""
    missed = False
    for column, of_loop in (
        (MODULUS, LOOP_MODULUS),
        (GAIN_DB, LOOP_GAIN_DB),
        (PHASE_RAD, LOOP_PHASE_RAD),
        (DELAY_S, LOOP_DELAY_S),
    ):
        row[column] = 0.0 if np.isnan(found[of_loop]) else found[of_loop]
        missed = missed or row[column] < required[column]
    return missed


@compiled
def _least_admittance(band: Band, blocks: FloatArray) -> float:
    """Return min |G| [m/s/N] over the band, see `problems.model.response.rendered_admittance`."""
    omega, z, position = band
    least = np.inf
    for k in range(len(omega)):
        forward, feedback = controller_gains(blocks, z[k])
        least = min(least, abs(forward * (1j * omega[k]) * position[k] / (1.0 + feedback * position[k])))
    return least
