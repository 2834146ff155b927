"""A descent: to the optimum from beside it, inside the bounds, with slopes only where it goes on."""

import numpy as np
import pytest

from autotune.tuning.bounds import Box, spread_out
from autotune.tuning.descent import descend
from problems.design.batch_evaluation import build_batch_evaluator
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
        values[reserve] = float(found.objective_n[0])
    assert values[0.0] == pytest.approx(solved().evaluation.objective_n, rel=1e-3)
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
