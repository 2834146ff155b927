"""The program of all rows and that of the few that bind have one solution."""

import numpy as np
import pytest
from scipy.optimize import linprog

from autotune.certificate.multiplier_search import most_room

_COLUMNS, _FADING = 34, 5


def _least_of_all(rows: np.ndarray) -> float:
    """Return the largest least of rows·weights, by a program of every row."""
    count = rows.shape[1]
    fading = np.append(-np.array([place >= count - _FADING for place in range(count)], dtype=float), 0.0)
    found = linprog(
        np.append(np.zeros(count), -1.0),
        A_ub=np.vstack([np.column_stack([-rows, np.ones(len(rows))]), fading]),
        b_ub=np.append(np.zeros(len(rows)), -0.1),
        A_eq=np.append(np.ones(count), 0.0)[None, :],
        b_eq=[1.0],
        bounds=[(0.0, None)] * count + [(None, None)],
    )
    return -float(found.fun)


@pytest.mark.parametrize("seed", range(4))
def test_the_rows_that_bind_give_the_room_of_all(seed: int) -> None:
    rng = np.random.default_rng(seed)
    # Smooth along the frequencies, as answers are, and mostly positive.
    places, waves = np.linspace(0.0, 1.0, 2000)[:, None], rng.uniform(1.0, 40.0, _COLUMNS)
    rows = 0.6 + np.cos(2.0 * np.pi * (waves * places + rng.random(_COLUMNS)))
    weights = most_room(rows)
    assert weights is not None
    assert np.all(weights >= 0.0)
    assert np.sum(weights) == pytest.approx(1.0, abs=1e-9)
    assert np.sum(weights[-_FADING:]) >= 0.1 - 1e-9
    assert np.min(rows @ weights) == pytest.approx(_least_of_all(rows), rel=1e-6)


def test_where_one_row_has_no_room_there_are_no_weights() -> None:
    rows = np.ones((2000, _COLUMNS))
    rows[1237] = -1.0  # none of those that are taken at first
    assert most_room(rows) is None
