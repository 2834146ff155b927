"""A descent: to the optimum from beside it, inside the bounds, with slopes only where it goes on."""

from dataclasses import replace

import numpy as np
import pytest

from autotune.tuning.bounds import Box, spread_out
from autotune.tuning.descent import LocalProblem, descend, polish_exactly
from autotune.tuning.optimality import OBJECTIVE, check_optimality, row_at
from problems.design.batch_evaluation import BatchEvaluator, build_batch_evaluator
from problems.design.batch_result import BatchEvaluation
from problems.design.problem import VARIABLES
from tests.autotune.tuning.cases import solved


def test_it_comes_back_to_the_optimum_and_keeps_its_reserve() -> None:
    screen, box = build_batch_evaluator(solved().active), Box(solved().problem)
    start = np.clip(box.unit(solved().design) + np.array([0.05, 0.03, -0.1, 0.1]), 0.0, 1.0)
    ends = {reserve: descend(screen, box, start, reserve=reserve) for reserve in (0.0, 1e-2)}
    values = {}
    for reserve, end in ends.items():
        assert np.all((end.unit >= 0.0) & (end.unit <= 1.0))
        found = screen.evaluate(box.design(end.unit)[None], peaks_if_missed=True)
        worst = max(float(value[0]) for value in found.requirements.values())
        # Steps along curved limits end within some 1e-6 of them.
        assert worst == pytest.approx(1.0 - reserve, abs=1e-5)
        values[reserve] = float(found.cost[0])
    assert values[0.0] == pytest.approx(solved().evaluation.cost, rel=1e-3)
    assert values[1e-2] > values[0.0] * (1.0 + 1e-3)


def test_slopes_are_asked_for_once_per_step_and_not_at_every_trial() -> None:
    screen, box = build_batch_evaluator(solved().active), Box(solved().problem)
    asked: list[int] = []
    evaluate = screen.evaluate

    class Counting:
        prepared, goal = screen.prepared, None

        def evaluate(self, designs: np.ndarray, *, peaks_if_missed: bool = False) -> object:
            asked.append(len(designs))
            return evaluate(designs, peaks_if_missed=peaks_if_missed)

        def evaluate_beside(self, known: BatchEvaluation, designs: np.ndarray) -> object:
            # The first one is known.
            asked.append(len(designs) - 1)
            return screen.evaluate_beside(known, designs)

    start = np.array([0.5, 0.5, 0.5, 0.5])
    found = descend(Counting(), box, start)  # type: ignore[arg-type]
    assert sum(asked) == found.evaluations
    points, slopes = asked.count(1), asked.count(4)
    assert slopes >= 2
    assert points >= slopes
    assert points + slopes == len(asked)


def test_points_apart_are_the_first_of_their_places() -> None:
    points = [np.array([x, 0.0]) for x in (0.0, 0.05, 0.5, 0.52, 1.0)]
    assert [float(p[0]) for p in spread_out(points, 0.1, 5)] == [0.0, 0.5, 1.0]
    assert len(spread_out(points, 0.1, 2)) == 2


RESERVE = 1e-6


def screen() -> BatchEvaluator:
    return build_batch_evaluator(solved().active)


def test_the_result_meets_the_conditions_to_many_digits() -> None:
    polished = polish_exactly(screen(), solved().design, backoff={}, reserve=RESERVE)
    found = check_optimality(solved().active, polished)
    assert found.relative_residual < 1e-6
    assert found.slack < 1e-5
    before, after = (solved().active.evaluate(d, peaks_if_missed=True) for d in (solved().design, polished))
    assert after.is_feasible
    assert after.cost <= before.cost * (1.0 + 1e-6)


@pytest.mark.parametrize("variable", [1, 2, 3])
@pytest.mark.parametrize("share", [-0.003, 0.003])
def test_a_design_beside_the_optimum_comes_back(variable: int, share: float) -> None:
    moved = solved().design.copy()
    moved[variable] *= 1.0 + share
    polished = polish_exactly(screen(), moved, backoff={}, reserve=RESERVE)
    at_best = polish_exactly(screen(), solved().design, backoff={}, reserve=RESERVE)
    peaks = [solved().active.evaluate(d, peaks_if_missed=True).cost for d in (polished, at_best)]
    assert solved().active.evaluate(polished, peaks_if_missed=True).is_feasible
    assert peaks[0] == pytest.approx(peaks[1], rel=3e-5)


def test_what_is_asked_in_reserve_is_kept() -> None:
    polished = polish_exactly(screen(), solved().design, backoff={"modulus_margin": 1e-3}, reserve=RESERVE)
    found = solved().active.evaluate(polished, peaks_if_missed=True)
    assert found.requirements["modulus_margin"] == pytest.approx(1.0 / (1.0 + 1e-3), rel=2e-5)


def test_bounds_hold() -> None:
    found = solved()
    bounds = {
        **found.problem.bounds,
        "lead_s": (float(found.design[2]),) * 2,
        "damping": (1100.0, float(found.design[1])),
    }
    narrow = replace(found.problem, bounds=bounds)
    polished = polish_exactly(
        build_batch_evaluator(replace(found.active, problem=narrow)), found.design, backoff={}, reserve=RESERVE
    )
    assert polished[2] == found.design[2]
    for value, name in zip(polished, VARIABLES, strict=True):
        low, high = bounds[name]
        assert low <= value <= high
    assert np.all(np.isfinite(polished))


def test_the_gradients_are_the_symbolic_ones() -> None:
    """By differences of compiled numbers, and row by row as the optimality is checked.

    The symbolic form reads a peak between the ticks from a parabola through three of them, which is off by some 1e-5.
    """
    local = LocalProblem(screen(), solved().design, backoff={}, reserve=RESERVE)
    names = {name for name, _ in local.keys}
    assert {OBJECTIVE, "free_space_admittance"} < names
    found = -local.slack_gradients(local.start())[:, : len(solved().design)]
    rows = [row_at(solved().active, solved().design, key) for key in local.keys]
    assert all(row.is_exact for row in rows)
    for gradient, row in zip(found, rows, strict=True):
        share = 5e-5 if row.name == OBJECTIVE else 1e-6
        np.testing.assert_allclose(gradient, row.gradient, atol=share * np.max(np.abs(row.gradient)))


def test_a_descent_says_what_its_end_misses() -> None:
    """One that is not allowed a step stays where it began."""
    evaluator, box = screen(), Box(solved().problem)
    unit = box.unit(solved().design)
    assert descend(evaluator, box, unit).missed == 0.0
    asked = evaluator.evaluate(box.design(unit)[None], peaks_if_missed=True).requirements
    backoff = {"free_space_admittance": 0.01}
    missed = descend(evaluator, box, unit, backoff=backoff, iterations=0).missed
    assert missed == pytest.approx(1.01 * float(asked["free_space_admittance"][0]) - 1.0, abs=1e-9)
