"""The exact polish: from beside the optimum to the conditions of an optimum, inside bounds and limits."""

from dataclasses import replace

import numpy as np
import pytest

from autotune.tuning.optimality import check_optimality
from autotune.tuning.polish import polish_exactly
from problems.design.batch_evaluation import BatchEvaluator, build_batch_evaluator
from problems.design.problem import VARIABLES
from tests.autotune.tuning.cases import solved

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
    assert after.objective_n <= before.objective_n * (1.0 + 1e-6)


@pytest.mark.parametrize("variable", [1, 2, 3])
@pytest.mark.parametrize("share", [-0.003, 0.003])
def test_a_design_beside_the_optimum_comes_back(variable: int, share: float) -> None:
    moved = solved().design.copy()
    moved[variable] *= 1.0 + share
    polished = polish_exactly(screen(), moved, backoff={}, reserve=RESERVE)
    at_best = polish_exactly(screen(), solved().design, backoff={}, reserve=RESERVE)
    peaks = [solved().active.evaluate(d, peaks_if_missed=True).objective_n for d in (polished, at_best)]
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
