"""`autotune optimize --schedule` and `autotune validate schedule.yaml` through the real entry point."""

import json
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest

from autotune.cli.main import main
from autotune.errors import InfeasibleError
from autotune.formats.problem import ProblemSpec
from autotune.formats.yaml12 import load_yaml
from autotune.tuning import schedule as schedule_module
from tests.autotune.tuning.cases import FAST_PROBLEM_YAML, write_plant
from tests.next_step import is_next_alone

RunCli = Callable[..., "subprocess.CompletedProcess[str]"]
BASE = ("optimize", "identified.yaml", "--problem", "problem.yaml")


def prepare(folder: Path, more: str = "") -> None:
    write_plant(folder)
    (folder / "problem.yaml").write_text(FAST_PROBLEM_YAML + more, encoding="utf-8")


@pytest.mark.slow
def test_the_table_is_printed_written_and_validates(run_cli: RunCli, tmp_path: Path) -> None:
    prepare(tmp_path)
    done = run_cli(*BASE, "--schedule", "payload=8,16:22", "-o", "cell")
    assert done.returncode == 0
    assert done.stderr.startswith("The runtime will compensate another mass than the identified one")
    assert "in m8;" in done.stderr
    lines = done.stdout.splitlines()
    assert lines[0].split()[:3] == ["class", "payload", "[kg]"]
    assert [line.split()[0] for line in lines[1:3]] == ["m8", "m16-22"]
    assert lines[3].startswith("axis x: one controller for all, all.yaml, costs up to ")
    assert lines[4] == "payload covered: 8, 16 to 22 kg; no class from 8 to 16"
    tree = load_yaml(tmp_path / "cell" / "schedule.yaml")
    assert lines[5].startswith("changes while it runs: each controller for ")
    assert lines[6] == f"written: cell, 3 controllers and schedule.yaml, checksum {tree['checksum'][:8]}"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["cell", "identified.yaml", "problem.yaml"]
    valid = run_cli("validate", "cell/schedule.yaml")
    assert valid.returncode == 0
    assert is_next_alone(valid.stderr)
    output = [line.split(":")[0].split()[-1] for line in valid.stdout.splitlines()[:-1]]
    assert output == ["m8.yaml", "m16-22.yaml", "all.yaml"]
    (tmp_path / "cell" / "all.yaml").write_bytes((tmp_path / "cell" / "m8.yaml").read_bytes())
    wrong = run_cli("validate", "cell/schedule.yaml", "--json")
    assert wrong.returncode == 6
    assert "all.yaml must have the checksum" in json.loads(wrong.stdout)["error"]["message"]
    # What was altered by hand is not overwritten.
    again = run_cli(*BASE, "--schedule", "payload=8", "-o", "cell")
    assert again.returncode == 2
    assert "holds something else than an unaltered schedule" in again.stderr


@pytest.mark.slow
def test_infeasible_classes_are_exit_5_and_nothing_is_left(run_cli: RunCli, tmp_path: Path) -> None:
    prepare(tmp_path, "  max_peak_force_n: 31\n")
    done = run_cli(*BASE, "--schedule", "payload=16,16.5", "--structure", "gains")
    assert (done.returncode, done.stdout, done.stderr.count("\n")) == (5, "", 1)
    assert done.stderr.startswith("autotune: 2 of 2 classes have no controller. m16: Axis x: ")
    assert "; m16.5: Axis x: " in done.stderr
    assert sorted(path.name for path in tmp_path.iterdir()) == ["identified.yaml", "problem.yaml"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--schedule", "mass=8"), "give payload=CLASSES in kg or stiffness=CLASSES in N/m"),
        (("--schedule", "payload"), "give payload=CLASSES"),
        (("--schedule", "payload="), "'' is not a number"),
        (("--schedule", "payload=8,heavy"), "'heavy' is not a number"),
        (("--schedule", "payload=8:9:10"), "'8:9:10' is no payload"),
        (("--schedule", "payload=12:8"), "the lower one first; found 12 and 8"),
        (("--schedule", "payload=nan"), "finite"),
        (("--schedule", "stiffness=0:1e5"), "above 0"),
        (("--schedule", "payload=8", "--schedule", "payload=8"), "8 to 8 is named twice"),
        (("--schedule", "payload=8:12"), "Class m8-12: The payload range 8 to 12 kg leaves out the identified payload"),
        (("--schedule", "payload=16", "--compare", "mass=10,damping=1500"), "--compare is about one controller"),
        (("--schedule", "payload=16", "--pareto"), "--pareto is about one controller"),
        (("--schedule", "payload=16", "--slack", "3"), "--slack, --proof-budget and --axes are about one"),
        (("--schedule", "payload=16", "--payload-mass", "16"), "both say the payload"),
        (("--schedule", "stiffness=1e5", "--environment-stiffness", "1e5:2e5"), "both say the stiffness"),
        (("--schedule", "payload=16", "-o", "problem.yaml"), "problem.yaml is a file"),
        (("--schedule", "payload=16", "-o", "."), "exists and holds no schedule"),
        (("--schedule", "payload=16", "-o", "missing/cell"), "does not exist"),
        (("-o", "."), "is a directory"),
    ],
)
def test_a_wrong_request_is_exit_2_before_the_search(
    run_cli: RunCli, tmp_path: Path, arguments: tuple[str, ...], message: str
) -> None:
    prepare(tmp_path)
    done = run_cli(*BASE, *arguments)
    assert (done.returncode, done.stdout, done.stderr.count("\n")) == (2, "", 1)
    assert message in done.stderr
    assert sorted(path.name for path in tmp_path.iterdir()) == ["identified.yaml", "problem.yaml"]


def test_an_identified_plant_is_not_compared_with_many_controllers(run_cli: RunCli, tmp_path: Path) -> None:
    prepare(tmp_path)
    (tmp_path / "schedule.yaml").write_text("format: autotune/schedule\n", encoding="utf-8")
    done = run_cli("validate", "schedule.yaml", "--identified", "identified.yaml")
    assert (done.returncode, done.stdout) == (2, "")
    assert "name one that the schedule lists" in done.stderr
    assert run_cli("validate", "schedule.yaml").returncode == 6


def test_the_structure_is_that_of_the_command_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    prepare(tmp_path)
    monkeypatch.chdir(tmp_path)
    seen = []

    def refused(_plant: object, spec: ProblemSpec, *_args: object, **_options: object) -> None:
        seen.append(spec.structure)
        raise InfeasibleError("Not now.")

    monkeypatch.setattr(schedule_module, "tune_schedule", refused)
    table = [*BASE, "--schedule", "payload=8,16:22"]
    assert [main(table), main([*table, "--structure", "biquad"])] == [5, 5]
    assert seen == [None, "biquad"]
