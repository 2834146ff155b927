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
    folder = Path("a") / "b" + [3]
    return max(values) - floor + 1e-9 / max(floor, 1e-12)
'''


def test_each_change_is_another_program_and_none_touches_types_or_messages() -> None:
    mutants = find_mutants(Path("toy.py"), SOURCE)
    changed = {mutant.applied(SOURCE) for mutant in mutants}
    assert len(changed) == len(mutants) >= 6
    for text in changed:
        compile(text, "toy.py", "exec")
        assert b"at least {1 + 1}" in text
        assert b"LIMIT = 3" in text
        assert b"1e-12" in text
        assert b'Path("a") / "b" + [' in text
    assert {mutant.before for mutant in mutants} >= {"0", "2", "1e-9", "max(values)", "not values"}
    assert {m.after for m in mutants if m.before == "len(values) < 2"} == {"(len(values) <= 2)", "(len(values) >= 2)"}


def test_the_nearest_tests_come_first() -> None:
    near, far, second_hand, farther = files_of_tests(Path("problems/stability/margins.py"))
    room = Path("tests/problems/stability")
    assert near[0] == room / "test_margins.py"
    assert all(file.is_relative_to(room) for file in near)
    # Then those elsewhere that import it, before those that only live in the same room.
    assert far.index(Path("tests/autotune/validation/test_margins.py")) < far.index(room / "test_passivity.py")
    assert Path("tests/autotune/tuning/test_search.py") in second_hand
    files = near + far + second_hand + farther
    assert len({*files}) == len(files)


def test_a_module_that_its_package_hands_on_has_the_tests_of_the_package() -> None:
    near, far, second_hand, _ = files_of_tests(Path("problems/design/requirements/peak_force.py"))
    assert near == []
    assert Path("tests/problems/design/test_requirements.py") in far
    assert Path("tests/autotune/tuning/test_limits.py") in second_hand


def test_what_reaches_a_module_through_tools_or_by_a_command_s_name_is_asked_last() -> None:
    """A record's bounds are in the schemas, which a tool makes; the commands are modules by name."""
    *_, farther = files_of_tests(Path("autotune/formats/plan.py"))
    assert Path("tests/tools/test_make_reference.py") in farther
    *_, farther = files_of_tests(Path("identification/given.py"))
    assert Path("tests/autotune/cli/test_identify.py") in farther


@pytest.mark.parametrize(
    ("code", "limit_s", "silence_s", "verdict"),
    [
        ("pass", 60.0, 30.0, Verdict.SURVIVED),
        ("while True: pass", 60.0, 0.5, Verdict.CAUGHT),
        ("while True: pass", 1.0, 30.0, Verdict.OUT_OF_TIME),
    ],
    ids=["unnoticed", "a hang", "out of time"],
)
def test_what_pytest_answers_is_what_became_of_a_change(
    code: str, limit_s: float, silence_s: float, verdict: Verdict, tmp_path: Path
) -> None:
    assert run_tests([_copy_with(code, tmp_path)], tmp_path, limit_s, silence_s) is verdict


def test_a_test_that_waits_for_ever_has_noticed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mutate, "_WAITING", 0.05)
    assert (
        run_tests([_copy_with("import threading; threading.Event().wait()", tmp_path)], tmp_path, 60.0, 30.0)
        is Verdict.CAUGHT
    )


def test_what_breaks_the_fixtures_has_been_noticed_and_a_file_that_is_not_there_is_no_answer(tmp_path: Path) -> None:
    file = _copy_with("pass", tmp_path)
    (tmp_path / "conftest.py").write_text("import nothing_of_that_name\n")
    assert run_tests([file], tmp_path, 60.0, 30.0) is Verdict.CAUGHT
    with pytest.raises(FileNotFoundError, match=r"no tests in .*: missing\.py"):
        run_tests([file, Path("missing.py")], tmp_path, 60.0, 30.0)


def test_files_run_in_the_order_given(tmp_path: Path) -> None:
    """What comes second is not reached, though it has a slow test."""
    file = _copy_with("assert False", tmp_path)
    second = file.with_name("test_second.py")
    second.write_text("import pathlib\ndef test_() -> None: pathlib.Path('reached').touch()\n")
    (tmp_path / "conftest.py").write_text("def pytest_collection_modifyitems(items): items.reverse()\n")
    assert run_tests([file, second], tmp_path, 60.0, 30.0) is Verdict.CAUGHT
    assert not (tmp_path / "reached").exists()


def _copy_with(code: str, root: Path) -> Path:
    """Make what is a checkout to the script: itself, and a file with one test."""
    (root / "tools").mkdir()
    shutil.copy(ROOT / "tools/mutate.py", root / "tools")
    file = root / "test_code.py"
    file.write_text(f"def test_() -> None:\n    {code}\n")
    return file
