"""`autotune optimize --pareto` through the real entry point."""

import json
import re
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from autotune.cli._pareto import _proof_options
from autotune.formats.yaml12 import load_yaml
from autotune.validation.axis_proof import ProofOptions
from tests.autotune.tuning.cases import FAST_PROBLEM_YAML, write_plant
from tests.next_step import is_next_alone

RunCli = Callable[..., "subprocess.CompletedProcess[str]"]
BASE = ("optimize", "identified.yaml", "--problem", "problem.yaml")


def prepare(folder: Path) -> None:
    write_plant(folder)
    (folder / "problem.yaml").write_text(FAST_PROBLEM_YAML, encoding="utf-8")


@pytest.fixture(autouse=True)
def _few_seeds(monkeypatch: pytest.MonkeyPatch) -> None:
    """A study begins with two points of the solver's front instead of five (those are `test_front.py`'s)."""
    monkeypatch.setattr("autotune.studies.front._SEED_POINTS", 2)


@pytest.mark.parametrize(
    ("slack_percent", "budget_s", "axes", "expected"),
    [
        (None, None, None, None),
        (3.0, None, None, ProofOptions(slack=0.03)),
        (None, 0.0, None, ProofOptions(further_s=0.0)),
        (None, 30.0, None, ProofOptions(further_s=30.0)),
        (None, 90.0, None, ProofOptions(budget_s=90.0, further_s=90.0)),
        (None, None, "together", ProofOptions(axes="together")),
    ],
)
def test_a_budget_is_for_the_uncertain_plant_and_never_takes_from_the_usual_proof(
    slack_percent: float | None, budget_s: float | None, axes: Any, expected: ProofOptions | None
) -> None:
    assert _proof_options(slack_percent, budget_s, axes) == expected


@pytest.mark.slow
def test_the_front_is_printed_and_written_beside_the_same_controller(run_cli: RunCli, tmp_path: Path) -> None:
    prepare(tmp_path)
    assert run_cli(*BASE, "--quiet").returncode == 0
    alone = (tmp_path / "controller.yaml").read_bytes()
    done = run_cli(*BASE, "--pareto", "2")
    assert done.returncode == 0
    replaced, following = done.stderr.splitlines()
    assert re.fullmatch(r"controller\.yaml: replaced the controller of checksum [0-9a-f]{8}\.", replaced)
    assert following == "next: autotune validate controller.yaml"
    lines = done.stdout.splitlines()
    head = next(i for i, line in enumerate(lines) if line.startswith("axis x: front of peak_force and admittance"))
    assert "peak_force [N]" in lines[head + 1]
    assert lines[head + 2].endswith("<- written")
    assert lines[-1] == "written: pareto.yaml"
    assert (tmp_path / "controller.yaml").read_bytes() == alone
    first = (tmp_path / "pareto.yaml").read_bytes()
    tree = load_yaml(tmp_path / "pareto.yaml")
    assert len(tree["axes"]["x"]["points"]) == 2
    assert tree["axes"]["x"]["study"] is None
    assert tree["axes"]["x"]["points"][0]["damping"] == load_yaml(tmp_path / "controller.yaml")["axes"]["x"]["damping"]
    # The front of another output has a name of its own, and this one stays as it is.
    again = run_cli(*BASE, "--pareto", "2", "--json", "-o", "fast.yaml")
    assert json.loads(again.stdout)["pareto"] == tree
    assert (tmp_path / "fast.pareto.yaml").read_bytes() == first
    assert (tmp_path / "pareto.yaml").read_bytes() == first


@pytest.mark.slow
def test_a_study_makes_the_same_file_anew_and_from_what_is_stored(run_cli: RunCli, tmp_path: Path) -> None:
    prepare(tmp_path)
    wish = ("--pareto", "--objectives", "peak_force,hand_force", "--choose", "discretization", "--trials", "8")
    done = run_cli(*BASE, *wish)
    assert done.returncode == 0
    assert is_next_alone(done.stderr)
    assert re.search(r"\d of 8 trials feasible \(\d+ %\)", done.stdout)
    written = (tmp_path / "pareto.yaml").read_bytes()
    assert run_cli(*BASE, *wish, "--quiet").returncode == 0  # nothing is left to try
    assert (tmp_path / "pareto.yaml").read_bytes() == written
    (tmp_path / "pareto.db").unlink()
    assert run_cli(*BASE, *wish, "--quiet").returncode == 0
    assert (tmp_path / "pareto.yaml").read_bytes() == written


def test_what_no_trial_meets_is_exit_5_and_nothing_is_written(run_cli: RunCli, tmp_path: Path) -> None:
    prepare(tmp_path)
    done = run_cli(*BASE, "--pareto", "--require", "peak_force=31", "--trials", "4")
    assert done.returncode == 5
    assert "peak_force_limit (" in done.stderr
    assert not (tmp_path / "controller.yaml").exists()
    assert not (tmp_path / "pareto.yaml").exists()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--objectives", "peak_force"), "is an option of --pareto"),
        (("--pareto", "1"), "1"),
        (("--pareto", "--objectives", "speed"), "There is no objective 'speed' installed; there are: admittance"),
        (("--pareto", "--objectives", ""), "A front needs an objective"),
        (("--pareto", "--require", "calm"), "There is no requirement 'calm'"),
        (("--pareto", "--choose", "wheels"), "cannot be left to a study"),
        (("--pareto", "--storage", "x"), "is no URL"),
        (("--pareto", "-o", "taken.yaml"), "taken.pareto.yaml exists and is no file of this tool"),
    ],
)
def test_a_wrong_request_is_exit_2_before_the_search(
    run_cli: RunCli, tmp_path: Path, arguments: tuple[str, ...], message: str
) -> None:
    prepare(tmp_path)
    (tmp_path / "taken.pareto.yaml").write_text("somebody's own\n", encoding="utf-8")
    done = run_cli(*BASE, *arguments)
    assert done.returncode == 2, done.stderr
    assert message in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1
    assert not (tmp_path / "controller.yaml").exists()
