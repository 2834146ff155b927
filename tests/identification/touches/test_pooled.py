"""Several contacts with one surface: mean, deviation and the error of leaving one out."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from identification.touches.surfaces import left_out_error, pooled


@given(values=st.lists(st.floats(1e3, 1e5), min_size=1, max_size=6), share=st.floats(0.0, 0.3))
@settings(max_examples=50, deadline=None)
def test_the_deviation_holds_what_differs_between_contacts(values: list[float], share: float) -> None:
    mean, std, spread = pooled(values, [share * value for value in values])
    assert mean == pytest.approx(np.mean(values))
    assert std >= 0.9 * float(np.std(values))
    assert std >= (1.0 - 1e-12) * 0.1 * mean / np.sqrt(len(values))
    assert (spread is None) == (len(values) == 1)
    errors = [value - np.mean([*values[:i], *values[i + 1 :]]) for i, value in enumerate(values) if len(values) > 2]
    assert left_out_error(values) == (
        pytest.approx(np.sqrt(np.mean(np.square(errors))), abs=1e-9 * mean) if errors else None
    )
    assert std >= (left_out_error(values) or 0.0)


@given(values=st.lists(st.floats(1e3, 1e5), min_size=1, max_size=2), share=st.floats(0.01, 0.3))
@settings(max_examples=50, deadline=None)
def test_of_one_or_two_contacts_their_own_errors_add_as_those_of_a_mean(values: list[float], share: float) -> None:
    stds = [share * value * (1.0 + i) for i, value in enumerate(values)]
    mean, std, _ = pooled(values, stds)
    # One contact more, at the mean but for a tenth, counts with the others.
    between = (sum((value - mean) ** 2 for value in values) + (0.1 * mean) ** 2) / len(values)
    of_the_mean = sum(each**2 for each in stds) / len(values) ** 2
    assert std**2 == pytest.approx(between + of_the_mean, rel=1e-9)


def test_contacts_of_which_each_is_well_known_are_no_better_known_than_what_they_differ_by() -> None:
    # Each is missed by the mean of the other n - 1 by n/(n - 1) of its own distance.
    values = [1e4, 1.3e4, 0.8e4, 2.1e4]
    _, std, spread = pooled(values, [0.0] * 4)
    assert std == pytest.approx(np.std(values) * 4.0 / 3.0)
    assert spread == pytest.approx(np.std(values, ddof=1) / np.mean(values))
