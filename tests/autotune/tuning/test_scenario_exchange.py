"""The search looks over the whole uncertainty, and what it returns holds where nobody looked."""

from dataclasses import replace

import numpy as np
import pytest

from autotune.tuning.scenario_exchange import WholeSet
from autotune.tuning.search import solve_design
from problems.design.evaluation import build_scenarios
from problems.design.uncertainty import Scenario
from tests.autotune.tuning.cases import FURTHER, fast_optimized, uncertain_optimized

# Requirements are held on many plants; between them a margin dips by less than this.
BETWEEN = 1e-3


def test_the_nominal_design_misses_somewhere_and_the_robust_one_nowhere() -> None:
    """Uniform draws of the whole box, which are none of the search's scenarios."""
    robust = uncertain_optimized().searches["x"]
    problem, rng = robust.problem, np.random.default_rng(17)
    nominal = solve_design(replace(problem, plants=problem.plants.only()))
    ranges = problem.plants.ranges
    draws = [Scenario(**{name: float(rng.uniform(*pair)) for name, pair in ranges.items()}) for _ in range(300)]
    prepared = build_scenarios(problem, draws)
    seen = prepared.evaluate_exactly(problem.controller(robust.design)).evaluation
    assert {name: value for name, value in seen.requirements.items() if value > 1.0 + BETWEEN} == {}
    assert seen.cost <= robust.evaluation.cost * (1.0 + 2e-3)
    flattered = prepared.evaluate_exactly(problem.controller(nominal.design)).evaluation
    assert max(flattered.requirements.values()) > 1.0 + 10.0 * BETWEEN
    # Safety costs: the same plants, more to hold.
    assert robust.evaluation.cost > nominal.evaluation.cost


def test_the_local_search_finds_what_lies_between_the_scenarios() -> None:
    """The largest miss that it returns is at least that of 300 random plants."""
    search = uncertain_optimized().searches["x"]
    problem, law = search.problem, search.problem.controller(search.design)
    found = WholeSet(problem).evaluate(law).evaluation
    others = build_scenarios(problem, problem.plants.samples(256, seed=99)).evaluate_exactly(law).evaluation
    for name in ("modulus_margin", "free_space_admittance"):
        assert found.requirements[name] >= others.requirements[name] * (1.0 - 1e-3)
    assert found.cost >= others.cost * (1.0 - 1e-3)


def test_the_whole_set_is_the_grid_alone_where_nothing_else_is_uncertain() -> None:
    problem = fast_optimized().searches["x"].problem
    assert WholeSet(problem).scenarios == problem.scenarios(33, 3)
    whole = WholeSet(uncertain_optimized().searches["x"].problem)
    assert all(whole.plants.contains(s) for s in whole.scenarios)
    assert {name for s in whole.scenarios for name in s.further()} == set(FURTHER)


def test_the_slowest_robot_is_the_one_that_moves_least_freely() -> None:
    whole = WholeSet(uncertain_optimized().searches["x"].problem)
    search = uncertain_optimized().searches["x"]
    (slowest,) = whole.worst_of(search.evaluation, ["free_space_admittance"], "robot")
    slow = build_scenarios(whole.problem, [slowest]).evaluate(search.design).requirements
    everything = whole.prepared.evaluate(search.design).requirements
    # The bands' points are the same for every robot without zeros.
    assert slow["free_space_admittance"] == pytest.approx(everything["free_space_admittance"], rel=1e-12)
