"""Arrays of balls in double precision, and of any precision by python-flint, which nothing else imports.

A ball is a midpoint and a radius; every operation returns a ball that holds all results for all members. Rounding is
bounded per operation (Rump's midpoint-radius arithmetic) and added to the radius.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import wraps
from typing import Any, ParamSpec, TypeVar

import flint
import numpy as np
from numpy.typing import NDArray

from problems.arrays import FloatArray

P = ParamSpec("P")
R = TypeVar("R")

BITS = 128
_UNIT = float(np.finfo(np.float64).eps)
# Radii are sums and products of a few hundred positive numbers at most: this much more than covers their rounding.
_OUTWARDS = 1.0 + 1e-12
_LEAST = 1e-290  # what may get lost below the smallest normal number


@dataclass(frozen=True, kw_only=True)
class Balls:
    """Balls of any shape: |value − `mid`| ≤ `rad`, real or complex."""

    mid: NDArray[Any]
    rad: NDArray[Any]

    def __add__(self, other: "Balls") -> "Balls":
        mid = self.mid + other.mid
        return Balls(mid=mid, rad=_out(self.rad + other.rad + _UNIT * np.abs(mid)))

    def __mul__(self, other: "Balls") -> "Balls":
        left, right = np.abs(self.mid), np.abs(other.mid)
        rad = left * other.rad + self.rad * (right + other.rad) + 4.0 * _UNIT * left * right
        return Balls(mid=self.mid * other.mid, rad=_out(rad))

    def __matmul__(self, other: "Balls") -> "Balls":
        left, right = np.abs(self.mid), np.abs(other.mid)
        terms = self.mid.shape[-1] + 4.0
        rad = left @ other.rad + self.rad @ (right + other.rad) + terms * _UNIT * (left @ right)
        return Balls(mid=self.mid @ other.mid, rad=_out(rad))

    def times(self, factor: float | FloatArray) -> "Balls":
        """Return the balls times exact real numbers."""
        mid = self.mid * factor
        return Balls(mid=mid, rad=_out(self.rad * np.abs(factor) + 2.0 * _UNIT * np.abs(mid)))

    def magnitude(self) -> FloatArray:
        """Return an upper bound of |value|."""
        return _out(np.abs(self.mid) + self.rad)

    def shaped(self, *shape: int) -> "Balls":
        """Return the same balls in another shape."""
        return Balls(mid=self.mid.reshape(shape), rad=self.rad.reshape(shape))

    def __getitem__(self, index: Any) -> "Balls":
        return Balls(mid=self.mid[index], rad=self.rad[index])


def _out(rad: FloatArray) -> FloatArray:
    return np.asarray(rad * _OUTWARDS + _LEAST)


def exact(values: NDArray[Any]) -> Balls:
    """Return numbers as balls without radius."""
    return Balls(mid=values, rad=np.zeros(values.shape))


def enclose(values: Sequence[Any]) -> Balls:
    """Return real flint balls (k,) as balls in double precision that hold them."""
    mid = np.array([float(v.mid()) for v in values])
    rad = np.array([float(v.rad()) for v in values])
    return Balls(mid=mid, rad=_out(rad + 2.0 * _UNIT * np.abs(mid)))


def enclose_complex(values: Sequence[Any]) -> Balls:
    """Return complex flint balls (k,), which are rectangles, as discs that hold them."""
    real, imaginary = enclose([v.real for v in values]), enclose([v.imag for v in values])
    return Balls(mid=real.mid + 1j * imaginary.mid, rad=_out(np.hypot(real.rad, imaginary.rad)))


def precise(function: Callable[P, R]) -> Callable[P, R]:
    """Run a function with flint at `BITS` of precision, or at the caller's if that is more."""

    @wraps(function)
    def run(*args: P.args, **kwargs: P.kwargs) -> R:
        with flint.ctx.workprec(max(BITS, flint.ctx.prec)):
            return function(*args, **kwargs)

    return run


def ball(low: float, high: float) -> Any:
    """Return the flint ball that holds [low, high]."""
    return flint.arb(low).union(flint.arb(high))


class DualBall:
    """A flint ball that carries its derivative through arithmetic; None is none.

    Along one direction that is a ball, along several at once a flint row of them (`units`).
    """

    __slots__ = ("derivative", "value")

    def __init__(self, value: Any, derivative: Any = None) -> None:
        self.value, self.derivative = value, derivative

    def __add__(self, other: Any) -> "DualBall":
        if not isinstance(other, DualBall):
            return DualBall(self.value + other, self.derivative)
        if self.derivative is None or other.derivative is None:
            return DualBall(self.value + other.value, other.derivative if self.derivative is None else self.derivative)
        return DualBall(self.value + other.value, self.derivative + other.derivative)

    def __mul__(self, other: Any) -> "DualBall":
        if not isinstance(other, DualBall):
            return DualBall(self.value * other, None if self.derivative is None else self.derivative * other)
        derivative = None if self.derivative is None else self.derivative * other.value
        if other.derivative is not None:
            more = other.derivative * self.value
            derivative = more if derivative is None else derivative + more
        return DualBall(self.value * other.value, derivative)

    def __truediv__(self, other: Any) -> "DualBall":
        if not isinstance(other, DualBall):
            return DualBall(self.value / other, None if self.derivative is None else self.derivative / other)
        ratio = self.value / other.value
        derivative = None if self.derivative is None else self.derivative / other.value
        if other.derivative is not None:
            less = other.derivative * ratio / other.value
            derivative = -less if derivative is None else derivative - less
        return DualBall(ratio, derivative)

    def __neg__(self) -> "DualBall":
        return DualBall(-self.value, None if self.derivative is None else -self.derivative)

    def __sub__(self, other: Any) -> "DualBall":
        out: DualBall = self + (-other)
        return out

    def __rsub__(self, other: Any) -> "DualBall":
        out: DualBall = -self + other
        return out

    def __rtruediv__(self, other: Any) -> "DualBall":
        out: DualBall = as_series(other) / self
        return out

    def __pow__(self, power: int) -> "DualBall":
        if power == 0:
            return DualBall(flint.arb(1))
        derivative = None if self.derivative is None else self.derivative * (power * self.value ** (power - 1))
        return DualBall(self.value**power, derivative)

    __radd__, __rmul__ = __add__, __mul__


class Jet:
    """A flint ball f(t) = c_0 + c_1 t + c_2 t² along one direction, whose higher powers of t are left out."""

    __slots__ = ("c",)

    def __init__(self, c_0: Any, c_1: Any = 0, c_2: Any = 0) -> None:
        self.c = flint.arb(c_0), flint.arb(c_1), flint.arb(c_2)

    @classmethod
    def of(cls, value: Any) -> "Jet":
        """Return a number, or a series without derivative, as a jet."""
        return value if isinstance(value, Jet) else cls(as_series(value).value)

    def __add__(self, other: Any) -> "Jet":
        return Jet(*(a + b for a, b in zip(self.c, Jet.of(other).c, strict=True)))

    def __mul__(self, other: Any) -> "Jet":
        if not isinstance(other, Jet):
            factor = as_series(other).value
            return Jet(*(each * factor for each in self.c))
        (a_0, a_1, a_2), (b_0, b_1, b_2) = self.c, other.c
        return Jet(a_0 * b_0, a_0 * b_1 + a_1 * b_0, a_0 * b_2 + a_1 * b_1 + a_2 * b_0)

    def __neg__(self) -> "Jet":
        return Jet(*(-each for each in self.c))

    def __sub__(self, other: Any) -> "Jet":
        return self + (-Jet.of(other))

    def __rsub__(self, other: Any) -> "Jet":
        return Jet.of(other) - self

    __radd__, __rmul__ = __add__, __mul__


def as_series(value: Any) -> DualBall:
    """Return a number as a series without derivative, and a series as it is."""
    return value if isinstance(value, DualBall) else DualBall(flint.arb(value))


def number(value: Any) -> Any:
    """Return a number as a flint ball."""
    return flint.arb(value)


def polynomial(ascending: Sequence[Any]) -> Any:
    """Return a real flint polynomial."""
    return flint.arb_poly(list(ascending))


def at(ascending: Sequence[Any], place: Any) -> Any:
    """Return the value of a real polynomial at a complex flint ball."""
    return flint.acb_poly(list(ascending))(place)


def on_circle(angle: float) -> Any:
    """Return e^{jφ} as a complex flint ball."""
    return flint.acb(0, flint.arb(angle)).exp()


def with_bits(bits: int) -> Any:
    """Return the context in which flint works with so many bits."""
    return flint.ctx.workprec(bits)


def derivative_of(value: Any) -> Any:
    """Return the derivative of a number or series, 0 where it carries none."""
    return value.derivative if isinstance(value, DualBall) and value.derivative is not None else flint.arb(0)


def units(count: int) -> list[Any]:
    """Return the derivatives of so many coordinates along each of them, rows (1, count)."""
    return [flint.arb_mat(1, count, [int(i == j) for j in range(count)]) for i in range(count)]


def derivatives_of(values: Sequence[Any], count: int) -> list[list[Any]]:
    """Return the derivatives of numbers and series along each of so many directions, 0 where they carry none."""
    rows = [each.derivative if isinstance(each, DualBall) else None for each in values]
    return [[flint.arb(0) if row is None else row[0, along] for row in rows] for along in range(count)]


def exponential(matrix: Any) -> Any:
    """Return exp of an object array (n, n) of series: exp [[A, E], [0, A]] holds value and derivative along E."""
    n, entries = len(matrix), [as_series(each) for row in matrix for each in row]
    numbers, given = [each.value for each in entries], [e.derivative for e in entries if e.derivative is not None]
    if not given:
        found = flint.arb_mat(n, n, numbers).exp()
        return np.array([DualBall(each) for each in found.entries()], dtype=object).reshape(n, n)
    if not isinstance(given[0], flint.arb_mat):
        value, slope = _moved_exponential(numbers, [derivative_of(each) for each in entries])
        return np.array([DualBall(*each) for each in zip(value, slope, strict=True)], dtype=object).reshape(n, n)
    slopes = []
    for along in derivatives_of(entries, given[0].ncols()):
        value, slope = _moved_exponential(numbers, along)
        slopes.append(slope)
    rows = (flint.arb_mat(1, len(slopes), list(each)) for each in zip(*slopes, strict=True))
    return np.array([DualBall(*each) for each in zip(value, rows, strict=True)], dtype=object).reshape(n, n)


def _moved_exponential(numbers: list[Any], along: list[Any]) -> tuple[list[Any], list[Any]]:
    """Return exp of a matrix and its derivative, both row by row, for a matrix and its derivative row by row."""
    n = math.isqrt(len(numbers))
    nothing = [flint.arb(0)] * n
    upper = [each for i in range(0, n * n, n) for each in (*numbers[i : i + n], *along[i : i + n])]
    lower = [each for i in range(0, n * n, n) for each in (*nothing, *numbers[i : i + n])]
    rows = flint.arb_mat(2 * n, 2 * n, upper + lower).exp().tolist()[:n]
    return [each for row in rows for each in row[:n]], [each for row in rows for each in row[n:]]


def jet_exponential(matrix: Any) -> Any:
    """Return exp of an object array (n, n) of jets: exp of a block Toeplitz matrix holds all coefficients."""
    n = len(matrix)
    block = flint.arb_mat(3 * n, 3 * n)
    for i, row in enumerate(matrix):
        for j, entry in enumerate(row):
            for power, each in enumerate(Jet.of(entry).c):
                for k in range(3 - power):
                    block[k * n + i, (k + power) * n + j] = each
    found = block.exp()
    out = np.empty((n, n), dtype=object)
    for i in range(n):
        for j in range(n):
            out[i, j] = Jet(*(found[i, power * n + j] for power in range(3)))
    return out


def turn(angles: FloatArray, half: FloatArray) -> tuple[Balls, Balls]:
    """Return z = e^{jφ} and w = z − 1 (m,) for all φ within `half` of `angles`; w keeps its digits near z = 1."""
    found = [flint.acb(0, flint.arb(a, r)).exp() for a, r in zip(angles.tolist(), half.tolist(), strict=True)]
    return enclose_complex(found), enclose_complex([z - 1 for z in found])


def solved(matrix: Any, right: Any) -> Any:
    """Return x (n,) of A x = b as series: the derivative is that of A x = b, A x' = b' − A' x.

    Both sides are multiplied by the inverse of the middle of A, without which balls of some per cent grow.
    """
    n = len(right)
    entries = [as_series(each) for row in matrix for each in row]
    near = flint.arb_mat(n, n, [each.value.mid() for each in entries]).inv()
    numbers = near * flint.arb_mat(n, n, [each.value for each in entries])
    found = numbers.solve(near * flint.arb_mat(n, 1, [as_series(each).value for each in right]))
    derivatives = near * flint.arb_mat(n, n, [derivative_of(each) for each in entries])
    rest = near * flint.arb_mat(n, 1, [derivative_of(as_series(each)) for each in right]) - derivatives * found
    change = numbers.solve(rest)
    return np.array([DualBall(found[i, 0], change[i, 0]) for i in range(n)], dtype=object)


def inverse_of(matrix: FloatArray) -> Any:
    """Return the inverse of an exact real matrix (n, n) as an object array of flint balls."""
    n = len(matrix)
    found = flint.arb_mat(n, n, [flint.arb(float(each)) for each in matrix.ravel()]).inv()
    return np.array([[found[i, j] for j in range(n)] for i in range(n)], dtype=object)


def similar(matrix: Any, basis: NDArray[Any]) -> tuple[Balls, Balls]:
    """Return W A V and W, the inverse of the exact complex matrix V (n, n), for an object array A of numbers.

    Raises ZeroDivisionError for a V that has no inverse at this precision.
    """
    n = len(basis)
    entries = [as_series(each).value for row in matrix for each in row]
    exact_basis = flint.acb_mat(n, n, [flint.acb(complex(each)) for each in basis.ravel()])
    inverse = exact_basis.inv()
    product = inverse * flint.acb_mat(n, n, [flint.acb(each) for each in entries]) * exact_basis
    found = [enclose_complex([each[i, j] for i in range(n) for j in range(n)]) for each in (product, inverse)]
    return found[0].shaped(n, n), found[1].shaped(n, n)
