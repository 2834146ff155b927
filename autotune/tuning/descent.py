"""Descend to the nearest optimum: sequential quadratic programming by differences, then with exact gradients.

`descend` goes all the way from a point of the unit cube on the batch evaluator; `polish_exactly` finds the last digits
that differences do not give, on the scenarios that are active at a design.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize

from problems.arrays import FloatArray
from problems.design.batch_evaluation import BatchEvaluator
from problems.design.batch_result import BatchEvaluation
from problems.design.requirements import LARGEST_SHARE
from problems.frozen import FrozenDict

from .bounds import Box, bounds_of, linear_variables
from .optimality import LEAST_RATIO, OBJECTIVE, near_keys, row_at, unit_widths

BACKOFF = 2e-5
"""The share of every requirement that is kept in hand, for what a step along a curved limit misses."""
_STEP = 1e-6
# Of the exact polish: the square of it is no more than the rounding of a difference.
_FINE_STEP = 1e-5
# A descent that takes more is on a kink of a margin, where every further step is dear and small.
SHORT_WAY = 12
_TOLERANCE = 1e-8
_WALL = 1e3
_HIGHEST = 300.0
# A logarithm of a share that no cost falls to, and whose exponential is still above 0.
_LEAST_LOG = -500.0
# Of the exact polish: the move, and how near to its limit a row counts, as shares.
_NEAR, _RADIUS, _POLISH_ITERATIONS = 0.01, 0.01, 6
_NONE: Mapping[str, float] = FrozenDict({})


@dataclass(frozen=True, kw_only=True)
class Descent:
    """Where a descent ended, a point (n,) of the unit cube, and how many designs it evaluated.

    `cost` is the objective's there, `missed` by how much it misses what is asked: 0 where it does not, infinite where
    it is unstable.
    """

    unit: FloatArray
    cost: float
    missed: float
    evaluations: int


def descend(
    screen: BatchEvaluator,
    box: Box,
    start: FloatArray,
    *,
    backoff: Mapping[str, float] = _NONE,
    reserve: float = BACKOFF,
    iterations: int = SHORT_WAY,
) -> Descent:
    """Lower t, which no cost of the objective may exceed, while every margin keeps its limit, from a point (n,) on.

    By e_j ≥ 0 a soft requirement j may be missed, which costs its price times e_j. `backoff` is the share by which
    more is asked of a requirement, `reserve` what is kept in hand of each. Where the descent ends it may still miss
    something: that is for the caller to see.
    """
    soft = screen.prepared.problem.requirements.soft_n if screen.goal is None else {}
    prices, count = np.array(list(soft.values()), dtype=np.float64), len(start)
    points = _Points(screen, box, backoff, reserve, np.asarray(start))
    first, spares = points.values(np.asarray(start)), points.spares
    costs = np.concatenate([np.zeros(count), [1.0], prices / points.scale])

    def slack(x: FloatArray) -> FloatArray:
        here = points.values(x[:count])
        return np.concatenate([x[count] - here.costs, here.slack + spares @ x[count + 1 :]])

    def slack_gradients(x: FloatArray) -> FloatArray:
        here = points.gradients(x[:count])
        rising, still = np.ones((len(here.costs), 1)), np.zeros((len(here.slack), 1))
        return np.block([[-here.costs, rising, np.zeros((len(rising), len(prices)))], [here.slack, still, spares]])

    missed = np.max(spares * -first.slack[:, None], axis=0, initial=0.0)
    found = minimize(
        lambda x: costs @ x,
        np.concatenate([start, [np.max(first.costs)], missed]),
        jac=lambda _: costs,
        method="SLSQP",
        bounds=[*[(0.0, 1.0)] * count, *[(0.0, None)] * (1 + len(prices))],
        constraints=[{"type": "ineq", "fun": slack, "jac": slack_gradients}],
        options={"maxiter": iterations, "ftol": _TOLERANCE},
    )
    unit = np.asarray(np.clip(found.x[:count], 0.0, 1.0))
    return Descent(unit=unit, cost=points.cost(unit), missed=points.missed(unit), evaluations=points.evaluations)


@dataclass(frozen=True, kw_only=True)
class _Rows:
    """Costs (s,) in units of the largest at the start and slack (k,), or their gradients (s, n) and (k, n)."""

    costs: FloatArray
    slack: FloatArray


class _Points:
    """Points of a descent: each is evaluated once, its neighbours only where the way goes on.

    `scale` is the largest cost at the start; `spares` (k, j) marks which rows of slack may be missed at a price,
    and by which of j soft requirements.
    """

    def __init__(
        self, screen: BatchEvaluator, box: Box, backoff: Mapping[str, float], reserve: float, start: FloatArray
    ) -> None:
        self.screen, self.box, self.backoff, self.reserve = screen, box, backoff, reserve
        self.evaluations, self.scale, self.spares = 0, 1.0, np.zeros((0, 0))
        self._found: dict[bytes, BatchEvaluation] = {}
        self._values: dict[bytes, _Rows] = {}
        self._gradients: dict[bytes, _Rows] = {}
        highest = float(np.max(self._rows(self._evaluated(start))[0].costs))
        self.scale = highest if np.isfinite(highest) else 1.0

    def values(self, unit: FloatArray) -> _Rows:
        """Return costs and slack at a point (n,)."""
        key = unit.tobytes()
        if key not in self._values:
            self._values[key] = self._rows(self._evaluated(unit))[0]
        return self._values[key]

    def cost(self, unit: FloatArray) -> float:
        """Return the objective's largest cost at a point (n,)."""
        return float(np.max(self._evaluated(unit).objective_rows))

    def missed(self, unit: FloatArray) -> float:
        """Return by how much a point (n,) misses what is asked, without what is kept in hand."""
        if not self._evaluated(unit).is_stable[0]:
            return float("inf")
        hard = ~np.any(self.spares > 0.0, axis=1)
        return max(0.0, -float(np.min(self.values(unit).slack[hard], initial=0.0)) - self.reserve)

    def gradients(self, unit: FloatArray) -> _Rows:
        """Return forward differences at a point (n,), backward ones at an upper bound."""
        key = unit.tobytes()
        if key not in self._gradients:
            steps = np.where(unit + _STEP <= 1.0, _STEP, -_STEP)
            here, *there = self._beside(np.vstack([unit, unit + np.diag(steps)]))
            self._gradients[key] = _Rows(
                costs=np.column_stack([each.costs - here.costs for each in there]) / steps,
                slack=np.column_stack([each.slack - here.slack for each in there]) / steps,
            )
        return self._gradients[key]

    def _evaluated(self, unit: FloatArray) -> BatchEvaluation:
        """Evaluate a point (n,), once."""
        key = unit.tobytes()
        if key not in self._found:
            self._found[key] = self.screen.evaluate(self.box.design(unit[None]), peaks_if_missed=True)
            self.evaluations += 1
        return self._found[key]

    def _beside(self, units: FloatArray) -> list[_Rows]:
        """Evaluate points (m, n) by small steps from the first of them."""
        known = self._evaluated(units[0])
        self.evaluations += len(units) - 1
        return self._rows(self.screen.evaluate_beside(known, self.box.design(units)))

    def _rows(self, found: BatchEvaluation) -> list[_Rows]:
        """Return costs and slack of points that are evaluated; an unstable one is a plain wall to the line search."""
        stable = found.is_stable[:, None]
        rows = [1.0 - value * (1.0 + self.backoff.get(name, 0.0)) for name, value in found.rows.items()]
        rows += [1.0 - value for value in found.soft_rows.values()]
        slack = np.hstack([np.zeros((len(stable), 0)), *rows])
        owners = np.repeat(np.arange(len(rows)), [row.shape[1] for row in rows]) - len(found.rows)
        self.spares = (owners[:, None] == np.arange(len(found.soft_rows))).astype(np.float64)
        costs = np.where(stable, found.objective_rows / self.scale, _WALL)
        slack = np.where(stable, np.clip(slack, -_WALL, 1.0) - self.reserve * (owners < 0), -1.0)
        return [_Rows(costs=c, slack=s) for c, s in zip(costs, slack, strict=True)]


def polish_exactly(
    screen: BatchEvaluator, design: FloatArray, *, backoff: Mapping[str, float], reserve: float
) -> FloatArray:
    """Return a design (n,) near a stable one, with a lower cost if the gradients lead to one.

    Sequential quadratic programming on `LocalProblem`. Whether the result is better, and feasible, is for the caller
    to evaluate: scenarios that were far from active are not looked at.
    """
    problem, count = LocalProblem(screen, design, backoff=backoff, reserve=reserve), len(design)
    start = problem.start()
    # Cost and prices are counted from the cost at the start.
    shares, origin = problem.prices / np.exp(start[count]), np.append(start[count], np.zeros(len(problem.prices)))
    found = minimize(
        lambda x: _log_of_sum(np.maximum(x[count:] - origin, _LEAST_LOG), shares, count),
        start,
        jac=True,
        method="SLSQP",
        bounds=[*problem.moves, (None, None), *[(0.0, None)] * len(problem.prices)],
        constraints=[{"type": "ineq", "fun": problem.slack, "jac": problem.slack_gradients}],
        options={"maxiter": _POLISH_ITERATIONS, "ftol": 1e-8},
    )
    # At a corner that many rows share a subproblem may be singular: t falls without end, and what was before stands.
    strayed = not abs(found.x[count] - start[count]) < 1.0
    return problem.at(np.asarray(problem.iterate if strayed else found.x[:count]))


class LocalProblem:
    """min t under φ_s ≤ t and c_j ≤ −reserve − backoff_j around a stable design (n,), with exact gradients.

    x is the move (n,) in the variables of `optimality`, at most 1 %, then t and a w per soft requirement, which has
    c_j ≤ w and w ≥ 0: its price times e^w − 1 is added to the cost. Rows are the costs and requirements within 1 % of
    their limits, named by `keys`. `iterate` is the last move whose gradients were asked, `moves` are the bounds of the
    moves, `prices` (N) those of the soft requirements.
    """

    def __init__(
        self, screen: BatchEvaluator, design: FloatArray, *, backoff: Mapping[str, float], reserve: float
    ) -> None:
        problem = screen.prepared.problem
        self._screen, self._design = screen, design
        self._widths, self._bounds = unit_widths(problem, design), bounds_of(problem)
        self._linear = linear_variables(problem)
        self.keys = near_keys(screen.prepared, design, _NEAR)
        self._found: dict[bytes, BatchEvaluation] = {}
        self.iterate = np.zeros(len(design))
        prices = {name: price for name, price in problem.requirements.soft_n.items() if name in dict(self.keys)}
        self._held = np.array(
            [
                0.0 if name == OBJECTIVE or name in prices else reserve + np.log1p(backoff.get(name, 0.0))
                for name, _ in self.keys
            ]
        )
        # Which of t and the w each row is held under.
        self._under = np.array(
            [[name == owner for owner in (OBJECTIVE, *prices)] for name, _ in self.keys], dtype=np.float64
        )
        self.prices = np.array(list(prices.values()), dtype=np.float64)
        self.moves = _moves(screen, design, self._widths)

    def start(self) -> FloatArray:
        """Return x at the design itself, with the least t and w that it allows."""
        count = len(self._design)
        first = np.where(self._under > 0.0, self._values(self._design)[:, None], -_WALL)
        start = np.concatenate([np.zeros(count), np.max(first, axis=0)])
        start[count + 1 :] = np.maximum(start[count + 1 :], 0.0)
        return start

    def at(self, move: FloatArray) -> FloatArray:
        """Return the design at a move (n,)."""
        steps = np.where(self._linear, 0.0, move)
        scaled = np.where(self._linear, self._design + move * self._widths, self._design * np.exp(steps))
        return np.clip(scaled, self._bounds[:, 0], self._bounds[:, 1])

    def slack(self, x: FloatArray) -> FloatArray:
        """Return what must not be negative (k,)."""
        count = len(self._design)
        return np.asarray(self._under @ x[count:] - self._values(self.at(x[:count])) - self._held)

    def slack_gradients(self, x: FloatArray) -> FloatArray:
        """Return the gradients of `slack` (k, len(x))."""
        self.iterate = x[: len(self._design)].copy()
        here = self.at(self.iterate)
        if self._screen.is_compiled:
            return np.column_stack([-self._differences(here), self._under])
        rows = [row_at(self._screen.prepared, here, key).gradient for key in self.keys]
        return np.column_stack([-np.array(rows), self._under])

    def _differences(self, here: FloatArray) -> FloatArray:
        """Return the gradients of the rows (k, n) by the moves: central differences, one-sided at 0."""
        widths = unit_widths(self._screen.prepared.problem, here)
        steps = np.diag(_FINE_STEP * widths)
        above, below = here + steps, np.maximum(here - steps, 0.0)
        found = self._screen.evaluate_beside(self._evaluated(here), np.vstack([here, above, below]))
        _, *rows = self._logarithms(found)
        span = np.diag(above - below) / np.where(widths > 0.0, widths, 1.0)
        count = len(here)
        risen = np.array(rows[:count]) - np.array(rows[count:])
        return np.asarray(np.where(widths > 0.0, risen.T / np.where(widths > 0.0, span, 1.0), 0.0))

    def _values(self, design: FloatArray) -> FloatArray:
        """Return the logarithms of the rows (k,), by the compiled screen; a wall where unstable."""
        return np.asarray(self._logarithms(self._evaluated(design))[0])

    def _evaluated(self, design: FloatArray) -> BatchEvaluation:
        """Evaluate a design (n,), once."""
        key = design.tobytes()
        if key not in self._found:
            self._found[key] = self._screen.evaluate(design[None], peaks_if_missed=True)
        return self._found[key]

    def _logarithms(self, found: BatchEvaluation) -> FloatArray:
        """Return the logarithms of the rows (m, k) of designs that are evaluated; a wall where unstable."""
        rows = {
            name: np.clip(row, LEAST_RATIO, LARGEST_SHARE)
            for name, row in (*found.rows.items(), *found.soft_rows.items())
        }
        rows[OBJECTIVE] = found.objective_rows
        logarithms = np.log(np.column_stack([rows[name][:, index] for name, index in self.keys]))
        return np.where(found.is_stable[:, None], logarithms, _WALL)


def _log_of_sum(levels: FloatArray, shares: FloatArray, count: int) -> tuple[float, FloatArray]:
    """Return ln(e^t + Σ share_j (e^w_j − 1)) of levels (t, w…) and its gradient, `count` zeros before it.

    That is t where there are no shares.
    """
    # Levels that a step far outside of what is linear asks for.
    levels = np.minimum(levels, _HIGHEST)
    cost, missed = np.exp(levels[0]), np.exp(levels[1:])
    total = cost + shares @ (missed - 1.0)
    return float(np.log(total)), np.concatenate([np.zeros(count), [cost / total], shares * missed / total])


def _moves(screen: BatchEvaluator, design: FloatArray, widths: FloatArray) -> list[tuple[float, float]]:
    """Return how far each variable may move: to its bounds, and not far."""
    moves, problem = [], screen.prepared.problem
    for value, width, name, linear in zip(design, widths, problem.variables, linear_variables(problem), strict=True):
        low, high = problem.bounds[name]
        if width == 0.0:
            moves.append((0.0, 0.0))
            continue
        below, above = (
            ((low - value) / width, (high - value) / width) if linear else np.log([low / value, high / value])
        )
        moves.append((max(float(below), -_RADIUS), min(float(above), _RADIUS)))
    return moves
