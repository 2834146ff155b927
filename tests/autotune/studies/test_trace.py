"""How a study begins: with the front that the solver finds, in designs of the problem's own variables."""

import numpy as np
import pytest

from autotune.studies.objectives import Admittance, HandForce, PeakForce
from autotune.studies.points import Judge
from autotune.studies.structures import design_of
from autotune.studies.trace import FrontRequest, prepare_fronts, seed_designs, trace_fronts
from tests.autotune.studies.small import START, small_problem, small_search
from tests.autotune.studies.test_front import front


def test_a_design_is_found_again_in_its_controller() -> None:
    problem = small_problem()
    np.testing.assert_array_equal(design_of(problem, problem.controller(START)), START)


@pytest.mark.slow
def test_a_study_begins_with_the_solvers_front_and_what_lies_between(tmp_path_factory: pytest.TempPathFactory) -> None:
    problem, judge = small_problem(), Judge(small_problem(), (PeakForce(), Admittance()))
    designs = seed_designs(small_search())
    judged = [judge.judge(problem.controller(design)) for design in designs]
    count = (len(designs) + 1) // 2
    assert len(designs) == 2 * count - 1
    assert count >= 4
    assert all(point.is_feasible for point in judged[:count])
    # The ends are those of a front of four points, whatever lies between.
    for end in (0, -1):
        known = front().points[end].values
        mine = judged[:count][end].values
        assert mine["peak_force"] == pytest.approx(known["peak_force"], rel=2e-3)  # what the solver leaves
    # A study that tries no more than these has at least the front's share of feasible trials.
    asked = FrontRequest(objectives=("peak_force", "hand_force"), trials=len(designs))
    folder = tmp_path_factory.mktemp("study")
    traced = trace_fronts(prepare_fronts(asked, folder / "pareto.db"), {"x": small_search()})["x"]
    assert traced.study is not None
    assert traced.study.feasible >= count
    assert {each.name for each in traced.objectives} == {PeakForce.name, HandForce.name}
