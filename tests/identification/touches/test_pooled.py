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
