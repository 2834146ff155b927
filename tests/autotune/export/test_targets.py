import json
import shlex
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
from jsonschema import Draft202012Validator

from autotune.cli.export import command
from autotune.errors import CertificateError, UsageError
from autotune.export import export as export_module
from autotune.export.designing import example_export
from autotune.export.export import export_controller
from autotune.export.own_formats import CELL_MARK, JSON, render_cell
from autotune.export.target import ExportRequest, Rendered
from autotune.export.targets import TARGETS, target_options
from autotune.formats.canonical import checksum
from autotune.formats.controller import read_controller, write_controller
from autotune.formats.controller_record import ControllerStatus
from autotune.formats.schema import load_schema
from autotune.formats.yaml12 import load_yaml
from tests.autotune.formats.samples import make_controller

pytestmark = pytest.mark.usefixtures("unchecked_law")


@pytest.fixture
def source(tmp_path: Path) -> Path:
    path = tmp_path / "controller.yaml"
    write_controller(path, make_controller())
    return path


@pytest.mark.parametrize("target", ["cell", "json"])
def test_an_export_reads_back_as_the_same_controller(source: Path, target: str) -> None:
    out = source.with_name("out")
    digest = export_controller(source, target, out).checksum
    back = read_controller(out)
    assert back.controller == make_controller()
    assert back.checksum == digest == read_controller(source).checksum


def test_the_cell_file_is_the_canonical_one_below_its_mark_whatever_the_layout_was(source: Path) -> None:
    """The mark tells an export, which may be replaced, from a file that a search wrote."""
    canonical = CELL_MARK.encode() + source.read_bytes()
    source.write_text(json.dumps(load_yaml(source)) + "\n", encoding="utf-8")
    export_controller(source, "cell", source.with_name("out"))
    assert source.with_name("out").read_bytes() == canonical


def test_the_json_twin_is_plain_json_that_satisfies_the_schema(source: Path) -> None:
    out = source.with_name("out.json")
    digest = export_controller(source, "json", out).checksum
    tree = json.loads(out.read_text(encoding="ascii"))
    assert list(Draft202012Validator(load_schema("controller")).iter_errors(tree)) == []
    assert tree == load_yaml(source)
    assert checksum(tree) == digest


@pytest.mark.parametrize("target", ["cell", "json"])
def test_a_file_that_cannot_be_trusted_leaves_the_old_output(source: Path, target: str) -> None:
    out = source.with_name("out")
    out.write_text("old", encoding="utf-8")
    source.write_text(source.read_text(encoding="utf-8").replace("mass: 12.5", "mass: 12.6"), encoding="utf-8")
    with pytest.raises(CertificateError, match="altered"):
        export_controller(source, target, out)
    write_controller(source, replace(make_controller(), status=ControllerStatus.UNVALIDATED))
    with pytest.raises(CertificateError, match="not validated"):
        export_controller(source, target, out)
    assert out.read_text(encoding="utf-8") == "old"
    assert {path.name for path in source.parent.iterdir()} == {"controller.yaml", "out"}


def test_an_unknown_target_is_a_usage_error_that_lists_what_works(source: Path) -> None:
    with pytest.raises(UsageError, match=rf"no export target fzi; targets: {', '.join(TARGETS)}\."):
        export_controller(source, "fzi", source.with_name("out"))


def test_an_export_that_reads_back_differently_is_not_written(source: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def render_rounded(request: ExportRequest) -> Rendered:
        controller = request.source.controller
        rounded = replace(controller, delay_samples=controller.delay_samples + 1)
        return render_cell(replace(request, source=replace(request.source, controller=rounded)))

    monkeypatch.setattr(export_module, "TARGETS", {"rounded": replace(JSON, name="rounded", render=render_rounded)})
    with pytest.raises(CertificateError, match="does not read back as the same controller"):
        export_controller(source, "rounded", source.with_name("out"))
    assert not source.with_name("out").exists()


@pytest.mark.parametrize("name", TARGETS)
def test_a_target_is_one_entry_of_the_table(name: str, source: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """What is offered is what works: the help, the names of options and the refusal of others come from the table."""
    target = TARGETS[name]
    assert target.name == name
    with pytest.raises(SystemExit):
        command.main(["--help"])
    page = " ".join(capsys.readouterr().out.split())
    assert f"{name}: {target.summary}" in page
    assert all(option.flag in page for option in target.options)
    with pytest.raises(UsageError, match=f"The target {name} has no option --no-such; it"):
        export_controller(source, name, source.with_name("out.c"), options={"no_such": 1})


def test_options_of_one_name_are_one_option() -> None:
    options = target_options()
    assert len({option.flag for option in options}) == len(options)


def test_the_table_is_read_without_numpy() -> None:
    """`autotune export --help` reads it."""
    program = "import sys, autotune.export.targets; sys.exit('numpy' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", program], check=False).returncode == 0


def test_the_command_that_is_shown_exports_to_a_name_of_the_targets_kind() -> None:
    source = Path("cell/controller.yaml")
    assert example_export(TARGETS["c"], source) == (
        "autotune export cell/controller.yaml --target c -o cell/controller.c"
    )
    for name, target in TARGETS.items():
        words = shlex.split(example_export(target, source))
        assert words[:5] == ["autotune", "export", str(source), "--target", name]
        assert words[-2:] == ["-o", str(source.with_suffix(".c")) if target.suffix == ".c" else name + target.suffix]
