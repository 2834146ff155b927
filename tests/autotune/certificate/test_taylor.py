"""Linear functions with a bounded rest hold what they stand for, and are no wider than the worst case."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from autotune.certificate.taylor import Taylor, turned
from problems.arrays import FloatArray

COUNT, WAYS, DRAWS = 40, 3, 200
ROUNDED = 1.0 + 1e-12
Complex = NDArray[np.complex128]


def drawn(seed: int, spread: float = 0.3, rest: float = 0.05, *, is_real: bool = False) -> Taylor:
    rng = np.random.default_rng(seed)
    terms = rng.normal(size=(COUNT, 1 + WAYS)) + (0.0 if is_real else 1j) * rng.normal(size=(COUNT, 1 + WAYS))
    terms[:, 1:] *= spread / WAYS
    # No middle near 0, where nothing can be inverted.
    terms[:, 0] += 3.0 * terms[:, 0] / np.abs(terms[:, 0])
    return Taylor(terms=terms.astype(np.complex128), rest=rest / WAYS * rng.random((COUNT, WAYS)))


def positive(spread: float = 0.2, rest: float = 0.05) -> Taylor:
    """All terms above 0: the largest value is at the upper ends, the least at the lower ones."""
    rng = np.random.default_rng(3)
    terms = np.concatenate([rng.uniform(1.0, 2.0, (COUNT, 1)), spread / WAYS * rng.random((COUNT, WAYS))], axis=1)
    return Taylor(terms=terms.astype(np.complex128), rest=rest / WAYS * rng.random((COUNT, WAYS)))


def places(seed: int) -> FloatArray:
    """Return places (DRAWS, WAYS) of the coordinates, many at their ends."""
    rng = np.random.default_rng(seed)
    return np.asarray(np.clip(rng.uniform(-2.0, 2.0, (DRAWS, WAYS)), -1.0, 1.0))


def linear(of: Taylor, at: FloatArray) -> Complex:
    return np.asarray(of.terms[:, 0] + at @ of.terms[:, 1:].T)


def values(of: Taylor, at: FloatArray, seed: int, *, is_real: bool = False) -> Complex:
    """Return values (DRAWS, COUNT) that it stands for, with rests on and inside their circles."""
    rng = np.random.default_rng(seed)
    size = np.minimum(rng.uniform(0.0, 2.0, (DRAWS, COUNT)), 1.0) * np.sum(of.rest, axis=1)
    phase = np.sign(rng.normal(size=(DRAWS, COUNT))) if is_real else np.exp(2j * np.pi * rng.random((DRAWS, COUNT)))
    return np.asarray(linear(of, at) + size * phase)


def all_of(of: Taylor) -> FloatArray:
    return np.asarray(np.sum(of.rest, axis=1))


BINARY: dict[str, Callable[[Any, Any], Any]] = {"sum": lambda a, b: a + b, "product": lambda a, b: a * b}
FACTOR = np.linspace(-2.0, 3.0, COUNT)[:, None] * (1.0 + 0.5j)
UNARY: dict[str, tuple[Callable[[Taylor], Taylor], Callable[[Complex], Complex]]] = {
    "times a number": (lambda a: a.times(2.0 - 1.5j), lambda v: v * (2.0 - 1.5j)),
    "times many": (lambda a: a.times(FACTOR), lambda v: v * FACTOR[:, 0]),
    "plus": (lambda a: a.plus(-2.5), lambda v: v - 2.5),
    "conjugate": (lambda a: a.conjugate(), np.conj),
    "inverse": (lambda a: a.inverse(), lambda v: 1.0 / v),
}


@pytest.mark.parametrize("operation", BINARY)
def test_sums_and_products_hold_those_of_all_values(operation: str) -> None:
    a, b, at = drawn(1), drawn(2, spread=1.0, rest=0.3), places(3)
    found = BINARY[operation](a, b)
    exact = BINARY[operation](values(a, at, 4), values(b, at, 5))
    assert np.all(np.abs(exact - linear(found, at)) <= all_of(found) * ROUNDED)


@pytest.mark.parametrize("operation", UNARY)
def test_what_is_made_of_one_holds_what_is_made_of_every_value(operation: str) -> None:
    a, at = drawn(6), places(7)
    make, exactly = UNARY[operation]
    found, exact = make(a), exactly(values(a, at, 8))
    assert np.all(np.abs(exact - linear(found, at)) <= all_of(found) * ROUNDED)


def test_a_turn_holds_that_of_every_angle() -> None:
    angle, at = drawn(9, is_real=True), places(10)
    found, exact = turned(angle), np.exp(1j * values(angle, at, 11, is_real=True).real)
    assert np.all(np.abs(exact - linear(found, at)) <= all_of(found) * ROUNDED)


def test_no_value_is_larger_than_the_magnitude_or_left_of_the_least_real_part() -> None:
    of, at = drawn(12), places(13)
    found = values(of, at, 14)
    assert np.all(np.abs(found) <= of.magnitude())
    assert np.all(found.real >= of.least_real())
    assert np.all(np.abs(linear(of, at)) <= of.size() * ROUNDED)


def test_of_positive_terms_the_bounds_are_the_values_at_the_ends() -> None:
    a, b = positive(), positive(spread=0.7, rest=0.2)
    top, bottom, one = a.terms.real.sum(axis=1) + all_of(a), a.terms[:, 0].real, np.ones((1, WAYS))
    bottom = bottom - a.terms[:, 1:].real.sum(axis=1) - all_of(a)
    assert a.magnitude() == pytest.approx(top, rel=1e-12)
    assert a.least_real() == pytest.approx(bottom, rel=1e-12)
    other = b.terms.real.sum(axis=1) + all_of(b)
    for name, combine in BINARY.items():
        found = combine(a, b)
        assert all_of(found) == pytest.approx(combine(top, other) - linear(found, one)[0].real, rel=1e-12), name
    for operation, (make, exactly) in UNARY.items():
        found = make(a)
        if operation == "inverse":
            # The largest is at the lower ends; what the rest makes is counted at its first and at its second order.
            least = 1.0 / bottom - linear(found, -one)[0].real
            assert np.all(all_of(found) >= least)
            assert np.all(all_of(found) <= 1.2 * least)
        else:
            largest = np.abs(exactly(top[None, :].astype(np.complex128)) - linear(found, one))[0]
            assert all_of(found) == pytest.approx(largest, rel=1e-12), operation


def test_without_a_rest_an_inverse_and_a_small_turn_leave_no_more_than_their_second_order() -> None:
    exact = Taylor(terms=positive().terms, rest=np.zeros((COUNT, WAYS)))
    share = exact.terms[:, 1:].real.sum(axis=1) / exact.terms[:, 0].real
    assert all_of(exact.inverse()) == pytest.approx(share**2 / (1.0 - share) / exact.terms[:, 0].real, rel=1e-9)
    angle = Taylor(terms=positive(spread=1e-3).terms, rest=np.zeros((COUNT, WAYS)))
    wide = angle.terms[:, 1:].real.sum(axis=1)
    assert all_of(turned(angle)) == pytest.approx(0.5 * wide**2, rel=1e-6)
    shaken = Taylor(terms=angle.terms, rest=np.full((COUNT, WAYS), 1e-5))
    assert all_of(turned(shaken)) == pytest.approx(3e-5 + 0.5 * (wide + 3e-5) ** 2, rel=1e-6)


def test_each_direction_has_the_rest_that_it_makes() -> None:
    """Of a product of two directions each has a half; what is squared, or multiplied by another's rest, has its own."""
    along = np.eye(1 + WAYS)[:, None, :].astype(np.complex128)
    none = np.zeros((1, WAYS))
    first, second = (Taylor(terms=2.0 * along[0] + along[i], rest=none) for i in (1, 2))
    assert (first * second).rest[0] == pytest.approx([0.5, 0.5, 0.0], abs=1e-12)
    assert (first * first).rest[0] == pytest.approx([1.0, 0.0, 0.0], abs=1e-12)
    unsure = Taylor(terms=3.0 * along[0], rest=np.array([[0.0, 0.0, 0.1]]))
    assert (first * unsure).rest[0] == pytest.approx([0.0, 0.0, 0.3], abs=1e-12)
    assert (unsure * first).rest[0] == pytest.approx([0.0, 0.0, 0.3], abs=1e-12)
    halved = second.inverse().rest[0]
    assert halved[1] > 1e28
    assert halved[[0, 2]] == pytest.approx([0.0, 0.0], abs=1e-12)


@pytest.mark.parametrize(("share", "is_bounded"), [(0.49, True), (0.51, False), (1.0, False)])
def test_where_a_half_may_be_lost_an_inverse_is_unbounded(share: float, is_bounded: bool) -> None:
    terms = np.array([[2.0, share, -0.6 * share, 0.0]], dtype=np.complex128)
    found = Taylor(terms=terms, rest=np.full((1, WAYS), 0.4 * share / WAYS)).inverse()
    (left,) = all_of(found).tolist()
    assert left < 10.0 if is_bounded else left > 1e28
    with np.errstate(over="ignore", invalid="ignore"):
        nothing = Taylor(terms=np.zeros((1, 4), dtype=np.complex128), rest=np.ones((1, WAYS))).inverse()
    assert np.sum(nothing.rest) > 1e28
