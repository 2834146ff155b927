"""Payload data as it is published: averaged rows, or orientations without positions."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from autotune.formats.cell import check_cell_text
from identification.errors import EstimateError, LogError
from identification.identify import identify_cell
from identification.logs.inspect import inspect_log
from identification.logs.read import read_checked_recording
from identification.result import Estimate, Identified, VectorEstimate
from identification.signals.recording import Recording
from problems.arrays import FloatArray

MASS_KG, COM_M = 3.42, np.array([0.012, -0.021, 0.083])
FORCE_BIAS_N, TORQUE_BIAS_N_M = np.array([1.5, -2.2, 4.1]), np.array([0.05, -0.08, 0.02])
HEAD = "format: autotune/cell\nversion: 1\n"
CELL = (
    HEAD
    + """\
table: {rows: poses}
wrench: {fields: {force: [Fx, Fy, Fz], torque: [Mx, My, Mz]}}
pose: {fields: {orientation: [qx, qy, qz, qw]}}
"""
)
FORCES = CELL.replace(", torque: [Mx, My, Mz]", "")


def rows(count: int, seed: int = 3) -> FloatArray:
    """Quaternions and wrenches of a payload in any orientation, each averaged to 0.05 N."""
    rng = np.random.default_rng(seed)
    turned = Rotation.from_rotvec(rng.uniform(-1.3, 1.3, (count, 3)))
    gravity = turned.inv().apply([0.0, 0.0, -9.80665])
    force = MASS_KG * gravity + FORCE_BIAS_N + 0.05 * rng.standard_normal((count, 3))
    torque = np.cross(COM_M, MASS_KG * gravity) + TORQUE_BIAS_N_M + 0.005 * rng.standard_normal((count, 3))
    return np.asarray(np.hstack([turned.as_quat(), force, torque]))


def written(path: Path, table: FloatArray, names: str = "qx,qy,qz,qw,Fx,Fy,Fz,Mx,My,Mz") -> Path:
    lines = [",".join(f"{value:.5f}" for value in row) for row in table]
    path.write_text("\n".join([names, *lines, ""]), encoding="utf-8")
    return path


def identified(paths: Path | list[Path], cell: str = CELL) -> Identified:
    return identify_cell(read_checked_recording(paths, check_cell_text(cell, Path("cell.yaml"))))


def deviations(estimate: Estimate | VectorEstimate | None, truth: float | FloatArray) -> FloatArray:
    assert estimate is not None
    assert estimate.value is not None
    assert estimate.std is not None
    return np.asarray(np.abs(np.atleast_1d(np.subtract(estimate.value, truth)) / np.atleast_1d(estimate.std)))


@pytest.mark.parametrize("count", [7, 12, 100])
def test_a_row_per_pose_shows_mass_centre_and_bias(tmp_path: Path, count: int) -> None:
    found = identified(written(tmp_path / "poses.csv", rows(count)))
    # Ten numbers, each within four of its deviations, and none of them vague.
    assert np.max(deviations(found.payload.mass_kg, MASS_KG)) < 4.0
    assert np.max(deviations(found.payload.com_m, COM_M)) < 4.0
    assert np.max(deviations(found.sensor.force_bias_n, FORCE_BIAS_N)) < 4.0
    assert np.max(deviations(found.sensor.torque_bias_n_m, TORQUE_BIAS_N_M)) < 4.0
    assert found.payload.mass_kg.std is not None
    assert found.payload.mass_kg.std < 0.05
    assert (found.axes, found.timelines) == ({}, ())
    assert found.sample_time_s.value is None
    assert [each.code for each in found.findings if each.severity == "error"] == ["payload-only"]


@pytest.mark.parametrize("torque", ["", "torque: [Mx, My, Mz]"])
def test_forces_alone_show_mass_and_their_bias(tmp_path: Path, torque: str) -> None:
    """Without torques, and with those of a three-axis sensor, 0 throughout."""
    table = rows(12)
    table[:, 7:] = 0.0
    cell = CELL.replace("torque: [Mx, My, Mz]", torque)
    path = written(tmp_path / "poses.csv", table)
    if torque:
        with pytest.raises(LogError, match=r"left_out: \[rx, ry, rz\]"):
            identified(path, cell)
        cell = cell.replace("wrench: {", "wrench: {left_out: [rx, ry, rz], ")
    found = identified(path, cell)
    whole = identified(written(path, rows(12)))
    # The force's own equations are the same with and without torques.
    assert (found.payload.mass_kg, found.sensor.force_bias_n) == (whole.payload.mass_kg, whole.sensor.force_bias_n)
    assert np.max(deviations(found.payload.mass_kg, MASS_KG)) < 4.0
    assert (found.payload.com_m.value, found.sensor.torque_bias_n_m.value) == (None, None)
    assert "no three torques" in found.payload.com_m.note


def test_forces_alone_show_another_convention_and_a_sensor_that_is_turned(tmp_path: Path) -> None:
    table = rows(20)
    found = identified(written(tmp_path / "a.csv", table[:, [3, 0, 1, 2, *range(4, 10)]]), FORCES)
    assert "convention-found" in [each.code for each in found.findings]
    assert np.max(deviations(found.payload.mass_kg, MASS_KG)) < 4.0
    # The axes of S as they are, seen from those assumed, turned by 3 degrees about x: f' = exp(mu)^T f.
    turn = Rotation.from_rotvec([np.radians(3.0), 0.0, 0.0])
    table[:, 4:7] = turn.inv().apply(table[:, 4:7])
    found = identified(written(tmp_path / "b.csv", table), FORCES)
    assert np.max(deviations(found.sensor.mounting_rad, turn.as_rotvec())) < 4.0
    assert found.sensor.mounting_rad is not None
    assert found.sensor.mounting_rad.std is not None
    assert max(found.sensor.mounting_rad.std) < np.radians(0.5)


def test_wrench_and_orientation_may_be_tables_of_their_own(tmp_path: Path) -> None:
    table = rows(9)
    turns = written(tmp_path / "turns.csv", table[:, :4], "qx,qy,qz,qw")
    forces = written(tmp_path / "forces.csv", table[:, 4:], "Fx,Fy,Fz,Mx,My,Mz")
    assert np.max(deviations(identified([turns, forces]).payload.mass_kg, MASS_KG)) < 4.0
    written(turns, table[:8, :4], "qx,qy,qz,qw")
    with pytest.raises(LogError, match=r"one row per pose each, found 9 in forces\.csv and 8 in turns\.csv"):
        identified([turns, forces])


def test_the_order_of_a_quaternion_is_found_by_the_weight(tmp_path: Path) -> None:
    table = rows(20)
    path = written(tmp_path / "poses.csv", table[:, [3, 0, 1, 2, *range(4, 10)]])
    found = identified(path)
    assert "convention-found" in [each.code for each in found.findings]
    assert np.max(deviations(found.payload.mass_kg, MASS_KG)) < 4.0


def test_rows_that_do_not_separate_weight_from_bias_are_refused(tmp_path: Path) -> None:
    with pytest.raises(EstimateError, match="at least 4 clearly different tool orientations"):
        identified(written(tmp_path / "poses.csv", np.repeat(rows(2), 5, axis=0)))


def test_a_few_rows_that_are_said_to_be_samples_are_refused_with_what_to_declare(tmp_path: Path) -> None:
    path = written(tmp_path / "poses.csv", rows(7))
    with pytest.raises(LogError, match=r"samples of poses\.csv 1 s apart.*`table: \{rows: poses\}`"):
        identified(path, CELL.replace("rows: poses", "sample_rate_hz: 1"))


def test_a_pose_that_is_held_from_row_to_row_is_no_motion(tmp_path: Path) -> None:
    """Seven poses of ten seconds beside a force of 100 Hz: what is between them is not to be interpolated."""
    table, names = rows(7), "fx,fy,fz,tx,ty,tz"
    time = np.arange(7000) / 100.0
    held = np.column_stack([time, table[(time / 10.0).astype(int), 4:]])
    forces = written(
        tmp_path / "force.csv",
        held + np.random.default_rng(1).normal(size=held.shape) * ([0] + [0.1] * 6),
        f"t,{names}",
    )
    turns = written(tmp_path / "pose.csv", np.column_stack([10.0 * np.arange(7), table[:, :4]]), "t,qx,qy,qz,qw")
    cell = (
        CELL.replace("{rows: poses}", "{time: t}")
        .replace("Fx, Fy, Fz", "fx, fy, fz")
        .replace("Mx, My, Mz", "tx, ty, tz")
    )
    with pytest.raises(LogError, match=r"samples of pose\.csv 10 s apart.*`table: \{rows: poses\}`"):
        identified([forces, turns], cell)


def test_inspect_says_what_such_a_table_holds(tmp_path: Path) -> None:
    cell = check_cell_text(CELL, tmp_path / "cell.yaml")
    summary = inspect_log(written(tmp_path / "poses.csv", rows(7)), cell)
    assert [each.code for each in summary.findings] == ["crc-absent"]
    assert summary.missing == (
        "Each row is a pose at rest: payload and sensor are in it, robot, coupling and surfaces are not.",
    )


def test_a_log_without_positions_shows_the_payload_all_the_same(demo_recording: Recording) -> None:
    whole = identify_cell(replace(demo_recording, command=None))
    pose = demo_recording.pose
    bare = replace(pose, position_m=np.full_like(pose.position_m, np.nan), measured_axes=("rx", "ry", "rz"))
    found = identify_cell(replace(demo_recording, pose=bare, command=None))
    assert whole.payload.mass_kg.value is not None
    assert np.max(deviations(found.payload.mass_kg, whole.payload.mass_kg.value)) < 2.0
    assert found.sensor.force_noise_rms_n.value == pytest.approx(whole.sensor.force_noise_rms_n.value, rel=0.1)
    assert found.axes == {}
