"""How a result stands: recomputed, rounded to what the numbers tell and never to the better side."""

from dataclasses import replace

import pytest

from autotune.tuning.optimality_report import OptimalityReport, optimality_tree, report_optimality
from autotune.tuning.search import SearchResult
from problems.design.batch_evaluation import build_batch_evaluator
from problems.design.evaluation import build_scenarios
from tests.autotune.tuning.cases import fast_optimized, solved


def standing() -> OptimalityReport:
    return fast_optimized().optimality_reports["x"]


def search() -> SearchResult:
    return fast_optimized().searches["x"]


def test_what_is_told_is_met_is_met_over_the_whole_grid() -> None:
    found = standing()
    assert found.is_feasible
    assert found.scenario_count == search().scenario_count
    assert found.nearest is not None
    # By the compiled screen, over a grid that the search did not use.
    problem = search().problem
    screen = build_batch_evaluator(build_scenarios(problem, problem.scenarios(11, 2)))
    other = screen.evaluate(search().design[None]).requirements
    assert all(float(value[0]) <= found.ratio + 1e-6 for value in other.values())
    assert found.ratio == pytest.approx(1.0, abs=1e-3)


def test_a_missed_requirement_is_told() -> None:
    missed = replace(search().evaluation, requirements={"modulus_margin": 1.01, "phase_margin_deg": 0.5})
    found = report_optimality(replace(search(), evaluation=missed))
    assert not found.is_feasible
    tree = optimality_tree(found, rotational=False)
    assert (tree["feasible"], tree["nearest_requirement"], tree["required_per_achieved"]) == (
        False,
        "modulus_margin",
        1.01,
    )


@pytest.mark.parametrize(("rotational", "unit"), [(False, "n"), (True, "n_m")])
def test_the_tree_is_rounded_upwards_and_names_its_units(rotational: bool, unit: str) -> None:
    found = standing()
    tree = optimality_tree(found, rotational=rotational)
    assert tree["kkt_residual"] >= found.optimality.relative_residual
    assert tree["unused_slack"] >= found.optimality.slack
    assert found.gap <= tree["gap"] <= max(1.1 * found.gap, 1e-5)
    assert tree["gap_against"][f"least_{unit}"] == pytest.approx(found.reference.least_n, rel=1e-4)
    assert {each["name"] for each in tree["active"]} == {each.name for each in found.active}
    assert all(f"price_{unit}_per_percent" in each for each in tree["active"])


def test_nothing_found_elsewhere_is_told_as_nothing() -> None:
    alone = replace(standing(), reference=replace(standing().reference, elsewhere_n=float("inf"), arrived=0))
    assert optimality_tree(alone, rotational=False)["gap_against"]["from_elsewhere_n"] is None


def test_the_bound_that_a_design_rests_on_is_among_the_prices() -> None:
    tree = optimality_tree(report_optimality(solved()), rotational=False)
    assert "lower bound of mass" in {each["name"] for each in tree["active"]}
