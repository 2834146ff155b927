"""What a mutation run changes, and which tests it asks."""

from pathlib import Path

import pytest

from tools.mutate import ROOT, files_of_tests, find_mutants

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
    near, room = files_of_tests(Path("problems/stability/margins.py"), ROOT)
    assert any(path.name == "test_margins.py" for path in near)
    assert not set(near) & set(room)


@pytest.mark.parametrize("name", ["problems/progress.py", "identification/result.py"])
def test_no_module_is_without_tests(name: str) -> None:
    assert files_of_tests(Path(name), ROOT)
