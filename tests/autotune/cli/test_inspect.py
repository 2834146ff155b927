"""`autotune inspect` through the real entry point."""

import json
import subprocess
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from autotune.cli.main import main
from tests.identification.logs.log_builder import complete, pose_stream, wrench_stream, write_mcap
from tests.next_step import is_next_alone

RunCli = Callable[..., "subprocess.CompletedProcess[str]"]


def test_a_table_and_nothing_missing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = write_mcap(tmp_path / "run.mcap", complete())
    assert main(["inspect", str(path)]) == 0
    output = capsys.readouterr()
    lines = output.out.splitlines()
    heading = next(line for line in lines if line.startswith("topic"))
    row = next(line for line in lines if line.startswith("/ft/wrench"))
    assert row.index("500.00") + len("500.00") == heading.index("rate [Hz]") + len("rate [Hz]")
    assert row.split()[1:3] == ["geometry_msgs/msg/WrenchStamped", "200"]
    assert lines[-1] == "Every channel that identify needs is there."
    assert is_next_alone(output.err)


def test_json_holds_the_whole_summary(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = write_mcap(tmp_path / "run.mcap", [wrench_stream(), pose_stream()])
    assert main(["inspect", str(path), "--json"]) == 0
    tree = json.loads(capsys.readouterr().out)
    assert tree["path"] == str(path)
    assert tree["container"] == "mcap"
    assert {channel["topic"]: channel["roles"] for channel in tree["channels"]} == {
        "/camera/image": [],
        "/ft/wrench": ["wrench"],
        "/robot/pose": ["pose measured"],
    }
    assert len(tree["missing"]) == 1
    assert "commanded pose" in tree["missing"][0]


def test_a_damaged_file_is_one_line_and_code_3(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = write_mcap(tmp_path / "run.mcap", complete())
    path.write_bytes(path.read_bytes()[:-1000])
    assert main(["inspect", str(path)]) == 3
    output = capsys.readouterr()
    assert output.out == ""
    assert len(output.err.splitlines()) == 1
    assert "run.mcap is truncated or damaged at byte" in output.err


def test_control_characters_of_a_topic_do_not_reach_the_terminal(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = write_mcap(tmp_path / "run.mcap", [wrench_stream("/ft\x1b[2J")])
    assert main(["inspect", str(path)]) == 0
    assert "\x1b" not in capsys.readouterr().out


def test_help_shows_an_example(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["inspect", "--help"]) == 0
    assert "autotune inspect run7.mcap" in capsys.readouterr().out


def test_recorded_bags_are_described(shared_data: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["inspect", str(shared_data / "nj60" / "yellow_table_1.bag")]) == 0
    output = capsys.readouterr().out
    assert "/robot_state" in output
    assert "record the force/torque sensor as geometry_msgs/msg/WrenchStamped" in output


def test_an_axis_that_is_constant_zero_is_to_be_corrected_first(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """All channels are there, and `identify` refuses the log all the same."""
    rng, count = np.random.default_rng(1), 2000
    columns = [np.arange(count) * 0.004, *rng.standard_normal((9, count)), *np.zeros((3, count)), np.ones(count)]
    columns[1] = np.zeros(count)
    head = "t,fx,fy,fz,tx,ty,tz,x,y,z,qx,qy,qz,qw"
    np.savetxt(tmp_path / "run.csv", np.column_stack(columns), delimiter=",", header=head, comments="", fmt="%.6f")
    cell = tmp_path / "cell.yaml"
    pose = "fields: {position: [x, y, z], orientation: [qx, qy, qz, qw]}, orientation_as: quaternion_xyzw"
    cell.write_text(
        "format: autotune/cell\nversion: 1\ntable: {time: t}\n"
        "wrench: {topic: run.csv, fields: {force: [fx, fy, fz], torque: [tx, ty, tz]}, exerted_by: payload}\n"
        f"pose: {{topic: run.csv, {pose}}}\ncommand: {{topic: run.csv, {pose}}}\n"
    )
    log = str(tmp_path / "run.csv")
    assert main(["inspect", log, "--cell", str(cell)]) == 0
    output = capsys.readouterr()
    assert "error: " in output.out
    assert output.out.splitlines()[-1] == "Every channel that identify needs is there; correct the errors above first."
    assert output.err.startswith("next: autotune plan  # ")
