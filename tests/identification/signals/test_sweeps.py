"""Kernels over long arrays against the array expressions that they stand for, to the last bit."""

import numpy as np
import pytest

from identification.signals.sweeps import (
    are_unit,
    batch_means,
    continuous,
    finite_rows,
    goes_and_returns,
    normalised,
    repeats,
    second_differences,
    steps,
    turn_between,
)

_RNG = np.random.default_rng(5)
COUNT = 2000


def _values(kind: str, width: int) -> np.ndarray:
    """Return numbers (n, k): plain, read-only, columns of a wider array, or with numbers that are not finite."""
    values = _RNG.normal(size=(COUNT, width + 3)) * 10.0 ** _RNG.integers(-9, 9, size=(COUNT, 1))
    if kind == "columns":
        return values[:, 2 : width + 2]
    values = values[:, :width].copy()
    if kind == "unknown":
        values[::7, 1], values[::11, 0], values[5, 2] = np.nan, np.inf, -np.inf
    if kind == "frozen":
        values.setflags(write=False)
    return values


KINDS = pytest.mark.parametrize("kind", ["plain", "frozen", "columns", "unknown"])


@KINDS
@pytest.mark.filterwarnings("ignore:invalid value")
def test_differences_are_those_of_numpy(kind: str) -> None:
    values = _values(kind, 3)
    assert np.array_equal(second_differences(values).T, np.abs(np.diff(values, n=2, axis=0)), equal_nan=True)
    limits = np.array([1e-3, 1.0, 1e3])
    assert np.array_equal(steps(values, 3, limits), np.any(np.abs(values[3:] - values[:-3]) > limits, axis=1))


def test_a_log_shorter_than_a_difference_has_none() -> None:
    assert second_differences(np.ones((1, 3))).shape == (3, 0)
    assert repeats(np.ones((1, 3))).shape == (0,)
    assert not goes_and_returns(np.ones((2, 3)), 0.0)


@KINDS
def test_rows_are_finite_as_numpy_has_it(kind: str) -> None:
    values = _values(kind, 4)
    assert np.array_equal(finite_rows(values), np.isfinite(values).all(axis=1))


@KINDS
def test_rows_repeat_as_numpy_has_it(kind: str) -> None:
    values = np.repeat(_values(kind, 3), 2, axis=0)
    values[9, 1] += 1.0
    assert np.array_equal(repeats(values), np.all(values[1:] == values[:-1], axis=1))


@pytest.mark.parametrize("place", [0, 1, 40, COUNT - 2, COUNT - 1])
@pytest.mark.parametrize("unknown", [None, 0, 2])
def test_one_value_away_from_both_neighbours_is_seen(place: int, unknown: int | None) -> None:
    values = _RNG.uniform(-0.4, 0.4, size=(COUNT, 3))
    values[place, 1] = 3.0
    if unknown is not None:
        values[:, unknown] = np.nan
    assert goes_and_returns(values, 1.0) == (0 < place < COUNT - 1)
    assert not goes_and_returns(values, 4.0)


@pytest.mark.parametrize("values", [[0.0, 0.0, 2.0, 2.0], [0.0, 2.0, 4.0, 6.0], [0.0, 5.0, 2.6, 2.0]])
def test_a_step_that_stays_does_not_return(values: list[float]) -> None:
    assert not goes_and_returns(np.array(values)[:, None], 1.0)


@KINDS
def test_quaternions_get_the_norm_1_that_numpy_gives_them(kind: str) -> None:
    values = _values(kind, 4)
    if kind == "unknown":
        values = np.where(np.isinf(values), np.nan, values)
    by_numpy = values / np.linalg.norm(values, axis=1, keepdims=True)
    by_numpy = by_numpy * np.where(by_numpy[:, 3:] < 0.0, -1.0, 1.0)
    assert np.array_equal(normalised(values), by_numpy, equal_nan=True)


def test_turns_between_quaternions_are_those_of_numpy() -> None:
    before, after = normalised(_values("plain", 4)), normalised(_values("plain", 4))
    x, y, z, w = before.T
    a, b, c, d = after.T
    vector = (w * a - d * x - y * c + z * b, w * b - d * y - z * a + x * c, w * c - d * z - x * b + y * a)
    cosine, sine = turn_between(before, after)
    assert np.array_equal(cosine, np.abs(w * d + x * a + y * b + z * c))
    assert np.array_equal(sine, np.sqrt(vector[0] ** 2 + vector[1] ** 2 + vector[2] ** 2))


@pytest.mark.parametrize("count", [0, 1, COUNT])
def test_signs_of_neighbours_are_those_by_numpy(count: int) -> None:
    quaternions = normalised(_values("plain", 4))[:count]
    turns = np.sum(quaternions[1:] * quaternions[:-1], axis=1) < 0.0
    signs = np.concatenate([[1.0], np.where(np.cumsum(turns) % 2 == 1, -1.0, 1.0)])[:count]
    assert np.array_equal(continuous(quaternions), quaternions * signs[:, None])


@KINDS
@pytest.mark.filterwarnings("ignore:invalid value")
@pytest.mark.parametrize("count", [8, 30, 501, COUNT])
def test_means_of_batches_are_those_of_numpy(kind: str, count: int) -> None:
    values = _values(kind, 3)[:count]
    by_numpy = [batch.mean(axis=0) for batch in np.array_split(values, 8)]
    assert np.array_equal(batch_means(values, 8), by_numpy, equal_nan=True)


@pytest.mark.parametrize(
    ("norm", "is_unit"), [(1.0, True), (1.0008, True), (0.9992, True), (1.001, False), (0.5, False)]
)
def test_a_norm_that_is_off_or_unknown_is_not_1(norm: float, is_unit: bool) -> None:
    values = np.hstack([np.ones((COUNT, 3)), normalised(_values("plain", 4))])
    values[70, 3:] *= norm
    assert are_unit(values, 1e-3) == is_unit
    values[3, 5] = np.nan
    assert not are_unit(values, 1e-3)
