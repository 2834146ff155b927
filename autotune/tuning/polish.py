"""Polish a design on its active scenarios with exact gradients: the last digits that differences do not give."""

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from problems.design.batch_evaluation import BatchEvaluator
from problems.design.requirements import LARGEST_SHARE

from .bounds import bounds_of, linear_variables
from .optimality import LEAST_RATIO, PEAK, near_keys, row_at, unit_widths

FloatArray = NDArray[np.float64]

_NEAR = 0.01
_RADIUS = 0.01
_ITERATIONS = 6
_WALL = 1e3


def polish_exactly(
    screen: BatchEvaluator, design: FloatArray, *, backoff: Mapping[str, float], reserve: float
) -> FloatArray:
    """Return a design (n,) near a stable one, with a lower peak if the gradients lead to one.

    Sequential quadratic programming on `LocalProblem`. Whether the result is better, and feasible, is for the caller
    to evaluate: scenarios that were far from active are not looked at.
    """
    problem, count = LocalProblem(screen, design, backoff=backoff, reserve=reserve), len(design)
    start = problem.start()
    # Peak and prices are counted from the peak at the start.
    shares, origin = problem.prices / np.exp(start[count]), np.append(start[count], np.zeros(len(problem.prices)))
    found = minimize(
        lambda x: _log_of_sum(x[count:] - origin, shares, count),
        start,
        jac=True,
        method="SLSQP",
        bounds=[*problem.moves, (None, None), *[(0.0, None)] * len(problem.prices)],
        constraints=[{"type": "ineq", "fun": problem.slack, "jac": problem.slack_gradients}],
        options={"maxiter": _ITERATIONS, "ftol": 1e-8},
    )
    return problem.at(np.asarray(found.x[:count]))


class LocalProblem:
    """min t under φ_s ≤ t and c_j ≤ −reserve − backoff_j around a stable design (n,), with exact gradients.

    x is the move (n,) in the variables of `optimality`, at most 1 %, then t and a w per soft requirement, which has
    c_j ≤ w and w ≥ 0: its price times e^w − 1 is added to the peak. Rows are the peaks and requirements within 1 % of
    their limits. `moves` are the bounds of the moves, `prices` (N) those of the soft requirements.
    """

    def __init__(
        self, screen: BatchEvaluator, design: FloatArray, *, backoff: Mapping[str, float], reserve: float
    ) -> None:
        problem = screen.prepared.problem
        self._screen, self._design = screen, design
        self._widths, self._bounds = unit_widths(problem, design), bounds_of(problem)
        self._linear = linear_variables(problem)
        self._keys = near_keys(screen.prepared, design, _NEAR)
        prices = {name: price for name, price in problem.requirements.soft_n.items() if name in dict(self._keys)}
        self._held = np.array(
            [
                0.0 if name == PEAK or name in prices else reserve + np.log1p(backoff.get(name, 0.0))
                for name, _ in self._keys
            ]
        )
        # Which of t and the w each row is held under.
        self._under = np.array(
            [[name == owner for owner in (PEAK, *prices)] for name, _ in self._keys], dtype=np.float64
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
        here = self.at(x[: len(self._design)])
        rows = [row_at(self._screen.prepared, here, key).gradient for key in self._keys]
        return np.column_stack([-np.array(rows), self._under])

    def _values(self, design: FloatArray) -> FloatArray:
        """Return the logarithms of the rows (k,), by the compiled screen; a wall where unstable."""
        found = self._screen.evaluate(design[None], peaks_if_missed=True)
        if not found.is_stable[0]:
            return np.full(len(self._keys), _WALL)
        rows = {
            name: np.clip(row, LEAST_RATIO, LARGEST_SHARE)
            for name, row in (*found.rows.items(), *found.soft_rows.items())
        }
        rows[PEAK] = found.peaks_n
        return np.log([rows[name][0, index] for name, index in self._keys])


def _log_of_sum(levels: FloatArray, shares: FloatArray, count: int) -> tuple[float, FloatArray]:
    """Return ln(e^t + Σ share_j (e^w_j − 1)) of levels (t, w…) and its gradient, `count` zeros before it.

    That is t where there are no shares.
    """
    peak, missed = np.exp(levels[0]), np.exp(levels[1:])
    total = peak + shares @ (missed - 1.0)
    return float(np.log(total)), np.concatenate([np.zeros(count), [peak / total], shares * missed / total])


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
