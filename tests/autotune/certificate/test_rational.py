"""Transfer functions in exact fractions: what they are at any w is what the matrices are there."""

from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from autotune.certificate.rational import add, numerator, resolvent, times, times_z

POLYNOMIALS = st.lists(st.integers(-9, 9), min_size=1, max_size=5)
W = Fraction(2, 7)


def at(polynomial: list[Fraction], w: Fraction = W) -> Fraction:
    return sum((value * w**i for i, value in enumerate(polynomial)), Fraction(0))


@pytest.mark.parametrize("size", [1, 2, 3, 5])
def test_the_adjugate_times_the_matrix_is_its_determinant(size: int) -> None:
    rng = np.random.default_rng(size)

    def drawn(*shape: int) -> np.ndarray:
        return np.asarray(
            np.vectorize(lambda each: Fraction(int(each), 5), otypes=[object])(rng.integers(-9, 10, shape))
        )

    change, row, column = drawn(size, size), drawn(size), drawn(size)
    characteristic, adjugate = resolvent(change)
    assert (len(characteristic), len(adjugate)) == (size + 1, size)
    assert characteristic[-1] == 1
    identity = np.array([[Fraction(int(i == j)) for j in range(size)] for i in range(size)], dtype=object)
    matrix = W * identity - change
    adjoint = sum((each * W**i for i, each in enumerate(adjugate)), 0 * identity)
    assert np.all(adjoint @ matrix == at(characteristic) * identity)
    assert at(numerator(row, adjugate, column)) == row @ adjoint @ column
    # Its zeros are the eigenvalues.
    found = np.sort_complex(np.roots([float(each) for each in characteristic[::-1]]))
    known = np.sort_complex(np.linalg.eigvals(change.astype(float)))
    assert found == pytest.approx(known, abs=1e-6)


@given(left=POLYNOMIALS, right=POLYNOMIALS)
@settings(max_examples=50, deadline=None)
def test_sums_and_products_of_polynomials_are_those_of_their_values(left: list[int], right: list[int]) -> None:
    one, other = ([Fraction(each) for each in side] for side in (left, right))
    assert at(add(one, other)) == at(one) + at(other)
    assert at(times(one, other)) == at(one) * at(other)
    assert at(times_z(one)) == (1 + W) * at(one)
    assert len(add(one, other)) == max(len(one), len(other))
    assert len(times(one, other)) == len(one) + len(other) - 1
    # Of what cannot be multiplied, a product is given.
    assert at(times(one, other, lambda a, b: 2 * a * b)) == 2 * at(one) * at(other)
