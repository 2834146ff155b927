"""Numbers and names as a sentence holds them."""

import math

import pytest

from problems.text import meant, rounded_down, significant


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


@pytest.mark.parametrize(
    ("value", "digits", "down"),
    [(0.0888, 2, 0.088), (0.245, 2, 0.24), (0.1, 2, 0.1), (0.3, 1, 0.3), (1999.0, 1, 1000.0), (5.0, 3, 5.0)],
)
def test_what_is_rounded_down_is_never_more(value: float, digits: int, down: float) -> None:
    assert rounded_down(value, digits) == down
    assert rounded_down(math.inf) == math.inf


def test_only_a_name_that_is_near_may_be_meant() -> None:
    known = ("drag", "mass", "coupling_stiffness")
    assert meant("draag", known) == "; drag may be meant"
    assert meant("coupling", known) == "; coupling_stiffness may be meant"
    assert not meant("orientation", known)
    assert not meant(3, known)
