import operator
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from problems.design.complex_pairs import Pair, determinant, pair, solve_resolvent
from tests.problems.axes import LAW

NUMBERS = st.complex_numbers(max_magnitude=1e3, allow_nan=False, allow_infinity=False)
OPERATIONS = [operator.add, operator.sub, operator.mul, operator.truediv]


def of(value: complex) -> Pair:
    return Pair(re=value.real, im=value.imag)


def back(value: Pair) -> complex:
    return complex(value.re, value.im)


@pytest.mark.parametrize("operation", OPERATIONS)
@LAW
@given(NUMBERS, NUMBERS, st.floats(-1e3, 1e3))
def test_arithmetic_is_that_of_complex_numbers(
    operation: Callable[[Any, Any], Any], one: complex, other: complex, real: float
) -> None:
    assume(min(abs(one), abs(other), abs(real)) > 1e-3)
    size = abs(operation(abs(one), -abs(other))) + abs(operation(abs(one), abs(other)))
    # Rounding of a few operations on numbers of this size.
    assert abs(back(operation(of(one), of(other))) - operation(one, other)) < 1e-14 * size
    assert back(operation(of(one), real)) == pytest.approx(operation(one, real), rel=1e-12, abs=1e-12)
    assert back(operation(real, of(one))) == pytest.approx(operation(real, one), rel=1e-12, abs=1e-12)


@LAW
@given(NUMBERS)
def test_conjugate_and_square(value: complex) -> None:
    assert back(of(value).conjugate) == value.conjugate()
    assert of(value).squared == pytest.approx(abs(value) ** 2)
    assert back(-of(value)) == -value
    assert pair(of(value)) == of(value)


@LAW
@given(st.integers(1, 5), st.floats(0.0, 3.0), st.integers(0, 1000))
def test_a_resolvent_is_numpys(size: int, angle: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    matrix, right, z = rng.normal(size=(size, size)), rng.normal(size=size), 3.0 * np.exp(1j * angle)
    expected = np.linalg.solve(z * np.eye(size) - matrix, right)
    found = np.array([back(value) for value in solve_resolvent(matrix, of(z), list(right))])
    # Cramer's rule on a few rows of numbers of size one, off the spectrum as a rule.
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-9 * np.max(np.abs(expected)))


def test_an_expansion_meets_no_vanishing_pivot() -> None:
    assert determinant([[0.0, 2.0], [3.0, 0.0]]) == -6.0
    assert determinant([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]]) == -1.0
