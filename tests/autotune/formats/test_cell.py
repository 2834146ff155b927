"""`cell.yaml` is read as it stands or refused with its line."""

import re
from dataclasses import replace
from pathlib import Path

import pytest

from autotune.errors import UsageError
from autotune.formats.cell import check_cell_text, read_cell
from identification.logs.roles.cell import Cell, Clock, ExertedBy, Frame, PoseSource
from identification.logs.tables.read import list_columns, read_table
from problems.contact.nonlinearities import DeadbandType

HEAD = "format: autotune/cell\nversion: 1\n"

EVERYTHING = (
    HEAD
    + """\
gravity_direction: [0.0, 0.6, -0.8]
sensor: {orientation: [0.0, 0.0, 90.0], orientation_as: euler_xyz, angle: deg}
wrench:
  topic: /state
  frame: ft
  header: inner.header
  clock: log
  clock_offset_s: -2e-3
  fields: {force: ["effort[0]", null, "effort[2]"], torque: [null, null, null]}
  units: {force: kN, torque: N·mm}
  signs: [1, -1, 1, 1, 1, -1]
  expressed_in: base
  exerted_by: sensor
  gravity_compensated: true
  deadband: {type: threshold, force_n: 2, torque_n_m: 0.1}
  saturation: {force_n: [500, 500, 1500], torque_n_m: [20, 20, 20]}
pose:
  parent: base
  child: tool0
  units: {position: mm, angle: deg}
  signs: [1, 1, -1]
  orientation_as: quaternion_wxyz
command: {topic: /cmd, fields: {position: [a, b, c], orientation: [d, e, f]}, orientation_as: euler_ZYZ}
twist: {topic: /twist, units: {linear: mm, angular: deg}, expressed_in: flange}
gains: {mass: [10, 10, 10, 1, 1, 1], damping: [100, 100, 100, 5, 5, 5]}
desired_force: {topic: /wish}
table: {time: t, time_unit: ms, delimiter: ";", decimal: ","}
"""
)


def refused(text: str) -> str:
    with pytest.raises(UsageError) as caught:
        check_cell_text(HEAD + text, Path("cell.yaml"))
    return str(caught.value)


def test_an_empty_cell_declares_nothing(tmp_path: Path) -> None:
    (tmp_path / "cell.yaml").write_text(HEAD, encoding="utf-8")
    found = read_cell(tmp_path / "cell.yaml")
    assert found.cell == Cell()
    assert re.fullmatch("[0-9a-f]{64}", found.sha256)


def test_every_entry_arrives_where_it_belongs() -> None:
    cell = check_cell_text(EVERYTHING, Path("cell.yaml"))
    wrench, pose, command = cell.wrench, cell.pose, cell.command
    assert cell.gravity_direction == (0.0, 0.6, -0.8)
    assert (cell.sensor.orientation, cell.sensor.orientation_as, cell.sensor.angle) == ((0, 0, 90), "euler_xyz", "deg")
    assert wrench is not None
    assert (wrench.topic, wrench.frame, wrench.header) == ("/state", "ft", "inner.header")
    assert [wrench.clock, wrench.clock_offset_s] == [Clock.LOG, -0.002]
    assert wrench.fields is not None
    assert wrench.fields.force == ("effort[0]", None, "effort[2]")
    assert (wrench.units.force, wrench.units.torque) == ("kN", "N·mm")
    assert list(wrench.signs) == [1, -1, 1, 1, 1, -1]
    assert [wrench.expressed_in, wrench.exerted_by, wrench.gravity_compensated] == [Frame.BASE, ExertedBy.SENSOR, True]
    assert wrench.deadband is not None
    assert [wrench.deadband.type, wrench.deadband.force_n] == [DeadbandType.THRESHOLD, 2.0]
    assert wrench.saturation.force_n == (500.0, 500.0, 1500.0)
    assert pose is not None
    assert (pose.parent, pose.child, pose.units.position, pose.signs) == ("base", "tool0", "mm", (1, 1, -1))
    assert command is not None
    assert command.fields is not None
    assert command.fields.orientation == ("d", "e", "f")
    assert cell.twist is not None
    assert cell.twist.expressed_in is Frame.FLANGE
    assert cell.gains is not None
    assert list(cell.gains.damping or ()) == [100, 100, 100, 5, 5, 5]
    assert cell.desired_force is not None
    assert cell.table is not None
    assert (cell.table.time, cell.table.time_unit, cell.table.delimiter, cell.table.decimal) == ("t", "ms", ";", ",")


def test_lists_of_a_known_count_need_no_spaces(tmp_path: Path) -> None:
    path = tmp_path / "cell.yaml"
    path.write_text(
        HEAD + "gravity_direction: [0,0,-1]\ngains: {mass: [20,20,20,1,1,1], damping: [900,900,900,9,9,9]}\n"
        "desired_force: {force: [0,0,30]}\n"
    )
    cell = read_cell(path).cell
    assert cell.gravity_direction == (0.0, 0.0, -1.0)
    assert cell.gains is not None
    assert cell.gains.mass == (20.0, 20.0, 20.0, 1.0, 1.0, 1.0)
    assert cell.desired_force is not None
    assert cell.desired_force.force == (0.0, 0.0, 30.0)


@pytest.mark.parametrize(
    ("text", "line", "output"),
    [
        ("wrensh: {}", 3, "wrench may be meant"),
        ("wrench:\n  topik: /a", 4, "topic may be meant"),
        ("wrench:\n  gravity_compensate: true", 4, "gravity_compensated may be meant"),
        ("pose:\n  units:\n    lenght: mm", 5, "must be one of position, angle, found the key lenght."),
        ("wrench: {units: {force: newton}}", 3, "one of N, kN, lbf, kgf"),
        ("wrench: {signs: [1, 1, 1, 1, 1, 2]}", 3, r"wrench.signs[5] must be one of 1, -1, found 2."),
        (
            "wrench: {signs: [1, 1, 1]}",
            3,
            "at least 6 entries long, found a list of 3: force x y z, then torque x y z.",
        ),
        ("wrench: {signs: [1,1,-1]}", 3, "at least 6 entries long"),
        ("pose: {signs: [1, 1]}", 3, "at least 3 entries long, found a list of 2."),
        ("gravity_direction: [0,0, -1]", 3, "0,0 may be a decimal comma; write 0.0 for one number, 0, 0 for two."),
        ("gains: {mass: [20,5,20], damping: [1,1,1]}", 3, "20,5 may be a decimal comma"),
        ("noise: [0,5]", 3, "0,5 may be a decimal comma"),
        ("wrench: {left_out: [w]}", 3, "one of x, y, z, rx, ry, rz"),
        ('wrench: {fields: {force: ["effort[0:2]"]}}', 3, "wrench.fields.force must be 3 paths"),
        ("pose: {fields: {orientation: [a, b, c]}}", 3, "pose.orientation_as must be of 3 numbers"),
        ('pose: {fields: {orientation: ["a[0:16]"]}}', 3, "orientation_as must be of 16 numbers"),
        ("wrench: {fields: {torque: [a, b, c]}}", 3, "wrench.fields.force must be present"),
        ("wrench: {deadband: {force_n: 2}}", 3, "deadband.type must be present"),
        ("wrench: {exerted_by: robot}", 3, "one of payload, sensor"),
        ("wrench: {topic: }", 3, "wrench.topic must be text, found nothing"),
        ("pose:\n  orientation_as: euler_ZZY", 4, "euler_ and three axes"),
        ("pose:\n  fields: {position: [a, b, c], orientation: [d, e, f]}", 3, "of 3 numbers"),
        ("pose:\n  child: tool0", 3, "pose.parent must be named too"),
        ("pose: {}\ndisplacement: {}", 4, "displacement must be the only one of the two"),
        ("gains: {mass: [1, 1, 1, 1, 1, 1]}", 3, "gains.damping must be given"),
        ("gains:\n  topic: /g\n  mass: [1, 1, 1, 1, 1, 1]\n  damping: [1, 1, 1, 1, 1, 1]", 5, "left out where topic"),
        ("sensor: {orientation: [1, 2, 3]}", 3, "4 numbers, as quaternion_xyzw has"),
        ("gravity_direction: [0, 0, 0]", 3, "a direction, not zero"),
        ("table: {time: t, sample_rate_hz: 100}", 3, "left out where a time column is named"),
        ("version: 1", 3, "the key version occurs twice"),
    ],
)
def test_what_is_unknown_or_contradictory_is_refused_with_its_line(text: str, line: int, output: str) -> None:
    message = refused(text)
    assert f"cell.yaml, line {line}: " in message
    assert output in message


def test_signs_need_no_space_after_their_commas() -> None:
    cell = check_cell_text("format: autotune/cell\nversion: 1\npose: {signs: [1,1,-1]}\n", Path("cell.yaml"))
    assert cell.pose is not None
    assert cell.pose.signs == (1, 1, -1)


@pytest.mark.parametrize("text", ["version: 1\n", "format: autotune/problem\nversion: 1\n", "format: autotune/cell\n"])
def test_another_format_or_version_is_refused(text: str) -> None:
    with pytest.raises(UsageError, match="must be"):
        check_cell_text(text, Path("cell.yaml"))


def test_the_examples_are_valid(repository: Path) -> None:
    for name in ("cell.yaml", "traces.yaml"):
        assert read_cell(repository / "examples" / "nj60" / name).cell.wrench is not None


def test_the_file_in_the_manual_is_valid_and_says_what_its_remarks_say(repository: Path) -> None:
    manual = (repository / "docs" / "cell.md").read_text(encoding="utf-8")
    text = manual.split("```yaml\n")[1].split("```")[0]
    cell = check_cell_text(text, Path("cell.md"))
    assert cell.pose is not None
    assert cell.pose.orientation_as == "euler_ZYZ"
    # What is shown as the default is the default.
    assert cell.gravity_direction == Cell().gravity_direction
    assert cell.pose.units == PoseSource().units


@pytest.mark.parametrize(
    ("entries", "rows"),
    [("header_rows: 0", 3), ("header_rows: 1", 2), ("header_rows: 1.0", 2), ("skip_rows: 1", 2), ("skip_rows: 1.0", 2)],
)
def test_whole_numbers_of_a_table_arrive_as_such(tmp_path: Path, entries: str, rows: int) -> None:
    """YAML's numbers are doubles to a schema; rows are counted."""
    path = tmp_path / "trace.csv"
    path.write_text("0.0,1.0\n0.5,2.0\n1.0,3.0\n", encoding="utf-8")
    layout = check_cell_text(HEAD + f"table: {{sample_rate_hz: 10, {entries}}}\n", tmp_path / "cell.yaml").table
    assert layout is not None
    assert len(read_table(path, replace(layout, columns=list_columns(path, layout))).values) == rows
