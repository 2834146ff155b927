"""The peer of the polish: IPOPT and sequential quadratic programming end at the same design."""

import numpy as np
import pytest

from autotune.tuning.descent import polish_exactly
from benchmarks.optimizer_page import tables
from benchmarks.optimizer_polish import RESERVE, polish_by_ipopt
from problems.design.batch_evaluation import build_batch_evaluator
from tests.autotune.tuning.cases import solved


def test_two_solvers_and_one_answer() -> None:
    screen = build_batch_evaluator(solved().active)
    ours = polish_exactly(screen, solved().design, backoff={}, reserve=RESERVE)
    theirs = polish_by_ipopt(screen, solved().design)
    values = screen.evaluate(np.array([ours, theirs]), peaks_if_missed=True)
    # Both stop where a step changes the peak by some 1e-8 of it.
    assert values.cost[1] == pytest.approx(values.cost[0], rel=1e-6)
    assert float(np.max(values.violation)) == 0.0
    # The optimum is flat along the limits: there 1e-6 of the peak are some 1e-3 of the gains.
    assert theirs == pytest.approx(ours, rel=5e-3)


def test_the_page_sets_them_side_by_side() -> None:
    record = {"part": "polish", "name": "7", "residual": 1e-9, "seconds": 0.02}
    values = {"before": 50.1, "SLSQP": 50.0, "IPOPT": 50.0 * (1.0 + 2e-9)}
    reported = tables([{**record, "solver": solver, "value_n": value} for solver, value in values.items()])
    assert "| 7 | 50.100000 | 50.000000 | 1.0e-09 | 0.020 |" in reported
    assert "differ by 2e-09 at most" in reported
