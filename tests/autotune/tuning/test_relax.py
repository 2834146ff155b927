"""Relaxations of an infeasible problem: enough, not more than needed, and reached by a design."""

from dataclasses import replace
from typing import Any

import pytest

from autotune.errors import InfeasibleError
from autotune.tuning.relax import Relaxation, asked_numbers, find_relaxations, relaxation_message
from autotune.tuning.search import solve_design
from problems.design.batch_result import EVERY_REQUIREMENT
from problems.design.problem import AdmittanceTarget, DesignProblem, PassivityTarget, Requirements
from tests.autotune.tuning.cases import design_problem

# Few requirements: each one is a search of its own.
FEW = Requirements(gain_margin_db=None, phase_margin_deg=None, delay_margin_s=None)


def eased(problem: DesignProblem, relaxation: Relaxation, share: float = 0.0) -> DesignProblem:
    """Return the problem with the relaxation, its step made smaller by a share."""
    value = relaxation.possible + share * (relaxation.asked - relaxation.possible)
    requirements = problem.requirements
    if relaxation.name == "free_space_admittance":
        assert requirements.free_space_admittance is not None
        target = replace(requirements.free_space_admittance, min_m_s_per_n=value)
        return replace(problem, requirements=replace(requirements, free_space_admittance=target))
    change: dict[str, Any] = {relaxation.name: value}
    return replace(problem, requirements=replace(requirements, **change))


def test_each_relaxation_is_enough_and_a_twentieth_less_is_not() -> None:
    problem = design_problem(requirements=replace(FEW, max_peak_force_n=50.0))
    with pytest.raises(InfeasibleError):
        solve_design(problem)
    found = find_relaxations(problem)
    assert {"free_space_admittance", "max_peak_force_n"} <= {each.name for each in found}
    assert [each.share for each in found] == sorted(each.share for each in found)
    for relaxation in found[:2]:
        assert solve_design(eased(problem, relaxation, -0.01)).evaluation.is_feasible
        with pytest.raises(InfeasibleError):
            solve_design(eased(problem, relaxation, 0.05))


def test_where_no_single_requirement_is_enough_all_together_are_eased() -> None:
    target = AdmittanceTarget(min_m_s_per_n=1.5e-3)
    problem = design_problem(requirements=replace(FEW, max_peak_force_n=30.5, free_space_admittance=target))
    (found,) = find_relaxations(problem)
    assert found.name == EVERY_REQUIREMENT
    assert 5.0 < found.possible < 100.0
    assert found.describe("") == f"all requirements together at {found.possible:g} % of what is asked"
    share = found.possible / 100.0
    asked: dict[str, Any] = {name: value * share for name, value in asked_numbers(problem).items()}
    asked["max_peak_force_n"] = 30.5 / share
    easier = AdmittanceTarget(min_m_s_per_n=asked.pop("free_space_admittance") * 0.999)
    solved = solve_design(design_problem(requirements=replace(FEW, free_space_admittance=easier, **asked)))
    assert solved.evaluation.is_feasible


def test_nothing_is_reported_where_nothing_is_stable() -> None:
    problem = design_problem(bounds={"mass": (1.0, 1.0), "damping": (5.0, 6.0), "lead_s": (0.0, 0.0)})
    with pytest.raises(InfeasibleError, match="stable"):
        solve_design(problem)
    assert find_relaxations(problem) == ()


def test_the_command_is_relaxed_like_the_loop_and_soft_limits_are_no_obstacle() -> None:
    asked = replace(FEW, passivity=PassivityTarget(passive_below_hz=80.0), soft_n={"free_space_admittance": 5.0})
    problem = design_problem(requirements=asked)
    assert asked_numbers(problem) == {"modulus_margin": 0.5, "passivity": 80.0}
    done: list[float] = []
    found = {each.name: each for each in find_relaxations(problem, progress=done.append)}
    assert sum(done) == pytest.approx(1.0)
    assert len(done) > 20
    possible = found["passivity"].possible
    assert 40.0 < possible < 80.0
    easier = replace(asked, passivity=PassivityTarget(passive_below_hz=possible))
    assert solve_design(design_problem(requirements=easier)).evaluation.is_feasible


def test_what_would_be_enough_and_what_would_not_is_reported() -> None:
    problem = design_problem(requirements=replace(FEW, delay_margin_s=1e-3, decay_rate_per_s=3.0))
    enough = Relaxation(name="modulus_margin", asked=0.9, possible=0.641)
    rest = "Or narrow the ranges of stiffness and payload, or widen the bounds."
    assert relaxation_message(problem, [enough]) == (
        "Enough by itself would be: modulus_margin 0.641 instead of 0.9. No easing of delay_margin_s, "
        f"decay_rate_per_s or free_space_admittance alone was found to be enough. {rest}"
    )
    together = Relaxation(name=EVERY_REQUIREMENT, asked=100.0, possible=77.7)
    assert relaxation_message(problem, [together]) == (
        "No single requirement was found that would be enough to ease; enough would be: all requirements "
        f"together at 77.7 % of what is asked. {rest}"
    )
