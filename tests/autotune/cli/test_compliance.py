"""A compliance that is free in problem.yaml, through the real entry point."""

import json
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest

from autotune.cli.main import main
from autotune.formats.controller import read_controller
from tests.autotune.cli.test_optimize import prepare
from tests.autotune.tuning.cases import FAST_PROBLEM_YAML
from tests.next_step import is_next_alone

RunCli = Callable[..., "subprocess.CompletedProcess[str]"]

FREE = """\
free:
  environment_stiffness_n_per_m: {bounds: [8.0e4, 8.6e4], tolerance: 0.1}
"""
PROBLEM = FAST_PROBLEM_YAML.replace("environment_stiffness_n_per_m: [1.0e5, 1.2e5]\n", FREE)


def test_the_table_the_file_and_the_same_bytes_twice(
    run_cli: RunCli, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    prepare(tmp_path, PROBLEM)
    done = run_cli("optimize", "identified.yaml", "--problem", "problem.yaml", "-o", "first.yaml")
    assert done.returncode == 0
    assert is_next_alone(done.stderr)
    lines = done.stdout.splitlines()[1:]
    assert lines[0] == "axis x: build K_e 80 N/mm to ± 10 %, certified from 72 to 88 N/mm"
    assert [line.split()[0] for line in lines[2:5]] == ["80", "82.95", "86"]
    assert lines[2].endswith("  chosen, at the lower bound")
    assert "  the lower bound of K_e, 80 N/mm, is active: widen it, or accept" in lines
    assert any(line.startswith("  assumed of the compliance: damping B_e 0 N·s/m, and no mass") for line in lines)
    monkeypatch.chdir(tmp_path)
    assert main(["optimize", "identified.yaml", "--problem", "problem.yaml", "-o", "second.yaml", "--json"]) == 0
    assert (tmp_path / "second.yaml").read_bytes() == (tmp_path / "first.yaml").read_bytes()
    output = json.loads(capsys.readouterr().out)["provenance"]["compliance"]["x"]
    assert output == read_controller("first.yaml").controller.provenance["compliance"]["x"]
    assert [output["chosen_n_per_m"], output["stiffest_that_meets_all_n_per_m"]] == [8e4, 8.6e4]
    assert main(["validate", "first.yaml", "--identified", "identified.yaml", "--samples", "0"]) == 6
    checks = capsys.readouterr().out.splitlines()
    # Everything holds but for the surface that was there before: it is not the one that was certified.
    failed = [line for line in checks if line.startswith("FAILED")]
    assert failed == ["FAILED axis x, identified plant: K_e of x1 [N/mm] is 110, certified for [72, 88]"]
    assert any(line.startswith("ok     axis x, peak force") for line in checks)


def test_the_surface_is_said_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    prepare(tmp_path, PROBLEM)
    monkeypatch.chdir(tmp_path)
    asked = ["optimize", "identified.yaml", "--problem", "problem.yaml"]
    assert main([*asked, "--environment-stiffness", "2e4:5e5"]) == 2
    assert "both say the surface; give one of them" in capsys.readouterr().err
    assert main([*asked, "--schedule", "payload=16"]) == 2
    assert "chooses one compliance, and a schedule has many controllers" in capsys.readouterr().err
    assert list(tmp_path.glob("controller*")) == []
