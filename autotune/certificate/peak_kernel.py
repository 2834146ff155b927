"""The walk of a cell of contacts from tick to tick, see `certificate.peaks`, whose coordinates these are."""

from typing import NamedTuple

import numpy as np

from problems.arrays import ComplexArray, FloatArray
from problems.compiled import compiled

# More than rounding in double precision can reach in a sum of some dozen products.
_ROUNDING = 1e-13
_OUT = 1.0 + 1e-9


class CellLoop(NamedTuple):
    """A loop over a cell, in m coordinates: changes, start at the first tick in contact, and rows of F_e.

    `change` (m, m) and `derivatives` (d, m, m) with their `spread` (m, m); `place` p (m,), `shifts` q (c, m) with c ≥ d
    and their `unknown` e (m,). `row` (m,), `row_derivatives` (d, m) and `row_spread` are F_e − F^d; `curved` and its
    spread its second derivative by the sample, `bent` a bound of what that changes within a sample by |z|. `weights`
    are a bound of |z| that no step raises. `desired` is F^d, `touching` a bound of F_e in the sample of the touch.
    """

    change: ComplexArray
    derivatives: ComplexArray
    spread: FloatArray
    place: ComplexArray
    shifts: ComplexArray
    unknown: FloatArray
    row: ComplexArray
    row_derivatives: ComplexArray
    row_spread: FloatArray
    curved: ComplexArray
    curved_spread: FloatArray
    bent: FloatArray
    weights: FloatArray
    desired: float
    touching: float


class CellState(NamedTuple):
    """p (m,), q (c, m), e (m,) and a bound of |z| (m,)."""

    place: ComplexArray
    shifts: ComplexArray
    unknown: FloatArray
    size: FloatArray


class Tick(NamedTuple):
    """F_e at a tick: its middle, what each coordinate adds (c,), what else it may be off, and its curvature then."""

    middle: float
    shares: FloatArray
    rest: float
    curvature: float


class ForceBounds(NamedTuple):
    """Bounds of F_e from the touch on: the largest, what each coordinate (c,) and the rest adds there, and the lowest.

    The lowest is that from the second tick in contact on, since at the first it may just begin. `middle` and
    `middle_low` are those of the cell's middle alone. Only where all later ticks are bounded too, `is_bounded`.
    """

    largest: float
    lowest: float
    shares: FloatArray
    rest: float
    middle: float
    middle_low: float
    is_bounded: bool


@compiled
def force_at(cell: CellLoop, state: CellState) -> Tick:
    """Return F_e at a tick."""
    p, q, e, size = state
    c, d = len(q), len(cell.derivatives)
    beside = size - np.abs(p)
    middle = cell.desired + np.sum(cell.row * p).real
    rest = np.sum(np.abs(cell.row) * e + cell.row_spread * size) + _ROUNDING * abs(middle)
    curvature = abs(np.sum(cell.curved * p).real) + np.sum(
        np.abs(cell.curved) * e + (cell.curved_spread + cell.bent) * size
    )
    shares = np.zeros(c)
    for j in range(c):
        value = np.sum(cell.row * q[j]).real
        if j < d:
            value += np.sum(cell.row_derivatives[j] * p).real
            rest += np.sum(np.abs(cell.row_derivatives[j]) * beside)
        shares[j] = abs(value)
        curvature += abs(np.sum(cell.curved * q[j]).real)
    return Tick(middle, shares, rest, curvature)


@compiled
def stepped(cell: CellLoop, state: CellState) -> CellState:
    """Return the state a sample later."""
    p, q, e, size = state
    beside = size - np.abs(p)
    after, shifts = cell.change @ p, np.zeros_like(q)
    error = np.abs(cell.change) @ (e + _ROUNDING * size) + cell.spread @ size
    for j in range(len(q)):
        shifts[j] = cell.change @ q[j]
        if j < len(cell.derivatives):
            shifts[j] += cell.derivatives[j] @ p
            error += np.abs(cell.derivatives[j]) @ (beside + _ROUNDING * size)
    error *= _OUT
    return CellState(after, shifts, error, size_of(after, shifts, error))


@compiled
def size_of(place: ComplexArray, shifts: ComplexArray, unknown: FloatArray) -> FloatArray:
    """Return a bound of |z| (m,)."""
    size = np.abs(place) + unknown
    for j in range(len(shifts)):
        size += np.abs(shifts[j])
    return size * _OUT


@compiled
def later_change(cell: CellLoop, size: FloatArray) -> float:
    """Return a bound of |F_e − F^d| from a tick on for ever."""
    slope = np.abs(cell.row) + cell.row_spread + 0.125 * (np.abs(cell.curved) + cell.curved_spread + cell.bent)
    for j in range(len(cell.row_derivatives)):
        slope += np.abs(cell.row_derivatives[j])
    return float(np.max(size / cell.weights) * np.sum(slope * cell.weights) * _OUT)


@compiled
def least_largest(cell: CellLoop, ticks: int) -> float:
    """Return a bound from below of the largest F_e at the first ticks, all over the cell."""
    state = CellState(cell.place, cell.shifts, cell.unknown, size_of(cell.place, cell.shifts, cell.unknown))
    least = -np.inf
    for _ in range(ticks):
        tick = force_at(cell, state)
        least = max(least, tick.middle - np.sum(tick.shares) - tick.rest)
        state = stepped(cell, state)
    return least


@compiled
def walk(cell: CellLoop, limit: float, longest: int, stride: int) -> ForceBounds:
    """Follow a cell until all that is to come is bounded below the limit, or a tick is not below it."""
    state = CellState(cell.place, cell.shifts, cell.unknown, size_of(cell.place, cell.shifts, cell.unknown))
    largest, lowest, middle, middle_low, before = cell.touching, np.inf, -np.inf, np.inf, 0.0
    shares, left = np.zeros(len(cell.shifts)), 0.0
    # A bound that is not a number is none.
    for k in range(longest if cell.touching <= limit else 0):
        tick = force_at(cell, state)
        rest = tick.rest + 0.125 * max(tick.curvature, before)
        before = tick.curvature
        off, middle = np.sum(tick.shares) + rest, max(middle, tick.middle)
        if k > 0:
            lowest, middle_low = min(lowest, tick.middle - off), min(middle_low, tick.middle)
        if not tick.middle + off <= largest:
            largest = tick.middle + off
            shares, left = tick.shares, rest
        if not largest <= limit:
            break
        if k % stride == 1:
            beyond = later_change(cell, state.size)
            # Whether the payload stays on the wall is known once the force is known to stay above 0.
            if cell.desired + beyond <= limit and (beyond < cell.desired or lowest <= 0.0):
                return ForceBounds(largest, lowest, shares, left, middle, middle_low, True)
        state = stepped(cell, state)
    return ForceBounds(largest, lowest, shares, left, middle, middle_low, False)
