"""Compiled numbers of designs beside one that is evaluated already, read where those of that one were found.

What `batch_kernel` finds by searches over frequency and time moves with a step of the design as `nearby_margins` says;
of a contact no more is simulated than up to the peaks.
"""

import numpy as np

from ..arrays import FloatArray, IntArray
from ..compiled import compiled, released
from ..contact.kernel import run_contact
from ..contact.kernel_types import CONTACT_PEAK, FOUND, SENSOR_PEAK, Traces
from ..model.controller import blocks_of
from ..model.difference import DAMPING
from ..stability.margin_kernel import PolynomialLoop
from ..stability.nearby_margins import margins_beside, modulus_beside
from ..stability.polynomials import CONTROLLER_POWERS, STABLE, controller_polynomials
from .batch_kernel import (
    AT_REST,
    CONTACT_AT,
    HELD_BREAK,
    HELD_RAD_PER_S,
    PEAK_CONTACT,
    PEAK_SENSOR,
    SENSOR_AT,
    VERDICT,
    Band,
    Contacts,
    Plants,
    begin_pair,
    least_and_peak,
)

# Samples behind a peak that the search of it between the ticks looks at.
_BEHIND = 3


@released
def evaluate_beside(
    plants: Plants,
    contacts: Contacts,
    bands: tuple[Band, Band],
    designs: FloatArray,
    sampling: tuple[float, float, bool],
    approach: tuple[float, float, bool, float],
    longest: int,
    known: tuple[FloatArray, FloatArray, FloatArray],
    out: tuple[FloatArray, FloatArray, FloatArray],
) -> None:
    """Fill `out` as `evaluate_designs` does, for designs (m, 7 or 11) beside the one that is `known`.

    `known` has its parameters (7 or 11), margins (p, MARGINS) and peaks (s, PEAK_COLUMNS); it is stable, and so are the
    others.
    """
    _, responses, _ = plants
    h, theta, ideal = sampling
    design, at_plant, at_pair = known
    first, controller = np.zeros((3, CONTROLLER_POWERS)), np.zeros((3, CONTROLLER_POWERS))
    first_degree = controller_polynomials(design, ideal, first)
    traces = Traces(np.empty(longest), np.empty(longest))
    whole, by_plant, by_pair = out
    whole[:] = np.nan
    for i in range(len(designs)):
        degree = controller_polynomials(designs[i], ideal, controller)
        blocks = blocks_of(designs[i], h, theta, ideal)
        whole[i, VERDICT] = STABLE
        least_and_peak(bands, blocks, whole[i])
        for j in range(len(responses)):
            near = PolynomialLoop(responses[j], controller, degree, h, theta)
            there = PolynomialLoop(responses[j], first, first_degree, h, theta)
            margins_beside(near, there, at_plant[j], by_plant[i, j])
        for j in range(by_pair.shape[1]):
            _find_peaks(contacts, j, blocks, designs[i, DAMPING], h, approach, traces, at_pair[j], by_pair[i, j])


@compiled
def _find_peaks(
    contacts: Contacts,
    j: int,
    blocks: FloatArray,
    damping: float,
    h: float,
    approach: tuple[float, float, bool, float],
    traces: Traces,
    at: FloatArray,
    out: FloatArray,
) -> None:
    """Simulate the impact of one scenario up to the peaks that are known of it and write them into a row."""
    plant, start, forces = begin_pair(contacts, j, blocks, damping, h, approach)
    found = np.zeros(FOUND)
    latest = max(at[SENSOR_AT], at[CONTACT_AT])
    if latest != AT_REST:
        count = min(len(traces.sensed), int(np.ceil(latest)) + 1 + _BEHIND)
        run_contact(plant, blocks, start, forces, Traces(traces.sensed[:count], traces.pressed[:count]), found, False)
    out[:] = at
    out[PEAK_SENSOR] = forces.desired if at[SENSOR_AT] == AT_REST else found[SENSOR_PEAK]
    out[PEAK_CONTACT] = forces.desired + forces.push if at[CONTACT_AT] == AT_REST else found[CONTACT_PEAK]


@released
def find_moduli_beside(
    plants: Plants,
    designs: FloatArray,
    sampling: tuple[float, float, bool],
    rows: IntArray,
    known: FloatArray,
    out: FloatArray,
) -> None:
    """Fill `out` (m, k) with min |1 + L| of designs (m, 7 or 11) on `rows` (k,) of plants.

    `known` (k, HELD_COLUMNS) are those of a design beside them, as `find_moduli` writes them; what is unstable there,
    or doubtful, counts as 0 here too.
    """
    _, responses, _ = plants
    h, theta, ideal = sampling
    controller = np.zeros((3, CONTROLLER_POWERS))
    for i in range(len(designs)):
        degree = controller_polynomials(designs[i], ideal, controller)
        for k in range(len(rows)):
            near = PolynomialLoop(responses[rows[k]], controller, degree, h, theta)
            omega = known[k, HELD_RAD_PER_S]
            out[i, k] = 0.0 if np.isnan(omega) else modulus_beside(near, omega, known[k, HELD_BREAK])
