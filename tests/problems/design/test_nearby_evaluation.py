"""Designs a tiny step from a known one: their numbers, read where those of that one lie, give the same differences."""

from dataclasses import replace

import numpy as np
import pytest

from problems.arrays import FloatArray
from problems.contact.transient import Approach
from problems.design.batch_evaluation import BatchEvaluator, build_batch_evaluator
from problems.design.batch_kernel import AT_REST, CONTACT_AT
from problems.design.batch_result import BatchEvaluation
from problems.design.evaluation import build_scenarios
from problems.design.hand import HandImpedance
from problems.design.objectives import SensorForce
from problems.design.problem import DesignProblem, biquad_bounds
from problems.design.requirements import HeldByHand
from tests.autotune.tuning.cases import design_problem
from tests.problems.design.test_batch_evaluation import COMMANDED, EASY, EVERYTHING, OF_BOTH, random_designs

STEP = 1e-6
HELD = replace(
    COMMANDED, passivity=None, further={"held_by_hand": HeldByHand(**vars(HandImpedance()), min_modulus=0.3)}
)
WITH_BIQUAD = replace(
    design_problem(requirements=HELD),
    bounds={**design_problem().bounds, **biquad_bounds(design_problem().sample_time_s, 12.0)},
)
PROBLEMS = [
    pytest.param(design_problem(requirements=HELD), id="noise and hands"),
    pytest.param(design_problem(requirements=replace(HELD, soft_n={"held_by_hand": 5.0})), id="soft hands"),
    pytest.param(WITH_BIQUAD, id="biquad"),
    pytest.param(design_problem(requirements=replace(EASY, further={"admittance_peak": 1.1})), id="admittance peak"),
    pytest.param(design_problem(requirements=EVERYTHING), id="one that is not compiled"),
    pytest.param(
        replace(design_problem(requirements=EASY), objective=SensorForce(), approach=Approach(speed_m_s=0.04)),
        id="sensor",
    ),
    pytest.param(
        design_problem(requirements=replace(EASY, command_noise=OF_BOTH)),
        id="noise of the pose",
    ),
]


def stable_designs(problem: DesignProblem, screen: BatchEvaluator) -> FloatArray:
    designs = random_designs(40)
    more = len(problem.variables) - designs.shape[1]
    biquad = np.tile([0.012, 0.5, 0.01, 0.45], (len(designs), 1))[:, :more]
    designs = np.hstack([designs, biquad])
    return designs[screen.evaluate(designs).is_stable]


def rows_of(found: BatchEvaluation) -> dict[str, FloatArray]:
    return {**found.rows, **found.soft_rows, "objective": found.objective_rows}


@pytest.mark.parametrize("problem", PROBLEMS)
def test_the_differences_are_those_of_whole_evaluations(problem: DesignProblem) -> None:
    """Of nearly all rows: where two places compete, a whole evaluation may go over to the other one."""
    screen = build_batch_evaluator(build_scenarios(problem, problem.scenarios(3, 2)))
    errors: dict[str, list[FloatArray]] = {}
    for design in stable_designs(problem, screen):
        steps = np.diag(STEP * np.maximum(design, 1e-3))
        units = np.vstack([design, design + steps])
        known = screen.evaluate(design[None], peaks_if_missed=True)
        beside, whole = screen.evaluate_beside(known, units), screen.evaluate(units, peaks_if_missed=True)
        first, again = rows_of(known), rows_of(beside)
        for name, row in rows_of(whole).items():
            # At the known design nothing is lost.
            np.testing.assert_allclose(again[name][0], first[name][0], rtol=1e-9)
            # A margin that nothing limits is infinite, its row 0.
            scale = STEP * np.where(row[0] > 0.0, row[0], 1.0)
            slopes, found = (row[1:] - row[0]) / scale, (again[name][1:] - again[name][0]) / scale
            errors.setdefault(name, []).append(np.abs(found - slopes) / np.maximum(1.0, np.abs(slopes)))
    for name, each in errors.items():
        assert np.quantile(np.concatenate(each), 0.95) < 1e-3, name


def test_a_force_that_creeps_to_its_rest_moves_with_that() -> None:
    problem = replace(design_problem(requirements=EASY), approach=Approach(speed_m_s=0.04))
    screen = build_batch_evaluator(build_scenarios(problem, problem.scenarios(2, 2)))
    # So much damping that nothing overshoots: the force at rest is B_a v.
    slow = np.array([5.0, 30000.0, 0.01, 0.0])
    known = screen.evaluate(slow[None], peaks_if_missed=True)
    assert np.any(known.places.peaks[0, :, CONTACT_AT] == AT_REST)
    moved = np.vstack([slow, slow * [1.0, 1.001, 1.0, 1.0]])
    beside, whole = screen.evaluate_beside(known, moved), screen.evaluate(moved, peaks_if_missed=True)
    np.testing.assert_allclose(beside.objective_rows, whole.objective_rows, rtol=1e-12)


def test_beside_what_is_unstable_all_are_evaluated() -> None:
    problem = design_problem(requirements=EASY)
    screen = build_batch_evaluator(build_scenarios(problem, problem.scenarios(2, 2)))
    designs = random_designs(40)
    unstable = designs[~screen.evaluate(designs).is_stable][0]
    known = screen.evaluate(unstable[None], peaks_if_missed=True)
    assert not screen.evaluate_beside(known, np.vstack([unstable, unstable])).is_stable.any()


def test_a_feedback_damping_grows_from_none_on() -> None:
    """Too small to be a value in seconds it would be none to a controller; a descent has to see where it leads."""
    problem = design_problem(requirements=EASY)
    screen = build_batch_evaluator(build_scenarios(problem, problem.scenarios(2, 2)))
    designs = np.array([[6.0, 3000.0, 0.02, feedback] for feedback in (0.0, 1e-8, 1e-5, 2e-4)])
    whole = screen.evaluate(designs, peaks_if_missed=True)
    assert whole.is_stable.all()
    beside = screen.evaluate_beside(screen.evaluate(designs[:1], peaks_if_missed=True), designs[:2])
    for name, row in rows_of(beside).items():
        # From there on the two break points see different loops, of which the worse one counts.
        slopes = (rows_of(whole)[name][1:] - row[0]) / designs[1:, 3:]
        np.testing.assert_allclose((row[1] - row[0]) / 1e-8, slopes[0], rtol=1e-3, atol=1e-3, err_msg=name)
        np.testing.assert_allclose(slopes[1], slopes[0], rtol=0.01, atol=1e-2, err_msg=name)
