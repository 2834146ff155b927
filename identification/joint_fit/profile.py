"""Profile likelihood: intervals of parameters whose likelihood a bound cuts off."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from .covariance import Spread
from .problem import Point, Problem, Summary, sizes_of
from .solve import Block, cost, information, minimise

FloatArray = NDArray[np.float64]

_LEVEL = 3.841  # the 95 % quantile of χ² with one degree of freedom
_TWO_SIDED = 1.96
_STEPS = 3
_TRIES = 3


def bounded_intervals(
    problem: Problem, point: Point, blocks: Sequence[Block], spread: Spread
) -> dict[str, tuple[float, float]]:
    """Return 95 % intervals by name of the dampings and masses that lie within 1.96 deviations of 0.

    The profile of −2 log L over the parameter, all others fitted again, is compared with the 95 % quantile of χ²(1),
    times the square of what `widened` did to the deviation. For a surface only its own contacts are computed again;
    what all other spans say is their quadratic form.
    """
    layout = problem.layout
    sizes = sizes_of(point.values, layout, problem.signals.period_s)
    linear = [1, 2] + [layout.surface(i).start + k for i in range(layout.surfaces) for k in (1, 2)]
    out = {}
    for index in linear:
        std = float(np.sqrt(spread.covariance[index, index])) * float(sizes[index])
        if point.values[index] > _TWO_SIDED * std:
            continue
        part, start = _part(problem, point, blocks, index)
        level = _LEVEL * float(spread.covariance[index, index] / spread.plain[index, index])
        floor = cost(part, start)
        upper = _crossing(part, start, index, float(point.values[index]) + _TWO_SIDED * std, level, floor)
        at_zero = _profiled(part, start, index, 0.0) - floor
        lower = 0.0
        if at_zero > level:
            lower = float(point.values[index]) * (1.0 - float(np.sqrt(level / at_zero)))
        out[layout.names[index]] = (lower, max(upper, float(point.values[index])))
    return out


def _part(problem: Problem, point: Point, blocks: Sequence[Block], index: int) -> tuple[Problem, Point]:
    """Return the spans that are computed again, the others being summed up."""
    layout, first = problem.layout, problem.layout.robot.stop
    surface = (index - first) // 3 if index >= first else None
    kept = [i for i, s in enumerate(problem.segments) if surface is None or s.surface == surface]
    matrix, _ = information([b for i, b in enumerate(blocks) if i not in kept], len(layout))
    values, vectors = np.linalg.eigh(matrix)
    summary = Summary(root=(vectors * np.sqrt(np.maximum(values, 0.0))).T, values=point.values)
    part = replace(
        problem,
        segments=tuple(problem.segments[i] for i in kept),
        pose_spans=(),
        priors=(),
        fixed=tuple(range(layout.robot.start, layout.robot.stop)),
        known_path=problem.path(point.values),
        summary=summary,
    )
    return part, Point(values=point.values, nuisances=tuple(point.nuisances[i] for i in kept))


def _profiled(part: Problem, start: Point, index: int, value: float) -> float:
    values = start.values.copy()
    values[index] = value
    held = replace(part, fixed=(*part.fixed, index))
    return minimise(held, Point(values=values, nuisances=start.nuisances), _STEPS)[1]


def _crossing(part: Problem, start: Point, index: int, guess: float, level: float, floor: float) -> float:
    """Return where the profile passes the level above the estimate: √Δ is nearly a straight line."""
    here, at = float(start.values[index]), guess
    for _ in range(_TRIES):
        rise = _profiled(part, start, index, at) - floor
        if rise <= 0.0 or not np.isfinite(rise):
            return float(np.inf)
        share = float(np.sqrt(level / rise))
        if abs(share - 1.0) < 0.05:
            break
        at = here + (at - here) * float(np.clip(share, 0.3, 3.0))
    return at
