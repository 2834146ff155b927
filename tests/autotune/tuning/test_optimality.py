"""The conditions of an optimum: met by the result, not met beside it, and their multipliers are prices."""

from dataclasses import replace

import numpy as np
import pytest

from autotune.tuning.optimality import Row, active_rows, check_optimality, unit_widths
from autotune.tuning.search import Search
from problems.contact.transient import Approach
from problems.design.evaluation import build_scenarios
from problems.design.problem import VARIABLES, Requirements
from tests.autotune.tuning.cases import design_problem, solved

FAR = 0.3


def test_the_result_meets_the_conditions() -> None:
    found = check_optimality(solved().active, solved().design)
    assert found.relative_residual < 1e-3
    assert found.slack < 1e-3
    assert found.exact_share == 1.0
    assert found.multipliers["modulus_margin"] > 0.1
    assert all(value >= 0.0 for value in found.multipliers.values())


@pytest.mark.parametrize("variable", range(4))
def test_a_design_beside_the_result_does_not(variable: int) -> None:
    """Moved away from the limits: nothing holds the peak up there, so the whole gradient is left."""
    moved = solved().design.copy()
    moved[1] *= 1.05
    moved[variable] *= 1.02
    found = check_optimality(solved().active, moved)
    assert found.relative_residual > 0.1


def test_every_gradient_is_that_of_the_evaluation() -> None:
    problem = design_problem(
        requirements=replace(solved().problem.requirements, decay_rate_per_s=0.5, max_peak_force_n=60.0)
    )
    prepared, design = build_scenarios(problem, problem.scenarios(2, 2)), solved().design
    widths = unit_widths(problem, design)
    _, limits = active_rows(prepared, design, near=10.0)
    worst: dict[str, Row] = {}
    for row in limits:
        if row.name not in worst or row.value > worst[row.name].value:
            worst[row.name] = row
    assert set(worst) == set(prepared.evaluate(design, peaks_if_missed=True).requirements)
    for i in range(len(VARIABLES)):
        step = np.zeros(len(VARIABLES))
        step[i] = 1e-5 * widths[i]
        up, down = (prepared.evaluate(design + sign * step, peaks_if_missed=True).requirements for sign in (1.0, -1.0))
        for name, row in worst.items():
            slope = (np.log(up[name]) - np.log(down[name])) / 2e-5
            assert row.gradient[i] == pytest.approx(slope, abs=0.01 * max(float(np.linalg.norm(row.gradient)), 1e-3))


def test_a_force_that_only_creeps_up_is_differentiated_by_differences() -> None:
    """Slow and heavily damped: the peak is the driving force itself, which no gain changes."""
    problem = replace(design_problem(requirements=Requirements(modulus_margin=0.1)), approach=Approach(force_n=30.0))
    prepared = build_scenarios(problem, problem.scenarios(2, 2)[:1])
    design = np.array([1.0, 4.0e4, 0.0, 0.0])
    peaks, _ = active_rows(prepared, design)
    assert np.exp(peaks[0].value) == pytest.approx(30.0, rel=0.02)
    assert np.linalg.norm(peaks[0].gradient) < 0.02
    assert check_optimality(prepared, design).relative_residual >= 0.0


def test_a_variable_fixed_by_its_bounds_does_not_move() -> None:
    problem = design_problem(bounds={**solved().problem.bounds, "lead_s": (0.02, 0.02)})
    design = Search(problem, 0).box.design(np.full(4, 0.5))
    assert unit_widths(problem, design)[2] == 0.0
