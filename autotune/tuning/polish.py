"""Polish a design on its active scenarios with exact gradients: the last digits that differences do not give."""

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from problems.requirements import LARGEST_SHARE
from problems.screening import Screen

from .box import bounds_of, linear_variables
from .optimality import LEAST_RATIO, PEAK, Key, near_keys, row_at, unit_widths

FloatArray = NDArray[np.float64]

_NEAR = 0.01
_RADIUS = 0.01
_ITERATIONS = 6
_WALL = 1e3


def polish_exactly(screen: Screen, design: FloatArray, *, backoff: Mapping[str, float], reserve: float) -> FloatArray:
    """Return a design (n,) near a stable one, with a lower peak if the gradients lead to one.

    min t under φ_s ≤ t and c_j ≤ −reserve − backoff_j, in the variables of `optimality`, over the peaks and
    requirements within 1 % of their limits: sequential quadratic programming, steps of at most 1 %. A soft requirement
    has c_j ≤ w and w ≥ 0, and its price times e^w − 1 is added to the peak. Whether the result
    is better, and feasible, is for the caller to evaluate: scenarios that were far from active are not looked at.
    """
    prepared, problem = screen.prepared, screen.prepared.problem
    widths = unit_widths(problem, design)
    keys = near_keys(prepared, design, _NEAR)
    prices = {name: price for name, price in problem.requirements.soft_n.items() if name in dict(keys)}
    held = np.array(
        [0.0 if name == PEAK or name in prices else reserve + np.log1p(backoff.get(name, 0.0)) for name, _ in keys]
    )
    # Which of t and the w each row is held under.
    under = np.array([[name == owner for owner in (PEAK, *prices)] for name, _ in keys], dtype=np.float64)
    linear, bounds, count = linear_variables(problem), bounds_of(problem), len(design)
    values = _Values(screen, keys)

    def at(move: FloatArray) -> FloatArray:
        scaled = np.where(linear, design + move * widths, design * np.exp(np.where(linear, 0.0, move)))
        return np.clip(scaled, bounds[:, 0], bounds[:, 1])

    def gradients(move: FloatArray) -> FloatArray:
        here = at(move)
        return np.array([row_at(prepared, here, each).gradient for each in keys])

    first = values(design)
    start = np.concatenate([np.zeros(count), np.max(np.where(under > 0.0, first[:, None], -_WALL), axis=0)])
    start[count + 1 :] = np.maximum(start[count + 1 :], 0.0)
    # Peak and prices are counted from the peak at the start.
    shares, origin = np.array(list(prices.values())) / np.exp(start[count]), np.append(start[count], 0.0 * under[0, 1:])
    found = minimize(
        lambda x: _log_of_sum(x[count:] - origin, shares, count),
        start,
        jac=True,
        method="SLSQP",
        bounds=[*_moves(screen, design, widths), (None, None), *[(0.0, None)] * len(prices)],
        constraints=[
            {
                "type": "ineq",
                "fun": lambda x: under @ x[count:] - values(at(x[:count])) - held,
                "jac": lambda x: np.column_stack([-gradients(x[:count]), under]),
            }
        ],
        options={"maxiter": _ITERATIONS, "ftol": 1e-8},
    )
    return at(np.asarray(found.x[:count]))


class _Values:
    """The logarithms of the peaks and requirements named by `keys`, by the compiled screen; a wall where unstable."""

    def __init__(self, screen: Screen, keys: tuple[Key, ...]) -> None:
        self.screen, self.keys = screen, keys

    def __call__(self, design: FloatArray) -> FloatArray:
        found = self.screen.evaluate(design[None], peaks_if_missed=True)
        if not found.is_stable[0]:
            return np.full(len(self.keys), _WALL)
        rows = {
            name: np.clip(row, LEAST_RATIO, LARGEST_SHARE)
            for name, row in (*found.rows.items(), *found.soft_rows.items())
        }
        rows[PEAK] = found.peaks_n
        return np.log([rows[name][0, index] for name, index in self.keys])


def _log_of_sum(levels: FloatArray, shares: FloatArray, count: int) -> tuple[float, FloatArray]:
    """Return ln(e^t + Σ share_j (e^w_j − 1)) of levels (t, w…) and its gradient, `count` zeros before it.

    That is t where there are no shares.
    """
    peak, missed = np.exp(levels[0]), np.exp(levels[1:])
    total = peak + shares @ (missed - 1.0)
    return float(np.log(total)), np.concatenate([np.zeros(count), [peak / total], shares * missed / total])


def _moves(screen: Screen, design: FloatArray, widths: FloatArray) -> list[tuple[float, float]]:
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
