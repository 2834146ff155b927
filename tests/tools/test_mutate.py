"""What a mutation run changes, and which tests it asks."""

import shutil
from pathlib import Path

import pytest

from tools import mutate
from tools.mutate import ROOT, Verdict, files_of_tests, find_mutants, run_tests

SOURCE = b'''"""Text with 1 + 2."""
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    LIMIT = 3


def largest(values: list[int], floor: int = 0) -> int:
    if len(values) < 2 and not values:
        raise ValueError(f"at least {1 + 1} values")
    return max(values) - floor
'''


def test_each_change_is_another_program_and_none_touches_types_or_messages() -> None:
    mutants = find_mutants(Path("toy.py"), SOURCE)
    changed = {mutant.applied(SOURCE) for mutant in mutants}
    assert len(changed) == len(mutants) >= 6
    for text in changed:
        compile(text, "toy.py", "exec")
        assert b"1 + 1" in text
        assert b"LIMIT = 3" in text
    assert {mutant.before for mutant in mutants} >= {"0", "2", "max(values)", "not values"}


def test_the_nearest_tests_come_first() -> None:
    near, far = files_of_tests(Path("problems/stability/margins.py"), ROOT)
    room = ROOT / "tests/problems/stability"
    assert near[0] == room / "test_margins.py"
    assert all(file.is_relative_to(room) for file in near)
    # Then those that import it, by whatever form of import, and last what only lives in the same room.
    assert ROOT / "tests/autotune/validation/test_margins.py" in far
    first = next(i for i, file in enumerate(far) if file.is_relative_to(room))
    assert all(file.is_relative_to(room) for file in far[first:])
    assert len({*near, *far}) == len(near) + len(far)


@pytest.mark.parametrize("name", ["problems/progress.py", "problems/design/requirements/peak_force.py"])
def test_no_module_is_without_tests(name: str) -> None:
    near, far = files_of_tests(Path(name), ROOT)
    assert [*near, *far]


@pytest.mark.parametrize(
    ("code", "silence_s", "verdict"),
    [
        ("assert False", 1.0, Verdict.CAUGHT),
        ("pass", 1.0, Verdict.SURVIVED),
        ("while True: pass", 1.0, Verdict.CAUGHT),
        ("while True: pass", 30.0, Verdict.OUT_OF_TIME),
    ],
    ids=["noticed", "unnoticed", "a hang", "out of time"],
)
def test_what_pytest_answers_is_what_became_of_a_change(
    code: str, silence_s: float, verdict: Verdict, tmp_path: Path
) -> None:
    assert run_tests([_copy_with(code, tmp_path)], tmp_path, 3.0, silence_s) is verdict


def test_a_test_that_waits_for_ever_has_noticed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mutate, "_WAITING", 1.0)
    assert (
        run_tests([_copy_with("import threading; threading.Event().wait()", tmp_path)], tmp_path, 3.0, 1.0)
        is Verdict.CAUGHT
    )


def test_files_run_in_the_order_given(tmp_path: Path) -> None:
    """What comes second is not reached, though it has a slow test."""
    file = _copy_with("assert False", tmp_path)
    second = file.with_name("test_second.py")
    second.write_text("import pathlib\ndef test_() -> None: pathlib.Path('reached').touch()\n")
    (tmp_path / "conftest.py").write_text("def pytest_collection_modifyitems(items): items.reverse()\n")
    assert run_tests([file, second], tmp_path, 3.0, 1.0) is Verdict.CAUGHT
    assert not (tmp_path / "reached").exists()


def _copy_with(code: str, root: Path) -> Path:
    """Make what is a checkout to the script: itself, and a file with one test."""
    (root / "tools").mkdir()
    shutil.copy(ROOT / "tools/mutate.py", root / "tools")
    file = root / "test_code.py"
    file.write_text(f"def test_() -> None:\n    {code}\n")
    return file
