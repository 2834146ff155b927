"""Prove that controllers may take over from each other after a dwell time, over all plants of their certified sets.

Of a cell of plants, P = WᵀW makes every loop A of the cell a contraction, ‖W A W⁻¹‖ ≤ 1, and ‖W' A^N W⁻¹‖ < 1 for the
W' of every cell of another controller. Then |W z| falls while a controller runs, and whoever takes over after N samples
or more begins with a smaller |W' z|: any sequence of controllers and plants that waits that long decays (Geromel and
Colaneri, SIAM J. Control Optim. 45(5), 2006). A over a cell is linear in its coordinates with a bounded rest, from the
plant's exponentials in balls; powers of it are Taylor models of first order whose rest is bounded in the 2-norm.
"""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from scipy.linalg import solve_discrete_lyapunov

from problems.arrays import FloatArray
from problems.design.uncertainty import ENVIRONMENT_MASS, MASS, STIFFNESS
from problems.errors import ParameterError
from problems.model.controller import AdmittanceController
from problems.model.sampled import build_sampled_plant
from problems.stability.dwell import common_loop, least_commands, translation_projection, without_translation

from .balls import Balls, Jet, as_series, ball, enclose, exact, inverse_of, jet_exponential, number, precise
from .family import Family
from .plant_cells import half_widths
from .plant_polynomials import continuous_plant, parameter_values

METHOD = "quadratic functions of cells of plants, contracting until the dwell time, in ball arithmetic"

# What the law's numbers in double precision may be off by, as a share of the largest of a row, and a norm.
_ROUNDING, _OUTWARDS = 1e-12, 1.0 + 1e-10
# More of a rest than this in the power of a cell, and the cell is cut before it is compared.
_MOST_REST = 0.05
# The weight of the quadratic functions is the mean of them, so often.
_ALIKE = 2
# So many comparisons of two cells take as long as a cell.
_PAIRS_OF_A_CELL = 200.0
_NARROWEST = 1e-9


@dataclass(frozen=True, kw_only=True, eq=False)
class DwellLoop:
    """A law on the plants of a family, K_e × M_p at most, in contact or in free space."""

    family: Family
    law: AdmittanceController


@dataclass(frozen=True, kw_only=True)
class DwellOutcome:
    """The share of the plants, of the controller of which least is proved, and the cells that were made."""

    share: float
    cells: int


@dataclass(frozen=True, kw_only=True, eq=False)
class _Model:
    """Matrices X_0 + Σ δ_k X_k + E with |δ_k| ≤ 1 and ‖E‖ ≤ `rest`; `terms` (1 + d, n, n) hold X."""

    terms: FloatArray
    rest: float

    @cached_property
    def moved(self) -> float:
        """A bound of ‖Σ δ_k X_k‖."""
        return float(np.sum(_norms(self.terms[1:])))

    @cached_property
    def size(self) -> float:
        """A bound of ‖X_0 + Σ δ_k X_k‖."""
        return float(np.max(_norms(self.corners())))

    def corners(self) -> FloatArray:
        """Return X_0 + Σ δ_k X_k at the corners (2^d, n, n), between which the norm is convex."""
        signs = np.array(list(itertools.product((-1.0, 1.0), repeat=len(self.terms) - 1)))
        return np.asarray(self.terms[0] + np.tensordot(signs, self.terms[1:], axes=1))

    def __matmul__(self, other: "_Model") -> "_Model":
        first = self.terms[:1] @ other.terms
        first[1:] += self.terms[1:] @ other.terms[0]
        rest = self.moved * other.moved + self.rest * (other.size + other.rest) + self.size * other.rest
        return _Model(terms=first, rest=rest * _OUTWARDS + _ROUNDING * (1.0 + self.size * other.size))

    def power(self, count: int) -> "_Model":
        """Return the model of the matrices' power, from 1 on, by squares."""
        found: _Model | None = None
        square = self
        for digit in reversed(f"{count:b}"):
            if digit == "1":
                found = square if found is None else found @ square
            square = square @ square
        return self if found is None else found


@dataclass(frozen=True, kw_only=True, eq=False)
class _Cell:
    """A cell (d, 2) of a loop, with its share, its W and W⁻¹, and the power A^N in the coordinates of W.

    `passed` are the numbers of the cells in whose measure it is smaller after N samples.
    """

    loop: DwellLoop
    cell: FloatArray
    share: float
    forward: Balls
    back: FloatArray
    power: _Model
    contracts: bool
    number: int = field(default_factory=itertools.count().__next__)
    passed: set[int] = field(default_factory=set)

    @property
    def is_comparable(self) -> bool:
        return self.contracts and self.power.rest < _MOST_REST

    def halves(self) -> list[tuple[FloatArray, float]] | None:
        """Return the cell cut along the coordinate that moves the power most; None where that is too narrow."""
        if not len(self.cell):
            return None
        moves = _norms(self.power.terms[1:])
        side = int(np.argmax(moves))
        low, high = self.cell[side]
        if high - low <= _NARROWEST * high:
            return None
        upper, lower = self.cell.copy(), self.cell.copy()
        upper[side, 0] = lower[side, 1] = 0.5 * (low + high)
        return [(lower, 0.5 * self.share), (upper, 0.5 * self.share)]


def prove_dwell(controllers: Sequence[Sequence[DwellLoop]], samples: int, *, most_cells: int) -> DwellOutcome:
    """Prove that changes between controllers which each run for `samples` at least are safe, or for which share.

    Parameters
    ----------
    controllers
        The loops of each controller, all in free space or all in contact.
    samples
        N, at least 1.
    most_cells
        Bound of the effort.

    Raises
    ------
    ParameterError
        For loops that have no common coordinates, and plants with a filter of the wrench, a bumper or a moving surface.
    """
    for loop in itertools.chain(*controllers):
        _check_covered(loop.family)
    every: list[list[_Cell]] = []
    weight, made = common_weight(controllers), 0
    for loops in controllers:
        cells: list[_Cell] = []
        for loop in loops:
            boxes = [(loop.family.box(), 1.0)]
            found, count = _comparable(loop, boxes, samples, weight, most_cells - made)
            cells, made = cells + found, made + count
        every.append(cells)
    spent = 0.0
    while True:
        passing = []
        for of in every:
            passes, compared = _passing(of, [cell for other in every if other is not of for cell in other])
            passing.append(passes)
            spent += compared / _PAIRS_OF_A_CELL
        before = made
        if made + spent < most_cells:
            for place, of in enumerate(every):
                every[place], count = _cut(of, passing[place], samples, weight, most_cells - made)
                made += count
        if made == before:
            return DwellOutcome(share=_least_share(controllers, every, passing), cells=made)


def _cut(
    cells: Sequence[_Cell], passing: Sequence[bool], samples: int, weight: FloatArray, most: int
) -> tuple[list[_Cell], int]:
    """Return the cells with those that do not pass cut in two, as far as that goes, and how many were made."""
    kept, made = [], 0
    for cell, passes in zip(cells, passing, strict=True):
        halves = None if passes or made >= most else cell.halves()
        if halves is None:
            kept.append(cell)
            continue
        found, count = _comparable(cell.loop, halves, samples, weight, most - made)
        kept, made = kept + found, made + count
    return kept, made


def _check_covered(family: Family) -> None:
    family.nominal.require_one_piece()
    lag = family.nominal.wrench_filter.time_constant_s
    if lag > 0.0 or family.shared_delay is not None:
        raise ParameterError("wrench_filter", lag, "none, for changes to be proved")
    if family.shared_mass is not None:
        raise ParameterError(ENVIRONMENT_MASS, family.shared_mass[1], "0, for changes to be proved")


def _least_share(
    controllers: Sequence[Sequence[DwellLoop]], every: Sequence[Sequence[_Cell]], passing: Sequence[Sequence[bool]]
) -> float:
    """Return the least share that passes of any loop."""
    shares = [
        sum(cell.share for cell, passes in zip(cells, ok, strict=True) if passes and cell.loop is loop)
        for of, cells, ok in zip(controllers, every, passing, strict=True)
        for loop in of
    ]
    return min(1.0, *shares)


def _comparable(
    loop: DwellLoop, boxes: list[tuple[FloatArray, float]], samples: int, weight: FloatArray, most: int
) -> tuple[list[_Cell], int]:
    """Return cells that contract, cut until they do or `most` were made; what does not is left out."""
    found, waiting, made = [], list(boxes), 0
    while waiting and made < most:
        box, share = waiting.pop()
        cell = _made(loop, box, share, samples, weight)
        made += 1
        halves = None if cell is None or cell.is_comparable else cell.halves()
        if cell is not None and cell.is_comparable:
            found.append(cell)
        elif halves is not None:
            waiting += halves
    return found, made


def _passing(cells: Sequence[_Cell], others: Sequence[_Cell]) -> tuple[list[bool], int]:
    """Return which cells are smaller after N samples in the measure of every other one, and how many were compared."""
    compared = 0
    for cell in cells:
        new = [other for other in others if other.number not in cell.passed]
        if not new:
            continue
        compared += len(new)
        forward = Balls(mid=np.array([c.forward.mid for c in new]), rad=np.array([c.forward.rad for c in new]))
        change = forward @ exact(cell.back)
        after = _norms((change.mid[:, None] @ cell.power.corners()).reshape(-1, *cell.back.shape))
        largest = np.max(after.reshape(len(new), -1), axis=1)
        unknown = np.linalg.norm(change.rad, axis=(1, 2)) * (cell.power.size + cell.power.rest)
        passes = largest + _norms(change.mid) * cell.power.rest + unknown < 1.0 - _ROUNDING
        cell.passed.update(other.number for other, ok in zip(new, passes.tolist(), strict=True) if ok)
    return [all(other.number in cell.passed for other in others) for cell in cells], compared


def common_weight(controllers: Sequence[Sequence[DwellLoop]]) -> FloatArray:
    """Return a weight (n, n) with which the quadratic functions of all loops are alike: the mean of them, twice over.

    With the weight 1 that of one loop is up to 10^6 times that of another one, in directions that decay at once.
    """
    middles = [_middle(loop) for loop in itertools.chain(*controllers)]
    stable = [each for each in middles if float(np.max(np.abs(np.linalg.eigvals(each)))) < 1.0]
    weight = np.eye(len(middles[0]))
    for _ in range(_ALIKE if stable else 0):
        mean = np.mean([_quadratic(each, weight) for each in stable], axis=0)
        weight = mean * (len(mean) / np.trace(mean))
    return weight


def _middle(loop: DwellLoop) -> FloatArray:
    sampled = build_sampled_plant(loop.family.plant(np.mean(loop.family.box(), axis=1)), loop.family.sample_time_s)
    found = common_loop(sampled, loop.law)
    return without_translation(found, sampled) if loop.family.is_free_space else found


def _quadratic(loop: FloatArray, weight: FloatArray) -> FloatArray:
    """Return P of A' P A − P = −weight, for a loop that is stable."""
    found = solve_discrete_lyapunov(loop.T, weight)
    return np.asarray(0.5 * (found + found.T))


def _made(loop: DwellLoop, cell: FloatArray, share: float, samples: int, weight: FloatArray) -> _Cell | None:
    """Return a cell with the quadratic function of its middle; None where the middle is unstable."""
    first, second = _loops(loop, cell)
    middle = first.mid[0]
    radius = float(np.max(np.abs(np.linalg.eigvals(middle))))
    if not radius < 1.0:
        return None
    back = np.ascontiguousarray(np.linalg.inv(np.linalg.cholesky(_quadratic(middle, weight)).T))
    inverse = inverse_of(back)
    forward = enclose(inverse.ravel().tolist()).shaped(*back.shape)
    moved, bent = (forward @ each @ exact(back) for each in (first, second))
    unknown = np.sum(np.linalg.norm(moved.rad, axis=(1, 2))) + np.sum(np.linalg.norm(bent.rad, axis=(1, 2)))
    step = _Model(terms=moved.mid, rest=(float(np.sum(_norms(bent.mid))) + float(unknown)) * _OUTWARDS)
    return _Cell(
        loop=loop,
        cell=cell,
        share=share,
        forward=forward,
        back=back,
        power=step.power(samples),
        contracts=step.size + step.rest <= 1.0,
    )


def _loops(loop: DwellLoop, cell: FloatArray) -> tuple[Balls, Balls]:
    """Return the loops over a cell (d, 2), in the coordinates of `common_loop`: A_0 + Σ δ_k A_k + Σ δ_k δ_l A_kl.

    First the A_0 and A_k of its middle, (1 + d, n, n), then the A_kl, k ≤ l, that hold all over it. The plant's
    exponentials are in balls; of the rows of the law, which no plant changes, only the rounding is unknown.
    """
    family, middle = loop.family, np.mean(cell, axis=1)
    sampled = build_sampled_plant(family.plant(middle), family.sample_time_s)
    whole = common_loop(sampled, loop.law)
    n, size = sampled.state_count, len(whole)
    first, second = _steps(family, cell)
    # What acts at the start and at the end of the sample, by z; the newest command is the law's own row.
    reads = np.zeros((n + 2, size))
    reads[:n, :n] = np.eye(n)
    unknown = _ROUNDING * np.max(np.abs(whole), axis=1, keepdims=True) * np.ones((1, size))
    of_reads = np.zeros_like(reads)
    for row, place in ((n, sampled.whole_delay), (n + 1, sampled.whole_delay + 1)):
        if place == 0:
            reads[row], of_reads[row] = whole[n], unknown[n]
        elif place <= least_commands(sampled):
            reads[row] = np.eye(size)[n + place - 1]
    found = []
    for held in (first, second):
        moved = held @ Balls(mid=reads, rad=of_reads)
        terms, radii = (np.zeros((len(held.mid), size, size)) for _ in range(2))
        terms[:, :n], radii[:, :n] = moved.mid, moved.rad
        if held is first:
            terms[0, n:], radii[0, n:] = whole[n:], unknown[n:]
        found.append(Balls(mid=terms, rad=radii))
    if family.is_free_space:
        project, kept = translation_projection(sampled, size)
        found = [exact(project) @ each @ exact(kept.T) for each in found]
    return found[0], found[1]


@precise
def _steps(family: Family, cell: FloatArray) -> tuple[Balls, Balls]:
    """Return what `_loops` says of φ and the columns of the newer and the older command, (…, n, n + 2) each.

    The states are (robot, x_p, h v_p). Along a direction the plant is a jet, from its middle and all over the cell.
    """
    middle, half = np.mean(cell, axis=1), half_widths(cell)
    parts, position = _affine(family), _position(family)
    point, directions = np.stack([middle, middle], axis=1), np.diag(half)
    n = len(position)
    first = [_held(family, parts, point, np.zeros(len(half)))[0]]
    first += [_held(family, parts, point, each)[1] for each in directions]
    second = [_held(family, parts, cell, each)[2] for each in directions]
    for i, j in itertools.combinations(range(len(half)), 2):
        both = _held(family, parts, cell, directions[i] + directions[j])[2]
        second.append(both + second[i].times(-1.0) + second[j].times(-1.0))
    # e = x_p − x there: x_p of what follows, and e of what was.
    after, before = np.eye(n), np.eye(n + 2)
    order = family.nominal.robot.order
    after[order, :order], before[order, :order] = position[:order], -position[:order]
    nothing = exact(np.zeros((0, n, n + 2)))
    return tuple(  # type: ignore[return-value]
        exact(after) @ (_stacked(each) if each else nothing) @ exact(before) for each in (first, second)
    )


def _stacked(balls: Sequence[Balls]) -> Balls:
    return Balls(mid=np.stack([each.mid for each in balls]), rad=np.stack([each.rad for each in balls]))


def _position(family: Family) -> FloatArray:
    """Return the row of the flange's position, which no stiffness and mass changes."""
    _, position, _, _ = continuous_plant(family, parameter_values(family, family.box(), [None] * len(family.box())))
    return np.array([float(as_series(each).value.mid()) for each in position])


def _affine(family: Family) -> tuple[Any, Any, Any]:
    """Return the augmented plant's parts: without a force on the payload, per 1/M_p, and per K_e/M_p."""
    values = parameter_values(family, family.box(), [None] * len(family.box()))

    def augmented(inverse: int, stiffness: int) -> Any:
        changed = {**values, MASS: as_series(inverse), STIFFNESS: as_series(stiffness)}
        return continuous_plant(family, changed)[0]

    steady, by_mass = augmented(0, 0), augmented(1, 0)
    return steady, by_mass - steady, augmented(1, 1) - by_mass


def _held(family: Family, parts: tuple[Any, Any, Any], cell: FloatArray, direction: FloatArray) -> list[Balls]:
    """Return the coefficients of 1, t and t² of φ and both columns (n, n + 2), along a direction (d,) over a cell."""
    places = {name: k for k, name in enumerate(family.varying)}

    def jet(name: str, nominal: float) -> Jet:
        if name not in places:
            return Jet(number(nominal))
        low, high = cell[places[name]]
        return Jet(ball(float(low), float(high)), number(float(direction[places[name]])))

    stiffness = jet(STIFFNESS, family.range_of(STIFFNESS)[0])
    inverse = jet(MASS, 1.0)
    if MASS not in places:
        inverse = Jet(1 / number(family.range_of(MASS)[0]))
    ratio = inverse * stiffness
    steady, per_mass, per_ratio = parts
    size = len(steady)
    augmented = np.empty((size, size), dtype=object)
    for i, j in itertools.product(range(size), repeat=2):
        augmented[i, j] = Jet.of(steady[i, j]) + inverse * per_mass[i, j] + ratio * per_ratio[i, j]
    n, full, (whole, has_fraction) = size - 1, jet_exponential(augmented), family.delay()
    newer, older = full[:n, n], np.array([Jet(0)] * n, dtype=object)
    if has_fraction:
        late = (whole + 1) - number(family.nominal.robot.delay_s) / number(family.sample_time_s)
        newer = jet_exponential(augmented * Jet(late))[:n, n]
        older = full[:n, n] - newer
    found = np.empty((n, n + 2), dtype=object)
    found[:, :n], found[:, n], found[:, n + 1] = full[:n, :n], newer, older
    return [enclose([each.c[power] for each in found.ravel()]).shaped(n, n + 2) for power in range(3)]


def _norms(matrices: FloatArray) -> FloatArray:
    """Return upper bounds of the 2-norms of matrices (m, n, n)."""
    if not len(matrices):
        return np.zeros(0)
    return np.asarray(np.linalg.norm(matrices, ord=2, axis=(1, 2)) * _OUTWARDS + 1e-300)
