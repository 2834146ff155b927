"""The closed loop of axes on one payload over a cell of K_e and mass: an affine matrix in balls (docs/method.md)."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Literal

import numpy as np
from scipy.linalg import matrix_balance

from problems.arrays import FloatArray
from problems.errors import ParameterError
from problems.model.controller import AdmittanceController, controller_blocks, needed_states
from problems.model.coupled import CoupledPlant, Law
from problems.model.difference import rest_states
from problems.model.plant import PLANT_PARAMETERS, Plant, write_plant
from problems.model.sampled import split_delay

from .balls import (
    Balls,
    DualBall,
    Jet,
    as_series,
    ball,
    derivative_of,
    enclose,
    exponential,
    inverse_of,
    jet_exponential,
    number,
    precise,
)
from .law import blocks_in_balls, controller_rows

Interval = tuple[float, float]
BreakPoint = Literal["force", "command"]
BREAK_POINTS: tuple[BreakPoint, ...] = ("force", "command")
Objects = Any  # arrays of flint numbers and series
_ROUNDING = 8.0 * float(np.finfo(np.float64).eps)


@dataclass(frozen=True, kw_only=True, eq=False)
class CoupledFamily:
    """Axes in free space, or on a surface in one direction with every K_e of a range, and a payload of every mass.

    `plant` has the nominal mass matrix, `mass_factors` multiply all of it. `scale` (k,) is 1 along an axis and the
    lever about one. Σ is from what is added `at` the forces, or the commands, to what goes on from there.
    """

    plant: CoupledPlant
    laws: tuple[Law, ...]
    scale: FloatArray
    sample_time_s: float
    stiffness_n_per_m: Interval
    mass_factors: Interval
    at: BreakPoint = "force"

    def box(self) -> FloatArray:
        """Return the ends of K_e and of 1/mass factor (2, 2), rounded outwards."""
        low, high = self.mass_factors
        inverse = (1.0, 1.0) if low == high == 1.0 else (np.nextafter(1.0 / high, 0.0), np.nextafter(1.0 / low, 9.0))
        return np.array([self.stiffness_n_per_m, inverse])


@dataclass(frozen=True, kw_only=True)
class AffineLoop:
    """Σ over a cell: `middle` + Σ δ_d `derivatives`_d + Σ ε_k `curves`_k ± `rest` entry by entry, |δ_d|, |ε_k| ≤ 1.

    The curves are what is of second order in δ, taken as if it was independent of it; n states come first. Rows are
    multiplied, and columns divided, by `balance`.
    """

    middle: FloatArray
    derivatives: tuple[FloatArray, ...]
    curves: tuple[FloatArray, ...]
    rest: FloatArray
    states: int
    balance: FloatArray

    def corners(self) -> list[FloatArray]:
        """Return Σ at the corners of the box."""
        found = [self.middle]
        for change in (*self.derivatives, *self.curves):
            found = [each + sign * change for each in found for sign in (-1.0, 1.0)]
        return found


@precise
def coupled_system(family: CoupledFamily, cell: FloatArray) -> AffineLoop:
    """Return Σ over a cell, without the motions that nothing holds, in balanced states.

    By Taylor's theorem Σ is Σ_0 with Σ_i δ_i and Σ_ij δ_i δ_j: the derivatives are those in the middle, and Σ_ij are
    halves of second derivatives, enclosed all over the cell. δ_i² lies between 0 and 1, δ_i δ_j within ±1.
    """
    middle = np.mean(cell, axis=1)
    frame, half = _frame(family), 0.5 * (cell[:, 1] - cell[:, 0]) * (1.0 + 1e-12) + 2.0 * np.spacing(middle)
    along = [np.eye(2)[i] * half for i in np.flatnonzero(cell[:, 0] < cell[:, 1]).tolist()]
    first = [_first_order(family, middle, each) for each in along or [np.zeros(2)]]
    value = frame.close(first[0][0])
    derivatives = [frame.close(each, with_constants=False) for _, each in first[: len(along)]]
    second = [
        frame.close(_second_order(family, cell, each), with_constants=False)
        for each in ([*along, along[0] + along[1]] if len(along) == 2 else along)
    ]
    shift, curves = np.zeros_like(value.mid), []
    for each in second[: len(along)]:
        shift = shift + 0.5 * each.mid
        curves.append(0.5 * each.mid)
    # What the sums of these are rounded by; what no parameter moves is added to nothing.
    moved = np.where(shift != 0.0, np.abs(value.mid), 0.0) + sum((np.abs(each.mid) for each in second), np.zeros(1))
    rest = value.rad + sum((each.rad for each in (*derivatives, *second)), np.zeros_like(value.rad))
    if len(along) == 2:
        # What is of second order along both is that along their sum without that of each alone.
        curves.append(second[2].mid - second[0].mid - second[1].mid)
        rest = rest + second[0].rad + second[1].rad
    n = frame.states
    _, (scale, _) = matrix_balance(value.mid[:n, :n], permute=False, separate=True)
    # Powers of two, which change no digit; and the states as large as the inputs make them.
    left = np.concatenate([1.0 / scale, np.ones(len(value.mid) - n)])
    scales = np.outer(left, 1.0 / left)
    return AffineLoop(
        middle=(value.mid + shift) * scales,
        derivatives=tuple(each.mid * scales for each in derivatives),
        curves=tuple(each * scales for each in curves),
        rest=(rest * (1.0 + 1e-12) + _ROUNDING * moved) * scales,
        states=n,
        balance=left,
    )


def _first_order(family: CoupledFamily, point: FloatArray, along: FloatArray) -> tuple[Balls, Balls]:
    """Return the plant's step at a point of K_e and 1/mass factor, and its derivative along a direction."""
    values = [DualBall(number(float(at)), number(float(d))) for at, d in zip(point, along, strict=True)]
    entries = _steps(family, values, exponential)
    derivatives = enclose([derivative_of(each) for each in entries.ravel()])
    return _balls(entries), derivatives.shaped(*entries.shape)


def _second_order(family: CoupledFamily, cell: FloatArray, along: FloatArray) -> Balls:
    """Return the halves of the second derivatives of the plant's step along a direction, all over a cell."""
    values = [Jet(ball(float(low), float(high)), float(d)) for (low, high), d in zip(cell, along, strict=True)]
    entries = _steps(family, values, jet_exponential)
    return enclose([Jet.of(each).c[2] for each in entries.ravel()]).shaped(*entries.shape)


def _steps(family: CoupledFamily, values: Sequence[Any], power: Callable[[Objects], Objects]) -> Objects:
    """Return the plant's step (n, n + 2 k): the states', then per axis that of the newer and of the older command."""
    a, b = _continuous(family, values)
    n, k = len(a), len(family.laws)
    whole = power(_held(a, b))
    out = _objects(n, n + 2 * k)
    out[:, :n] = whole[:n, :n]
    for i, plant in enumerate(family.plant.plants):
        samples, fraction = split_delay(plant.loop_delay_s, family.sample_time_s)
        newer = whole[:n, n + i]
        if fraction > 0.0:
            rest = (samples + 1) - number(plant.loop_delay_s) / number(family.sample_time_s)
            newer = power(_held(a, b[:, [i]]) * as_series(rest))[:n, n]
        out[:, n + 2 * i], out[:, n + 2 * i + 1] = newer, whole[:n, n + i] - newer
    return out


def _held(a: Objects, b: Objects) -> Objects:
    n, inputs = b.shape
    out = _objects(n + inputs, n + inputs)
    out[:n, :n], out[:n, n:] = a, b
    return out


def _parts(plant: Plant, sample_time_s: float) -> tuple[Objects, ...]:
    """Return A, B, rows of x and F and F's direct part of one axis with a payload of one kilogramme, in balls."""
    parameters = plant.parameters()
    numerator, denominator = plant.robot.ascending()
    n = plant.robot.order + 2 + len(parameters) - PLANT_PARAMETERS
    a, (b, push, position, force, contact) = _objects(n, n), (_objects(n) for _ in range(5))
    direct = _objects(3)
    given = np.array([as_series(float(each)) for each in parameters], dtype=object)
    given[2] = as_series(1)
    top, bottom = (np.array([as_series(float(e)) for e in each], dtype=object) for each in (numerator, denominator))
    write_plant(a, b, push, position, force, contact, direct, top, bottom, given, as_series(sample_time_s))  # type: ignore[arg-type]
    return a, b, position, force, direct[0]


def _continuous(family: CoupledFamily, values: Sequence[Any]) -> tuple[Objects, Objects]:
    """Return A (n, n) and B (n, k) per sample, accelerations through the inverse of the mass matrix, on the surface."""
    stiffness, inverse_factor = values
    singles = [_parts(each, family.sample_time_s) for each in family.plant.plants]
    ends = np.cumsum([len(each[0]) for each in singles])
    n, k = int(ends[-1]), len(singles)
    a, b = _objects(n, n), _objects(n, k)
    for i, (end, (own, drive, *_)) in enumerate(zip(ends, singles, strict=True)):
        of_axis = slice(int(end) - len(own), int(end))
        a[of_axis, of_axis], b[of_axis, i] = own, drive
    inverse = inverse_of(family.plant.mass_matrix)
    speeds, places = [int(end) - 1 for end in ends], [int(end) - 2 for end in ends]
    rows, drives = a[speeds].copy(), b[speeds].copy()
    for i, speed in enumerate(speeds):
        a[speed], b[speed] = 0, 0
        for j in range(k):
            weight = inverse[i, j] * inverse_factor
            for column in range(n):
                a[speed, column] = a[speed, column] + weight * rows[j, column]
            for column in range(k):
                b[speed, column] = b[speed, column] + weight * drives[j, column]
    surface = family.plant.surface
    if surface is not None:
        _press(a, inverse, (family, stiffness, inverse_factor), speeds, places)
    return a, b


def _press(a: Objects, inverse: Objects, of: tuple[Any, Any, Any], speeds: list[int], places: list[int]) -> None:
    """Take Jᵀ (K_e J q + B_e J q') off, through the inverse of the mass matrix."""
    family, stiffness, inverse_factor = of
    direction, h = [number(float(each)) for each in family.plant.surface.direction], number(family.sample_time_s)
    damping = number(family.plant.surface.environment.damping_n_s_per_m)
    for i, speed in enumerate(speeds):
        push = sum((inverse[i, j] * each for j, each in enumerate(direction)), number(0))
        for each, place in zip(direction, places, strict=True):
            a[speed, place] = a[speed, place] - inverse_factor * stiffness * (push * each * h * h)
            a[speed, place + 1] = a[speed, place + 1] - inverse_factor * (push * each * h * damping)


@lru_cache(maxsize=4)
def _frame(family: CoupledFamily) -> "_Frame":
    """Return the frame of a family, made once for all its cells."""
    return _Frame(family)


class _Frame:
    """What of the closed loop hangs on no parameter: the laws, the delay chains, the motions that nothing holds."""

    def __init__(self, family: CoupledFamily) -> None:
        plants, laws, h = family.plant.plants, family.laws, family.sample_time_s
        singles = [_parts(each, h) for each in plants]
        self.n = sum(len(each[0]) for each in singles)
        delays = [split_delay(each.loop_delay_s, h) for each in plants]
        chains = [whole + int(fraction > 0.0) for whole, fraction in delays]
        rows = [None if law is None else controller_rows(law, h) for law in laws]
        sizes = [0 if each is None else len(each) - 1 for each in rows]
        size, k = self.n + sum(chains) + sum(sizes), len(plants)
        self.outputs = [i for i, law in enumerate(laws) if law is not None]
        width = size + len(self.outputs)
        self.fixed, self.select = _objects(size - self.n + len(self.outputs), width), _objects(self.n + 2 * k, width)
        for i in range(self.n):
            self.select[i, i] = 1
        moved = _objects(size, len(self.outputs))
        first, chain, own = 0, self.n, self.n + sum(chains)
        for i, (single, law) in enumerate(zip(singles, laws, strict=True)):
            _, _, position, force, direct = single
            place = first + len(position)
            if chains[i] == 0 and law is not None and as_series(direct).value != 0:
                raise ParameterError("robot.delay_s", 0.0, "above 0 with damping in the coupling")
            measured, where, command = _objects(width), _objects(width), _objects(width)
            measured[first:place], where[first:place] = force, position
            if chains[i]:
                measured[chain + chains[i] - 1] = direct
            if law is not None:
                output, read, scale = self.outputs.index(i), measured.copy(), number(float(family.scale[i]))
                if family.at == "force":
                    read[size + output] = scale
                command = self._answer(rows[i], read, where, own)
                self.fixed[size - self.n + output] = read / scale
                if family.at == "command":
                    last = _unit(width, chain) if chains[i] else None
                    self.fixed[size - self.n + output] = self._shift(command, last, (own, size + output), scale)
                self._move(moved[:, output], (first, place), (chain, chains[i]), (own, law, h))
            acting = [command, *(_unit(width, chain + j) for j in range(chains[i]))]
            self.select[self.n + 2 * i] = acting[delays[i][0]]
            if chains[i] > delays[i][0]:
                self.select[self.n + 2 * i + 1] = acting[chains[i]]
            for j in range(chains[i]):
                self.fixed[chain - self.n + j] = acting[j]
            first, chain, own = place, chain + chains[i], own + sizes[i]
        self._reduce(family, moved, size)

    def _answer(self, of_law: Objects, read: Objects, where: Objects, own: int) -> Objects:
        """Write the rows of one law's states, which begin at `own`, and return that of its command."""
        states = len(of_law) - 1
        answers = [of_law[j, states] * read + of_law[j, states + 1] * where for j in range(states + 1)]
        for j, answer in enumerate(answers):
            answer[own : own + states] = answer[own : own + states] + of_law[j, :states]
            if j < states:
                self.fixed[own - self.n + j] = answer
        return answers[-1]

    def _shift(self, command: Objects, last: Objects | None, at: tuple[int, int], scale: Objects) -> Objects:
        """Let an input δ shift the command from now on, and return the row of what the command changes by.

        Both are those of the sensitivity at the command times (z − 1), which leaves it as it is and makes it one of
        what moves alone: a shift that stays is one of the law's integrator, its first state, whose gain is 1.
        """
        if last is None:
            raise ParameterError("robot.delay_s", 0.0, "a sample or more, to be proved at the command")
        state, column = at
        command[column] = 1 / scale
        self.fixed[state - self.n, column] = 1 / scale
        return (command - last) * scale

    @staticmethod
    def _move(
        column: Objects, plant: tuple[int, int], past: tuple[int, int], own: tuple[int, AdmittanceController, float]
    ) -> None:
        """Write the state in which one axis rests one unit further on."""
        (first, place), (chain, length), (at, law, h) = plant, past, own
        column[first] = column[place - 2] = 1
        column[chain : chain + length] = 1
        kept, rest = needed_states(controller_blocks(law, h)), rest_states(blocks_in_balls(law, h))
        for j, each in enumerate(kept.tolist()):
            column[at + j] = rest[each]

    def _reduce(self, family: CoupledFamily, moved: Objects, size: int) -> None:
        """Take the motions that nothing holds out: s − motions·s[pivots], the pivots left out.

        The pivot of an axis is its payload's place, where its motion is 1 and the other axes' is 0.
        """
        places = np.cumsum([len(_parts(each, family.sample_time_s)[0]) for each in family.plant.plants]) - 2
        pivots = [int(places[i]) for i in self.outputs]
        motions = [moved[:, j] for j in range(len(pivots))]
        surface = family.plant.surface
        if surface is not None:
            along = [number(float(surface.direction[i])) for i in self.outputs]
            held = int(np.argmax(np.abs(surface.direction[self.outputs])))
            if along[held] != 0:
                against = motions[held]
                motions = [motions[j] - (along[j] / along[held]) * against for j in range(len(pivots)) if j != held]
                del pivots[held]
        self.kept = [i for i in range(size) if i not in pivots]
        change = _objects(size, size)
        for i in range(size):
            change[i, i] = 1
        for motion, pivot in zip(motions, pivots, strict=True):
            change[:, pivot] = change[:, pivot] - motion
        self.states = len(self.kept)
        outputs = len(self.outputs)
        whole = _objects(self.states + outputs, size + outputs)
        whole[: self.states, :size] = change[self.kept]
        for j in range(outputs):
            whole[self.states + j, size + j] = 1
        self.columns = [*self.kept, *range(size, size + outputs)]
        self.reduction = _balls(whole)
        self.fixed_rows, self.selected = _balls(self.fixed), _balls(self.select)

    def close(self, steps: Balls, *, with_constants: bool = True) -> Balls:
        """Return Σ of the plant's step (n, n + 2 k); of its derivative without what is constant."""
        plant = steps @ self.selected
        fixed = self.fixed_rows if with_constants else self.fixed_rows.times(0.0)
        stacked = Balls(mid=np.vstack([plant.mid, fixed.mid]), rad=np.vstack([plant.rad, fixed.rad]))
        reduced = self.reduction @ stacked
        return reduced[:, self.columns]


def _balls(matrix: Objects) -> Balls:
    return enclose([as_series(each).value for each in matrix.ravel()]).shaped(*matrix.shape)


def _unit(size: int, place: int) -> Objects:
    return np.array([int(i == place) for i in range(size)], dtype=object)


def _objects(*shape: int) -> Objects:
    out = np.empty(shape, dtype=object)
    out.fill(0)
    return out
