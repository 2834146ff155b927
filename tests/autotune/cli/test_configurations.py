"""Configurations that must not get through: exit code 6 and one sentence with the line of the file and the reason."""

from pathlib import Path

import pytest

from autotune.cli.main import main
from autotune.formats.canonical import checksum
from autotune.formats.controller import controller_tree, read_controller
from autotune.formats.identified import write_identified
from autotune.formats.yaml12 import dump_yaml
from tests.autotune.formats.samples import make_controller
from tests.autotune.tuning.cases import identified_plant

TREE = controller_tree(make_controller(("x",)))
YAML = dump_yaml(TREE)
LAST = YAML.count("\n")


def line_of(text: str) -> int:
    return YAML[: YAML.index(text)].count("\n") + 1


def swapped(old: str, new: str) -> bytes:
    assert old in YAML
    return YAML.replace(old, new, 1).encode()


def sealed(**changes: object) -> bytes:
    tree = TREE | changes
    return dump_yaml(tree | {"checksum": checksum(tree)}).encode()


MASS = line_of("    mass:")
BOMB = "a: &a [x, x]\nb: &b [*a, *a]\nc: &c [*b, *b]\nd: &d [*c, *c]\n"
CASES: dict[str, tuple[bytes, int, str]] = {
    "a line deleted": (swapped("    mass: 12.5\n", ""), line_of("  x:\n"), "axes.x.mass must be present"),
    "a digit changed": (swapped("mass: 12.5", "mass: 13.5"), LAST, "the file is altered"),
    "duplicate keys": (swapped("    mass: 12.5", "    mass: 12.5\n    mass: 13.0"), MASS + 1, "mass occurs twice"),
    "2e-5 as text": (swapped("feedback_damping_s: 0.02", 'feedback_damping_s: "2e-2"'), MASS + 3, "the text '2e-2'"),
    "the paper's 2e-5": (
        swapped("feedback_damping_s: 0.02", "feedback_damping_s: 2e-5"),
        MASS + 3,
        "0 or at least 1e-4",
    ),
    ".nan": (swapped("mass: 12.5", "mass: .nan"), MASS, "is not a finite number"),
    ".inf": (swapped("mass: 12.5", "mass: -.inf"), MASS, "is not a finite number"),
    "a number too large": (swapped("mass: 12.5", "mass: 1e999"), MASS, "1e999"),
    "a decimal comma": (swapped("mass: 12.5", "mass: 12,5"), MASS, "with a decimal point, not a comma"),
    "commas in a list": (swapped("[0.01, -0.02, 0.1]", "[0,01, -0,02, 0,1]"), line_of("  com_m"), "decimal comma"),
    "a byte order mark": (b"\xef\xbb\xbf" + YAML.encode(), 1, "a byte order mark"),
    "UTF-16": (YAML.encode("utf-16"), 1, "not UTF-8"),
    "a tab": (swapped("    mass:", "\tmass:"), MASS, "a tab"),
    "two documents": (swapped("axes:\n", "---\naxes:\n"), line_of("axes:\n"), "a second document begins"),
    "an alias bomb": ((BOMB + YAML).encode(), 1, "anchors"),
    "deep nesting": (swapped("mass: 12.5", "mass: " + "[" * 2000 + "]" * 2000), MASS, "nested more than"),
    "a tag": (swapped("mass: 12.5", "mass: !!python/name:os.system 12.5"), MASS, "tags"),
    "an older version": (sealed(version=0), 2, "version must be 1, which this release reads, found 0"),
    "a newer version": (sealed(version=2), 2, "version must be 1, which this release reads, found 2"),
    "a stale checksum": (swapped(TREE["checksum"], "0" * 64), LAST, "the checksum says 00000000, but the content has"),
    "not validated": (sealed(status="unvalidated"), 3, "the controller is not validated"),
    "cut": (YAML[: YAML.index("margins:")].encode(), 1, ""),
    "empty": (b"", 1, ""),
}


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("command", ["validate", "export"])
def test_a_configuration_that_must_not_get_through(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], command: str, case: str
) -> None:
    content, line, reason = CASES[case]
    path, out = tmp_path / "controller.yaml", tmp_path / "out.json"
    path.write_bytes(content)
    further = ["--target", "json", "-o", str(out)] if command == "export" else []
    code = main([command, str(path), *further])
    output = capsys.readouterr()
    assert (code, output.out, output.err.count("\n")) == (6, "", 1), output.err
    assert not out.exists()
    assert f"{path}, line " in output.err
    assert reason in output.err
    if case != "cut":
        assert f"{path}, line {line}: " in output.err, output.err


@pytest.mark.parametrize("command", ["validate", "export"])
def test_another_kind_of_file_is_a_wrong_request_and_no_tampering(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], command: str
) -> None:
    path, out = tmp_path / "controller.yaml", tmp_path / "out.json"
    path.write_bytes(sealed(format="autotune/identified"))
    further = ["--target", "json", "-o", str(out)] if command == "export" else []
    assert main([command, str(path), *further]) == 2
    assert "is an identified plant, not a controller" in capsys.readouterr().err
    assert not out.exists()


def test_2e_5_and_its_like_are_numbers(tmp_path: Path) -> None:
    """YAML 1.1 reads an exponent without a point as text."""
    path = tmp_path / "controller.yaml"
    path.write_text(YAML.replace("feedback_damping_s: 0.02", "feedback_damping_s: 2e-2"), encoding="utf-8")
    assert read_controller(path).checksum == TREE["checksum"]


def test_another_cells_file_does_not_pass_for_this_cell(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The file itself is whole; what tells is the plant that was identified here, beside the certified one."""
    path, plant = tmp_path / "controller.yaml", tmp_path / "identified.yaml"
    path.write_text(YAML, encoding="utf-8")
    write_identified(plant, identified_plant(), {"tool": "by hand"})
    code = main(["validate", str(path), "--identified", str(plant), "--samples", "0", "--json"])
    output = capsys.readouterr()
    assert code == 6
    assert '"name": "identified plant",\n      "passed": false' in output.out
