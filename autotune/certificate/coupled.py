"""Prove stability and min σ(I + L) of axes on one payload over K_e and its mass, by one quadratic function per cell.

Bounded real lemma: where P > 0 has diag(P, γ² I) − Σᵀ diag(P, I) Σ > 0 for the matrix Σ = (A, B; C, D) of the closed
loop from what is added to the forces to what the laws read, A is stable and σ(D + C (zI − A)⁻¹ B) < γ on the whole unit
circle (de Souza and Xie, Systems & Control Letters 18, 1992): σ_min(I + L) > 1/γ at every frequency at once. The
left side is concave in Σ, so that it holds for a cell of plants if it does at the corners of a box around their Σ,
whose sides are what K_e and the mass change to first and to second order.
"""

import itertools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import solve_discrete_are

from problems.arrays import FloatArray
from problems.stability.coupled_margins import largest_gain

from .balls import Balls, exact
from .coupled_system import AffineLoop, CoupledFamily, coupled_system

METHOD = "bounded real lemma with one quadratic function per cell of plants, in ball arithmetic"

# A cell of a loop of twenty states takes as long as so many arcs of the proof of one axis; it goes with the square.
_CELL_WORK, _USUAL_STATES = 1200, 20
_RANK, _LEAST_RANK = 3, 1e-9
_NARROWEST = 1e-6
# Powers of ten between which the scales of the parameters' influence are searched, and how often steps are halved.
_SCALES, _REFINED = (-18.0, 3.0), 5
_ROUNDING = 1e-12
# Shares of the slowest decay in a sample that are left as slack, the most first.
_SLACKS = (0.3, 0.1, 0.03)


@dataclass(frozen=True, kw_only=True)
class CoupledOutcome:
    """The share of a family that is proved, in how many cells and how much work; `refuted` names K_e and factor."""

    share: float
    cells: int
    work: int
    refuted: tuple[float, float] | None = None


def prove_coupled(
    family: CoupledFamily, modulus: float, *, work: int, progress: Callable[[float], None] | None = None
) -> CoupledOutcome:
    """Prove that every loop of a family is stable with σ_min(I + L) > `modulus` where it is cut, or how far that goes.

    Raises ParameterError for a command that acts at once through a coupling with damping, and at the commands for one
    without a sample of delay.
    """
    gamma = float(np.nextafter(1.0 / modulus, 0.0))
    start: FloatArray | None = None
    waiting, spent, cells, share = [(family.box(), 1.0)], 0, 0, 0.0
    while waiting and spent < work:
        cell, part = waiting.pop()
        system = coupled_system(family, cell)
        spent += int(_CELL_WORK * (system.states / _USUAL_STATES) ** 2) + 1
        # The scales of one cell are nearly those of the next.
        scales = start
        if scales is None or not _is_proved(system, gamma, scales):
            if not _gain(system) < gamma:
                middle = np.mean(cell, axis=1)
                found = float(middle[0]), float(1.0 / middle[1])
                return CoupledOutcome(share=share, cells=cells, work=spent, refuted=found)
            scales = start = _best_scales(system, gamma, start)
            is_proved = _is_proved(system, gamma, scales)
        else:
            is_proved = True
        if is_proved:
            cells, share = cells + 1, share + part
            if progress is not None:
                progress(part)
            continue
        varying = np.flatnonzero(cell[:, 0] < cell[:, 1])
        side = int(varying[_widest(system, gamma, scales)]) if len(varying) else 0
        low, high = cell[side]
        if high - low <= _NARROWEST * high:
            waiting.append((cell, part))
            break
        halves = cell.copy(), cell.copy()
        halves[0][side], halves[1][side] = (0.5 * (low + high), high), (low, 0.5 * (low + high))
        waiting += [(each, 0.5 * part) for each in halves]
    return CoupledOutcome(share=1.0 if not waiting else share, cells=cells, work=spent)


def _gain(system: AffineLoop) -> float:
    """Return max σ(S) in the middle, infinite where that is unstable."""
    n = system.states
    a, b = system.middle[:n, :n], system.middle[:n, n:]
    if not np.max(np.abs(np.linalg.eigvals(a))) < 1.0:
        return np.inf
    return largest_gain(a, b, system.middle[n:, :n], system.middle[n:, n:])[0]


def _widest(system: AffineLoop, gamma: float, scales: FloatArray) -> int:
    """Return which of the coordinates that vary stands in the way: without its width the scaled gain is least."""
    count, parts = len(system.derivatives), _influences(system)

    def gain_without(place: int) -> float:
        others = [each for each in range(count) if each != place]
        try:
            return largest_gain(*_augmented(system, gamma, [parts[each] for each in others], scales[others]))[0]
        except np.linalg.LinAlgError:
            return np.inf

    return 0 if count < 2 else int(np.argmin([gain_without(place) for place in range(count)]))


def _is_proved(system: AffineLoop, gamma: float, scales: FloatArray) -> bool:
    """Return whether a quadratic function shows the gain of a whole cell to be below γ."""
    for p in _candidates(system, gamma, scales):
        if all(_holds(p, corner, system.rest, gamma) for corner in system.corners()):
            return True
    return False


def _candidates(system: AffineLoop, gamma: float, scales: FloatArray) -> Iterator[FloatArray]:
    """Yield P of the Riccati equation of the middle with the parameters' influence as further inputs and outputs.

    A parameter that moves Σ by δ U Vᵀ does not take the gain beyond γ if the loop with the inputs U √τ and outputs
    Vᵀ/√τ beside its own has a gain below 1: a P of that serves all |δ| ≤ 1. It is a guess; `_holds` decides.
    """
    parts = _influences(system)
    n = system.states
    decay = 1.0 - float(np.max(np.abs(np.linalg.eigvals(system.middle[:n, :n]))))
    for share in _SLACKS:
        # All of Σ longer by this much: what is left is slack in every direction.
        longer = 1.0 + share * decay
        augmented = tuple(longer * each for each in _augmented(system, gamma, parts, scales))
        found = _riccati(augmented) if np.max(np.abs(np.linalg.eigvals(augmented[0]))) < 1.0 else None
        if found is not None:
            yield found


def _influences(system: AffineLoop) -> list[tuple[FloatArray, FloatArray]]:
    """Return U and Vᵀ of what each parameter moves in Σ, of the rank that matters."""
    parts = []
    for derivative in system.derivatives:
        u, values, v = np.linalg.svd(derivative)
        rank = max(1, min(_RANK, int(np.sum(values > _LEAST_RANK * values[0]))))
        root = np.sqrt(values[:rank])
        parts.append((u[:, :rank] * root, (v[:rank].T * root).T))
    return parts


def _augmented(
    system: AffineLoop, gamma: float, parts: Sequence[tuple[FloatArray, FloatArray]], scales: FloatArray
) -> tuple[FloatArray, ...]:
    """Return A, B, C, D with the parameters' inputs and outputs, the loop's own inputs divided by γ."""
    n, m = system.states, system.middle
    inputs = [m[:, n:] / gamma, *(left * np.sqrt(scale) for (left, _), scale in zip(parts, scales, strict=True))]
    outputs = [right / np.sqrt(scale) for (_, right), scale in zip(parts, scales, strict=True)]
    wide, tall = np.hstack(inputs), np.vstack([m[n:], *outputs])
    own = m.shape[1] - n
    d = np.zeros((len(tall), wide.shape[1]))
    d[:own] = wide[n:]
    d[own:, :own] = tall[own:, n:] / gamma
    return m[:n, :n], wide[:n], tall[:, :n], d


def _best_scales(system: AffineLoop, gamma: float, start: FloatArray | None) -> FloatArray:
    """Return the scales τ (d,) with the least gain, one coordinate after the other, from a start where there is one."""
    parts = _influences(system)

    def gain(exponents: FloatArray, of: slice = slice(None)) -> float:
        try:
            return largest_gain(*_augmented(system, gamma, parts[of], 10.0**exponents))[0]
        except np.linalg.LinAlgError:
            return np.inf

    exponents = np.zeros(len(parts)) if start is None else np.log10(start)
    if start is None:
        grid = np.arange(*_SCALES)
        for place in range(len(parts)):
            # Each parameter alone: beside a bad scale of another one none is better than the next.
            tried = [gain(np.array([each]), slice(place, place + 1)) for each in grid]
            exponents[place] = grid[int(np.argmin(tried))]
    best, step = gain(exponents), 0.5 if start is None else 0.2
    for _ in range(_REFINED if start is None else 1):
        for place, sign in itertools.product(range(len(parts)), (-1.0, 1.0)):
            trial = exponents.copy()
            trial[place] += sign * step
            value = gain(trial)
            if value < best:
                best, exponents = value, trial
        step *= 0.5
    return np.asarray(10.0**exponents)


def _riccati(system: tuple[FloatArray, ...]) -> FloatArray | None:
    """Return P of the bounded real lemma at the gain 1, None where there is none."""
    a, b, c, d = system
    weight = c.T @ c
    try:
        found = solve_discrete_are(a, b, weight, d.T @ d - np.eye(d.shape[1]), s=c.T @ d)
    except (np.linalg.LinAlgError, ValueError):
        return None
    return np.asarray(0.5 * (found + found.T))


def _holds(p: FloatArray, corner: FloatArray, rest: FloatArray, gamma: float) -> bool:
    """Return whether P > 0 and diag(P, γ²) − Σᵀ diag(P, I) Σ > 0 for every Σ within `rest` of a corner.

    P = LᵀL, and V is nearly L⁻¹: both sides are taken between Vᵀ and V, which makes the first one nearly 1 and changes
    no sign. All of it is computed in balls.
    """
    n, wide, tall = len(p), corner.shape[1], len(corner)
    try:
        root = np.linalg.cholesky(p).T
    except np.linalg.LinAlgError:
        return False
    before, inner, outer = np.eye(wide), np.eye(tall), np.eye(wide)
    before[:n, :n], before[n:, n:] = np.linalg.inv(root), np.eye(wide - n) / gamma
    inner[:n, :n], outer[:n, :n] = root, root
    outer[n:, n:] *= gamma * (1.0 - 1e-15)
    around = Balls(mid=corner, rad=rest + 4.0 * np.finfo(np.float64).eps * np.abs(corner))
    moved, stood = exact(inner) @ (around @ exact(before)), exact(outer) @ exact(before)
    return _is_positive(_square(stood)) and _is_positive(_square(stood) + _square(moved).times(-1.0))


def _square(matrix: Balls) -> Balls:
    return Balls(mid=matrix.mid.T, rad=matrix.rad.T) @ matrix


def _is_positive(matrix: Balls) -> bool:
    """Return whether every symmetric matrix in the balls is positive definite."""
    symmetric = 0.5 * (matrix.mid + matrix.mid.T)
    lost = float(np.max(np.sum(matrix.rad + np.abs(matrix.mid - symmetric), axis=1)))
    size = float(np.max(np.sum(np.abs(symmetric), axis=1)))
    return bool(np.min(np.linalg.eigvalsh(symmetric)) > lost + _ROUNDING * len(symmetric) * size)
