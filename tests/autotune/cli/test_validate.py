"""`autotune validate` through the real entry point: a true file, false ones with a right checksum, altered ones."""

import json
import re
import subprocess
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from autotune.files.controller import read_controller, short, write_controller
from autotune.files.controller_record import ControllerStatus
from autotune.files.identified import write_identified
from tests.autotune.tuning.cases import identified_plant, known, small_controller, write_plant
from tests.autotune.validation.test_validate import EVERY_CHECK, FALSE_CLAIMS

RunCli = Callable[..., "subprocess.CompletedProcess[str]"]
THROUGH_THE_COMMAND_LINE = [
    "modulus too high",
    "damping too low",
    "an unstable gap among the walls",
    "stiffer walls",
    "contact peak too small",
    "admittance too high",
    "delay too small",
    "requirement unknown",
    "compensation",
    "collision response",
]


@pytest.fixture
def good(tmp_path: Path) -> Path:
    write_controller(tmp_path / "controller.yaml", small_controller())
    return tmp_path / "controller.yaml"


def test_a_true_file_passes_and_every_check_is_told(run_cli: RunCli, good: Path) -> None:
    done = run_cli("validate", "controller.yaml")
    assert (done.returncode, done.stderr) == (0, "")
    lines = done.stdout.splitlines()
    assert [re.match(r"ok +axis x, ([^:]+): \S", line)[1] for line in lines[:-1]] == EVERY_CHECK  # type: ignore[index]
    assert lines[-1] == f"controller.yaml: valid, checksum {short(read_controller(good).checksum)}"
    assert [path.name for path in good.parent.iterdir()] == ["controller.yaml"]


def test_json_is_one_object_and_quiet_is_silent(run_cli: RunCli, good: Path) -> None:
    done = run_cli("validate", "controller.yaml", "--json")
    tree = json.loads(done.stdout)
    assert (done.returncode, done.stderr, tree["passed"]) == (0, "", True)
    assert [check["name"] for check in tree["checks"]] == EVERY_CHECK
    assert tree["checksum"] == read_controller(good).checksum
    quiet = run_cli("validate", "controller.yaml", "--quiet")
    assert (quiet.returncode, quiet.stdout, quiet.stderr) == (0, "", "")


@pytest.mark.parametrize("name", THROUGH_THE_COMMAND_LINE)
def test_a_false_file_with_a_right_checksum_is_exit_6_and_the_check_names_numbers(
    run_cli: RunCli, tmp_path: Path, name: str
) -> None:
    change, check, told = FALSE_CLAIMS[name]
    write_controller(tmp_path / "controller.yaml", change(small_controller()))
    done = run_cli("validate", "controller.yaml")
    assert done.returncode == 6
    assert done.stderr.count("\n") == 1
    assert done.stderr.startswith("autotune: Axis x, ")
    failed = [line for line in done.stdout.splitlines() if line.startswith("FAILED")]
    assert any(f"axis x, {check}: " in line and re.search(told, line) for line in failed)
    assert "controller.yaml: NOT valid, checksum " in done.stdout


def test_a_false_file_with_json_is_one_object_and_exit_6(run_cli: RunCli, tmp_path: Path) -> None:
    write_controller(tmp_path / "controller.yaml", FALSE_CLAIMS["delay too small"][0](small_controller()))
    done = run_cli("validate", "controller.yaml", "--json")
    tree = json.loads(done.stdout)
    assert (done.returncode, tree["passed"]) == (6, False)
    assert [check["name"] for check in tree["checks"] if not check["passed"]] == ["delay"]


@pytest.mark.parametrize(
    ("old", "new"),
    [
        (r"(?m)^    damping: .*$", "    damping: 2000.0"),
        ("status: validated", "status: unvalidated"),
        (r"(?s)certificate:.*", ""),
        (r"(?s).*", ""),
    ],
    ids=["a gain", "the status", "the end is missing", "empty"],
)
def test_an_altered_file_is_exit_6(run_cli: RunCli, good: Path, old: str, new: str) -> None:
    text = good.read_text(encoding="utf-8")
    altered = re.sub(old, new, text, count=1)
    assert altered != text
    good.write_text(altered, encoding="utf-8")
    done = run_cli("validate", "controller.yaml")
    assert (done.returncode, done.stdout, done.stderr.count("\n")) == (6, "", 1)
    assert done.stderr.startswith("autotune: controller.yaml")


def test_an_unvalidated_file_is_exit_6(run_cli: RunCli, tmp_path: Path) -> None:
    write_controller(tmp_path / "c.yaml", replace(small_controller(), status=ControllerStatus.UNVALIDATED))
    done = run_cli("validate", "c.yaml")
    assert (done.returncode, done.stdout) == (6, "")
    assert "not validated" in done.stderr


def test_the_identified_plant_is_compared_with_the_domain(run_cli: RunCli, good: Path) -> None:
    write_plant(good.parent)
    inside = run_cli("validate", "controller.yaml", "--identified", "identified.yaml")
    assert (inside.returncode, inside.stderr) == (0, "")
    assert "axis x, identified plant: lies inside the certified domain" in inside.stdout
    plant = identified_plant()
    heavy = replace(plant, payload=replace(plant.payload, mass_kg=known(20.0, 0.1)))
    write_identified(good.parent / "heavy.yaml", heavy, {"tool": "by hand"})
    outside = run_cli("validate", "controller.yaml", "--identified", "heavy.yaml")
    assert outside.returncode == 6
    assert "payload mass [kg] is 20, certified for [16, 16]" in outside.stderr


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        ([], "Missing argument 'CONTROLLER'"),
        (["absent.yaml"], "absent.yaml cannot be read"),
        (["controller.yaml", "--identified", "absent.yaml"], "absent.yaml cannot be read"),
        (["controller.yaml", "--identified", "controller.yaml"], "format must be autotune/identified"),
    ],
)
def test_a_wrong_request_is_exit_2(run_cli: RunCli, good: Path, arguments: list[str], told: str) -> None:
    done = run_cli("validate", *arguments)
    assert good.exists()
    assert (done.returncode, done.stdout, done.stderr.count("\n")) == (2, "", 1)
    assert told in done.stderr
