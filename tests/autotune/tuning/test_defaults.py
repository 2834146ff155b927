"""The default admittance follows the cell: its band the robot, its level what can be had; what is asked stays."""

import math
import pickle
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import autotune as at
from autotune.formats.problem import read_problem
from autotune.formats.records import record_tree
from autotune.tuning.defaults import beside_margins, default_admittance, default_message, follow_robot, lower_default
from autotune.tuning.relax import find_relaxations
from autotune.tuning.search import solve_design
from problems.design.problem import AdmittanceTarget, Requirements
from problems.design.requirements import ContactAtSpeed
from problems.model.robot import RobotModel
from tests.autotune.tuning.cases import design_problem

ONE_POLE = RobotModel.from_bandwidth(bandwidth_rad_per_s=2.0 * math.pi * 3.6, delay_s=2e-3)
# Few requirements and one scenario: the searches are short.
FEW = Requirements(gain_margin_db=None, phase_margin_deg=None, delay_margin_s=None)


def band(asked: Requirements, robot: RobotModel) -> tuple[float, float]:
    target = follow_robot(asked, robot).free_space_admittance
    assert target is not None
    return target.band_hz


@pytest.mark.parametrize(("bandwidth_hz", "end_hz"), [(3.6, 1.2), (3.2, 1.0), (6.5, 2.0), (30.0, 2.0), (0.15, 0.05)])
def test_the_default_band_ends_at_a_third_of_the_bandwidth_and_at_2_hz_at_most(
    bandwidth_hz: float, end_hz: float
) -> None:
    robot = RobotModel.from_bandwidth(bandwidth_rad_per_s=2.0 * math.pi * bandwidth_hz, delay_s=2e-3)
    # Two digits, downwards; the lower end never lies above the upper one.
    assert band(Requirements(), robot) == (min(0.1, end_hz), end_hz)


def test_up_to_there_a_robot_of_one_pole_follows_to_a_twentieth() -> None:
    _, end_hz = band(Requirements(), ONE_POLE)
    (response,) = abs(ONE_POLE.position_response(2.0 * math.pi * end_hz * np.ones(1)))
    assert response == pytest.approx(1.0 / math.hypot(1.0, 1.0 / 3.0), rel=1e-6)
    assert response > 0.94


def test_what_somebody_asked_for_stays_as_it_is() -> None:
    said = Requirements(free_space_admittance=AdmittanceTarget())
    assert follow_robot(said, ONE_POLE) is said
    nothing = Requirements(free_space_admittance=None)
    assert follow_robot(nothing, ONE_POLE) is nothing
    # Another requirement that is said leaves the default a default, and so do copies of it.
    other = pickle.loads(pickle.dumps(replace(Requirements(modulus_margin=0.6), gain_margin_db=None)))
    assert band(other, ONE_POLE) == (0.1, 1.2)


def test_a_file_that_asks_for_the_usual_numbers_asks_for_them(tmp_path: Path) -> None:
    path = tmp_path / "problem.yaml"
    path.write_text("requirements: {free_space_admittance: {min_m_s_per_n: 7.0e-4, band_hz: [0.1, 2.0]}}\n")
    assert band(read_problem(path).requirements, ONE_POLE) == (0.1, 2.0)
    path.write_text("requirements: {modulus_margin: 0.6}\n")
    assert band(read_problem(path).requirements, ONE_POLE) == (0.1, 1.2)


def test_whether_it_was_asked_for_is_neither_compared_nor_written() -> None:
    default = Requirements().free_space_admittance
    assert default == AdmittanceTarget()
    assert record_tree(default) == {"min_m_s_per_n": 7e-4, "band_hz": [0.1, 2.0]}


def test_a_default_that_cannot_be_had_is_lowered_to_what_can() -> None:
    default = AdmittanceTarget(min_m_s_per_n=5e-3, is_default=True)
    problem = design_problem(requirements=replace(FEW, free_space_admittance=default), mass=(16.0, 16.0))
    lowered = lower_default(problem, seed=0)
    assert lowered is not None
    found = solve_design(lowered)
    assert found.evaluation.is_feasible
    reported = default_admittance(problem, found)
    assert reported is not None
    assert reported.attainable is not None
    assert found.problem.requirements.threshold("free_space_admittance") == reported.target.min_m_s_per_n
    message = default_message("x", reported, found.problem)
    assert "the usual 0.005 cannot be had in this cell" in message
    assert f"{reported.target.min_m_s_per_n:g} m/s/N are asked" in message
    assert (
        f"at 0.1 m/s a hand needs up to {0.1 / reported.target.min_m_s_per_n:.3g} N, with the usual one 20." in message
    )
    # A quarter above four fifths is all that can be had: a little more than that has no controller.
    more = replace(default, min_m_s_per_n=1.1 * reported.attainable)
    again = lower_default(
        replace(problem, requirements=replace(problem.requirements, free_space_admittance=more)), seed=0
    )
    assert again is not None
    asked = replace(problem.requirements, free_space_admittance=AdmittanceTarget(min_m_s_per_n=5e-3))
    assert lower_default(replace(problem, requirements=asked), seed=0) is None


def test_beside_a_limit_of_the_peak_the_default_is_what_margins_leave() -> None:
    """What is said of a limit that cannot be met is not about an admittance that nobody asked for."""
    default = AdmittanceTarget(min_m_s_per_n=5e-3, is_default=True)
    asked = replace(FEW, free_space_admittance=default)
    problem = design_problem(requirements=asked, mass=(16.0, 16.0))
    hard = replace(
        problem, requirements=asked.with_asked("contact_at_speed", ContactAtSpeed(speed_m_s=1.0, max_force_n=5.0))
    )
    assert lower_default(hard, seed=0) is None
    eased, lowered = beside_margins(hard, seed=0), lower_default(problem, seed=0)
    assert lowered is not None
    assert eased.requirements.free_space_admittance == lowered.requirements.free_space_admittance
    assert eased.requirements.asked()["contact_at_speed"] == hard.requirements.asked()["contact_at_speed"]
    assert beside_margins(problem, seed=0) is problem
    (relaxation,) = (each for each in find_relaxations(eased) if each.name == "contact_at_speed")
    assert relaxation.possible > 5.0


def test_the_price_of_the_band_is_that_of_a_search_with_the_usual_one() -> None:
    fixed = design_problem(requirements=FEW, mass=(16.0, 16.0))
    narrow = replace(fixed, requirements=follow_robot(FEW, fixed.plants.nominal.robot))
    found = solve_design(narrow)
    reported = default_admittance(narrow, found)
    assert reported is not None
    assert reported.attainable is None
    assert reported.objective == found.evaluation.cost
    assert reported.objective_with_usual == pytest.approx(solve_design(fixed).evaluation.cost, rel=5e-3)
    assert reported.objective_with_usual is not None
    assert reported.objective_with_usual > reported.objective
    assert default_admittance(fixed, solve_design(fixed)) is None


def test_the_default_stays_where_a_freer_structure_has_it_beside_a_limit_of_the_peak() -> None:
    """Four gains in their bounds have it above 45 N only; at the same noise, with wider bounds, a law has 40 N."""
    plant = at.Plant(
        mass=16.2,
        coupling_stiffness=3.1e5,
        coupling_damping=150,
        drag=330,
        robot=at.Robot(bandwidth=3.18, delay=2.4e-3),
        environment_stiffness=1.2e5,
        sample_time=8e-4,
        force_noise=0.14,
    )
    design = at.optimize(plant, problem=at.Problem(requirements=at.Requirements(max_peak_force_n=42.0)))
    assert design.optimized is not None
    found = design.optimized.searches["x"]
    target = found.problem.requirements.free_space_admittance
    assert target is not None
    assert target.min_m_s_per_n == AdmittanceTarget().min_m_s_per_n
    assert 38.0 < found.evaluation.cost < 42.0
    assert not any("cannot be had" in each for each in design.notes)
