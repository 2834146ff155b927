"""Zero exclusion on one cell of plants and many arcs at once: |χ| > m |R| for the return differences χ/R."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from problems.arrays import FloatArray

from .balls import Balls
from .circle import Arcs

# The last steps are some hundred operations on doubles; this share of their size is far more than they can lose.
_ROUNDING = 1e-11


@dataclass(frozen=True, kw_only=True)
class PlantCell:
    """Groups of coefficients, as in `Arcs`, over a cell of plants: value + Σ δ_i slope_i ± rest for |δ_i| ≤ 1.

    Per group `linear` (k, 1 + d) holds value and derivatives, its first column's radius the rest.
    """

    groups: tuple[Balls, ...]

    def whole(self) -> tuple[Balls, ...]:
        """Return one ball per coefficient that holds it over the cell, (k, 1) each."""
        return tuple(
            Balls(mid=g.mid[:, :1], rad=g.rad[:, :1] + np.sum(np.abs(g.mid[:, 1:]) + g.rad[:, 1:], axis=1)[:, None])
            for g in self.groups
        )


@dataclass(frozen=True, kw_only=True)
class Verdicts:
    """Per arc: whether it `holds`, whether it fails at its middle, and what each direction adds to the bound.

    `blame` (m, 1 + d) is in the order frequency, then coordinates.
    """

    holds: NDArray[np.bool_]
    middle: FloatArray
    blame: FloatArray


@dataclass(frozen=True, kw_only=True)
class Linear:
    """A quantity over a cell and an arc: `terms` (m, 2 + d) of value, frequency and coordinates, and what is left."""

    terms: NDArray[np.complex128]
    curve: FloatArray
    cross: FloatArray
    rest: FloatArray

    def error(self) -> FloatArray:
        """Return a bound (m,) of what is not linear."""
        return np.asarray(self.curve + np.sum(self.cross, axis=1) + self.rest)

    def size(self) -> FloatArray:
        """Return a bound (m,) of the linear part."""
        return np.asarray(np.sum(np.abs(self.terms), axis=1))

    def spread(self) -> FloatArray:
        """Return how far from its middle it may be."""
        return np.asarray(np.sum(np.abs(self.terms[:, 1:]), axis=1) + self.error())

    def shares(self) -> FloatArray:
        """Return what each direction, frequency first, adds to the error (m, 1 + d)."""
        count = max(self.cross.shape[1], 1)
        own = 0.5 * self.cross + (self.rest / count)[:, None]
        return np.concatenate([(self.curve + 0.5 * np.sum(self.cross, axis=1))[:, None], own], axis=1)


def judge(arcs: Arcs, cell: PlantCell, modulus: float) -> Verdicts:
    """Judge |χ| > m |R| on every arc for all plants of the cell, R of the command and R of the force."""
    parts = []
    for jet, linear, whole in zip(arcs.groups, cell.groups, cell.whole(), strict=True):
        parts.append((jet[0] @ linear, jet[1] @ linear, jet[2] @ whole))
    closed = linear_part(parts, (1.0,) + (-1.0,) * (len(parts) - 1), arcs.half)
    # Of stability alone the loops that are cut say nothing.
    cuts = arcs.opened if modulus > 0.0 else arcs.opened[:1]
    found = [_compare(closed, linear_part(parts, signs, arcs.half), modulus) for signs in cuts]
    worse = np.argmin([slack for slack, _, _ in found], axis=0)
    pick = np.arange(len(worse))
    return Verdicts(
        holds=np.min([slack for slack, _, _ in found], axis=0) > 0.0,
        middle=np.min([middle for _, middle, _ in found], axis=0),
        blame=np.array([blame for _, _, blame in found])[worse, pick],
    )


def judge_at_rest(arcs: Arcs, cell: PlantCell, modulus: float) -> Verdicts:
    """Judge the same on arcs from 0 for plants of every stiffness K from above 0 to that of the cell.

    There χ and R vanish together at z = 1, K = 0. With the factor w taken out, and 1/w = −½ (1 + j cot ½θ) on the
    circle, χ/w = U + jκV with U = B + tV, V = ½ K₂ β_F n_F'(K), t = K/K₂ and κ = t cot ½θ ≥ 0; B is the rest of the
    loop. As κ is all from 0 to ∞, |χ/w| is bounded by what of U lies along V. The cell's last group is ½ K₂ n_F'(K).
    """
    parts = []
    for jet, linear, whole in zip(arcs.groups, cell.groups, cell.whole(), strict=True):
        parts.append((jet[0] @ linear, jet[1] @ linear, jet[2] @ whole))
    rest, pull = parts[:-1], linear_part(parts[-1:], (1.0,), arcs.half)
    closed = linear_part(rest, (1.0,) + (-1.0,) * (len(rest) - 1), arcs.half)
    cuts = arcs.opened if modulus > 0.0 else arcs.opened[:1]
    cut_loops = [linear_part(rest, signs, arcs.half) for signs in cuts]
    towards = np.abs(pull.terms[:, 0])
    along = np.abs(np.real(np.conj(closed.terms[:, 0]) * pull.terms[:, 0])) / towards
    turned = pull.spread() / towards
    opened = np.max([np.abs(each.terms[:, 0]) + each.spread() for each in cut_loops], axis=0)
    size = closed.size() + pull.size() + np.max([each.size() for each in cut_loops], axis=0)
    lost = closed.spread() + towards + pull.spread() + 2.0 * turned * np.abs(closed.terms[:, 0]) + _ROUNDING * size
    slack = np.where(turned < 0.5, along - lost, -1.0) - modulus * opened
    blame = sum(np.abs(each.terms[:, 1:]) + each.shares() for each in (closed, *cut_loops))
    blame = blame + (np.abs(closed.terms[:, 0]) / towards)[:, None] * (np.abs(pull.terms[:, 1:]) + pull.shares())
    middle = along - modulus * np.max([np.abs(each.terms[:, 0]) for each in cut_loops], axis=0)
    return Verdicts(holds=slack > 0.0, middle=middle, blame=np.asarray(blame))


def linear_part(parts: list[tuple[Balls, Balls, Balls]], signs: tuple[float, ...], half: FloatArray) -> Linear:
    """Add up the groups with their signs; what is not linear in frequency and coordinates goes into the errors."""
    value, slope, curve = (
        _sum([part[order] for part, sign in zip(parts, signs, strict=False) if sign], signs) for order in range(3)
    )
    terms = np.concatenate([value.mid[:, :1], half[:, None] * slope.mid[:, :1], value.mid[:, 1:]], axis=1)
    return Linear(
        terms=terms,
        curve=half**2 * curve.magnitude()[:, 0],
        cross=half[:, None] * slope[:, 1:].magnitude(),
        rest=np.sum(value.rad, axis=1) + half * slope.rad[:, 0],
    )


def _sum(balls: list[Balls], signs: tuple[float, ...]) -> Balls:
    used = [sign for sign in signs if sign]
    out = balls[0]
    for ball, sign in zip(balls[1:], used[1:], strict=False):
        out = out + ball.times(sign)
    return out


def _compare(closed: Linear, opened: Linear, modulus: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return a lower bound of |χ|² − m²|R|² less all errors, its value at the middle, and the blame.

    With t in the unit cube it is q + 2 g·t + tᵀHt; each coordinate alone is minimised exactly.
    """
    square = modulus**2
    gram = np.real(np.einsum("mi,mj->mij", np.conj(closed.terms), closed.terms))
    gram = gram - square * np.real(np.einsum("mi,mj->mij", np.conj(opened.terms), opened.terms))
    middle, g, h = gram[:, 0, 0], np.abs(gram[:, 0, 1:]), np.diagonal(gram, axis1=1, axis2=2)[:, 1:]
    bowl = np.where(h > 0.0, h, 1.0)
    own = np.where(h > g, -(g**2) / bowl, h - 2.0 * g)
    mixed = np.sum(np.abs(gram[:, 1:, 1:]), axis=2) - np.abs(h)
    error, size = closed.error() + modulus * opened.error(), opened.size()
    lost = (2.0 * modulus * size + error) * error + _ROUNDING * (closed.size() + modulus * size) ** 2
    slack = middle + np.sum(own, axis=1) - np.sum(mixed, axis=1) - lost
    weight = 2.0 * modulus * size + error
    blame = 2.0 * g + np.abs(h) + mixed
    blame += weight[:, None] * (closed.shares() + modulus * opened.shares())
    return slack, middle, blame
