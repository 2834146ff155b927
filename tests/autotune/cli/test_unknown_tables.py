"""From a CSV that nobody explained to the payload, in two edits of what `inspect --write-cell` begins."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa  # type: ignore[import-untyped]  # the package carries no annotations
import pyarrow.parquet as pq  # type: ignore[import-untyped]  # the package carries no annotations
import pytest
from scipy.spatial.transform import Rotation, RotationSpline

from autotune.cli.main import main
from autotune.formats.cell import read_cell
from autotune.formats.identified import read_identified
from identification.result import Status
from problems.arrays import FloatArray

MASS_KG, RATE_HZ = 7.3, 200.0
COM_M = np.array([0.02, -0.03, 0.11])


@dataclass(frozen=True, kw_only=True)
class Run:
    """Eight rests and the moves between them: time (n,), place, orientation, and the raw wrench (n, 3) each."""

    time: FloatArray
    place: FloatArray
    turned: Rotation
    force: FloatArray
    torque: FloatArray


@pytest.fixture(scope="module")
def run() -> Run:
    """A tool that tilts and turns, at rest for 1 s each; by numpy and scipy alone."""
    rng = np.random.default_rng(7)
    rests = Rotation.from_euler("x", 170.0, degrees=True) * Rotation.from_rotvec(rng.uniform(-0.8, 0.8, (8, 3)))
    places = np.array([0.5, 0.1, 0.6]) + rng.uniform(-0.1, 0.1, (8, 3))
    time = np.arange(round(8 * 1.8 * RATE_HZ)) / RATE_HZ
    within = np.clip((time % 1.8 - 1.0) / 0.8, 0.0, 1.0)
    at = np.minimum(np.floor(time / 1.8) + within**3 * (10.0 - 15.0 * within + 6.0 * within**2), 7.0)
    turned = RotationSpline(np.arange(8.0), rests)(at)
    low = np.minimum(at.astype(int), 6)
    place = places[low] + (at - low)[:, None] * (places[low + 1] - places[low])
    gravity = turned.inv().apply([0.0, 0.0, -9.80665])
    force = MASS_KG * gravity + [3.0, -5.0, 8.0] + 0.3 * rng.standard_normal((len(time), 3))
    torque = np.cross(COM_M, MASS_KG * gravity) + [0.2, 0.1, -0.1] + 0.02 * rng.standard_normal((len(time), 3))
    return Run(
        time=time, place=place + 1e-6 * rng.standard_normal(place.shape), turned=turned, force=force, torque=torque
    )


def columns(path: Path, names: str, values: FloatArray, *, separator: str = ",", comma: bool = False) -> Path:
    rows = [separator.join(f"{value:.6f}" for value in row) for row in values]
    text = "\n".join([*([names] if names else []), *(row.replace(".", ",") if comma else row for row in rows), ""])
    path.write_text(text, encoding="utf-8")
    return path


def in_two_edits(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], logs: Sequence[Path], edits: Sequence[tuple[str, str]] = ()
) -> str:
    """Begin a cell.yaml, edit it (at most twice) and identify; returns the text that was begun."""
    cell, out = tmp_path / "cell.yaml", tmp_path / "identified.yaml"
    names = [*map(str, logs)]
    assert main(["inspect", *names, "--write-cell", str(cell), "--quiet"]) == 0, capsys.readouterr().err
    begun = text = cell.read_text(encoding="utf-8")
    assert len(edits) <= 2
    for before, after in edits:
        assert text.count(before) == 1, f"{before!r} must be once in\n{text}"
        text = text.replace(before, after)
    cell.write_text(text, encoding="utf-8")
    code = main(["identify", *names, "--cell", str(cell), "-o", str(out), "--allow-partial", "--quiet"])
    assert code == 0, capsys.readouterr().err + text
    payload = read_identified(out).result.payload
    assert payload.mass_kg.value is not None
    assert payload.mass_kg.std is not None
    assert abs(payload.mass_kg.value - MASS_KG) < 4.0 * payload.mass_kg.std < 0.1
    assert payload.com_m.value is not None
    assert np.max(np.abs(np.subtract(payload.com_m.value, COM_M))) < 1e-3
    return begun


def test_millimetres_degrees_and_milliseconds(tmp_path: Path, capsys: pytest.CaptureFixture[str], run: Run) -> None:
    """Euler angles under names that do not say which: the weight does, and nothing is to edit."""
    angles = run.turned.as_euler("xyz", degrees=True)
    values = np.column_stack([1e3 * run.time, 1e3 * run.place, angles, run.force, 1e3 * run.torque])
    path = columns(tmp_path / "a.csv", "time,x,y,z,rx,ry,rz,fx,fy,fz,tx,ty,tz", values)
    begun = in_two_edits(tmp_path, capsys, [path])
    assert "orientation_as: euler_xyz  # leaves 0." in begun
    assert "table: {time: time, time_unit: ms}  # it always rises; rows are 5 ms apart" in begun
    assert "units: {position: mm, angle: deg}  # positions up to " in begun
    assert "units: {force: N, torque: N·mm}  # newtons are usual; torques vary " in begun


def test_german_separators_and_units_in_brackets(tmp_path: Path, capsys: pytest.CaptureFixture[str], run: Run) -> None:
    """Decimal commas, units beside the names and w in front: nothing to edit."""
    turns = run.turned.as_quat()[:, [3, 0, 1, 2]]
    values = np.column_stack([1e3 * run.time, 1e-3 * run.force, run.torque, 1e2 * run.place, turns])
    names = (
        "Zeit [ms];Kraft X [kN];Kraft Y [kN];Kraft Z [kN];Moment X [Nm];Moment Y [Nm];Moment Z [Nm];"
        "Pos X [cm];Pos Y [cm];Pos Z [cm];qw;qx;qy;qz"
    )
    begun = in_two_edits(tmp_path, capsys, [columns(tmp_path / "b.csv", names, values, separator=";", comma=True)])
    assert 'table: {time: "Zeit [ms]", time_unit: ms}  # it always rises; its unit by its name' in begun
    assert "units: {force: kN, torque: N·m}  # by name" in begun
    assert "orientation: [qx, qy, qz, qw]" in begun


def test_no_header_at_all(tmp_path: Path, capsys: pytest.CaptureFixture[str], run: Run) -> None:
    """Time and quaternion show in the values; where force, torque and position stand has to be said."""
    values = np.column_stack([run.time, run.place, run.turned.as_quat(), run.force, run.torque])
    edits = [
        (
            'fields: {orientation: ["4", "5", "6", "7"]}',
            'fields: {position: ["1", "2", "3"], orientation: ["4", "5", "6", "7"]}',
        ),
        ("# Which of these is `wrench`?", 'wrench: {fields: {force: ["8", "9", "10"], torque: ["11", "12", "13"]}}'),
    ]
    begun = in_two_edits(tmp_path, capsys, [columns(tmp_path / "c.txt", "", values, separator=" ")], edits)
    assert 'table: {time: "0", time_unit: s}' in begun
    assert "#   8: " in begun


def test_a_matrix_and_nanoseconds_since_1970(tmp_path: Path, capsys: pytest.CaptureFixture[str], run: Run) -> None:
    """Column by column as Franka writes it, a command beside it, and a filtered force that is not the one to take."""
    matrix = np.zeros((len(run.time), 4, 4))
    matrix[:, :3, :3], matrix[:, :3, 3], matrix[:, 3, 3] = run.turned.as_matrix(), run.place, 1.0
    flat = matrix.transpose(0, 2, 1).reshape(len(run.time), 16)
    stamps = 1_700_000_000_000_000_000 + np.rint(run.time * 1e9).astype(np.int64)
    names = [
        "timestamp",
        *(f"O_T_EE[{i}]" for i in range(16)),
        *(f"O_T_EE_d[{i}]" for i in range(16)),
        *(f"ft.force.{axis}" for axis in "xyz"),
        *(f"ft.torque.{axis}" for axis in "xyz"),
        *(f"ft_filtered.force.{axis}" for axis in "xyz"),
    ]
    numbers = np.column_stack([flat, flat, run.force, run.torque, 0.0 * run.force + 1.0])
    rows = [f"{stamp}," + ",".join(f"{v:.7f}" for v in row) for stamp, row in zip(stamps, numbers, strict=True)]
    path = tmp_path / "d.csv"
    path.write_text("\n".join([",".join(names), *rows, ""]), encoding="utf-8")
    begun = in_two_edits(tmp_path, capsys, [path])
    assert "table: {time: timestamp, time_unit: ns}  # it always rises; counted since 1970 in ns" in begun
    assert begun.count("orientation_as: matrix_column_major  # the entries that are 0 throughout") == 2


@pytest.mark.parametrize(
    ("pose", "force", "who"),
    [("O_T_EE[{}]", "O_F_ext_hat_K[{}]", "sensor"), ("actual_TCP_pose_{}", "actual_TCP_force_{}", None)],
)
def test_whose_force_a_robot_logs(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], run: Run, pose: str, force: str, who: str | None
) -> None:
    """Franka's is the robot's on its surroundings, as of a bag; what a UR's is its manual does not say: a question."""
    turned = run.turned.as_matrix()
    matrix = np.concatenate([np.dstack([turned, run.place]), np.tile([[[0.0, 0.0, 0.0, 1.0]]], (len(turned), 1, 1))], 1)
    is_matrix = pose.startswith("O")
    placed = matrix.transpose(0, 2, 1).reshape(-1, 16) if is_matrix else np.c_[run.place, run.turned.as_rotvec()]
    names = ["time", *(pose.format(i) for i in range(placed.shape[1])), *(force.format(i) for i in range(6))]
    path = columns(tmp_path / "e.csv", ",".join(names), np.c_[run.time, placed, run.force, run.torque][:400])
    cell = tmp_path / "cell.yaml"
    assert main(["inspect", str(path), "--write-cell", str(cell), "--quiet"]) == 0, capsys.readouterr().err
    wrench = read_cell(cell).cell.wrench
    assert wrench is not None
    assert (wrench.gravity_compensated, wrench.expressed_in) == (True, "base")
    assert wrench.exerted_by == who
    assert ("# exerted_by: " in cell.read_text(encoding="utf-8")) == (who is None)


def test_lists_of_a_parquet_file(tmp_path: Path, capsys: pytest.CaptureFixture[str], run: Run) -> None:
    """A pose as Franka writes it and joint angles, each in one column: the file begun runs as it is."""
    matrix = np.zeros((len(run.time), 4, 4))
    matrix[:, :3, :3], matrix[:, :3, 3], matrix[:, 3, 3] = run.turned.as_matrix(), run.place, 1.0
    lists = {
        "O_T_EE": matrix.transpose(0, 2, 1).reshape(-1, 16),
        "wrench": np.c_[run.force, run.torque],
        "q": np.sin(np.outer(run.time, np.arange(1, 8))),
    }
    path = tmp_path / "run.parquet"
    pq.write_table(pa.table({"time": run.time} | {name: list(rows) for name, rows in lists.items()}), path)
    begun = in_two_edits(tmp_path, capsys, [path])
    assert '"O_T_EE[15]"]}  # by name; orientation' in begun
    assert "orientation_as: matrix_column_major  # the entries that are 0 throughout" in begun
    assert "# q[0] to q[6] of run.parquet are joint angles (by name; -1 to 1)." in begun


def test_an_orientation_alone_leaves_the_position_open(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], run: Run
) -> None:
    values = np.column_stack([run.time, run.turned.as_quat(), run.force, run.torque])[:400]
    path, cell = columns(tmp_path / "a.csv", "time,qx,qy,qz,qw,fx,fy,fz,tx,ty,tz", values), tmp_path / "cell.yaml"
    assert main(["inspect", str(path), "--write-cell", str(cell)]) == 0
    said = " ".join(capsys.readouterr().err.split())
    assert "guessed: wrench, pose, time; open: command, position of pose; check the guesses" in said


def test_two_tables_with_clocks_of_their_own(tmp_path: Path, capsys: pytest.CaptureFixture[str], run: Run) -> None:
    """A quaternion with its w in front that only the weight can show, at half the rate of the force."""
    forces = columns(
        tmp_path / "force.csv",
        "t_us,wrench_0,wrench_1,wrench_2,wrench_3,wrench_4,wrench_5",
        np.column_stack([1e6 * run.time, run.force, run.torque]),
    )
    half = slice(None, None, 2)
    turns = run.turned.as_quat()[half][:, [3, 0, 1, 2]]
    values = np.column_stack([run.time[half], run.place[half], turns])
    poses = columns(tmp_path / "pose.csv", "secs,pos_1,pos_2,pos_3,quat_1,quat_2,quat_3,quat_4", values)
    begun = in_two_edits(tmp_path, capsys, [forces, poses])
    assert "  force.csv: {time: t_us, time_unit: us}" in begun
    assert "  pose.csv: {time: secs, time_unit: s}" in begun


@pytest.mark.parametrize("has_time", [True, False])
def test_a_row_per_pose(tmp_path: Path, capsys: pytest.CaptureFixture[str], run: Run, has_time: bool) -> None:
    """Means of rests, with the time of each or without: nothing to edit, and no time is made of it."""
    at = (np.arange(8) * 1.8 * RATE_HZ).astype(int)[:, None] + np.arange(20, 180)
    means = [each[at].mean(axis=1) for each in (run.force, run.torque)]
    values = np.column_stack([10.0 * np.arange(8), run.turned[at[:, 80]].as_quat(), *means])
    names = "time,qx,qy,qz,qw,fx,fy,fz,mx,my,mz"
    path = columns(tmp_path / "poses.csv", names if has_time else names[5:], values if has_time else values[:, 1:])
    assert "table: {rows: poses}  # the orientation leaps from row to row" in in_two_edits(tmp_path, capsys, [path])


def test_what_is_printed_is_how_the_log_is_read_with_the_guesses(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], run: Run
) -> None:
    names = "time,x,y,z,qx,qy,qz,qw,fx,fy,fz,tx,ty,tz"
    values = np.column_stack([run.time, run.place, run.turned.as_quat(), run.force, run.torque])
    path, cell = columns(tmp_path / "a.csv", names, values), tmp_path / "cell.yaml"
    assert main(["inspect", str(path), "--write-cell", str(cell)]) == 0
    printed = capsys.readouterr()
    said = " ".join(printed.err.split())
    assert "guessed: wrench, pose, time; open: command; check the guesses" in said
    assert f"next: autotune identify {path} --cell {cell} --allow-partial" in said
    assert "wrench: a.csv (declared with its fields)" in printed.out
    assert "error: " not in printed.out
    assert "no channel for the wrench" not in printed.out


def test_times_that_repeat_or_fall_are_said(tmp_path: Path, run: Run) -> None:
    names = "time,x,y,z,qx,qy,qz,qw,fx,fy,fz,tx,ty,tz"
    time = np.floor(run.time * 125.0 + 1e-6) / 125.0
    cell = tmp_path / "cell.yaml"
    for falls in (False, True):
        stamps = np.where(np.arange(len(time)) == 1000, time - 1.0, time) if falls else time
        values = np.column_stack([stamps, run.place, run.turned.as_quat(), run.force, run.torque])
        path = columns(tmp_path / "a.csv", names, values)
        assert main(["inspect", str(path), "--write-cell", str(cell), "--force", "--quiet"]) == 0
        begun = cell.read_text(encoding="utf-8")
        said = (
            f"from {time[999]:g} to {time[1000] - 1.0:g} in row 1001"
            if falls
            else f"rows repeat a time, {time[-1] / (len(time) - 1):.4g} s"
        )
        assert said in begun
        assert "it always rises" not in begun


def contact_trace(*, noise_n: float = 0.3) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Time [s], travel [mm] at 30 mm/s against 12 N/mm at 0.5 mm, and a force [N] that rings at 25 Hz as it rises."""
    time = np.arange(1200) / 1000.0
    travel = np.minimum(30.0 * time, 3.0)
    ringing = 1.0 + 0.6 * np.exp(-30.0 * np.maximum(time - 0.02, 0.0)) * np.cos(50.0 * np.pi * time)
    force = np.where(travel > 0.5, 12.0 * (travel - 0.5) * ringing, 0.0)
    return time, travel, force + noise_n * np.random.default_rng(0).standard_normal(len(time))


@pytest.mark.parametrize(
    ("names", "sign", "who", "edits"),
    [
        ("Time [s];Displacement [mm];Load [N]", -1.0, "payload", []),
        ("", 1.0, "sensor", [("# table: {sample_rate_hz: 1000.0}", "table: {sample_rate_hz: 1000.0}")]),
        ("", -1.0, "payload", []),
    ],
)
def test_a_trace_of_one_contact(
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    names: str,
    sign: float,
    who: str,
    edits: Sequence[tuple[str, str]],
) -> None:
    """By name, and of two columns without names the one that rings; whose force it is shows in its sign."""
    time, travel, force = contact_trace()
    values = np.column_stack([*([] if edits else [time]), travel, sign * force])
    log = columns(tmp_path / "trace.csv", names, values, separator=";")
    cell, out = tmp_path / "cell.yaml", tmp_path / "identified.yaml"
    assert main(["inspect", str(log), "--write-cell", str(cell), "--quiet"]) == 0
    text = cell.read_text(encoding="utf-8")
    assert f"exerted_by: {who}" in text
    for before, after in edits:
        text = text.replace(before, after)
    cell.write_text(text, encoding="utf-8")
    assert main(["identify", str(log), "--cell", str(cell), "-o", str(out), "--allow-partial", "--quiet"]) == 0
    capsys.readouterr()
    [surface] = read_identified(out).result.axes["z"].environments
    secant = surface.secant_stiffness_n_per_m
    assert secant.value is not None
    assert secant.std is not None
    assert abs(secant.value - 12e3) < 2.0 * secant.std


def test_a_height_that_begins_elsewhere_is_a_place(tmp_path: Path) -> None:
    time, travel, force = contact_trace()
    log = columns(tmp_path / "z.csv", "t,z,Fz", np.column_stack([time, 0.62 + 1e-3 * travel, force]))
    assert main(["inspect", str(log), "--write-cell", str(tmp_path / "cell.yaml"), "--quiet"]) == 0
    cell = read_cell(tmp_path / "cell.yaml").cell
    assert cell.displacement is None
    assert cell.pose is not None


def test_a_test_along_one_axis_with_its_command_shows_the_robot_too(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Three presses on a spring behind a pole of 25 rad/s and 8 ms of delay: nothing to edit, and no warning."""
    pole, delay_s, step_s = 25.0, 8e-3, 1e-3
    time = np.arange(0.0, 12.0, step_s)
    within = time % 4.0
    command = np.interp(within, [0.0, 0.5, 1.5, 2.5, 3.3, 4.0], [0.0, 0.0, 0.03, 0.03, 0.0, 0.0])
    late = np.interp(time - delay_s, time, command)
    travel = np.zeros_like(time)
    for i in range(1, len(time)):
        travel[i] = late[i - 1] + (travel[i - 1] - late[i - 1]) * np.exp(-pole * step_s)
    noise = 0.1 * np.random.default_rng(5).standard_normal(len(time))
    values = np.column_stack([time, travel, command, noise - 3e3 * np.maximum(travel - 0.022, 0.0)])[::4]
    log = columns(tmp_path / "test.csv", "t,z,z_cmd,Fz", values)
    cell, out = tmp_path / "cell.yaml", tmp_path / "identified.yaml"
    assert main(["inspect", str(log), "--write-cell", str(cell), "--quiet"]) == 0
    assert "position: [null, null, z_cmd]}  # by name; 0 to 0.03" in cell.read_text(encoding="utf-8")
    capsys.readouterr()
    assert main(["identify", str(log), "--cell", str(cell), "-o", str(out), "--allow-partial"]) == 0
    assert "warning(s) of the numerical libraries" not in capsys.readouterr().err
    axis = read_identified(out).result.axes["z"]
    bandwidth, delay = axis.robot.bandwidth_hz, axis.robot.delay_s
    assert bandwidth.value is not None
    assert delay.value is not None
    assert delay.std is not None
    assert bandwidth.value == pytest.approx(pole / (2.0 * np.pi), rel=0.01)
    assert abs(delay.value - delay_s) < 3.0 * delay.std + 1e-3
    assert axis.environments


def pressed_to_and_fro(stiffness: float) -> FloatArray:
    """16 kg behind an admittance of 13 kg and 1000 N·s/m, ±20 N in turn, a wall at 10 mm: time, place, force (n, 3).

    The payload is rigid on a robot of two poles at 25 rad/s that gives way a little, as 200 kg do, and has a drag of
    30 N·s/m; the force is the robot's on it.
    """
    step, rng = 1e-4, np.random.default_rng(3)
    asked = asking = at = speed = felt = 0.0
    rows = []
    for k in range(round(26.0 / step)):
        time = k * step
        desired = 0.0 if time < 2.0 else 20.0 if int((time - 2.0) / 3.0) % 2 == 0 else -20.0
        asking += step * (desired - felt - 1000.0 * asking) / 13.0
        asked += step * asking
        push = 25.0**2 * (asked - at) + 50.0 * (asking - speed)
        wall = max(0.0, stiffness * (at - 0.01)) if at > 0.01 else 0.0
        acceleration = push - (wall + 30.0 * speed) / 200.0
        felt = 16.0 * acceleration + 30.0 * speed + wall
        speed += step * acceleration
        at += step * speed
        if k % 20 == 0:
            rows.append((time, at, felt))
    found = np.array(rows)
    found[:, 2] += rng.normal(0.0, 0.15, len(found))
    return found


@pytest.mark.parametrize(("stiffness", "shows_mass"), [(1500.0, True), (4000.0, False)])
def test_a_force_that_turns_to_and_fro_on_a_soft_wall(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], stiffness: float, shows_mass: bool
) -> None:
    log = columns(tmp_path / "push.csv", "time,x,fx", pressed_to_and_fro(stiffness))
    cell, out = tmp_path / "cell.yaml", tmp_path / "identified.yaml"
    assert main(["inspect", str(log), "--write-cell", str(cell), "--quiet"]) == 0
    read = read_cell(cell).cell
    # It goes beyond where it began, and meets the wall on the way: a place, no displacement since the contact.
    assert read.displacement is None
    assert read.wrench is not None
    assert read.wrench.exerted_by == "sensor"
    assert main(["identify", str(log), "--cell", str(cell), "--allow-partial", "-o", str(out), "--quiet"]) == 0
    capsys.readouterr()
    found = read_identified(out).result
    [surface] = found.axes["x"].environments
    secant = surface.secant_stiffness_n_per_m
    assert secant.value is not None
    assert secant.std is not None
    assert abs(secant.value - stiffness) < 2.0 * secant.std
    [timeline] = found.timelines
    # Where F^d turns, the payload's own inertia presses, and that is no touch.
    walls = [each for each in timeline.touches if each.surface == surface.name]
    assert all(each.sign == 1 for each in (timeline.touches if shows_mass else walls))
    first = walls[0]
    assert first.onset_s == pytest.approx(2.0 + 0.01 / 0.0194 + 0.07, abs=0.1)
    # Three pushes or more show what moves, if nothing shows the coupling.
    mass = found.payload.mass_kg
    if not shows_mass:
        return
    assert mass.status is Status.WEAK
    assert mass.value is not None
    assert mass.std is not None
    assert abs(mass.value - 16.0) < 2.0 * mass.std
