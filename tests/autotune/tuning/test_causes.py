"""Why nothing is feasible: numbers of the plant that are enough, and lines for problem.yaml that a search confirms."""

from dataclasses import replace
from pathlib import Path

import pytest

from autotune.errors import InfeasibleError
from autotune.formats.canonical import lines_to_paste
from autotune.formats.problem import read_problem
from autotune.tuning import causes as causes_module
from autotune.tuning.causes import Explanation, explain, explanation_message, find_causes
from autotune.tuning.relax import Relaxation
from autotune.tuning.search import SearchResult, solve_design
from problems.design.batch_result import EVERY_REQUIREMENT
from problems.design.problem import AdmittanceTarget, DesignProblem, Requirements
from problems.model.plant_parameters import with_values
from tests.autotune.tuning.cases import design_problem

# Few requirements and one payload: the searches are short.
FEW = Requirements(
    gain_margin_db=None, phase_margin_deg=None, delay_margin_s=None, free_space_admittance=AdmittanceTarget()
)


def of_plant(problem: DesignProblem, name: str, value: float) -> DesignProblem:
    plants = problem.plants
    return replace(problem, plants=replace(plants, nominal=with_values(plants.nominal, {name: value})))


def test_missing_drag_is_named_and_the_suggested_lines_have_a_controller(tmp_path: Path) -> None:
    problem = of_plant(design_problem(requirements=FEW, mass=(16.0, 16.0)), "drag_n_s_per_m", 5.0)
    with pytest.raises(InfeasibleError):
        solve_design(problem)
    done: list[float] = []
    why = explain("x", problem, seed=0, progress=done.append)
    assert sum(done) == pytest.approx(1.0)
    causes = {each.name: each for each in why.causes}
    assert {"drag_n_s_per_m", "robot_bandwidth_hz"} <= set(causes)
    for name, cause in causes.items():
        assert cause.enough > cause.value
        # Over the whole uncertainty, where the cause was found over its corners and the middle.
        assert solve_design(of_plant(problem, name, 1.05 * cause.enough)).evaluation.is_feasible
    message = explanation_message("x", problem, why)
    assert "this payload has 5 N·s/m of damping to ground (B_p), and about " in message
    path = tmp_path / "problem.yaml"
    path.write_text("\n".join(lines_to_paste(why.suggestion)) + "\n")
    assert message.endswith("; ".join(lines_to_paste(why.suggestion)))
    asked = read_problem(path).requirements.free_space_admittance
    assert asked is not None
    assert not asked.is_default
    again = solve_design(replace(problem, requirements=replace(FEW, free_space_admittance=asked)))
    assert why.found is not None
    assert again.evaluation.cost == why.found.evaluation.cost


def test_where_no_number_is_enough_by_itself_two_together_are_named() -> None:
    few = replace(FEW, free_space_admittance=AdmittanceTarget(min_m_s_per_n=7e-4))
    problem = design_problem(requirements=few, mass=(16.0, 16.0), stiffness=(2e4, 5e5))
    problem = of_plant(of_plant(problem, "drag_n_s_per_m", 5.0), "robot_bandwidth_hz", 1.0)
    assert find_causes(problem, seed=0) == ()
    pairs = find_causes(problem, seed=0, together=2)
    assert len(pairs) > 1
    drag, robot = next(
        pair for pair in pairs if {each.name for each in pair} == {"drag_n_s_per_m", "robot_bandwidth_hz"}
    )
    better = of_plant(problem, drag.name, drag.enough)
    assert solve_design(of_plant(better, robot.name, 1.05 * robot.enough)).evaluation.is_feasible
    with pytest.raises(InfeasibleError):
        solve_design(better)
    relaxation = Relaxation(name="free_space_admittance", asked=7e-4, possible=1e-4)
    message = explanation_message("x", problem, Explanation(relaxations=(relaxation,), pairs=pairs))
    assert (
        "Two together would be enough: about 89 N·s/m of damping to ground and a robot to about 3.4 Hz; or " in message
    )


def test_where_no_number_of_the_plant_is_enough_that_is_said() -> None:
    problem = design_problem(requirements=FEW)
    why = Explanation(
        relaxations=(Relaxation(name="free_space_admittance", asked=7e-4, possible=1e-4, damping=9876.0),)
    )
    message = explanation_message("x", problem, why)
    assert "free_space_admittance 0.0001 instead of 0.0007 m/s/N (with B_a 9.88e+03)" in message
    assert "8.91e+03 N·s/m of damping to ground (B_p) would not be enough" in message
    assert "problem.yaml" not in message


def test_all_requirements_are_eased_together_each_in_its_own_direction() -> None:
    asked = replace(FEW, max_peak_force_n=50.0, soft_n={"modulus_margin": 3.0})
    together = Relaxation(name=EVERY_REQUIREMENT, asked=100.0, possible=80.0).within(asked)
    assert together.max_peak_force_n == 62.5
    assert together.threshold("free_space_admittance") == pytest.approx(5.6e-4)
    assert together.modulus_margin == 0.5
    alone = Relaxation(name="max_peak_force_n", asked=50.0, possible=60.0).within(asked, 0.1)
    assert (alone.max_peak_force_n, alone.threshold("free_space_admittance")) == (66.0, 7e-4)


@pytest.mark.parametrize(
    ("name", "possible", "is_tried"),
    [
        (EVERY_REQUIREMENT, 10.4, False),
        (EVERY_REQUIREMENT, 47.0, True),
        ("modulus_margin", 0.003, False),
        ("free_space_admittance", 1e-4, True),
    ],
)
def test_no_controller_without_a_margin_worth_the_name_is_offered(
    monkeypatch: pytest.MonkeyPatch, name: str, possible: float, is_tried: bool
) -> None:
    """Who pastes such lines has a controller that the next surface makes unstable; what a hand feels may be little."""
    tried: list[DesignProblem] = []

    def searched(problem: DesignProblem, **_: object) -> SearchResult:
        tried.append(problem)
        raise InfeasibleError("Nothing.")

    monkeypatch.setattr("autotune.tuning.causes.solve_design", searched)
    problem = design_problem()
    asked = 100.0 if name == EVERY_REQUIREMENT else problem.requirements.threshold(name)
    relaxation = Relaxation(name=name, asked=asked, possible=possible)
    assert causes_module._checked("x", problem, (relaxation,), 0) == ({}, None)
    assert bool(tried) is is_tried


def test_a_suggestion_for_a_turning_axis_is_in_its_units() -> None:
    tree = {
        "rotational": {"requirements": {"free_space_admittance": {"min_rad_s_per_n_m": 0.0123, "band_hz": [0.1, 2.0]}}}
    }
    assert lines_to_paste(tree) == (
        "rotational: {requirements: {free_space_admittance: {min_rad_s_per_n_m: 0.0123, band_hz: [0.1, 2.0]}}}",
    )
