"""A command counts where the weight was taken off: robot, coupling and moving mass, against physics by scipy."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from identification import compensated
from identification.given import Given
from identification.identify import identify_cell
from identification.logs.read import read_recording
from identification.logs.roles.cell import Cell, PoseFields, PoseSource
from identification.logs.tables.layout import TableLayout
from identification.result import Estimate, Status
from identification.signals.aligned import Span
from identification.signals.recording import AppliedDeadband
from identification.signals.segments import MotionSpans

from .commanded_cell import CommandedCell, Logger, logged, swept

# Deviations of 95 % for a normal error; of the delay, of which any value within an interval is as likely, √3 is all.
WITHIN_STDS = 2.5


def covers(estimate: Estimate, truth: float) -> bool:
    assert estimate.value is not None
    assert estimate.std is not None
    return abs(estimate.value - truth) < WITHIN_STDS * estimate.std


@pytest.mark.parametrize(
    ("rate_hz", "deadband", "cell"),
    [
        (1250.0, None, CommandedCell()),
        (200.0, AppliedDeadband(type="subtractive", force_n=2.0), CommandedCell(delay_s=9e-3)),
        (100.0, AppliedDeadband(type="threshold", force_n=2.0), CommandedCell(robot=(60.0, 0.8), mass=20.0)),
    ],
    ids=["at the controller's rate", "subtractive deadband", "threshold, two poles"],
)
def test_robot_coupling_and_moving_mass_follow_from_command_pose_and_force(
    rate_hz: float, deadband: AppliedDeadband | None, cell: CommandedCell
) -> None:
    command = swept(cell, min(40.0, 0.25 * rate_hz))
    result = identify_cell(logged(cell, command, Logger(rate_hz=rate_hz, deadband=deadband, axis=2)))
    axis = result.axes["z"]
    assert covers(axis.robot.bandwidth_hz, cell.bandwidth_hz)
    assert covers(axis.robot.delay_s, cell.delay_s)
    assert covers(axis.coupling.stiffness_n_per_m, cell.stiffness)
    assert covers(result.payload.mass_kg, cell.mass)
    assert axis.robot.bandwidth_hz.std is not None
    assert axis.robot.bandwidth_hz.std < 0.02 * cell.bandwidth_hz
    assert result.payload.mass_kg.std is not None
    assert result.payload.mass_kg.std < 0.1 * cell.mass
    removed = next(finding for finding in result.findings if finding.code == "gravity-removed")
    assert removed.severity == "warning"
    assert "its mass is what moves" in removed.message
    assert result.payload.com_m.status is Status.UNIDENTIFIABLE
    assert "no-command" not in {finding.code for finding in result.findings}
    # Nothing was touched: all of the force is what the payload makes of its motion.
    assert result.timelines[0].touches == ()


def test_a_constant_force_of_the_sensor_is_no_force_of_the_payload() -> None:
    """As a robot's own estimate shows it: along the motion and across it, at rest as in motion."""
    cell = CommandedCell()
    recording = logged(cell, swept(cell, 40.0), Logger(rate_hz=1250.0, axis=2))
    wrench = recording.wrench
    moved = identify_cell(
        replace(recording, wrench=replace(wrench, force_n=wrench.force_n + np.array([-2.5, 0.3, 4.0])))
    )
    clean = identify_cell(recording)
    assert moved.timelines[0].touches == ()
    assert moved.payload.mass_kg.value == pytest.approx(clean.payload.mass_kg.value, rel=1e-3)
    (about,) = (finding for finding in moved.findings if finding.code == "wrench-offset")
    assert "-2.5 N along x, +4.5 N along z: taken off" in about.message
    assert "wrench-offset" not in {finding.code for finding in clean.findings}


@pytest.mark.parametrize(("rate_hz", "robot"), [(150.0, (38.0,)), (125.0, (28.0, 0.9))], ids=["one pole", "two poles"])
def test_a_log_several_times_slower_than_the_controller_shows_the_coupling(
    rate_hz: float, robot: tuple[float, ...]
) -> None:
    """No command was held from sample to sample, and the payload swings at 23 Hz, six samples long."""
    cell = CommandedCell(robot=robot)
    logger = Logger(rate_hz=rate_hz, axis=2, force_noise_n=0.1, pose_noise_m=2e-6)
    result = identify_cell(logged(cell, swept(cell, 35.0), logger))
    axis, mass = result.axes["z"], result.payload.mass_kg
    assert axis.coupling.stiffness_n_per_m.std is not None
    assert axis.coupling.stiffness_n_per_m.std < 0.03 * cell.stiffness
    assert covers(axis.coupling.stiffness_n_per_m, cell.stiffness)
    assert covers(axis.coupling.damping_n_s_per_m, cell.damping)
    assert covers(axis.drag_n_s_per_m, cell.drag)
    assert covers(mass, cell.mass)
    assert covers(axis.robot.bandwidth_hz, cell.bandwidth_hz)
    # How the command went between its samples leaves the poles open by this much, beside any noise.
    assert axis.robot.bandwidth_hz.std is not None
    assert axis.robot.bandwidth_hz.std > 0.0025 * cell.bandwidth_hz
    # Anything up to half of the longest control period may be part of the lag.
    assert covers(axis.robot.delay_s, cell.delay_s)


def test_a_robot_that_gives_way_to_its_payload_biases_nothing() -> None:
    """Its servo yields by micrometres, which no filter for the pose's noise keeps: 8 deviations of K_s as it was."""
    cell = CommandedCell(robot=(45.0, 0.9), robot_mass=2000.0)
    recording = logged(cell, swept(cell, 40.0), Logger(rate_hz=1250.0, axis=2, force_noise_n=0.1, pose_noise_m=2e-6))
    axis = identify_cell(recording).axes["z"]
    assert covers(axis.coupling.stiffness_n_per_m, cell.stiffness)
    assert covers(axis.coupling.damping_n_s_per_m, cell.damping)
    assert covers(axis.robot.bandwidth_hz, cell.bandwidth_hz)
    assert covers(axis.robot.delay_s, cell.delay_s)
    assert axis.coupling.stiffness_n_per_m.std is not None
    assert axis.coupling.stiffness_n_per_m.std < 0.01 * cell.stiffness


def test_a_slow_log_leaves_the_hold_of_the_controller_open_unless_its_period_is_given() -> None:
    cell = CommandedCell(delay_s=6e-3)
    recording = logged(cell, swept(cell, 20.0), Logger(rate_hz=100.0))
    alone = identify_cell(recording).axes["x"].robot.delay_s
    known = identify_cell(recording, given={"sample_time_s": Given(value=cell.tick_s, std=0.0)}).axes["x"].robot.delay_s
    assert alone.status is Status.WEAK
    assert "half a control period" in alone.note
    assert alone.std is not None
    # Any hold up to 4 ms: half of it, as likely as any other, scatters by 2 ms/√12.
    assert alone.std == pytest.approx(2e-3 / np.sqrt(12.0), rel=0.05)
    assert known.std is not None
    assert known.std < 0.3 * alone.std
    assert covers(known, cell.delay_s)


def test_without_a_force_on_the_axis_the_robot_is_identified_all_the_same() -> None:
    cell = CommandedCell()
    result = identify_cell(logged(cell, swept(cell, 25.0), Logger(measured=("y", "z", "rx", "ry", "rz"))))
    assert covers(result.axes["x"].robot.bandwidth_hz, cell.bandwidth_hz)
    assert result.axes["x"].coupling.stiffness_n_per_m.value is None
    assert result.payload.mass_kg.value is None
    assert next(f for f in result.findings if f.code == "gravity-removed").severity == "error"


def test_a_table_of_pose_and_command_alone_shows_the_robot(tmp_path: Path) -> None:
    cell = CommandedCell(robot=(25.0,))
    recording = logged(cell, swept(cell, 25.0), Logger(rate_hz=125.0, axis=1))
    assert recording.command is not None
    log = tmp_path / "run.csv"
    time_s = (recording.pose.stamp_ns - recording.pose.stamp_ns[0]) * 1e-9
    rows = np.column_stack([time_s, recording.pose.position_m, recording.command.position_m])
    np.savetxt(log, rows, delimiter=",", header="t,x,y,z,cx,cy,cz", comments="", fmt="%.9f")
    declared = Cell(
        pose=PoseSource(fields=PoseFields(position=("x", "y", "z"))),
        command=PoseSource(fields=PoseFields(position=("cx", "cy", "cz"))),
        table=TableLayout(time="t"),
    )
    result = identify_cell(read_recording(log, declared))
    # The tool points down and is turned by 0.4 rad: its y lies along both of the base's.
    for name in ("x", "y"):
        assert covers(result.axes[name].robot.bandwidth_hz, cell.bandwidth_hz)
        assert covers(result.axes[name].robot.delay_s, cell.delay_s)
    errors = [finding.code for finding in result.findings if finding.severity == "error"]
    assert errors == ["no-wrench"]
    assert "no-orientation" in {finding.code for finding in result.findings}
    assert result.sample_time_s.status is Status.WEAK


def test_a_subtractive_deadband_of_unknown_width_hides_the_coupling_and_not_the_robot() -> None:
    cell = CommandedCell()
    recording = logged(cell, swept(cell, 25.0), Logger(deadband=AppliedDeadband(type="subtractive", force_n=2.0)))
    unknown = replace(recording.wrench, deadband=AppliedDeadband(type="subtractive"))
    result = identify_cell(replace(recording, wrench=unknown))
    assert covers(result.axes["x"].robot.bandwidth_hz, cell.bandwidth_hz)
    assert result.payload.mass_kg.value is None


def test_the_noise_at_rest_is_that_of_the_sensor_and_not_what_changes_slowly() -> None:
    """White noise beside a force that drifts by a hundred times as much; half of the samples are in a deadband."""
    rng, count = np.random.default_rng(5), 4000
    drift = 20.0 * np.sin(2.0 * np.pi * np.arange(count) / count)
    force = np.stack([drift, np.zeros(count), -0.5 * drift], axis=1) + 0.2 * rng.normal(size=(count, 3))
    force[count // 2 :] = 0.0
    rest = MotionSpans(velocity_S_m_s=np.zeros((count, 3)), still=(Span(start=0, stop=count),), moving=())
    assert compensated._noise_n(force, rest) == pytest.approx(0.2, rel=0.05)
