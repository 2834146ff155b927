"""The reference page is the schemas', and its maker reads what they say."""

import json
import re
import shutil
from pathlib import Path
from typing import Any

import pytest

from autotune.formats.controller import controller_tree
from tests.autotune.formats.samples import make_controller
from tools import make_reference
from tools.make_reference import Schema, main, page


def test_the_page_is_up_to_date(repository: Path) -> None:
    """Else: python tools/make_reference.py."""
    assert (repository / "docs" / "reference.md").read_text(encoding="utf-8") == page()
    assert main(["--check"]) == 0


@pytest.mark.parametrize("name", ["controller", "identified", "cell"])
def test_a_record_that_the_schema_does_not_follow_is_found_out(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.copytree(make_reference.SCHEMAS, tmp_path, dirs_exist_ok=True)
    (tmp_path / f"{name}.schema.json").write_text("{}", encoding="utf-8")
    monkeypatch.setattr(make_reference, "SCHEMAS", tmp_path)
    monkeypatch.setattr(make_reference, "page", (make_reference.PAGE).read_text)
    assert main(["--check"]) == 1
    assert f"{name}.schema.json is out of date" in capsys.readouterr().err


def test_a_page_that_is_not_is_found_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(make_reference, "PAGE", tmp_path / "reference.md")
    assert main(["--check"]) == 1
    assert "out of date" in capsys.readouterr().err
    assert main([]) == 0
    assert main(["--check"]) == 0


def test_every_file_has_a_section(repository: Path) -> None:
    schemas = {path.name.split(".")[0] for path in (repository / "autotune/formats/schemas").glob("*.json")}
    assert set(re.findall(r"^## (\w+)\.yaml$", page(), re.MULTILINE)) == schemas


def test_rows_say_what_the_schema_says() -> None:
    tree: dict[str, Any] = {
        "required": ["delay_s"],
        "properties": {
            "delay_s": {"$ref": "#/$defs/time"},
            **{axis: {"type": "object", "properties": {"mass": {"type": "number"}}} for axis in "xyz"},
            "com_m": {"type": "array", "items": {"type": "number", "minimum": 0}, "minItems": 3, "maxItems": 3},
            "free": {"type": "object", "additionalProperties": {"anyOf": [{"type": "null"}, {"enum": ["a"]}]}},
        },
        "$defs": {"time": {"type": "number", "exclusiveMinimum": 0, "description": "a time"}},
    }
    assert [row.text() for row in Schema(tree).rows()] == [
        "| • | `delay_s` | number | s | > 0; a time |",
        "|  | `<x y z>` | mapping |  |  |",
        "|  | `<x y z>.mass` | number | kg, kg·m² |  |",
        "|  | `com_m` | list of: number | m | 3 entries; each ≥ 0 |",
        "|  | `free` | mapping |  |  |",
        '|  | `free.<name>` | null or `"a"` |  |  |',
    ]


def test_every_entry_of_a_written_file_has_its_row() -> None:
    tree = json.loads((make_reference.SCHEMAS / "controller.schema.json").read_text(encoding="utf-8"))
    rows = [row.path for row in Schema(tree).rows()]
    reported = {re.sub(r"<[xyzr ]+>", "<axis>", path) for path in rows}
    # Mappings of which the schema lists nothing hold anything.
    free = ("provenance", "certificate.proved[ ].over", *(p.removesuffix("<name>") for p in reported if "<name>" in p))
    for path in _paths(controller_tree(make_controller(("x", "rz"))), ""):
        assert path in reported or path.startswith(free), path


def _paths(node: object, path: str) -> list[str]:
    if isinstance(node, dict):
        names = ("<axis>" if key in {"x", "rz"} else key for key in node)
        below = [(f"{path}.{name}".lstrip("."), value) for name, value in zip(names, node.values(), strict=True)]
        return [each for at, value in below for each in [at, *_paths(value, at)]]
    if isinstance(node, list):
        return [each for value in node for each in _paths(value, f"{path}[ ]")]
    return []
