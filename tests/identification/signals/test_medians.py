"""Medians of long arrays against NumPy's, to the last bit."""

import numpy as np
import pytest

from identification.signals.medians import column_medians, median

COUNT = 60_000
_RNG = np.random.default_rng(3)


@pytest.mark.parametrize("count", [3, 4, COUNT, COUNT + 1])
@pytest.mark.parametrize(
    "values",
    [
        _RNG.normal(size=COUNT + 1),
        _RNG.normal(800_000.0, 3_000.0, COUNT + 1).astype(np.int64),
        800_000 + _RNG.integers(-1, 2, COUNT + 1),
        np.full(COUNT + 1, 800_000),
        np.arange(COUNT + 1.0),
        # A sample of every 14th sees only ones: everything is put in order.
        np.where(np.arange(COUNT + 1) % (COUNT // 4096) == 0, 1.0, _RNG.normal(size=COUNT + 1)),
        np.repeat([1.0, 2.0], [(COUNT + 1) // 2, COUNT + 1 - (COUNT + 1) // 2]),
    ],
    ids=["normal", "integers", "ties", "constant", "rising", "sample-misleads", "two-values"],
)
def test_a_median_is_that_of_numpy(values: np.ndarray, count: int) -> None:
    assert median(values[:count]) == float(np.median(values[:count]))


@pytest.mark.parametrize("place", [0, 1, COUNT - 1])
@pytest.mark.parametrize("fill", [0.0, None], ids=["constant", "normal"])
def test_a_median_with_a_number_that_is_not_known_is_not_known(place: int, fill: float | None) -> None:
    values = _RNG.normal(size=COUNT) if fill is None else np.full(COUNT, fill)
    values[place] = np.nan
    assert np.isnan(median(values))


def test_medians_of_columns_leave_out_what_is_not_known() -> None:
    values = _RNG.normal(size=(COUNT, 3))
    values[::7, 1] = np.nan
    assert np.array_equal(column_medians(values), np.nanmedian(values, axis=0))
