"""Complex quantities over arcs of frequencies and a cell of plants, as linear functions with a bounded rest.

With t_0 the place on the arc and t_i the coordinates in the cell, all from −1 to 1, a quantity is
a_0 + Σ a_i t_i + e, |e| ≤ Σ rest_i (Taylor models of first order; Makino and Berz, International Journal of Pure and
Applied Mathematics 4(4), 2003). Each direction has its share of the rest, which says what to cut. Rounding is bounded
per operation and added.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from problems.arrays import FloatArray

from .balls import turn
from .bounds import Linear

# Of an operation on complex doubles, with its sums: eight roundings at most.
_ROUNDING = 16.0 * float(np.finfo(np.float64).eps)
# What is not bounded at all; its tenth power is still a number.
_UNBOUNDED = 1e30


@dataclass(frozen=True, kw_only=True)
class Taylor:
    """`terms` (m, 1 + n) hold a_0 and the derivatives, `rest` (m, n) the bound of what is left by direction."""

    terms: NDArray[np.complex128]
    rest: FloatArray

    def size(self) -> FloatArray:
        """Return a bound (m,) of the linear part."""
        return np.asarray(np.sum(np.abs(self.terms), axis=1))

    def magnitude(self) -> FloatArray:
        """Return a bound (m,) of |value|."""
        return np.asarray((self.size() + np.sum(self.rest, axis=1)) * (1.0 + _ROUNDING))

    def least_real(self) -> FloatArray:
        """Return a lower bound (m,) of the real part."""
        spread = np.sum(np.abs(self.terms[:, 1:].real), axis=1) + np.sum(self.rest, axis=1)
        return np.asarray(self.terms[:, 0].real - spread * (1.0 + _ROUNDING) - _ROUNDING * self.size())

    def __add__(self, other: "Taylor") -> "Taylor":
        terms = self.terms + other.terms
        rest = self.rest + other.rest
        return Taylor(terms=terms, rest=_with_rounding(rest, np.sum(np.abs(terms), axis=1)))

    def __mul__(self, other: "Taylor") -> "Taylor":
        a, b = self.terms, other.terms
        terms = a[:, :1] * b
        terms[:, 1:] += a[:, 1:] * b[:, :1]
        left, right = np.abs(a[:, 1:]), np.abs(b[:, 1:])
        left_sum, right_sum = np.sum(left, axis=1, keepdims=True), np.sum(right, axis=1, keepdims=True)
        right_rest = np.sum(other.rest, axis=1, keepdims=True)
        left_all, right_all = np.abs(a[:, :1]) + left_sum, np.abs(b[:, :1]) + right_sum
        rest = 0.5 * (left * right_sum + right * left_sum)
        rest = rest + self.rest * (right_all + right_rest) + other.rest * left_all
        return Taylor(terms=terms, rest=_with_rounding(rest, left_all[:, 0] * right_all[:, 0]))

    def times(self, factor: complex | NDArray[Any]) -> "Taylor":
        """Return it times a number, or (m, 1) of them."""
        terms = self.terms * factor
        return Taylor(terms=terms, rest=_with_rounding(self.rest * np.abs(factor), np.sum(np.abs(terms), axis=1)))

    def plus(self, number: float) -> "Taylor":
        """Return it plus a number."""
        terms = self.terms.copy()
        terms[:, 0] += number
        return Taylor(terms=terms, rest=_with_rounding(self.rest, np.abs(terms[:, 0]) + abs(number)))

    def conjugate(self) -> "Taylor":
        """Return its complex conjugate."""
        return Taylor(terms=np.conj(self.terms), rest=self.rest)

    def inverse(self) -> "Taylor":
        """Return 1/value; unbounded where a half of a_0 may be lost."""
        first = self.terms[:, :1]
        size = np.maximum(np.abs(first), 1e-300)
        derivatives = np.abs(self.terms[:, 1:]) + self.rest
        share = np.sum(derivatives, axis=1, keepdims=True) / size
        is_bounded = (share < 0.5) & (np.abs(first) > 1e-290)
        inverse = 1.0 / np.where(np.abs(first) > 1e-300, first, 1e-300)
        terms = np.concatenate([inverse, np.where(is_bounded, -self.terms[:, 1:] * inverse**2, 0.0)], axis=1)
        over = self.rest / size + derivatives / size * share / (1.0 - np.where(is_bounded, share, 0.0))
        rest = np.where(is_bounded, over * np.abs(inverse), _UNBOUNDED * derivatives / np.maximum(share * size, 1e-300))
        return Taylor(terms=terms, rest=_with_rounding(rest, 4.0 * np.abs(inverse[:, 0])))


def _with_rounding(rest: FloatArray, size: FloatArray) -> FloatArray:
    """Return the rest with the rounding of what is so large, which counts as the frequency's."""
    out = rest * (1.0 + _ROUNDING)
    out[:, 0] += _ROUNDING * size
    return out


def taylor_of(linear: Linear) -> Taylor:
    """Return what `bounds.linear` adds up."""
    return Taylor(terms=linear.terms, rest=_with_rounding(linear.shares(), linear.size()))


def turned(angle: Taylor) -> Taylor:
    """Return e^{jx} of a real x: its terms are real."""
    middle = angle.terms[:, 0].real
    points, _ = turn(middle, np.zeros_like(middle))
    derivatives = np.abs(angle.terms[:, 1:])
    wide = np.sum(derivatives + angle.rest, axis=1, keepdims=True)
    terms = np.concatenate([points.mid[:, None], 1j * angle.terms[:, 1:] * points.mid[:, None]], axis=1)
    rest = angle.rest + 0.5 * (derivatives + angle.rest) * wide
    rest[:, 0] += points.rad
    return Taylor(terms=terms, rest=_with_rounding(rest, 1.0 + wide[:, 0]))
