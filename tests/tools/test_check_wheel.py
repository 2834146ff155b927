"""The wheel check finds what is missing and what should not be there."""

from pathlib import Path

from tools.check_wheel import TYPED, complaints, expected_files

INFO = "robot_autotune-0.1.0.dist-info/METADATA"
SCHEMA = "autotune/formats/schemas/controller.schema.json"
EXPECTED = frozenset({*TYPED, SCHEMA, "problems/model/plant.py"})


def test_a_wheel_as_it_should_be_passes() -> None:
    assert complaints({*EXPECTED, INFO}, EXPECTED) == []


def test_each_fault_is_named() -> None:
    names = {*EXPECTED, INFO, "tests/conftest.py"} - {"problems/model/plant.py", "identification/py.typed", SCHEMA}
    assert complaints(names, EXPECTED) == [
        f"missing: {SCHEMA}",
        "missing: identification/py.typed",
        "missing: problems/model/plant.py",
        "unexpected: tests/conftest.py",
        "missing: a schema in autotune/formats/schemas/",
    ]


def test_modules_types_and_schemas_are_expected_and_nothing_else(tmp_path: Path) -> None:
    for name in (SCHEMA, "problems/model/plant.py", "problems/notes.txt", "tests/test_plant.py", *TYPED):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()
    assert expected_files(tmp_path) == EXPECTED
