"""What an evaluation of many designs says of each: required/achieved, costs, and where they were found."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from ..arrays import BoolArray, FloatArray, IntArray
from .requirements import Requirements

EVERY_REQUIREMENT = "all requirements"
"""The goal that combines all requirements: the worst required/achieved of any."""


@dataclass(frozen=True, kw_only=True)
class Places:
    """Where the margins and peaks of designs (m,) were found.

    `margins` (m, p, MARGINS) and `peaks` (m, s, PEAK_COLUMNS) as `evaluate_designs` writes them; `hands` (m, p) and
    `held` (m, p, HELD_COLUMNS) are the hand of the least modulus on each plant and what `find_moduli` writes of it, NaN
    where none was looked at.
    """

    margins: FloatArray
    peaks: FloatArray
    hands: IntArray
    held: FloatArray

    @property
    def are_known(self) -> BoolArray:
        """Whether margins and peaks of designs (m,) are known by a place: some are read at no crossover."""
        return np.asarray(~np.isnan(self.margins).any(axis=(1, 2)) & ~np.isnan(self.peaks).any(axis=(1, 2)))


@dataclass(frozen=True, kw_only=True)
class BatchEvaluation:
    """Designs (m,): `radius` of the first plant found unstable, 0 where all are stable.

    `rows` maps each requirement to required/achieved (m, k), plant by plant or scenario by scenario as it depends on
    them: each column is smooth in the design, their maximum is not. NaN where unstable, 0 where not evaluated because
    something is missed. `objective_rows` (m, s) are the costs of the objective, infinite where not evaluated.
    `soft_rows` are those of `asked` that need not be met. `places` says where all that was found.
    """

    radius: FloatArray
    rows: Mapping[str, FloatArray]
    objective_rows: FloatArray
    soft_rows: Mapping[str, FloatArray]
    asked: Requirements
    places: Places

    def towards(self, goal: str) -> "BatchEvaluation":
        """Return the same with one requirement, or `EVERY_REQUIREMENT`, in place of the objective and soft ones."""
        rows = dict(self.rows)
        if goal == EVERY_REQUIREMENT:
            sought, rows = np.hstack([np.zeros((len(self.radius), 1)), *rows.values()]), {}
        else:
            sought = rows.pop(goal)
        costs = np.where(self.is_stable[:, None], sought, np.inf)
        return replace(self, rows=rows, objective_rows=costs, soft_rows={})

    @property
    def is_stable(self) -> BoolArray:
        """Which designs are stable in every scenario."""
        return self.radius < 1.0

    @property
    def requirements(self) -> Mapping[str, FloatArray]:
        """Required/achieved (m,), the worst of all scenarios."""
        return {name: np.max(value, axis=1) for name, value in self.rows.items()}

    @property
    def cost(self) -> FloatArray:
        """The objective's largest cost (m,), and what missed soft requirements add to it."""
        return np.asarray(np.max(self.objective_rows, axis=1)) + self.penalty_n

    @property
    def penalty_n(self) -> FloatArray:
        """What missed soft requirements cost (m,)."""
        cost = np.zeros(len(self.radius))
        for name, row in self.soft_rows.items():
            cost += [self.asked.cost_n(name, float(ratio)) for ratio in np.max(row, axis=1)]
        return cost

    @property
    def violation(self) -> FloatArray:
        """By how much the worst requirement is missed: 0 where feasible, infinite where unstable."""
        if not self.rows:
            return np.where(self.is_stable, 0.0, np.inf)
        worst = np.max(list(self.requirements.values()), axis=0)
        missed = np.minimum(np.maximum(worst - 1.0, 0.0), np.finfo(np.float64).max)
        return np.where(self.is_stable & ~np.isnan(worst), missed, np.inf)
