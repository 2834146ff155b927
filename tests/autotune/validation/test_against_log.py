"""Contacts of simulated cells beside what a controller file predicts: its own cell, others, and other controllers."""

import re
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest

from autotune.cli.validate import print_comparison
from autotune.formats.controller_record import admittance_controller
from autotune.report.page import Table
from autotune.report.validate_page import Validated, measured_section
from autotune.simulation.phases import Program
from autotune.simulation.simulate import simulate_cell
from autotune.simulation.truth import SimulatedCell
from autotune.validation.against_log import LogComparison, compare_with_log, log_checks
from autotune.validation.report import ValidationReport
from identification.errors import EstimateError, LogError
from identification.signals.recording import GainsSignal, Recording
from problems.model.plant import Coupling, Environment
from problems.model.robot import RobotModel
from tests.autotune.tuning.cases import small_controller
from tests.autotune.tuning.turning import SQUARE, both_optimized

PROGRAM = Program(pose_count=5, pose_hold_s=0.6, pose_move_s=0.6, jogging_s=0.0, sweep_s=0.0, contact_count=2)


def certified_cell(**changes: Any) -> SimulatedCell:
    """Return a cell inside the domain of the small controller, which runs there."""
    usual: dict[str, Any] = {
        "payload_mass_kg": 16.0,
        "coupling": Coupling(stiffness_n_per_m=3e5, damping_n_s_per_m=150.0),
        "environment": Environment(stiffness_n_per_m=1.1e5),
        "robot": RobotModel.from_bandwidth(bandwidth_rad_per_s=20.0, delay_s=2.4e-3),
        "controller": admittance_controller(small_controller(), "x"),
    }
    return SimulatedCell(**{**usual, **changes})


@cache
def recorded(program: Program = PROGRAM, **changes: Any) -> Recording:
    return simulate_cell(certified_cell(**changes), program, seed=6).recording


@cache
def own() -> LogComparison:
    return compare_with_log(small_controller(), recorded())


def test_its_own_cell_is_predicted_to_the_noise() -> None:
    found = own()
    assert (len(found.contacts), found.passed_over, found.is_weighed, found.inside_share) == (2, 0, True, 1.0)
    for each in found.contacts:
        assert each.is_inside
        assert each.outside == ""
        # F^d of the program; the approach of the linear loop, whose drag of 6 N the deadband of 5 N does not hide.
        assert each.desired_force_n == pytest.approx(30.0, abs=0.1)
        assert each.speed_m_s == pytest.approx(30.0 / (small_controller().axes["x"].damping + 330.0), rel=0.01)
        assert each.stiffness_n_per_m == pytest.approx(1.1e5, rel=0.02)
        # The largest of a hundred noisy samples at the top stands out by two deviations, 0.3 N.
        assert abs(each.peak_error_n) < 0.5
        assert each.rms_error_n is not None
        assert each.rms_error_n < 2.0 * certified_cell().force_noise_rms_n
        assert each.band_peaks_n[0] < each.measured_peak_n < each.band_peaks_n[1]
    assert all(check.passed for check in log_checks(found))


def test_the_same_log_gives_the_same_comparison() -> None:
    assert compare_with_log(small_controller(), recorded()) == own()


def test_a_heavier_payload_is_reported_as_outside() -> None:
    found = compare_with_log(small_controller(), recorded(payload_mass_kg=20.0))
    assert found.mass_kg == pytest.approx(20.0, rel=0.01)
    assert {each.outside for each in found.contacts} == {f"M_p {found.mass_kg:.4g} kg outside of 16 to 16"}
    assert not any(check.passed for check in log_checks(found))


def test_a_wall_that_is_too_stiff_is_outside_and_above_the_set() -> None:
    found = compare_with_log(small_controller(), recorded(environment=Environment(stiffness_n_per_m=3e5)))
    for each, check in zip(found.contacts, log_checks(found), strict=True):
        assert each.outside.startswith("K_e ")
        assert each.measured_peak_n > each.band_peaks_n[1]
        assert not each.is_inside
        # The plant with the K_e of the contact itself is still the right one.
        assert abs(each.peak_error_n) < 0.03 * each.measured_peak_n
        assert not check.passed


def test_a_drag_that_is_not_the_certified_leaves_the_band() -> None:
    found = compare_with_log(small_controller(), recorded(drag_n_s_per_m=450.0))
    assert found.inside_share == 0.0


@pytest.mark.parametrize("change", [{"damping_n_s_per_m": 1600.0}, {"lead_s": 0.012}], ids=["B_a", "K_l"])
def test_a_log_under_another_controller_is_refused(change: dict[str, float]) -> None:
    other = replace(admittance_controller(small_controller(), "x"), **change)  # type: ignore[arg-type]
    with pytest.raises(LogError, match=r"recorded with another controller.* found \d+(\.\d+)? % left"):
        compare_with_log(small_controller(), recorded(controller=other))


def test_gains_in_the_log_show_another_controller_at_once() -> None:
    recording = recorded()
    mass, damping = np.full((1, 6), 6.0), np.full((1, 6), 900.0)
    gains = GainsSignal(topic="/gains", stamp_ns=recording.wrench.stamp_ns[:1], mass=mass, damping=damping)
    said = re.escape(f"{small_controller().axes['x'].damping:g}")
    with pytest.raises(LogError, match=rf"topic /gains says B_a = 900 on axis x, the file {said}"):
        compare_with_log(small_controller(), replace(recording, gains=gains))


def test_a_log_without_tilted_poses_is_weighed_by_the_file() -> None:
    """The cell's bias is not the file's: that is found out, and with the right one the comparison goes on."""
    bare, cell = replace(PROGRAM, pose_count=1), certified_cell()
    with pytest.raises(LogError, match=r"explained by the file's payload of 16 kg and its bias .* N left"):
        compare_with_log(small_controller(), recorded(bare, force_bias_S_n=(4.2, -7.5, 40.0)))
    controller = small_controller()
    payload = replace(controller.payload, force_bias_n=cell.force_bias_S_n, com_m=cell.com_S_m)
    found = compare_with_log(replace(controller, payload=payload), recorded(bare))
    assert (found.is_weighed, found.mass_kg, found.inside_share) == (False, 16.0, 1.0)


@cache
def turned(**changes: Any) -> LogComparison:
    """A cell that turns about ry inside the domain of the controller of both axes, which runs there."""
    controller = both_optimized().controller
    usual: dict[str, Any] = {
        "payload_mass_kg": 16.0,
        "inertia_S_kg_m2": (0.55, 16.0 * SQUARE, 0.21),
        "coupling": Coupling(stiffness_n_per_m=3e5 * SQUARE, damping_n_s_per_m=150.0 * SQUARE),
        "drag_n_s_per_m": 330.0 * SQUARE,
        "environment": Environment(stiffness_n_per_m=1.1e5 * SQUARE),
        "robot": RobotModel.from_bandwidth(bandwidth_rad_per_s=20.0, delay_s=2.4e-3),
        "controller": admittance_controller(controller, "ry"),
        "deadband_n": controller.axes["ry"].deadband,
    }
    program = Program.turning(
        pose_count=5, pose_hold_s=0.6, pose_move_s=0.6, jogging_s=0.0, sweep_s=0.0, contact_count=3
    )
    cell = SimulatedCell.turning("ry", **{**usual, **changes})
    return compare_with_log(controller, simulate_cell(cell, program, seed=6).recording)


def test_contacts_at_the_end_of_a_turn_are_predicted_in_torque_and_angle() -> None:
    found = turned()
    assert [each.axis for each in found.contacts] == ["ry", "ry", "ry"]
    assert found.passed_over == 0
    for each, check in zip(found.contacts, log_checks(found), strict=True):
        # T^d of the program behind a threshold deadband, which passes it whole.
        assert each.desired_force_n == pytest.approx(5.5, abs=0.05)
        assert each.speed_m_s == pytest.approx(5.5 / (both_optimized().controller.axes["ry"].damping + 13.2), rel=0.05)
        assert each.stiffness_n_per_m == pytest.approx(1.1e5 * SQUARE, rel=0.02)
        # The weight turns with what turns, which no model holds: 1 % of 8.6 N·m, and five deviations of the noise.
        assert abs(each.peak_error_n) < 0.15
        assert each.share_inside is not None
        assert each.share_inside > 0.95
        assert each.outside == ""
        assert check.passed
        assert " N·m (" in check.message


def test_a_turn_into_a_wall_that_is_too_stiff_is_outside() -> None:
    found = turned(environment=Environment(stiffness_n_per_m=3e5 * SQUARE))
    for each, check in zip(found.contacts, log_checks(found), strict=True):
        assert re.fullmatch(r"K_e 1\.\d+e\+04 N·m/rad outside of 4000 to 4800", each.outside)
        assert not check.passed


def test_turning_and_straight_contacts_have_a_table_each(capsys: pytest.CaptureFixture[str]) -> None:
    both = replace(own(), contacts=(*own().contacts, *turned().contacts))
    print_comparison(both)
    output = capsys.readouterr().out
    assert output.count("certified set") == 2
    assert "N·m/mrad" in output
    assert "N/mm" in output
    (section,) = measured_section(Validated(report=ValidationReport(checks=()), compared=both))
    tables = [block for block in section.blocks if isinstance(block, Table)]
    assert [table.columns[3] for table in tables] == ["measured [N]", "measured [N·m]"]


def test_a_log_that_shows_nothing_is_refused() -> None:
    with pytest.raises(LogError, match=r"must hold contacts along x .* found none"):
        compare_with_log(small_controller(), recorded(replace(PROGRAM, contact_count=0)))
    with pytest.raises(LogError, match="must hold the commanded pose, found none"):
        compare_with_log(small_controller(), replace(recorded(), command=None))
    compensated = replace(recorded(), wrench=replace(recorded().wrench, gravity_compensated=True))
    with pytest.raises(EstimateError, match="Gravity is already removed"):
        compare_with_log(small_controller(), compensated)
