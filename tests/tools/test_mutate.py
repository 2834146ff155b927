"""What a mutation run changes, and which tests it asks."""

import subprocess
import sys
from pathlib import Path

import pytest

from tools.mutate import ROOT, _is_unnoticed, files_of_tests, find_mutants

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
    files = files_of_tests(Path("problems/stability/margins.py"), ROOT)
    assert files[0] == ROOT / "tests/problems/stability/test_margins.py"
    assert len(set(files)) == len(files)
    # Then those that import it, by whatever form of import, and last what only lives in the same room.
    assert ROOT / "tests/autotune/validation/test_margins.py" in files
    room = ROOT / "tests/problems/stability"
    last = next(i for i in reversed(range(len(files))) if not files[i].is_relative_to(room))
    assert all(file.is_relative_to(room) for file in files[last + 1 :])


@pytest.mark.parametrize(
    ("code", "limit_s", "expected"),
    [
        ("raise SystemExit(1)", 30.0, False),
        ("pass", 30.0, True),
        ("import time; time.sleep(30)", 30.0, False),
        ("import time; [(print('.', flush=True), time.sleep(0.1)) for _ in range(300)]", 1.0, True),
    ],
    ids=["noticed", "unnoticed", "a hang", "out of time"],
)
def test_what_pytest_answers_is_what_became_of_a_change(code: str, limit_s: float, expected: bool) -> None:
    with subprocess.Popen([sys.executable, "-S", "-c", code], stdout=subprocess.PIPE) as run:
        assert _is_unnoticed(run, limit_s, 2.0) is expected
        run.kill()


@pytest.mark.parametrize("name", ["problems/progress.py", "identification/result.py"])
def test_no_module_is_without_tests(name: str) -> None:
    assert files_of_tests(Path(name), ROOT)
