"""Polish a design on its active scenarios with exact gradients: the last digits that differences do not give."""

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from problems.design import VARIABLES
from problems.screening import Screen

from .optimality import LINEAR_VARIABLES, PEAK, Row, near_keys, row_at, unit_widths

FloatArray = NDArray[np.float64]

_NEAR = 0.01
_RADIUS = 0.01
_ITERATIONS = 6
_WALL = 1e3
_LINEAR = np.array([name in LINEAR_VARIABLES for name in VARIABLES])


def polish_exactly(screen: Screen, design: FloatArray, *, backoff: Mapping[str, float], reserve: float) -> FloatArray:
    """Return a design (4,) near a stable one, with a lower peak if the gradients lead to one.

    min t under φ_s ≤ t and c_j ≤ −reserve − backoff_j, in the variables of `optimality`, over the peaks and
    requirements within 1 % of their limits: sequential quadratic programming, steps of at most 1 %. Whether the result
    is better, and feasible, is for the caller to evaluate: scenarios that were far from active are not looked at.
    """
    prepared = screen.prepared
    problem = prepared.problem
    widths = unit_widths(problem, design)
    keys = near_keys(prepared, design, _NEAR)
    held = np.array([reserve + np.log1p(backoff.get(name, 0.0)) if name != PEAK else 0.0 for name, _ in keys])
    is_peak = np.array([name == PEAK for name, _ in keys])
    cache: dict[bytes, tuple[FloatArray, FloatArray]] = {}

    def at(move: FloatArray) -> FloatArray:
        scaled = np.where(_LINEAR, design + move * widths, design * np.exp(np.where(_LINEAR, 0.0, move)))
        bounds = np.array([problem.bounds[name] for name in VARIABLES])
        return np.clip(scaled, bounds[:, 0], bounds[:, 1])

    def rows(move: FloatArray) -> tuple[FloatArray, FloatArray]:
        key = move.tobytes()
        if key not in cache:
            here = at(move)
            if screen.evaluate(here[None]).is_stable[0]:
                found: list[Row] = [row_at(prepared, here, each) for each in keys]
                cache[key] = np.array([row.value for row in found]), np.array([row.gradient for row in found])
            else:
                cache[key] = np.full(len(keys), _WALL), np.zeros((len(keys), len(design)))
        return cache[key]

    first = rows(np.zeros(len(design)))[0]
    start = np.append(np.zeros(len(design)), np.max(first[is_peak]))
    found = minimize(
        lambda x: x[-1],
        start,
        jac=lambda x: np.append(np.zeros(len(x) - 1), 1.0),
        method="SLSQP",
        bounds=[*_moves(screen, design, widths), (None, None)],
        constraints=[
            {
                "type": "ineq",
                "fun": lambda x: np.where(is_peak, x[-1], 0.0) - rows(x[:-1])[0] - held,
                "jac": lambda x: np.column_stack([-rows(x[:-1])[1], is_peak.astype(np.float64)]),
            }
        ],
        options={"maxiter": _ITERATIONS, "ftol": 1e-8},
    )
    return at(np.asarray(found.x[:-1]))


def _moves(screen: Screen, design: FloatArray, widths: FloatArray) -> list[tuple[float, float]]:
    """Return how far each variable may move: to its bounds, and not far."""
    moves = []
    for value, width, name, linear in zip(design, widths, VARIABLES, _LINEAR, strict=True):
        low, high = screen.prepared.problem.bounds[name]
        if width == 0.0:
            moves.append((0.0, 0.0))
            continue
        below, above = (
            ((low - value) / width, (high - value) / width) if linear else np.log([low / value, high / value])
        )
        moves.append((max(float(below), -_RADIUS), min(float(above), _RADIUS)))
    return moves
