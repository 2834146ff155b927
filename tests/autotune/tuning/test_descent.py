"""A descent: to the optimum from beside it, inside the bounds, with slopes only where it goes on."""

from dataclasses import replace

import numpy as np
import pytest

from autotune.tuning.bounds import Box, spread_out
from autotune.tuning.descent import descend, polish_exactly
from autotune.tuning.optimality import check_optimality
from problems.design.batch_evaluation import BatchEvaluator, build_batch_evaluator
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
