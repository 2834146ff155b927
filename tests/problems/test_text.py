"""Numbers as a sentence holds them."""

import pytest

from problems.text import significant


@pytest.mark.parametrize(
    ("value", "digits", "text"),
    [
        (373.0, 2, "370"),
        (100.0, 2, "100"),
        (37.3, 2, "37"),
        (0.00373, 2, "0.0037"),
        (-1234.0, 3, "-1230"),
        (0.0, 2, "0"),
    ],
)
def test_large_numbers_are_written_out(value: float, digits: int, text: str) -> None:
    assert significant(value, digits) == text
