"""The command that is named last can be pasted: followed from a log on, it leads to a controller and its export."""

import shlex
import subprocess
from dataclasses import replace
from pathlib import Path

import pytest

from autotune.cli.main import main
from autotune.formats.identified import write_identified
from identification.result import Finding
from tests.autotune.tuning.cases import identified_plant, share_results, shorten_checks

PLANT_TEXT = """format: autotune/plant
version: 1
mass: 16
coupling_stiffness: 3e5
drag: 630
robot: {bandwidth: 3.2, delay: 2.4e-3}
environment_stiffness: [2e4, 8e4]
sample_time: 8e-4
"""


def following(capsys: pytest.CaptureFixture[str], *words: str) -> list[str]:
    """Run a command and return the words of the one that it names."""
    assert main(list(words)) == 0
    last = capsys.readouterr().err.splitlines()[-1]
    assert last.startswith("next: autotune ")
    return shlex.split(last)[2:]


@pytest.mark.slow
def test_the_named_commands_lead_from_a_log_to_an_export(
    good_log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    shorten_checks(monkeypatch)
    share_results(monkeypatch)
    log = tmp_path / "run 7.mcap"
    log.symlink_to(good_log)
    done, words = [], ["inspect", log.name]
    while words[0] != "export":
        done.append(words[0])
        words = following(capsys, *words)
    assert done == ["inspect", "identify", "optimize", "validate"]
    assert main(words) == 0
    compiles = shlex.split(capsys.readouterr().err.splitlines()[-1])
    assert compiles[:2] == ["next:", "cc"]
    subprocess.run(compiles[1:], check=True)
    assert (tmp_path / "controller.o").is_file()


def test_a_table_whose_columns_nobody_named_is_followed_by_a_cell_file_that_begins_to(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    rows = "".join(f"{i};{i % 3},5;1,2;{i / 10};0;0\n" for i in range(40))
    Path("run.csv").write_text(f"Zeit [ms];FX;FY;X_ist;Y_ist;Z_ist\n{rows}", encoding="utf-8")
    words = following(capsys, "inspect", "run.csv")
    assert words == ["inspect", "run.csv", "--write-cell", "cell.yaml"]
    Path("cell.yaml").write_text('format: autotune/cell\nversion: 1\ntable: {time: "Zeit [ms]"}\n', encoding="utf-8")
    words = following(capsys, "inspect", "run.csv")
    assert words[:5] == ["identify", "run.csv", "--cell", "cell.yaml", "#"]


def test_a_prediction_names_the_search_with_its_gains_beside_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("plant.yaml").write_text(PLANT_TEXT, encoding="utf-8")
    gains = ("--gains", "mass=13,damping=1000,lead=20ms", "--surface", "40N/mm", "--approach", "force=30")
    words = following(capsys, "predict", "plant.yaml", *gains)
    assert words == ["optimize", "plant.yaml", "--compare", "x.mass=13,x.damping=1000,x.lead=20ms"]


@pytest.mark.parametrize(("severity", "named"), [("warning", "optimize"), ("error", "plan")])
def test_the_report_of_a_plant_that_lacks_something_names_the_plan(
    severity: str, named: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    found = Finding(code="weak", severity=severity, message="Axis x: K_s: weak.", advice="")
    write_identified(Path("identified.yaml"), replace(identified_plant(), findings=(found,)), {"tool": "by hand"})
    assert following(capsys, "report", "identified.yaml") == [named, "identified.yaml"]


def test_a_plan_names_what_reads_the_recording_that_it_asks_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert following(capsys, "plan", "-o", "first plan.yaml")[:3] == ["identify", "first plan.mcap", "#"]
    Path("run1.mcap").touch()
    logs = [{"path": name, "sha256": "0"} for name in ("run1.mcap", "gone.mcap")]
    write_identified(Path("identified.yaml"), identified_plant(), {"tool": "by hand", "logs": logs})
    assert following(capsys, "plan", "identified.yaml")[:4] == ["identify", "run1.mcap", "plan.mcap", "#"]


def test_a_log_that_no_prediction_meets_is_identified_next(
    good_log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("plant.yaml").write_text(PLANT_TEXT, encoding="utf-8")
    asked = ("--gains", "mass=10,damping=9000", "--surface", "40N/mm", "--approach", "force=30", "--log")
    words = following(capsys, "predict", "plant.yaml", *asked, str(good_log))
    assert words == ["identify", str(good_log), "--allow-partial", "-o", "of_this_log.yaml"]


@pytest.mark.parametrize("option", ["--json", "--quiet"])
def test_programs_are_reported_nothing(
    option: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["plan", option]) == 0
    assert "next:" not in capsys.readouterr().err
