import json
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest

from autotune.files.controller import read_controller, short, write_controller
from tests.autotune.files.samples import make_controller

RunCli = Callable[..., "subprocess.CompletedProcess[str]"]


@pytest.fixture
def source(tmp_path: Path) -> Path:
    write_controller(tmp_path / "controller.yaml", make_controller())
    return tmp_path / "controller.yaml"


@pytest.mark.parametrize("target", ["cell", "json"])
def test_a_controller_is_exported_and_its_short_checksum_told(run_cli: RunCli, source: Path, target: str) -> None:
    run = run_cli("export", source, "--target", target, "-o", "out")
    assert (run.returncode, run.stderr) == (0, "")
    exported = read_controller(source.with_name("out"))
    assert exported.controller == make_controller()
    assert run.stdout == f"out: {target}, checksum {short(exported.checksum)}\n"


def test_c_is_a_source_and_its_header(run_cli: RunCli, source: Path) -> None:
    run = run_cli("export", source, "--target", "c", "-o", "cell.c")
    assert (run.returncode, run.stderr) == (0, "")
    assert run.stdout == f"cell.c: c, checksum {short(read_controller(source).checksum)}\n"
    assert source.with_name("cell.c").exists()
    assert source.with_name("cell.h").exists()


def test_json_is_one_object_and_quiet_is_silent(run_cli: RunCli, source: Path) -> None:
    digest = read_controller(source).checksum
    told = run_cli("export", source, "--target", "json", "-o", "out", "--json")
    expected = {"target": "json", "path": "out", "checksum": digest, "short_checksum": digest[:8]}
    assert json.loads(told.stdout) == expected
    quiet = run_cli("export", source, "--target", "json", "-o", "out", "--quiet")
    assert (quiet.returncode, quiet.stdout, quiet.stderr) == (0, "", "")


@pytest.mark.parametrize(("old", "new"), [("mass: 12.5", "mass: 12.4"), ("status: validated\n", ""), ("\n", "\n\t")])
def test_an_altered_file_is_exit_6_with_one_line(run_cli: RunCli, source: Path, old: str, new: str) -> None:
    source.write_text(source.read_text(encoding="utf-8").replace(old, new, 1), encoding="utf-8")
    run = run_cli("export", source, "--target", "cell", "-o", "out")
    assert run.returncode == 6
    assert run.stdout == ""
    assert run.stderr.count("\n") == 1
    assert f"{source}, line " in run.stderr
    assert not source.with_name("out").exists()


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (["controller.yaml", "--target", "fzi", "-o", "out"], "'cell', 'json'"),
        (["controller.yaml", "--target", "cell"], "--output"),
        (["missing.yaml", "--target", "cell", "-o", "out"], "missing.yaml cannot be read"),
        (["controller.yaml", "--target", "cell", "-o", "no/such/folder/out"], "cannot be written"),
    ],
)
def test_a_wrong_request_is_exit_2(run_cli: RunCli, source: Path, arguments: list[str], told: str) -> None:
    run = run_cli("export", *arguments)
    assert run.returncode == 2
    assert told in run.stderr
    assert [path.name for path in source.parent.iterdir()] == ["controller.yaml"]


def test_the_help_has_an_example(run_cli: RunCli) -> None:
    run = run_cli("export", "--help")
    assert run.returncode == 0
    assert "Example: autotune export controller.yaml --target json -o controller.json" in run.stdout
