"""`autotune identify` through the real entry point."""

import json
import subprocess
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from autotune.cli.identify import print_identified
from autotune.formats.identified import read_identified
from autotune.formats.yaml12 import load_yaml
from autotune.simulation.truth import SimulatedCell
from tests.next_step import is_next_alone

RunCli = Callable[..., "subprocess.CompletedProcess[str]"]


@pytest.fixture(scope="module")
def first_run(tmp_path_factory: pytest.TempPathFactory, good_log: Path, repository: Path) -> tuple[Path, str, str]:
    """One run on the good log: where, standard output, standard error."""
    import os
    import sys

    folder = tmp_path_factory.mktemp("identify")
    done = subprocess.run(
        [sys.executable, "-m", "autotune", "identify", str(good_log)],
        capture_output=True,
        text=True,
        cwd=folder,
        env={**os.environ, "PYTHONPATH": str(repository)},
        check=True,
    )
    return folder, done.stdout, done.stderr


def test_the_file_holds_the_cell(first_run: tuple[Path, str, str]) -> None:
    found, cell = read_identified(first_run[0] / "identified.yaml").result, SimulatedCell()
    axis = found.axes["x"]
    assert found.payload.mass_kg.value == pytest.approx(cell.payload_mass_kg, rel=0.05)
    assert axis.coupling.stiffness_n_per_m.value == pytest.approx(cell.coupling.stiffness_n_per_m, rel=0.05)
    assert axis.environments[0].stiffness_n_per_m.value == pytest.approx(cell.environment.stiffness_n_per_m, rel=0.05)


def test_people_see_a_table_and_what_comes_next_on_standard_error(first_run: tuple[Path, str, str]) -> None:
    folder, reported, aside = first_run
    assert is_next_alone(aside)
    lines = reported.splitlines()
    assert lines[0].split() == ["parameter", "value", "±", "std", "unit", "verdict"]
    assert any(line.startswith("x: coupling K_s") and line.endswith("identified") for line in lines)
    (line,) = (each for each in lines if each.startswith("time line: "))
    assert "contact" in line
    assert "commanded-motion" in line
    assert lines[-1] == "written: identified.yaml"
    assert [path.name for path in folder.iterdir()] == ["identified.yaml"]


def test_touches_of_several_logs_say_of_which_and_from_when(
    first_run: tuple[Path, str, str], capsys: pytest.CaptureFixture[str]
) -> None:
    found = read_identified(first_run[0] / "identified.yaml").result
    (line,) = found.timelines
    print_identified(
        replace(found, timelines=tuple(replace(line, log=log) for log in ("one", "two"))), Path("out.yaml")
    )
    lines = capsys.readouterr().out.splitlines()
    for log in ("one", "two"):
        assert lines[lines.index(f"touches in {log}, from its start:") + 1].startswith("touch  cause")


def test_json_is_the_tree_of_the_file_and_the_same_log_gives_the_same_bytes(
    run_cli: RunCli, tmp_path: Path, good_log: Path, first_run: tuple[Path, str, str]
) -> None:
    done = run_cli("identify", good_log, "--json")
    assert (done.returncode, done.stderr) == (0, "")
    assert json.loads(done.stdout) == load_yaml(tmp_path / "identified.yaml")
    assert (tmp_path / "identified.yaml").read_bytes() == (first_run[0] / "identified.yaml").read_bytes()


def test_quiet_writes_the_file_and_says_nothing(run_cli: RunCli, tmp_path: Path, good_log: Path) -> None:
    done = run_cli("identify", good_log, "--quiet", "-o", "here.yaml")
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
    assert [path.name for path in tmp_path.iterdir()] == ["here.yaml"]


@pytest.mark.parametrize(
    ("name", "code", "reported"),
    [
        ("no_contact", 4, ["no contact", "Record 3 or more contacts"]),
        ("one_pose", 4, ["tool orientations", "found 1", "record 6 to 12 poses"]),
        ("no_command", 4, ["no commanded pose", "Record the position command", "--command-topic"]),
        ("nan_burst", 3, ["/ft_sensor/wrench", "50"]),
        ("truncated", 3, ["truncated or damaged at byte"]),
        ("no_log", 3, ["no_log.mcap"]),
        ("empty", 3, ["empty.mcap"]),
        ("absent", 3, ["absent.mcap"]),
    ],
)
def test_a_log_that_does_not_show_is_refused_with_one_line_and_no_file(
    run_cli: RunCli, tmp_path: Path, unusable_logs: Path, name: str, code: int, reported: list[str]
) -> None:
    (tmp_path / "identified.yaml").write_text("format: autotune/identified\n", encoding="utf-8")
    done = run_cli("identify", unusable_logs / f"{name}.mcap")
    assert (done.returncode, done.stdout) == (code, "")
    assert done.stderr.count("\n") == 1
    assert done.stderr.startswith("autotune: ")
    assert "Traceback" not in done.stderr
    assert [part for part in reported if part not in done.stderr] == []
    assert [path.name for path in tmp_path.iterdir()] == ["identified.yaml"]
    assert (tmp_path / "identified.yaml").read_text(encoding="utf-8") == "format: autotune/identified\n"


def test_a_refusal_with_json_is_one_object_with_the_code(run_cli: RunCli, tmp_path: Path, unusable_logs: Path) -> None:
    done = run_cli("identify", unusable_logs / "one_pose.mcap", "--json")
    error = json.loads(done.stdout)["error"]
    assert (done.returncode, error["exit_code"], error["kind"]) == (4, 4, "EstimateError")
    assert error["message"] in done.stderr
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("option", ["--wrench-topic", "--pose-topic", "--command-topic"])
def test_a_topic_that_is_not_there_is_reported_with_those_that_are(
    run_cli: RunCli, tmp_path: Path, good_log: Path, option: str
) -> None:
    done = run_cli("identify", good_log, option, "/nowhere")
    assert (done.returncode, done.stdout, done.stderr.count("\n")) == (3, "", 1)
    assert "Topic `/nowhere` is not in cell.mcap; topics of that type: /" in done.stderr
    assert list(tmp_path.iterdir()) == []


def test_what_is_missing_can_be_left_open_on_request(run_cli: RunCli, tmp_path: Path, unusable_logs: Path) -> None:
    done = run_cli("identify", unusable_logs / "no_contact.mcap", "--allow-partial")
    assert done.returncode == 0
    assert "no contact with an onset and a hold was found" in done.stdout
    found = read_identified(tmp_path / "identified.yaml").result
    assert found.axes["x"].environments == ()
    assert found.axes["x"].coupling.stiffness_n_per_m.value is not None
    # Nothing is tuned on what is not there.
    refused = run_cli("optimize", "identified.yaml")
    assert (refused.returncode, refused.stdout, refused.stderr.count("\n")) == (4, "", 1)
    assert "--environment-stiffness LO:HI" in refused.stderr


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "Missing argument 'LOG...'"),
        (["cell.mcap", "--wrench"], "No such option"),
        (["cell.mcap", "-o", "."], "is a directory"),
        (["cell.mcap", "--given", "x.drga=300"], "Nothing called x.drga can be given; what can: mass_kg"),
        (["cell.mcap", "--given", "rz.drag_n_s_per_m=3"], "rz.drag_n_m_s_per_rad"),
    ],
)
def test_a_wrong_request_is_exit_2(run_cli: RunCli, tmp_path: Path, arguments: list[str], message: str) -> None:
    (tmp_path / "cell.mcap").write_bytes(b"no log is read before this")
    done = run_cli("identify", *arguments)
    assert (done.returncode, done.stdout, done.stderr.count("\n")) == (2, "", 1)
    assert message in done.stderr


def test_a_folder_that_cannot_be_written_is_exit_2_and_leaves_nothing(
    run_cli: RunCli, tmp_path: Path, good_log: Path
) -> None:
    done = run_cli("identify", good_log, "-o", "no/such/folder/identified.yaml")
    assert (done.returncode, done.stdout, done.stderr.count("\n")) == (2, "", 1)
    assert "cannot be written" in done.stderr
    assert list(tmp_path.iterdir()) == []
