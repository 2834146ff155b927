"""Compiled loop over designs and all plants of their scenarios, for `problems.screening`."""

import numpy as np
from numpy.typing import NDArray

from .batch_kernel import COLUMNS as PAIR_COLUMNS
from .batch_kernel import PEAK_CONTACT as PAIR_CONTACT
from .batch_kernel import PEAK_SENSOR as PAIR_SENSOR
from .batch_kernel import Contacts, Grids, Loops, judge_loop, loop_room, simulate_pair
from .compiled import compiled
from .controller import blocks_of
from .margin_kernel import DELAY_S as LOOP_DELAY_S
from .margin_kernel import GAIN_DB as LOOP_GAIN_DB
from .margin_kernel import MARGINS, MODULUS_ALONE, WITH_CROSSOVERS, find_loop_margins
from .margin_kernel import MODULUS as LOOP_MODULUS
from .margin_kernel import PHASE_RAD as LOOP_PHASE_RAD
from .polynomials import CONTROLLER_POWERS, STABLE, controller_polynomials
from .response import controller_gains

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
ComplexArray = NDArray[np.complex128]

# Plants whose loops are judged: polynomials, response polynomials (p, 4, n) and grids.
Plants = tuple[Loops, FloatArray, Grids]
# ω, z and x/x^d over the band of the admittance.
Band = tuple[FloatArray, ComplexArray, ComplexArray]

# Columns of a result: the verdict, then the least of each margin and of the admittance, then the largest peaks; and the
# plant whose verdict was not STABLE.
VERDICT, MODULUS, GAIN_DB, PHASE_RAD, DELAY_S, ADMITTANCE, PEAK_SENSOR, PEAK_CONTACT, FAILED, COLUMNS = (
    0,
    1,
    2,
    3,
    4,
    5,
    6,
    7,
    8,
    9,
)


@compiled
def screen_designs(
    plants: Plants,
    contacts: Contacts,
    band: Band,
    designs: FloatArray,
    sampling: tuple[float, float, bool],
    approach: tuple[float, float, bool, float],
    longest: int,
    required: FloatArray,
    peaks_if_missed: bool,
    out: FloatArray,
) -> None:
    """Fill `out` (m, COLUMNS) for designs (m, 7).

    `plants` are those in contact, as many as `contacts` has, then those in free space. `required` (COLUMNS,) has what
    is asked of each margin and of the admittance, 0 where nothing is. Of a design that misses something no more is
    judged (margins stay infinite, peaks NaN) unless `peaks_if_missed`; where a verdict is not STABLE the rest is NaN.
    """
    loops, responses, grids = plants
    h, theta, ideal = sampling
    controller, work, found = np.zeros((3, CONTROLLER_POWERS)), loop_room(loops), np.zeros(MARGINS)
    row, traces = np.empty(PAIR_COLUMNS), (np.empty(longest), np.empty(longest))
    omega, tangent, force, position, offsets = grids
    crosses = required[GAIN_DB] > 0.0 or required[PHASE_RAD] > 0.0 or required[DELAY_S] > 0.0
    shallowest = MODULUS_ALONE if required[MODULUS] > 0.0 else WITH_CROSSOVERS
    deepest = WITH_CROSSOVERS if crosses else MODULUS_ALONE
    for i in range(len(designs)):
        degree = controller_polynomials(designs[i], ideal, controller)
        out[i, :] = np.nan
        verdict = STABLE
        for j in range(len(loops[1])):
            verdict = judge_loop(loops, j, controller, degree, h, theta, work)
            if verdict != STABLE:
                out[i, FAILED] = j
                break
        out[i, VERDICT] = verdict
        if verdict != STABLE:
            continue
        blocks = blocks_of(designs[i], h, theta, ideal)
        out[i, MODULUS : ADMITTANCE + 1] = np.inf
        if required[ADMITTANCE] > 0.0:
            out[i, ADMITTANCE] = _least_admittance(band, blocks)
        missed = out[i, ADMITTANCE] < required[ADMITTANCE]
        # The cheap margin of all plants comes first: most designs miss it, and nobody asks for the rest of those.
        for depth in range(shallowest, deepest + 1):
            if missed and not peaks_if_missed:
                break
            for j in range(len(loops[1])):
                part = slice(offsets[j], offsets[j + 1])
                grid = (omega[part], tangent[part], force[part], position[part])
                find_loop_margins(responses[j], grid, controller, degree, (h, theta), depth, found)
                _keep_least(found, out[i])
            for column in range(MODULUS, ADMITTANCE):
                missed = missed or out[i, column] < required[column]
        if missed and not peaks_if_missed:
            continue
        out[i, PEAK_SENSOR], out[i, PEAK_CONTACT] = -np.inf, -np.inf
        for j in range(len(contacts[1])):
            simulate_pair(contacts, j, blocks, designs[i, 1], h, approach, traces, row)
            out[i, PEAK_SENSOR] = max(out[i, PEAK_SENSOR], row[PAIR_SENSOR])
            out[i, PEAK_CONTACT] = max(out[i, PEAK_CONTACT], row[PAIR_CONTACT])


@compiled
def _keep_least(found: FloatArray, row: FloatArray) -> None:
    """Keep the least of each margin in a row of a result; one that is not a number misses whatever is asked."""
    for column, of_loop in (
        (MODULUS, LOOP_MODULUS),
        (GAIN_DB, LOOP_GAIN_DB),
        (PHASE_RAD, LOOP_PHASE_RAD),
        (DELAY_S, LOOP_DELAY_S),
    ):
        value = found[of_loop]
        if not value >= row[column]:
            row[column] = 0.0 if np.isnan(value) else value


@compiled
def _least_admittance(band: Band, blocks: FloatArray) -> float:
    """Return min |G| [m/s/N] over the band, see `problems.response.rendered_admittance`."""
    omega, z, position = band
    least = np.inf
    for k in range(len(omega)):
        forward, feedback = controller_gains(blocks, z[k])
        least = min(least, abs(forward * (1j * omega[k]) * position[k] / (1.0 + feedback * position[k])))
    return least
