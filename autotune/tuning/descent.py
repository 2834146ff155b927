"""Descend from a point to the nearest optimum: sequential quadratic programming on the compiled screen."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from problems.design.batch_evaluation import BatchEvaluator
from problems.frozen import FrozenDict

from .bounds import Box

FloatArray = NDArray[np.float64]

BACKOFF = 2e-5
"""The share of every requirement that is kept in hand, for what a step along a curved limit misses."""
_STEP = 1e-6
# A descent that takes more is on a kink of a margin, where every further step is dear and small.
_ITERATIONS = 12
_TOLERANCE = 1e-8
_WALL = 1e3
_NONE: Mapping[str, float] = FrozenDict({})


@dataclass(frozen=True, kw_only=True)
class Descent:
    """Where a descent ended, a point (n,) of the unit cube, and how many designs it evaluated."""

    unit: FloatArray
    evaluations: int


def descend(
    screen: BatchEvaluator,
    box: Box,
    start: FloatArray,
    *,
    backoff: Mapping[str, float] = _NONE,
    reserve: float = BACKOFF,
) -> Descent:
    """Lower t, which no scenario's peak may exceed, while every margin keeps its limit, from a point (n,) on.

    By e_j ≥ 0 a soft requirement j may be missed, which costs its price times e_j. `backoff` is the share by which
    more is asked of a requirement, `reserve` what is kept in hand of each. Where the descent ends it may still miss
    something: that is for the caller to see.
    """
    wishes = screen.prepared.problem.requirements.soft_n if screen.goal is None else {}
    prices, count = np.array(list(wishes.values()), dtype=np.float64), len(start)
    around = _Around(screen, box, backoff, reserve, np.asarray(start))
    first, spares = around.values(np.asarray(start)), around.spares
    costs = np.concatenate([np.zeros(count), [1.0], prices / around.scale])

    def slack(x: FloatArray) -> FloatArray:
        here = around.values(x[:count])
        return np.concatenate([x[count] - here.peaks, here.slack + spares @ x[count + 1 :]])

    def slack_gradients(x: FloatArray) -> FloatArray:
        here = around.gradients(x[:count])
        rising, still = np.ones((len(here.peaks), 1)), np.zeros((len(here.slack), 1))
        return np.block([[-here.peaks, rising, np.zeros((len(rising), len(prices)))], [here.slack, still, spares]])

    missed = np.max(spares * -first.slack[:, None], axis=0, initial=0.0)
    found = minimize(
        lambda x: costs @ x,
        np.concatenate([start, [np.max(first.peaks)], missed]),
        jac=lambda _: costs,
        method="SLSQP",
        bounds=[*[(0.0, 1.0)] * count, *[(0.0, None)] * (1 + len(prices))],
        constraints=[{"type": "ineq", "fun": slack, "jac": slack_gradients}],
        options={"maxiter": _ITERATIONS, "ftol": _TOLERANCE},
    )
    return Descent(unit=np.asarray(np.clip(found.x[:count], 0.0, 1.0)), evaluations=around.evaluations)


@dataclass(frozen=True, kw_only=True)
class _Standing:
    """Peaks (s,) in units of the first one and slack (k,), or their gradients (s, n) and (k, n)."""

    peaks: FloatArray
    slack: FloatArray


class _Around:
    """What a descent asks of points: each is evaluated once, its neighbours only where the way goes on.

    `scale` is the largest peak [N] at the start; `spares` (k, j) marks which rows of slack may be missed at a price,
    and by which of j soft requirements.
    """

    def __init__(
        self, screen: BatchEvaluator, box: Box, backoff: Mapping[str, float], reserve: float, start: FloatArray
    ) -> None:
        self.screen, self.box, self.backoff, self.reserve = screen, box, backoff, reserve
        self.evaluations, self.scale, self.spares = 0, 1.0, np.zeros((0, 0))
        highest = float(np.max(self._look(start[None])[0].peaks))
        self.scale = highest if np.isfinite(highest) else 1.0
        self._values: dict[bytes, _Standing] = {}
        self._gradients: dict[bytes, _Standing] = {}

    def values(self, unit: FloatArray) -> _Standing:
        """Return peaks and slack at a point (n,)."""
        key = unit.tobytes()
        if key not in self._values:
            self._values[key] = self._look(unit[None])[0]
        return self._values[key]

    def gradients(self, unit: FloatArray) -> _Standing:
        """Return forward differences at a point (n,), backward ones at an upper bound."""
        key = unit.tobytes()
        if key not in self._gradients:
            here, steps = self.values(unit), np.where(unit + _STEP <= 1.0, _STEP, -_STEP)
            there = self._look(unit + np.diag(steps))
            self._gradients[key] = _Standing(
                peaks=np.column_stack([each.peaks - here.peaks for each in there]) / steps,
                slack=np.column_stack([each.slack - here.slack for each in there]) / steps,
            )
        return self._gradients[key]

    def _look(self, units: FloatArray) -> list[_Standing]:
        """Evaluate points (m, n); an unstable one is a plain wall to the line search."""
        found = self.screen.evaluate(self.box.design(units), peaks_if_missed=True)
        self.evaluations += len(units)
        stable = found.is_stable[:, None]
        rows = [1.0 - value * (1.0 + self.backoff.get(name, 0.0)) for name, value in found.rows.items()]
        rows += [1.0 - value for value in found.soft_rows.values()]
        slack = np.hstack([np.zeros((len(units), 0)), *rows])
        owners = np.repeat(np.arange(len(rows)), [row.shape[1] for row in rows]) - len(found.rows)
        self.spares = (owners[:, None] == np.arange(len(found.soft_rows))).astype(np.float64)
        peaks = np.where(stable, found.peaks_n / self.scale, _WALL)
        slack = np.where(stable, np.clip(slack, -_WALL, 1.0) - self.reserve * (owners < 0), -1.0)
        return [_Standing(peaks=p, slack=s) for p, s in zip(peaks, slack, strict=True)]
