"""The nearest design that meets everything."""

import numpy as np

from autotune.explore.design_map import build_window, compute_map
from autotune.explore.sliders import nominal_values, scenario_at
from autotune.explore.view import find_way_back, prepare_view
from autotune.tuning.bounds import Box
from problems.design.evaluation import build_scenarios
from tests.autotune.explore.start import DESIGN, small_exploration

START = small_exploration().axes["x"]
PREPARED = prepare_view(
    START.problem, scenario_at(START.problem, nominal_values(START.problem)), START.problem.scenarios(2, 2)
)


def distance(one: np.ndarray, other: np.ndarray) -> float:
    box = Box(START.problem)
    return float(np.linalg.norm(box.unit(one) - box.unit(other)))


def judged(design: np.ndarray) -> bool:
    return build_scenarios(START.problem, PREPARED.scenarios).evaluate(design).is_feasible


def test_the_line_to_the_start_ends_where_everything_is_met() -> None:
    lost = np.array([6.0, 450.0, 0.0, 0.005])
    assert not judged(lost)
    found = find_way_back(PREPARED, lost, DESIGN, None)
    assert found is not None
    assert "of the way to the start" in found.found
    assert judged(found.design)
    # One step of the forty earlier nothing was met.
    share = distance(lost, found.design) / distance(lost, DESIGN) - 1.0 / 40.0
    box = Box(START.problem)
    before = box.design(box.unit(lost) + share * (box.unit(DESIGN) - box.unit(lost)))
    assert not judged(before)


def test_a_cell_of_the_map_that_is_nearer_is_taken() -> None:
    near = np.array([6.0, 1900.0, 0.018, 0.005])
    assert not judged(near)
    around = compute_map(
        PREPARED.screen, near, build_window(START.problem, near, ("damping", "lead_s"), columns=40, rows=30)
    )
    by_line, by_both = (
        find_way_back(PREPARED, near, np.array([6.0, 1250.0, 0.018, 0.04]), each) for each in (None, around)
    )
    assert by_both is not None
    assert judged(by_both.design)
    assert "map" in by_both.found
    assert by_line is None or distance(near, by_both.design) <= distance(near, by_line.design)


def test_without_feasible_ground_there_is_no_way_back() -> None:
    lost = np.array([6.0, 450.0, 0.0, 0.005])
    assert find_way_back(PREPARED, lost, lost, None) is None
