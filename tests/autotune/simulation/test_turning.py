"""A simulated cell that turns about one axis: the same equations in rad and N·m, and what a log shows of them."""

from functools import cache
from typing import Literal

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from autotune.simulation.phases import Program, build_script
from autotune.simulation.simulate import GRAVITY_B_M_S2, WORKING_ORIENTATION, AxisRun, CellRun, run_axis, simulate_cell
from autotune.simulation.truth import SimulatedCell
from problems.arrays import FloatArray
from tests.autotune.simulation.runs import silent

Axis = Literal["rx", "ry", "rz"]

SHORT = Program.turning(pose_count=3, pose_hold_s=0.4, jogging_s=4.0, sweep_s=3.0, contact_count=2)
EVERY: tuple[Axis, ...] = ("rx", "ry", "rz")


@cache
def run_about(axis: Axis) -> CellRun:
    return simulate_cell(silent(SimulatedCell.turning(axis)), SHORT, seed=3)


def after_the_poses(run: CellRun) -> slice:
    """From where the tool has left its tilted poses."""
    return slice(int(np.flatnonzero(np.any(run.script.rotation_rad != 0.0, axis=1))[-1]) + 5, None)


def orientation(run: CellRun) -> Rotation:
    return Rotation.from_quat(run.recording.pose.quaternion_xyzw)


def without_weight(run: CellRun) -> tuple[FloatArray, FloatArray]:
    """Force and torque without bias and without the weight at the flange's orientation."""
    cell, wrench = run.cell, run.recording.wrench
    weight = cell.payload_mass_kg * orientation(run).inv().apply(GRAVITY_B_M_S2)
    force = wrench.force_n - cell.force_bias_S_n - weight
    return force, wrench.torque_n_m - cell.torque_bias_S_n_m - np.cross(cell.com_S_m, weight)


@pytest.mark.parametrize("axis", EVERY)
def test_pose_and_command_turn_about_the_axis_and_stay_in_place(axis: Axis) -> None:
    run = run_about(axis)
    recording, used = run.recording, after_the_poses(run)
    assert recording.command is not None
    for pose, angle in ((recording.pose, run.axis.flange_m), (recording.command, run.axis.command_m)):
        np.testing.assert_array_equal(pose.position_m - np.array(run.cell.base_position_m), 0.0)
        turned = (WORKING_ORIENTATION.inv() * Rotation.from_quat(pose.quaternion_xyzw)).as_rotvec()[used]
        expected = np.zeros_like(turned)
        expected[:, EVERY.index(axis)] = angle[used]
        assert np.ptp(angle) > 0.1
        # Rounding of quaternions, 2e-16, through the square root of 1 − w² at small angles.
        np.testing.assert_allclose(turned, expected, rtol=0.0, atol=1e-14)


@pytest.mark.parametrize("axis", EVERY)
def test_the_torque_about_the_axis_is_that_of_the_coupling(axis: Axis) -> None:
    run = run_about(axis)
    _, torque = without_weight(run)
    used, index = after_the_poses(run), EVERY.index(axis)
    assert np.ptp(run.axis.force_n) > 5.0
    np.testing.assert_allclose(torque[used, index], run.axis.force_n[used], rtol=0.0, atol=1e-9)


def test_a_turning_axis_obeys_the_equations_of_a_straight_one() -> None:
    turning = silent(SimulatedCell.turning("ry"))
    straight = SimulatedCell(
        **{**turning.__dict__, "approach_axis": "z", "payload_mass_kg": turning.inertia_S_kg_m2[1]},
    )
    script = build_script(SHORT, turning.sample_time_s, np.random.default_rng(2))
    runs: list[AxisRun] = [run_axis(cell, script, np.zeros(len(script))) for cell in (turning, straight)]
    for name in runs[0].__dict__:
        np.testing.assert_array_equal(getattr(runs[0], name), getattr(runs[1], name))
    assert turning.moved_mass_kg == 0.52


@pytest.mark.parametrize("axis", EVERY)
def test_in_free_motion_the_force_swings_the_centre_of_mass(axis: Axis) -> None:
    """F = −m a of a point on the payload, its acceleration by differences of its path."""
    run = run_about(axis)
    cell, h = run.cell, run.cell.sample_time_s
    angle = run.axis.payload_m[:, None] * np.eye(3)[EVERY.index(axis)]
    path = Rotation.from_rotvec(angle).apply(cell.com_S_m)
    acceleration = np.gradient(np.gradient(path, h, axis=0), h, axis=0)
    expected = -cell.payload_mass_kg * Rotation.from_rotvec(angle).inv().apply(acceleration)
    force, _ = without_weight(run)
    sweep = slice(round(15.0 / h), round(16.5 / h))
    assert np.max(np.abs(run.axis.contact_force_n[sweep])) == 0.0
    assert np.max(np.abs(expected[sweep])) > 0.3
    # Differences at h err by (ω h)²/6 for swings up to 55 Hz, twice: 3 %.
    assert np.max(np.abs(force[sweep] - expected[sweep])) < 0.03 * np.max(np.abs(expected[sweep]))
    # Along the arm from the axis there is only what the arc takes: m ω² r.
    arm = np.array(cell.com_S_m) * (np.eye(3)[EVERY.index(axis)] == 0.0)
    outwards = cell.payload_mass_kg * run.axis.payload_velocity_m_s[sweep] ** 2 * float(arm @ arm)
    assert np.max(outwards) > 1e-6
    np.testing.assert_allclose(force[sweep] @ arm, outwards, rtol=1e-6, atol=1e-12)


@pytest.mark.parametrize("axis", EVERY)
def test_pressing_pushes_at_the_contact_point_square_to_its_lever(axis: Axis) -> None:
    run = run_about(axis)
    a, point, direction = run.axis, np.array(run.cell.contact_point_S_m), np.eye(3)[EVERY.index(axis)]
    # Nothing accelerates at the end of a hold.
    ends = np.flatnonzero(np.diff(run.script.desired_force_n) < -1.0)
    settled = np.concatenate([np.arange(end - 250, end) for end in ends])
    assert len(ends) == 2
    assert np.min(a.contact_force_n[settled]) > 3.0
    force, torque = (each[settled] for each in without_weight(run))
    lever = point - (point @ direction) * direction
    np.testing.assert_allclose(np.linalg.norm(force, axis=1) * np.linalg.norm(lever), a.contact_force_n[settled], 2e-3)
    assert np.max(np.abs(force @ direction)) < 1e-9
    assert np.max(np.abs(force @ lever)) < 2e-3 * np.max(np.linalg.norm(force, axis=1))
    # One force at the point explains the whole torque; a millinewton metre is what is left of acceleration.
    np.testing.assert_allclose(torque, np.cross(point, force), rtol=0.0, atol=3e-3)


def test_what_is_changed_of_a_turning_cell_or_program_is_taken() -> None:
    assert SimulatedCell.turning("rz", drag_n_s_per_m=7.0).contact_plant().payload.drag_n_s_per_m == 7.0
    assert SimulatedCell.turning("rz").contact_plant().payload.mass_kg == 0.21
    assert Program.turning(contact_force_n=2.0).contact_force_n == 2.0
    assert not SimulatedCell().is_turning
    with pytest.raises(TypeError, match="unheard_of"):
        SimulatedCell.turning("rx", unheard_of=1.0)
