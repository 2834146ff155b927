"""Objectives: gradients as differences have them, costs that order as they should, and what no search may minimise."""

from dataclasses import replace
from functools import cache
from typing import ClassVar

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from problems.design.evaluation import CustomObjective, Evaluation, build_scenarios
from problems.design.objectives import BUILT_IN, Direction, Objective
from problems.design.problem import DesignProblem, Requirements
from problems.design.stable_design import StableDesign
from problems.errors import ParameterError
from problems.model.controller import AdmittanceController
from tests.autotune.tuning.cases import design_problem

GOOD = np.array([6.0, 1500.0, 0.02, 0.005])


class Height(CustomObjective):
    """The peak at the contact, as one function of the evaluation."""

    name: ClassVar[str] = "height"
    unit: ClassVar[str] = "N"
    direction: ClassVar[Direction] = "minimize"

    def __call__(self, controller: AdmittanceController, problem: DesignProblem, evaluation: Evaluation) -> float:
        return max(peak.peak_contact_force_n for peak in evaluation.peaks)


class Nothing(Height):
    name: ClassVar[str] = "nothing"

    def __call__(self, controller: AdmittanceController, problem: DesignProblem, evaluation: Evaluation) -> float:
        return 0.0


@cache
def stable(change: int | None = None, step: float = 0.0) -> StableDesign:
    """Return the good design, or one with a variable changed by a share."""
    problem, design = design_problem(), GOOD.copy()
    if change is not None:
        design[change] *= 1.0 + step
    prepared = build_scenarios(problem, problem.scenarios(2, 2))
    return prepared.stable(problem.controller(design))


@pytest.mark.parametrize("name", BUILT_IN)
def test_an_exact_gradient_is_that_of_differences(name: str) -> None:
    objective, asked, step = BUILT_IN[name], Requirements(), 1e-4
    found = [objective.gradient(asked, stable(), row) for row in range(objective.count(stable().prepared))]
    assert all(found) or not any(found)
    for row, gradient in enumerate(found):
        if gradient is None:
            continue
        assert gradient.value == pytest.approx(objective.achieved(asked, stable(), row), rel=2e-3)
        exact = gradient.by_controller[:4] * GOOD
        up, down = (
            np.array([objective.achieved(asked, stable(i, sign * step), row) for i in range(4)]) for sign in (1.0, -1.0)
        )
        # Of the second order in the step, beside what the largest of them is.
        assert (up - down) / (2.0 * step) == pytest.approx(exact, abs=1e-3 * np.max(np.abs(exact)))


@pytest.mark.parametrize("name", BUILT_IN)
def test_the_worst_is_the_dearest_row_and_its_scenario_has_it(name: str) -> None:
    objective, asked, design = BUILT_IN[name], Requirements(), stable()
    costs = objective.costs(asked, design)
    assert objective.worst(asked, design) == pytest.approx(objective.value(np.max(costs)), rel=1e-14)
    problem = design_problem()
    alone = build_scenarios(problem, [objective.worst_scenario(asked, design)]).stable(design.controller)
    assert objective.worst(asked, alone) == pytest.approx(objective.worst(asked, design), rel=1e-9)


@given(st.lists(st.floats(1e-6, 1e6), min_size=2, max_size=5))
def test_what_costs_more_is_worse(numbers: list[float]) -> None:
    for objective in BUILT_IN.values():
        costs = objective.value(np.array(numbers))
        worst = numbers[int(np.argmax(costs))]
        assert worst == (max(numbers) if objective.direction == "minimize" else min(numbers))
        assert objective.value(costs) == pytest.approx(np.array(numbers), rel=1e-14)


def test_one_function_of_the_evaluation_counts_as_its_rows_do() -> None:
    built_in, own = (
        build_scenarios(problem, problem.scenarios(2, 2)).evaluate(GOOD, peaks_if_missed=True)
        for problem in (replace(design_problem(), objective=each) for each in (BUILT_IN["contact_force"], Height()))
    )
    assert own.cost == built_in.cost
    assert own.objective[0].scenario == max(built_in.objective, key=lambda row: row.cost).scenario


def test_objectives_are_values() -> None:
    assert Height() == Height()
    assert len({*BUILT_IN.values(), Height(), Height()}) == len(BUILT_IN) + 1


def test_a_number_that_has_no_ratio_is_refused() -> None:
    with pytest.raises(ParameterError, match=r"objective nothing must be a finite number above 0 .*, found 0\.0"):
        build_scenarios(problem := replace(design_problem(), objective=Nothing()), problem.scenarios(2, 2)).evaluate(
            GOOD, peaks_if_missed=True
        )


@pytest.mark.parametrize("objective", [BUILT_IN["robustness"], Height()])
def test_prices_in_newtons_are_refused_where_no_force_is_minimised(objective: Objective) -> None:
    with pytest.raises(ParameterError, match=rf"soft_n must be left out: .* the objective is {objective.name}"):
        replace(
            design_problem(requirements=Requirements(soft_n={"modulus_margin": 20.0})),
            objective=objective,
        )


def test_the_table_of_a_problem_names_what_is_maximised() -> None:
    said = str(replace(design_problem(), objective=BUILT_IN["robustness"])).splitlines()[0]
    assert said.split(maxsplit=1) == ["maximise", "the least modulus margin, worst over the whole uncertainty"]
