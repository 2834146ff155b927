import json
from dataclasses import replace
from pathlib import Path

import pytest
from jsonschema import Draft202012Validator

from autotune.errors import CertificateError, UsageError
from autotune.export import targets
from autotune.export.replace import CELL_MARK
from autotune.export.targets import TARGETS, export_controller
from autotune.formats.controller import Controller, ControllerStatus, checksum, read_controller, write_controller
from autotune.formats.schema import load_schema
from autotune.formats.yaml12 import load_yaml
from tests.autotune.formats.samples import make_controller

pytestmark = pytest.mark.usefixtures("unchecked_law")


@pytest.fixture
def source(tmp_path: Path) -> Path:
    path = tmp_path / "controller.yaml"
    write_controller(path, make_controller())
    return path


@pytest.mark.parametrize("target", TARGETS)
def test_an_export_reads_back_as_the_same_controller(source: Path, target: str) -> None:
    out = source.with_name("out")
    digest = export_controller(source, target, out)
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
    digest = export_controller(source, "json", out)
    tree = json.loads(out.read_text(encoding="ascii"))
    assert list(Draft202012Validator(load_schema("controller")).iter_errors(tree)) == []
    assert tree == load_yaml(source)
    assert checksum(tree) == digest


@pytest.mark.parametrize("target", TARGETS)
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


def test_an_unknown_target_is_a_usage_error_that_lists_the_others(source: Path) -> None:
    with pytest.raises(UsageError, match="no export target fzi; targets: cell, json"):
        export_controller(source, "fzi", source.with_name("out"))


def test_a_format_that_tells_another_controller_is_not_written(source: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def render_rounded(controller: Controller) -> str:
        return targets.render_cell(replace(controller, delay_samples=controller.delay_samples + 1))

    monkeypatch.setattr(targets, "TARGETS", {"rounded": render_rounded})
    with pytest.raises(CertificateError, match="does not read back as the same controller"):
        export_controller(source, "rounded", source.with_name("out"))
    assert not source.with_name("out").exists()
