"""Compare the cells of a campaign with each other, and each with its own past."""

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np

from autotune.drift import BIAS, Change, drifts
from problems.arrays import FloatArray

from .work import RunOutcome

_UNUSUAL_FLEETS, _DRAWN_FLEETS = 0.01, 400
_FEWEST_CELLS, _CELLS_PER_PARAMETER = 5, 5
_TO_STD = 1.4826  # of a normal distribution: standard deviation over median absolute deviation


@dataclass(frozen=True, kw_only=True)
class Unusual:
    """A parameter of a cell that is far from the fleet's median, or all of them together (`name` is "").

    `score` is the distance in robust deviations; of all together the squared Mahalanobis distance.
    """

    cell: str
    name: str
    value: float
    median: float
    score: float


def by_cell(outcomes: Sequence[RunOutcome]) -> dict[str, tuple[RunOutcome, ...]]:
    """Return the runs of every cell that were identified, in the order of their recording."""
    found: dict[str, list[RunOutcome]] = {}
    for each in outcomes:
        if each.values:
            found.setdefault(each.cell, []).append(each)
    return {cell: tuple(sorted(runs, key=lambda run: (run.recorded_s or 0.0, run.run))) for cell, runs in found.items()}


def changes(outcomes: Sequence[RunOutcome]) -> tuple[Change, ...]:
    """Return what differs between each run of a cell and the one before it, or has crept away since it last changed."""
    return tuple(
        change
        for cell, runs in by_cell(outcomes).items()
        for change in drifts(cell, [(run.run, run.values) for run in runs])
    )


def unusual(outcomes: Sequence[RunOutcome]) -> tuple[Unusual, ...]:
    """Return the cells whose newest run is far from the fleet, parameter by parameter and all together.

    Centre and scale are median and median absolute deviation, with the cell's own deviation on top; together it is the
    squared distance under a covariance that outliers do not move (Gnanadesikan and Kettenring, *Biometrics* 28, 1972;
    Maronna and Zamar, *Technometrics* 44, 2002). Unusual is what one fleet of normal cells in a hundred shows. Fewer
    than five cells with a parameter are no fleet.
    """
    newest = {cell: runs[-1].values for cell, runs in by_cell(outcomes).items()}
    names = _shared(newest)
    limit, _ = _limits(len(newest), len(names)) if names else (0.0, 0.0)
    found = [each for name in names for each in _of_parameter(newest, name, limit)]
    return (*found, *_together(newest))


def _shared(newest: Mapping[str, Mapping[str, tuple[float, float]]]) -> list[str]:
    # A bias is that of one sensor since it was tared.
    names = dict.fromkeys(name for values in newest.values() for name in values if not name.startswith(BIAS))
    return [name for name in names if sum(name in values for values in newest.values()) >= _FEWEST_CELLS]


def _of_parameter(
    newest: Mapping[str, Mapping[str, tuple[float, float]]], name: str, limit: float
) -> Iterator[Unusual]:
    held = {cell: values[name] for cell, values in newest.items() if name in values}
    values = np.array([value for value, _ in held.values()])
    median = float(np.median(values))
    scale = _TO_STD * float(np.median(np.abs(values - median)))
    for cell, (value, std) in held.items():
        spread = math.hypot(scale, std)
        score = abs(value - median) / spread if spread > 0.0 else (math.inf if value != median else 0.0)
        if score > limit:
            yield Unusual(cell=cell, name=name, value=value, median=median, score=score)


def _together(newest: Mapping[str, Mapping[str, tuple[float, float]]]) -> Iterator[Unusual]:
    """Yield the cells that are unusual in the parameters that all cells have, together."""
    names = [name for name in _shared(newest) if all(name in values for values in newest.values())]
    cells = list(newest)
    # With fewer cells than that a covariance says nothing.
    if len(names) < 2 or len(cells) < _CELLS_PER_PARAMETER * len(names):
        return
    values = np.array([[newest[cell][name][0] for name in names] for cell in cells])
    own = np.array([[newest[cell][name][1] for name in names] for cell in cells])
    centre = np.median(values, axis=0)
    scale = np.maximum(_spread(values), np.median(own, axis=0))
    kept = scale > 0.0
    scaled, errors = ((values - centre) / scale)[:, kept], (own / scale)[:, kept]
    found = _distances(scaled, errors)
    _, limit = _limits(*scaled.shape)
    for cell, distance in zip(cells, found, strict=True):
        if distance > limit:
            yield Unusual(cell=cell, name="", value=float(distance), median=limit, score=float(distance))


def _distances(scaled: FloatArray, errors: FloatArray) -> FloatArray:
    """Return the squared distance (n,) of each row of (n, p), with its own deviations on top of the fleet's."""
    shared = _robust_covariance(scaled)
    apart = [row @ np.linalg.solve(shared + np.diag(error**2), row) for row, error in zip(scaled, errors, strict=True)]
    return np.array(apart)


@cache
def _limits(cells: int, parameters: int) -> tuple[float, float]:
    """Return the largest score of one parameter and the largest distance that 99 of 100 normal fleets stay below.

    From drawn fleets: quantiles of the normal and chi-square distributions would be far too small, since centre, scale
    and covariance of a few dozen cells are uncertain themselves.
    """
    random = np.random.default_rng(0)
    scores, distances = [], []
    for _ in range(_DRAWN_FLEETS):
        values = random.normal(size=(cells, parameters))
        values = (values - np.median(values, axis=0)) / _spread(values)
        scores.append(float(np.max(np.abs(values))))
        if cells >= _CELLS_PER_PARAMETER * parameters:
            distances.append(float(np.max(_distances(values, np.zeros_like(values)))))
    level = 1.0 - _UNUSUAL_FLEETS
    return float(np.quantile(scores, level)), float(np.quantile(distances, level)) if distances else np.inf


def _spread(values: FloatArray) -> FloatArray:
    middle = np.median(values, axis=0)
    return np.asarray(_TO_STD * np.median(np.abs(values - middle), axis=0))


def _robust_covariance(scaled: FloatArray) -> FloatArray:
    """Return a positive definite covariance (p, p) of the rows of (n, p), each column with a robust spread near 1."""
    count = scaled.shape[1]
    pairs = np.eye(count)
    for i, j in itertools.combinations(range(count), 2):
        plus, minus = _spread(np.stack([scaled[:, i] + scaled[:, j], scaled[:, i] - scaled[:, j]], axis=1))
        total = plus**2 + minus**2
        pairs[i, j] = pairs[j, i] = (plus**2 - minus**2) / total if total > 0.0 else 0.0
    _, turned = np.linalg.eigh(pairs)
    along = np.maximum(_spread(scaled @ turned), 0.1)
    return np.asarray((turned * along**2) @ turned.T)
