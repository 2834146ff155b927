"""How a result stands: recomputed, rounded to what the numbers tell and never to the better side."""

import math
from dataclasses import replace

import numpy as np
import pytest

from autotune.tuning.optimality import check_optimality
from autotune.tuning.optimality_report import (
    ActiveConstraint,
    OptimalityReport,
    Reference,
    active_constraints,
    find_reference,
    optimality_tree,
    report_optimality,
)
from autotune.tuning.search import SearchResult, solve_design
from problems.design.batch_evaluation import build_batch_evaluator
from problems.design.evaluation import build_scenarios
from problems.design.problem import AdmittanceTarget, Requirements
from tests.autotune.tuning.cases import design_problem, fast_optimized, relaxed, solved


def standing() -> OptimalityReport:
    return fast_optimized().optimality_reports["x"]


def search() -> SearchResult:
    return fast_optimized().searches["x"]


def test_what_is_reported_is_met_is_met_over_the_whole_grid() -> None:
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


def test_a_missed_requirement_is_reported() -> None:
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
    assert tree["gap_against"][f"least_{unit}"] == pytest.approx(found.reference.least, rel=1e-4)
    assert {each["name"] for each in tree["active"]} == {each.name for each in found.active}
    assert all(f"price_{unit}_per_percent" in each for each in tree["active"])


def test_nothing_found_elsewhere_is_reported_as_nothing() -> None:
    alone = replace(standing(), reference=replace(standing().reference, elsewhere=float("inf"), arrived=0))
    assert optimality_tree(alone, rotational=False)["gap_against"]["from_elsewhere_n"] is None


def test_the_bound_that_a_design_rests_on_is_among_the_prices() -> None:
    tree = optimality_tree(report_optimality(solved()), rotational=False)
    assert "lower bound of mass" in {each["name"] for each in tree["active"]}


def moved(share: float) -> SearchResult:
    """Return the solution with more damping: gentler nowhere, and still feasible over what the search looked at."""
    found = solved()
    design = found.design * np.array([1.0, 1.0, 1.0 - share, 1.0])
    evaluation = found.active.evaluate(design, peaks_if_missed=True)
    return replace(found, design=design, evaluation=evaluation)


def test_descents_from_elsewhere_end_at_the_search_s_own_optimum() -> None:
    found, reference = solved(), find_reference(solved())
    assert reference.arrived >= 1
    # Less is asked: nothing in reserve, fewer scenarios. That is worth less than the search's own tolerance of 1e-3.
    assert reference.least <= found.evaluation.cost
    assert reference.gap(found.evaluation.cost) < 1e-3
    assert reference.elsewhere == pytest.approx(reference.from_here, rel=1e-4)
    assert reference == find_reference(solved())


def test_a_design_that_is_not_the_best_has_the_gap_that_it_was_given() -> None:
    worse = moved(0.05)
    given = worse.evaluation.cost / solved().evaluation.cost - 1.0
    assert given > 5e-3
    reference = find_reference(worse)
    assert reference.gap(worse.evaluation.cost) == pytest.approx(given, abs=1e-3)
    # Where the design stands does not matter to what is found elsewhere.
    assert reference.elsewhere == find_reference(solved()).elsewhere


def test_without_anything_from_elsewhere_the_descent_from_here_is_the_reference() -> None:
    alone = Reference(elsewhere=math.inf, from_here=50.0, designs=128, descents=4, arrived=0, scenarios=3)
    assert alone.gap(50.5) == pytest.approx(0.01)
    assert alone.gap(49.0) == 0.0


def explained() -> tuple[ActiveConstraint, ...]:
    found = solved()
    return active_constraints(found.problem, found.evaluation.cost, check_optimality(found.active, found.design))


def test_the_active_requirements_are_reported_dearest_first() -> None:
    active = explained()
    assert [a.price for a in active] == sorted((a.price for a in active), reverse=True)
    tight = {name for name, value in solved().evaluation.requirements.items() if value > 0.999}
    assert tight
    assert tight <= {a.name for a in active}
    at_bound = [a.name for a in active if a.name.startswith("lower bound")]
    assert at_bound == ["lower bound of mass"]


def test_easing_the_dearest_requirement_and_solving_anew_saves_its_price() -> None:
    found = solved()
    dearest = next(a for a in explained() if "bound" not in a.name)
    assert dearest.price > 0.1
    eased = solve_design(relaxed(found.problem, dearest.name, 0.01))
    saved = found.evaluation.cost - eased.evaluation.cost
    # Both objectives are polished to about 1e-3 of the peak by way of their margins: 0.05 N of 55 N.
    assert saved == pytest.approx(dearest.price, abs=0.06)


@pytest.mark.parametrize(
    ("name", "before", "after"),
    [("modulus_margin", 0.5, 0.45), ("gain_margin_db", 6.0, 5.4), ("delay_margin_s", 1e-3, 9e-4)],
)
def test_easing_asks_for_less_of_one_requirement_only(name: str, before: float, after: float) -> None:
    problem = design_problem()
    eased = relaxed(problem, name, 0.1)
    assert getattr(problem.requirements, name) == before
    assert getattr(eased.requirements, name) == pytest.approx(after)
    others = [n for n in ("modulus_margin", "gain_margin_db", "phase_margin_deg", "delay_margin_s") if n != name]
    assert [getattr(eased.requirements, n) for n in others] == [getattr(problem.requirements, n) for n in others]


def test_easing_the_admittance_and_the_peak() -> None:
    target = AdmittanceTarget(min_m_s_per_n=1e-3, band_hz=(0.2, 3.0))
    problem = design_problem(requirements=Requirements(free_space_admittance=target, max_peak_force_n=100.0))
    eased = relaxed(problem, "free_space_admittance", 0.01).requirements.free_space_admittance
    assert eased is not None
    assert eased.min_m_s_per_n == pytest.approx(9.9e-4)
    assert eased.band_hz == (0.2, 3.0)
    # A limit from above is eased upwards.
    assert relaxed(problem, "max_peak_force_n", 0.01).requirements.max_peak_force_n == pytest.approx(101.0)
    without = design_problem(requirements=Requirements(free_space_admittance=None))
    assert relaxed(without, "free_space_admittance", 0.01) is without
