"""Margins beside a known loop against the search that knows nothing: the change by a small step of the law."""

from dataclasses import replace

import numpy as np

from problems.arrays import FloatArray
from problems.model.controller import AdmittanceController
from problems.model.sampled import SampledPlant
from problems.stability.margin_kernel import (
    DELAY_RAD_PER_S,
    DELAY_S,
    GAIN_DB,
    GAIN_RAD_PER_S,
    MARGINS,
    MODULUS,
    PHASE_RAD,
    WITH_CROSSOVERS,
    PolynomialLoop,
    find_loop_margins,
)
from problems.stability.margins import margin_grid, response_polynomials
from problems.stability.nearby_margins import margins_beside
from problems.stability.polynomials import CONTROLLER_POWERS, controller_polynomials
from tests.problems.axes import PERIOD_S
from tests.problems.random_loops import stable_loops

NUMBERS = {"modulus": MODULUS, "gain": GAIN_DB, "phase": PHASE_RAD, "delay": DELAY_S}
PLACES = {"gain": GAIN_RAD_PER_S, "phase": DELAY_RAD_PER_S, "delay": DELAY_RAD_PER_S}
STEP = 1e-6


def loop_of(sampled: SampledPlant, controller: AdmittanceController) -> PolynomialLoop:
    factors = np.zeros((3, CONTROLLER_POWERS))
    degree = controller_polynomials(controller.parameters(), controller.is_ideal, factors)
    return PolynomialLoop(response_polynomials(sampled), factors, degree, PERIOD_S, controller.theta)


def searched(sampled: SampledPlant, controller: AdmittanceController) -> FloatArray:
    found = np.zeros(MARGINS)
    find_loop_margins(loop_of(sampled, controller), margin_grid(sampled), WITH_CROSSOVERS, found)
    return found


def moved(controller: AdmittanceController, share: float) -> AdmittanceController:
    return replace(
        controller,
        mass_kg=controller.mass_kg * (1.0 + share),
        damping_n_s_per_m=controller.damping_n_s_per_m * (1.0 - 0.7 * share),
        lead_s=controller.lead_s * (1.0 + 2.0 * share),
    )


def test_the_change_is_that_of_two_searches() -> None:
    """Of nearly all loops: where two minima or crossovers compete, a search may go over to the other."""
    errors: dict[str, list[float]] = {name: [] for name in NUMBERS}
    for sampled, controller in stable_loops(np.random.default_rng(17), 150, below=0.999):
        known, beside = searched(sampled, controller), np.zeros(MARGINS)
        near = moved(controller, STEP)
        margins_beside(loop_of(sampled, near), loop_of(sampled, controller), known, beside)
        ahead, behind = searched(sampled, near), searched(sampled, moved(controller, -STEP))
        for name, column in NUMBERS.items():
            if not (np.isfinite(known[column]) and known[column] > 0.0) or np.isnan(known[PLACES.get(name, MODULUS)]):
                continue
            # The margins of the searches have some 1e-13 of noise, which a step of 1e-6 makes 1e-7.
            slope = (ahead[column] - behind[column]) / (2.0 * STEP * known[column])
            found = (beside[column] - known[column]) / (STEP * known[column])
            errors[name].append(abs(found - slope) / max(1.0, abs(slope)))
    for name, each in errors.items():
        assert len(each) > 30, name
        assert np.quantile(each, 0.95) < 1e-3, name


def test_the_known_loop_is_beside_itself() -> None:
    for sampled, controller in stable_loops(np.random.default_rng(5), 40):
        known, beside = searched(sampled, controller), np.zeros(MARGINS)
        loop = loop_of(sampled, controller)
        margins_beside(loop, loop, known, beside)
        for column in NUMBERS.values():
            assert (
                np.isnan(beside[column])
                or beside[column] == known[column]
                or abs(beside[column] / known[column] - 1.0) < 1e-9
            )


def test_what_is_read_at_no_crossover_is_no_number() -> None:
    """A loop gain above 1 up to the Nyquist frequency tolerates no delay, and that at no frequency."""
    sampled, controller = next(stable_loops(np.random.default_rng(5), 1))
    loop, known, beside = loop_of(sampled, controller), searched(sampled, controller), np.zeros(MARGINS)
    known[DELAY_S], known[DELAY_RAD_PER_S] = 0.0, np.nan
    known[GAIN_DB] = np.inf
    margins_beside(loop, loop, known, beside)
    assert np.isnan(beside[DELAY_S])
    assert beside[GAIN_DB] == np.inf
