"""What a file gives to explore, and what a saved design must pass."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from autotune.errors import CertificateError, InfeasibleError, UsageError
from autotune.explore import saving as save_module
from autotune.explore import source as source_module
from autotune.explore.saving import Target, changed_lines, save_controller
from autotune.explore.source import _bounds, problem_of, read_exploration, with_requirements
from autotune.formats.certificate_record import SoftRequirement
from autotune.formats.controller import read_controller, write_controller
from autotune.formats.controller_record import Controller, ControllerStatus
from autotune.formats.problem import read_problem
from autotune.tuning.record import build_domain
from autotune.tuning.strategies import StrategySettings
from autotune.tuning.threshold import ThresholdSettings
from problems.design.evaluation import build_scenarios
from problems.design.problem import AdmittanceTarget
from problems.model.controller import AdmittanceController
from problems.model.plant import WrenchFilter
from tests.autotune.explore.start import solved_exploration
from tests.autotune.tuning.cases import FAST_PROBLEM_YAML, FAST_REQUIREMENTS, FURTHER, fast_optimized, write_plant
from tests.autotune.tuning.responding import responding


def refuse(*_arguments: object, **_options: object) -> None:
    raise InfeasibleError("No controller within the bounds meets all requirements.")


def test_the_problem_of_a_controller_is_the_one_that_it_was_tuned_for() -> None:
    done = fast_optimized()
    problem, asked = problem_of(done.controller, "x"), done.searches["x"].problem
    assert build_domain(problem) == done.controller.certificate.domain["x"] == build_domain(asked)
    assert problem.requirements == asked.requirements
    assert problem.sample_time_s == asked.sample_time_s


def test_what_is_uncertain_and_what_is_only_wished_are_kept() -> None:
    wished = replace(FAST_REQUIREMENTS, gain_margin_db=None, soft_n={"delay_margin_s": 2.0})
    solved = fast_optimized().searches["x"].problem
    asked = replace(solved, plants=solved.plants.with_ranges(FURTHER), requirements=wished)
    controller = fast_optimized().controller
    hard = {key: value for key, value in controller.certificate.requirements.items() if not key.startswith(("g", "d"))}
    certificate = replace(
        controller.certificate,
        domain={"x": build_domain(asked)},
        requirements=hard,
        soft={"x": {"delay_margin_s": SoftRequirement(asked=1e-3, soft_n=2.0, achieved=3e-3)}},
    )
    problem = problem_of(replace(controller, certificate=certificate), "x")
    assert build_domain(problem) == build_domain(asked)
    assert problem.requirements == wished


@pytest.mark.parametrize("wrench", [WrenchFilter(time_constant_s=3e-3), WrenchFilter(delay_s=2e-3)])
def test_the_filter_of_the_wrench_is_kept_and_nothing_reads_the_position_beside_a_late_one(
    wrench: WrenchFilter,
) -> None:
    controller = fast_optimized().controller
    domain = replace(controller.certificate.domain["x"], wrench_filter=wrench)
    gains = {"x": replace(controller.axes["x"], feedback_damping_s=0.0)}
    certificate = replace(controller.certificate, domain={"x": domain})
    problem = problem_of(replace(controller, axes=gains, certificate=certificate), "x")
    assert problem.plants.nominal.wrench_filter == wrench
    assert build_domain(problem) == domain
    assert (problem.bounds["feedback_damping_s"] == (0.0, 0.0)) == (wrench.delay_s > 0.0)


def test_filters_and_compensation_of_a_controller_are_kept() -> None:
    controller = fast_optimized().controller
    filters = replace(controller.filters, velocity_rad_per_s=90.0, acceleration_rad_per_s=150.0)
    problem = problem_of(replace(controller, filters=filters, compensation_mass_kg=4.0), "x")
    law = problem.controller([problem.bounds[name][0] for name in problem.variables])
    assert (law.velocity_filter_rad_per_s, law.acceleration_filter_rad_per_s, law.compensation_mass_kg) == (90, 150, 4)


def test_a_controller_starts_where_it_is_and_keeps_its_deadband(tmp_path: Path) -> None:
    controller = fast_optimized().controller
    path = tmp_path / "old.yaml"
    write_controller(path, replace(controller, axes={"x": replace(controller.axes["x"], deadband=3.5)}))
    found = read_exploration(path)
    gains = controller.axes["x"]
    reported = (gains.mass, gains.damping, gains.lead_s, gains.feedback_damping_s)
    assert tuple(found.axes["x"].design.tolist()) == reported
    kept = source_module.keep_deadband(found, controller)
    assert kept.axes["x"].deadband == 3.5
    assert found.provenance["options"]["controller"]["path"] == str(path)


def test_a_collision_response_is_not_kept_and_the_page_says_so(tmp_path: Path) -> None:
    write_controller(tmp_path / "old.yaml", responding().controller)
    start = read_exploration(tmp_path / "old.yaml").axes["x"]
    assert start.note == (
        "Collision response and variable damping of the file were chosen for its gains; what is saved here has none."
    )


def test_a_problem_beside_a_controller_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "old.yaml"
    write_controller(path, fast_optimized().controller)
    with pytest.raises(UsageError, match="use --problem with an identified plant"):
        read_exploration(path, tmp_path / "problem.yaml")
    path.write_text("neither: 1", encoding="utf-8")
    with pytest.raises(UsageError, match="neither a plant nor a controller"):
        read_exploration(path)


def test_where_nothing_is_feasible_the_page_starts_in_the_middle_and_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plant = write_plant(tmp_path)
    problem = tmp_path / "problem.yaml"
    problem.write_text(FAST_PROBLEM_YAML, encoding="utf-8")
    monkeypatch.setattr(source_module, "solve_design", refuse)
    start = read_exploration(plant.path, problem).axes["x"]
    assert "meets all requirements" in start.note
    for value, (low, high) in zip(start.design, start.problem.bounds.values(), strict=True):
        assert low <= value <= high


def test_plants_that_hold_the_best_design_back_are_looked_at(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    plant, found = write_plant(tmp_path), fast_optimized().searches["x"]
    grid = found.problem.scenarios(3, 2)
    delays = [replace(grid[0], delay_s=delay) for delay in np.linspace(1e-3, 4e-3, 9).tolist()]
    active = build_scenarios(found.problem, (*grid, *delays))
    monkeypatch.setattr(source_module, "solve_design", lambda *_, **__: replace(found, active=active))
    problem = tmp_path / "problem.yaml"
    problem.write_text(FAST_PROBLEM_YAML, encoding="utf-8")
    seen = read_exploration(plant.path, problem).axes["x"].scenarios
    assert set(grid) < set(seen)
    # More delay leaves less margin, and the longest ones are what counts.
    assert set(delays[-3:]) <= set(seen)
    assert len(seen) <= len(grid) + 4


def test_what_is_saved_is_an_ordinary_controller(tmp_path: Path) -> None:
    exploration = replace(
        solved_exploration(), strategies=StrategySettings(threshold=ThresholdSettings(bounds_n=(5.0, 60.0)))
    )
    path, start = tmp_path / "controller.yaml", exploration.axes["x"]
    design = start.design * np.array([1.0, 0.999, 1.0, 1.0])
    saved = save_controller(exploration, {"x": design}, Target(path))
    read = read_controller(path)
    assert read.checksum.startswith(saved.checksum)
    assert read.controller.axes["x"].damping == float(f"{design[1]:.6g}")
    assert read.controller.status is ControllerStatus.VALIDATED
    # Its lead is too much for a collision response to lower the peak, which was asked and is reported.
    assert read.controller.provenance["collision"]["response"] == "none"
    reported = read.controller.predicted["x"].scenarios
    assert saved.peak_n["x"] == pytest.approx(max(each.peak_contact_force_n for each in reported), rel=1e-3)


def test_a_saved_file_states_the_requirements_that_were_set_by_hand(tmp_path: Path) -> None:
    exploration = solved_exploration()
    asked = exploration.axes["x"].problem.requirements
    assert with_requirements(exploration, {"x": asked}) is exploration
    target = AdmittanceTarget(min_m_s_per_n=4e-4)
    changed = with_requirements(exploration, {"x": replace(asked, modulus_margin=0.4, free_space_admittance=target)})
    path = tmp_path / "controller.yaml"
    # More damping than the file's requirements allow.
    design = exploration.axes["x"].design * np.array([1.0, 1.15, 1.0, 1.0])
    save_controller(changed, {"x": design}, Target(path))
    read = read_controller(path).controller
    assert read.certificate.requirements["modulus_margin"] == 0.4
    assert read.certificate.requirements["free_space_admittance"] == target
    by_hand = read.provenance["options"]["asked_by_hand"]
    said = tmp_path / "problem.yaml"
    said.write_text(changed_lines(changed).partition("<pre>")[2].removesuffix("</pre>"), encoding="utf-8")
    spec = read_problem(said)
    assert by_hand["requirements"]["modulus_margin"] == spec.requirements.modulus_margin == 0.4
    assert spec.requirements.free_space_admittance == target
    assert changed_lines(exploration) == ""


@pytest.mark.parametrize(
    ("factors", "message"),
    [
        ((1.0, 1.15, 1.0, 1.0), "Axis x: The design misses free_space_admittance"),
        ((1.0, 0.75, 1.0, 1.0), "Axis x: The design misses modulus_margin"),
        ((1.0, 3.0, 1.0, 1.0), "Axis x: damping must lie within 900 and 1600"),
    ],
)
def test_a_design_that_does_not_hold_is_not_written(tmp_path: Path, factors: tuple[float, ...], message: str) -> None:
    exploration, path = solved_exploration(), tmp_path / "controller.yaml"
    with pytest.raises(InfeasibleError, match=message):
        save_controller(exploration, {"x": exploration.axes["x"].design * np.array(factors)}, Target(path))
    assert not path.exists()


def test_a_design_that_validation_refuses_is_not_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def doubt(*_arguments: object, **_options: object) -> tuple[Controller, object]:
        raise CertificateError("Axis x, margins: not so.")

    monkeypatch.setattr(save_module, "certify", doubt)
    exploration, path = solved_exploration(), tmp_path / "controller.yaml"
    with pytest.raises(CertificateError, match="not so"):
        save_controller(exploration, {"x": exploration.axes["x"].design}, Target(path))
    assert not path.exists()


def test_sliders_reach_the_usual_bounds_and_about_a_turning_axis_a_tenth_and_ten_times_the_gains() -> None:
    law = AdmittanceController(mass_kg=2.0, damping_n_s_per_m=20000.0, lead_s=0.05, feedback_damping_s=0.01)
    usual = _bounds(law, "x", 8e-4, reads_position=True)
    # Gains outside of the usual bounds are an end.
    assert usual == {
        "mass": (2.0, 100.0),
        "damping": (100.0, 20000.0),
        "lead_s": (0.0, 0.05),
        "feedback_damping_s": (0.0, 0.05),
    }
    turning = _bounds(law, "rz", 8e-4, reads_position=False)
    assert turning["mass"] == pytest.approx((0.2, 20.0))
    assert turning["damping"] == pytest.approx((2000.0, 200000.0))
    assert (turning["lead_s"], turning["feedback_damping_s"]) == ((0.0, 0.05), (0.0, 0.0))
    # What is compensated stays as it is.
    heavy = _bounds(replace(law, compensation_mass_kg=3.0), "x", 8e-4, reads_position=True)
    assert {name: heavy[name] for name in heavy if name not in usual} == {
        "velocity_filter_rad_per_s": (law.velocity_filter_rad_per_s,) * 2,
        "acceleration_filter_rad_per_s": (law.acceleration_filter_rad_per_s,) * 2,
        "compensation_mass_kg": (3.0, 3.0),
    }
