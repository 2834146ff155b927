"""`--cell`, `--write-cell`, `--salvage` and several logs through the real entry point."""

import hashlib
import json
from pathlib import Path

import pytest

from autotune.cli.main import main
from autotune.formats.cell import read_cell
from autotune.formats.identified import read_identified
from tests.identification.logs.log_builder import complete, pose_stream, wrench_stream, write_mcap


def run(capsys: pytest.CaptureFixture[str], *arguments: str | Path) -> tuple[int, str, str]:
    code = main([*map(str, arguments)])
    output = capsys.readouterr()
    return code, output.out, output.err


def test_inspect_begins_a_cell_file_and_takes_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path, cell = write_mcap(tmp_path / "run.mcap", complete()), tmp_path / "cell.yaml"
    code, out, err = run(capsys, "inspect", path, "--write-cell", cell)
    assert (code, err) == (0, f"written: {cell}\nnext: autotune identify {path} --cell {cell}\n")
    assert "wrench: /ft/wrench (the only plausible geometry_msgs/msg/WrenchStamped)" in out
    assert read_cell(cell).cell.wrench is not None
    code, out, _ = run(capsys, "inspect", path, "--cell", cell)
    assert code == 0
    assert "wrench: /ft/wrench (named by you)" in out
    code, out, err = run(capsys, "inspect", path, "--write-cell", cell)
    assert (code, out) == (2, "")
    assert "exists; name another file, or use --force" in err
    assert run(capsys, "inspect", path, "--write-cell", cell, "--force")[0] == 0
    assert run(capsys, "inspect", path, "--write-cell", tmp_path / "b.yaml", "--cell", cell)[0] == 2


def test_inspect_with_a_wrong_cell_file_is_a_usage_error(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path, cell = write_mcap(tmp_path / "run.mcap", complete()), tmp_path / "cell.yaml"
    cell.write_text("format: autotune/cell\nversion: 1\nwrench:\n  topik: /a\n", encoding="utf-8")
    code, out, err = run(capsys, "inspect", path, "--cell", cell)
    assert (code, out) == (2, "")
    assert "line 4" in err
    assert "topic may be meant" in err


def test_a_cell_file_settles_what_is_ambiguous(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path, cell = tmp_path / "run.mcap", tmp_path / "cell.yaml"
    write_mcap(path, [wrench_stream("/a"), wrench_stream("/b"), pose_stream()])
    tree = json.loads(run(capsys, "inspect", path, "--json")[1])
    roles = {role["entry"]: role for role in tree["roles"]}
    assert roles["wrench"]["topic"] is None
    assert [candidate["topic"] for candidate in roles["wrench"]["candidates"]] == ["/a", "/b"]
    cell.write_text("format: autotune/cell\nversion: 1\nwrench: {topic: /b}\n", encoding="utf-8")
    tree = json.loads(run(capsys, "inspect", path, "--json", "--cell", cell)[1])
    assert {role["entry"]: role["topic"] for role in tree["roles"]}["wrench"] == "/b"


def test_the_identified_file_says_where_it_comes_from(
    tmp_path: Path, good_log: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cell, out = tmp_path / "cell.yaml", tmp_path / "identified.yaml"
    cell.write_text("format: autotune/cell\nversion: 1\nwrench: {topic: /ft_sensor/wrench}\n", encoding="utf-8")
    assert run(capsys, "identify", good_log, "--cell", cell, "-o", out, "--quiet")[0] == 0
    read = read_identified(out)
    assert read.provenance["cell"] == {"path": str(cell), "sha256": hashlib.sha256(cell.read_bytes()).hexdigest()}
    assert read.provenance["clocks"] == {"wrench": "header", "pose": "header", "command": "header"}
    assert read.provenance["options"]["salvage"] is False
    assert [log["path"] for log in read.provenance["logs"]] == [str(good_log)]
    chosen = [finding.message for finding in read.result.findings if finding.code == "channel-chosen"]
    assert any(message.startswith("The wrench is read from /ft_sensor/wrench") for message in chosen)
    assert "clocks-agree" in [finding.code for finding in read.result.findings]


def test_a_damaged_log_is_read_on_request_and_the_loss_is_reported(
    tmp_path: Path, good_log: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cut, out = tmp_path / "cut.mcap", tmp_path / "identified.yaml"
    cut.write_bytes(good_log.read_bytes()[:-2000])
    assert run(capsys, "identify", cut, "-o", out)[0] == 3
    assert not out.exists()
    code, _, err = run(capsys, "identify", cut, "-o", out, "--salvage", "--quiet")
    assert (code, err) == (0, "")
    read = read_identified(out)
    assert read.provenance["options"]["salvage"] is True
    text = {finding.code: finding.message for finding in read.result.findings if "cut.mcap" in finding.message}
    assert "the end was cut off" in text["salvaged"]
    lasts = read.provenance["time_span_s"][1] - read.provenance["time_span_s"][0]
    assert f"spans {lasts:.3f} s" in text["salvaged-span"]
    assert run(capsys, "inspect", cut)[0] == 3
    assert run(capsys, "inspect", cut, "--salvage")[0] == 0


def test_nothing_to_read_is_a_usage_error(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(capsys, "inspect")[0] == 2
    assert run(capsys, "identify")[0] == 2
