"""A cell.yaml to start from says what was found, asks for the rest, and is valid at every step."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from autotune.errors import UsageError
from autotune.formats.cell import cell_text, check_cell_text, read_cell, write_cell_start
from identification.logs.guess import guess_cell
from identification.logs.inspect import inspect_log
from identification.logs.read import read_recording
from identification.logs.roles.cell import Cell, Frame, PoseSource, WrenchSource
from tests.identification.logs.log_builder import complete, pose_stream, wrench_stream, write_mcap
from tests.identification.logs.message_builder import Topic, header, write_log


def uncommented(text: str) -> str:
    """Take the # of every answer away, leaving the remarks behind it."""
    return re.sub(r"^( *)# ((?:  )?[a-z_]+:.*)$", r"\1\2", text, flags=re.MULTILINE)


def test_what_was_found_is_filled_in_and_reads_the_log_alike(tmp_path: Path) -> None:
    path = write_mcap(tmp_path / "run.mcap", complete())
    write_cell_start(tmp_path / "cell.yaml", inspect_log(path))
    cell = read_cell(tmp_path / "cell.yaml").cell
    assert cell == Cell(
        wrench=WrenchSource(topic="/ft/wrench"),
        pose=PoseSource(topic="/robot/pose"),
        command=PoseSource(topic="/robot/pose_command"),
    )
    found = read_recording(path, cell)
    assert (found.wrench.topic, found.pose.topic) == ("/ft/wrench", "/robot/pose")


def test_candidates_are_listed_where_the_log_does_not_decide(tmp_path: Path) -> None:
    text = cell_text(inspect_log(write_mcap(tmp_path / "run.mcap", [wrench_stream("/a"), wrench_stream("/b")])))
    assert check_cell_text(text, Path("cell.yaml")) == Cell()
    lines = text.splitlines()
    at = lines.index("# Which of these is `wrench`?")
    assert lines[at + 1].startswith("#   /a (geometry_msgs/msg/WrenchStamped, 200 messages, ")
    assert lines[at + 2].startswith("#   /b (")
    assert "# The log has no channel for `pose`." in lines


def test_every_answer_offered_is_one_that_the_reader_takes(tmp_path: Path) -> None:
    path = write_mcap(tmp_path / "run.mcap", complete())
    text = uncommented(cell_text(inspect_log(path)))
    cell = check_cell_text(text, Path("cell.yaml"))
    assert cell.wrench is not None
    assert cell.wrench.deadband is not None
    assert cell.wrench.saturation.force_n is not None
    assert cell.sensor.orientation == (0.0, 0.0, 0.0, 1.0)


@pytest.mark.parametrize(("frame", "axes"), [("base_link", Frame.BASE), ("ft", None)])
def test_a_wrench_that_is_near_zero_at_both_ends_is_without_its_weight(
    tmp_path: Path, frame: str, axes: Frame | None
) -> None:
    raw = wrench_stream(duration_s=2.0)
    values = np.random.default_rng(4).normal(size=raw.values.shape) * 0.2
    values[400:600, 2] += 40.0
    path = write_mcap(tmp_path / "run.mcap", [replace(raw, values=values, frame_id=frame), pose_stream(duration_s=2.0)])
    cell = check_cell_text(cell_text(inspect_log(path), guess_cell([path])), Path("cell.yaml"))
    assert cell.wrench is not None
    assert (cell.wrench.gravity_compensated, cell.wrench.expressed_in) == (True, axes)
    loaded = write_mcap(tmp_path / "raw.mcap", [raw, pose_stream(duration_s=2.0)])
    assert guess_cell([loaded]).wrenches == {}
    # Whoever declares the one and not the other is told where the axes are in doubt.
    bare = replace(cell.wrench, expressed_in=None)
    assert ("wrench-frame-assumed" in codes_of(path, bare)) == (axes is not None)
    assert "wrench-frame-assumed" not in codes_of(path, replace(bare, expressed_in=Frame.SENSOR))


def codes_of(path: Path, wrench: WrenchSource) -> set[str]:
    return {finding.code for finding in inspect_log(path, Cell(wrench=wrench)).findings}


def test_numbers_without_meaning_are_named(tmp_path: Path) -> None:
    joints = Topic(
        topic="/state",
        type_name="sensor_msgs/msg/JointState",
        message=lambda i, s: {"header": header(s), "position": [0.0] * 6, "effort": [float(i)] * 6},
    )
    text = cell_text(inspect_log(write_log(tmp_path / "run.mcap", [joints])))
    assert "#   /state: position[0] to position[5], effort[0] to effort[5]" in text
    assert '#   topic: "/state"\n#   fields: {force: ["…", "…", "…"], torque: ["…", "…", "…"]}' in text


def test_names_cannot_break_out_of_their_line(tmp_path: Path) -> None:
    hostile = '/ft\nwrench: {topic: "/evil"} # \x1b[2J \ufeff"'
    path = write_mcap(tmp_path / "run.mcap", [wrench_stream(hostile), pose_stream("/p\t1"), pose_stream("/p\n2")])
    text = cell_text(inspect_log(path))
    cell = check_cell_text(text, Path("cell.yaml"))
    assert cell == Cell(wrench=WrenchSource(topic=hostile))
    assert "\x1b" not in text


def test_a_file_that_is_there_stays_unless_forced(tmp_path: Path) -> None:
    path, target = write_mcap(tmp_path / "run.mcap", complete()), tmp_path / "cell.yaml"
    target.write_text("mine\n", encoding="utf-8")
    with pytest.raises(UsageError, match="exists; name another file, or use --force"):
        write_cell_start(target, inspect_log(path))
    assert target.read_text(encoding="utf-8") == "mine\n"
    write_cell_start(target, inspect_log(path), force=True)
    assert read_cell(target).cell.wrench is not None


def test_a_table_is_asked_for_its_time(tmp_path: Path) -> None:
    path = tmp_path / "run.csv"
    path.write_text("t,fx\n0.0,1\n0.1,2\n0.2,4\n", encoding="utf-8")
    text = cell_text(inspect_log(path))
    assert "# table: {time: t, time_unit: s}" in text
    assert "#   run.csv: t, fx" in text
    assert check_cell_text(text, Path("cell.yaml")) == Cell()
