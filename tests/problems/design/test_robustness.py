"""The objective `robustness` is the number that the requirement `modulus_margin` is measured by."""

import pytest

from problems.design.evaluation import build_scenarios
from problems.design.objectives import BUILT_IN
from problems.design.problem import Requirements
from tests.autotune.tuning.cases import design_problem

GOOD, BETTER = (6.0, 1500.0, 0.02, 0.005), (6.0, 3000.0, 0.02, 0.005)


def test_it_is_what_the_modulus_margin_is_measured_by_and_grows_with_damping() -> None:
    problem = design_problem(requirements=Requirements(modulus_margin=0.5), bounds={})
    robustness, found = BUILT_IN["robustness"], []
    for design in (GOOD, BETTER):
        prepared = build_scenarios(problem, problem.scenarios(2, 2))
        stable = prepared.stable(problem.controller(design))
        evaluation = prepared.evaluate_stable(stable).evaluation
        found.append(robustness.worst(problem.requirements, stable))
        assert found[-1] == pytest.approx(0.5 / evaluation.requirements["modulus_margin"], rel=1e-12)
    assert found[0] < found[1] < 1.0
