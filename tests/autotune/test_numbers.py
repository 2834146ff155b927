"""Numbers as far as their deviation tells."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from autotune.numbers import rounded_to, with_deviation


@pytest.mark.parametrize(
    ("value", "std", "told"),
    [
        (16.20512, 0.0241, ("16.205", "0.024")),
        (310.018, 0.0996, ("310.02", "0.10")),  # two digits, not the three of 0.100
        (12345.6, 250.0, ("12346", "250")),
        (-0.00001, 0.0016, ("0.0000", "0.0016")),  # no negative zero
        (1.234e-9, 1e-10, ("1.23e-09", "0.10e-09")),
        (3e-12, 1.4e-10, ("0.0e-10", "1.4e-10")),
        (0.8, 0.0, ("0.8000", "0")),
        (0.8, None, ("0.8000", "-")),
        (None, None, ("-", "-")),
        (2.0, math.inf, ("2.0000", "0")),
    ],
)
def test_value_and_deviation_have_the_same_decimals(
    value: float | None, std: float | None, told: tuple[str, str]
) -> None:
    assert with_deviation(value, std) == told


def test_both_are_told_in_the_unit_of_the_reader() -> None:
    assert with_deviation(0.0023996, 2.4e-6, 1e3) == ("2.3996", "0.0024")


@given(value=st.floats(-1e6, 1e6), std=st.floats(1e-12, 1e4))
def test_what_is_written_is_the_value_to_a_part_of_its_deviation(value: float, std: float) -> None:
    written, spread = with_deviation(value, std)
    # Two digits: half of the second one is at most a twentieth of the deviation.
    assert float(written) == pytest.approx(value, abs=0.0501 * std, rel=1e-15)
    assert float(spread) == pytest.approx(std, rel=0.0501)
    decimals = [len(text.partition("e")[0].partition(".")[2]) for text in (written, spread)]
    assert decimals[0] == decimals[1]
    assert written.partition("e")[2] == spread.partition("e")[2]


def test_a_truth_is_written_as_far_as_the_estimate_beside_it() -> None:
    assert rounded_to(0.024, 16.2) == "16.200"
    assert rounded_to(0.0, 16.2) == "16.2000"
