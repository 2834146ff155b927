"""What of the loop's equation depends on frequency only, over arcs of the unit circle, worked out once for all plants.

The closed loop χ = z^c α d − β_F n_F − β_x n_x is linear in the coefficients of d, n_F and n_x: each has a factor that
is a function of z alone. Of it an arc holds value and slope at its middle, and half the curvature all over the arc.

A law that follows the position has β_x = α + β', and its terms α (z^c d − n_x) − β_F n_F − β' n_x. In free space
x = x^d at rest, n_x = d − w y: with z^c − 1 = w (1 + z + … + z^(c−1)) the factor w of the integrator is taken out of
α (z^c d − n_x) as α ((1 + z + … + z^(c−1)) d + y).
"""

import math
from dataclasses import dataclass

import numpy as np

from problems.arrays import FloatArray, IntArray

from .balls import Balls, enclose, exact, turn
from .law import LawPolynomials

Jet = tuple[Balls, Balls, Balls]

# Frequencies [rad/sample] spread over decades: the first arcs halve towards 0, where loops have their poles.
_OCTAVES = 14
_TURN = float(np.nextafter(math.pi, 4.0))


@dataclass(frozen=True, kw_only=True)
class Arcs:
    """Factors on m arcs: per group of coefficients balls (m, k) of value, slope and half curvature by angle.

    The groups are d, n_F, n_x of a law that follows the position (y in free space), and n_x of what else it reads.
    `opened` has for each break point the groups' signs in the loop that is cut there, the command's first.
    """

    half: FloatArray
    groups: tuple[Jet, ...]
    opened: tuple[tuple[float, ...], ...]


class Circle:
    """The arcs of the upper half circle that were asked for so far; each is cut in two at most once.

    `sizes` is how many coefficients each group has. `is_deflated` takes a factor w out of everything: free space has
    its integrator there. With a `pull` the last group is the force at rest, n_F(z = 1), whose factor is β_F.
    """

    def __init__(
        self, law: LawPolynomials, chain: int, sizes: tuple[int, ...], *, is_deflated: bool, pull: bool = False
    ) -> None:
        drop = 1 if is_deflated else 0
        self._chain, self._sizes = chain, sizes
        self._sums_chain = is_deflated and law.follows
        alpha = enclose(law.denominator)
        self._polynomials = [alpha if self._sums_chain else alpha[drop:], enclose(law.force)]
        if law.follows:
            self._polynomials.append(alpha.times(-1.0) if is_deflated else alpha)
        followed: tuple[float, ...] = (-1.0,) if law.follows else ()
        self._opened: tuple[tuple[float, ...], ...] = ((1.0, 0.0, *followed),)
        if law.position:
            self._polynomials.append(enclose(law.position)[drop:])
            self._opened = (1.0, 0.0, *followed, 0.0), (1.0, 0.0, *followed, -1.0)
        if pull:
            self._polynomials.append(enclose(law.force))
        self._angles = np.zeros((0, 2))
        self._children = np.zeros(0, dtype=np.int64)
        self._table: list[list[Balls]] = []
        ends = np.concatenate([[0.0], _TURN * 2.0 ** -np.arange(_OCTAVES, -1.0, -1.0)])
        self._add(np.stack([ends[:-1], ends[1:]], axis=1))
        self.count_of_first = _OCTAVES + 1

    def angles(self, arcs: IntArray) -> FloatArray:
        """Return the ends (m, 2) of arcs, rad/sample."""
        return np.asarray(self._angles[arcs])

    def halves(self, arcs: IntArray) -> IntArray:
        """Return the two halves of every arc, (2 m,)."""
        missing = np.unique(arcs[self._children[arcs] < 0])
        if missing.size:
            low, high = self._angles[missing].T
            middle = 0.5 * (low + high)
            self._children[missing] = len(self._angles) + 2 * np.arange(len(missing))
            self._add(np.stack([low, middle, middle, high], axis=1).reshape(-1, 2))
        first = self._children[arcs]
        return np.stack([first, first + 1], axis=1).ravel()

    def at(self, arcs: IntArray) -> Arcs:
        """Return the factors on arcs."""
        low, high = self._angles[arcs].T
        # Half an arc, rounded up: together the arcs leave nothing out.
        half = 0.5 * (high - low) * (1.0 + 1e-12) + 1e-15
        groups = tuple((jet[0][arcs], jet[1][arcs], jet[2][arcs]) for jet in self._table)
        return Arcs(half=half, groups=groups, opened=self._opened)

    def on(self, ends: FloatArray) -> Arcs:
        """Return the factors on arcs with these ends (m, 2), which are not kept."""
        half = 0.5 * (ends[:, 1] - ends[:, 0]) * (1.0 + 1e-12) + 1e-15
        thin, wide = (
            self._factors(np.mean(ends, axis=1), np.zeros_like(half)),
            self._factors(np.mean(ends, axis=1), half),
        )
        groups = tuple((a[0], a[1], b[2]) for a, b in zip(thin, wide, strict=True))
        return Arcs(half=half, groups=groups, opened=self._opened)

    def _add(self, ends: FloatArray) -> None:
        new = [list(jet) for jet in self.on(ends).groups]
        old = self._table or [[each[:0] for each in jet] for jet in new]
        self._table = [[_stack(a, b) for a, b in zip(*pair, strict=True)] for pair in zip(old, new, strict=True)]
        self._angles = np.vstack([self._angles, ends])
        self._children = np.concatenate([self._children, np.full(len(ends), -1)])

    def _factors(self, middle: FloatArray, half: FloatArray) -> list[Jet]:
        z, w = turn(middle, half)
        slope, curve = z * exact(np.full(len(middle), 1j)), z.times(-0.5)
        z_jet, w_jet = (z, slope, curve), (w, slope, curve)
        factors = [_polynomial(each, w_jet) for each in self._polynomials]
        if self._sums_chain:
            factors[0] = _product(factors[0], _polynomial(exact(np.ones(self._chain)), z_jet))
        else:
            for _ in range(self._chain):
                factors[0] = _product(factors[0], z_jet)
        return [_powers(each, w_jet, size) for each, size in zip(factors, self._sizes, strict=True)]


def _product(a: Jet, b: Jet) -> Jet:
    return a[0] * b[0], a[0] * b[1] + a[1] * b[0], a[0] * b[2] + a[1] * b[1] + a[2] * b[0]


def _polynomial(coefficients: Balls, w: Jet) -> Jet:
    """Return a polynomial with coefficients (k,) on the jets of w (m,), by Horner's rule."""
    nothing = exact(np.zeros_like(w[0].mid))
    out: Jet = (nothing, nothing, nothing)
    for i in range(len(coefficients.mid) - 1, -1, -1):
        value, slope, curve = _product(out, w)
        out = (value + coefficients[i], slope, curve)
    return out


def _powers(first: Jet, w: Jet, count: int) -> Jet:
    """Return first·w^k for k below `count` as balls (m, count)."""
    found = [first]
    while len(found) < count:
        found.append(_product(found[-1], w))
    return tuple(_columns([jet[order] for jet in found]) for order in range(3))  # type: ignore[return-value]


def _columns(balls: list[Balls]) -> Balls:
    return Balls(mid=np.stack([b.mid for b in balls], axis=1), rad=np.stack([b.rad for b in balls], axis=1))


def _stack(old: Balls, more: Balls) -> Balls:
    return Balls(mid=np.vstack([old.mid, more.mid]), rad=np.vstack([old.rad, more.rad]))
