"""The solver's front: feasible, without a dominated point, and not beaten by every controller of a grid."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from autotune.studies.front import (
    FrontRequest,
    _most_admittance,
    prepare_fronts,
    seed_designs,
    trace_front,
    trace_fronts,
)
from autotune.studies.points import Front, Judge
from autotune.tuning.bounds import Box
from autotune.tuning.scenario_exchange import DENSE_STIFFNESS
from problems.design.evaluation import build_scenarios
from problems.design.objectives import Admittance, HandForce, PeakForce
from problems.design.problem import Requirements
from tests.autotune.studies.small import small_problem, small_search

# What the solver leaves: its reserve and six digits of each gain, of a peak.
SOLVER = 2e-3


@cache
def front() -> Front:
    return trace_front(small_search(), 4)


@cache
def every_controller() -> tuple[tuple[float, float], ...]:
    """Peak and admittance of every feasible controller of a grid over the two free numbers."""
    problem = small_problem()
    prepared, box = build_scenarios(problem, problem.scenarios(3, 2)), Box(problem)
    target = problem.requirements.free_space_admittance
    assert target is not None
    found = []
    for damping in np.linspace(0.3, 0.9, 49):
        for lead in np.linspace(0.0, 0.7, 29):
            seen = prepared.evaluate(box.design(np.array([0.0, damping, lead, 0.0])))
            if seen.is_feasible:
                found.append((seen.cost, target.min_m_s_per_n / seen.requirements["free_space_admittance"]))
    return tuple(found)


def test_no_controller_of_a_grid_beats_a_point_of_the_front() -> None:
    rivals = every_controller()
    assert len(rivals) > 20
    for point in front().points:
        peak, admittance = point.values["peak_force"], point.values["admittance"]
        as_free = [rival_peak for rival_peak, rival in rivals if rival >= admittance]
        assert min(as_free, default=np.inf) >= peak * (1.0 - SOLVER)


def test_the_ends_are_the_gentlest_and_the_freest_controller_of_the_grid() -> None:
    rivals, points = every_controller(), front().points
    assert points[0].values["peak_force"] <= min(peak for peak, _ in rivals) * (1.0 + SOLVER)
    assert points[-1].values["admittance"] >= max(free for _, free in rivals) * (1.0 - SOLVER)


def test_every_point_is_feasible_over_the_dense_grid_and_none_beats_another() -> None:
    found = front()
    assert len(found.points) >= 4
    assert found.scenario_count == DENSE_STIFFNESS  # one mass
    judge = Judge(found.problem, found.objectives)
    peaks = [point.values["peak_force"] for point in found.points]
    free = [point.values["admittance"] for point in found.points]
    assert peaks == sorted(set(peaks))
    assert free == sorted(set(free))
    for point in found.points:
        assert judge.judge(point.controller).is_feasible
    assert found.chosen == 0
    assert found.points[0].controller == found.problem.controller(small_search().design)


def test_the_same_seed_traces_the_same_front() -> None:
    again = trace_front(small_search(), 4)
    assert [(p.controller, p.values) for p in again.points] == [(p.controller, p.values) for p in front().points]


def test_without_a_target_the_sweep_begins_at_what_the_gentlest_controller_has() -> None:
    problem = replace(small_problem(), requirements=Requirements(free_space_admittance=None))
    judge = Judge(problem, front().objectives)
    gentle = np.array([6.0, 1500.0, 0.0235, 0.005])
    own = judge.judge(problem.controller(gentle))
    most, design = _most_admittance(problem, gentle, judge, 0)
    assert own.is_feasible
    assert most > own.values["admittance"]
    assert judge.judge(problem.controller(design)).is_feasible


@pytest.mark.parametrize("count", [2])
def test_two_points_are_the_two_ends(count: int) -> None:
    ends = trace_front(small_search(), count).points
    assert ends[0].controller == front().points[0].controller
    assert ends[-1].values["admittance"] == pytest.approx(front().points[-1].values["admittance"], rel=SOLVER)


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
