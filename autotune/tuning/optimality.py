"""Is the design optimal, and what does each requirement cost: the Karush–Kuhn–Tucker conditions at the result.

In u (variables that may be zero by the width of their bounds, the others by their logarithm) the search minimises the
largest φ_s = ln F_s of the objective's costs F_s under c_j = ln(required/achieved) ≤ 0. At an optimum some λ_s ≥ 0 of
sum 1, μ_j ≥ 0 and ν_b ≥ 0 balance Σ λ_s ∇φ_s + Σ μ_j ∇c_j + Σ ν_b n_b = 0 over what is active; what is left of that
sum is the residual, and Σ λ_s (φ − φ_s) + Σ μ_j |c_j| is what the design could still gain, to first order, by using up
its slack. μ_j is the share by which the cost grows when requirement j is raised by one share. A soft requirement that
is missed, with the price p and the ratio r = e^c, has multipliers of the sum p r/F: what missing it costs; just met, at
most that.
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from scipy.optimize import nnls

from problems.arrays import FloatArray
from problems.design.evaluation import PreparedScenarios
from problems.design.problem import CONTROLLER_VARIABLES, DesignProblem
from problems.design.requirements import LARGEST_SHARE
from problems.design.stable_design import Gradient, StableDesign
from problems.model.controller import AdmittanceController

from .bounds import bounds_of, linear_variables

Key = tuple[str, int]

OBJECTIVE = "objective"
_NEAR = 2e-3
_AGREES = 2e-3
_STEP = 1e-5
_SUM_WEIGHT = 1e3
_AT_BOUND = 1e-6
LEAST_RATIO = 1e-100


@dataclass(frozen=True, kw_only=True)
class Row:
    """A cost of the objective or a requirement near its limit: its logarithm and the gradient of that by u, (n,).

    `is_exact` where the symbolic derivative was taken, else central differences of the simulation.
    """

    name: str
    value: float
    gradient: FloatArray
    is_exact: bool


@dataclass(frozen=True, kw_only=True)
class Optimality:
    """How the conditions hold: `residual` of the balance beside `gradient`, the largest ∇φ_s of an active scenario.

    `multipliers` are those of requirements and of bounds ("lower bound of mass"), by name, the largest first;
    `scenarios` how many costs are at the top together; `exact_share` of the gradients that are symbolic; `slack` the
    share of the cost that using up what the active ones leave could still save.
    """

    residual: float
    gradient: float
    multipliers: dict[str, float]
    scenarios: int
    exact_share: float
    slack: float

    @property
    def relative_residual(self) -> float:
        """The residual as a share of the gradient; 0 where the cost does not depend on the design at all."""
        return self.residual / self.gradient if self.gradient > 0.0 else 0.0


def check_optimality(prepared: PreparedScenarios, design: FloatArray) -> Optimality:
    """Check the conditions at a stable design (n,) over prepared scenarios."""
    costs, limits = active_rows(prepared, design)
    count, bounds = len(design), dict(_active_bounds(prepared.problem, design))
    top = [row for row in costs if row.value >= max(row.value for row in costs) - _NEAR]
    prices = _prices(prepared.problem, top, limits)
    columns = [row.gradient for row in top] + [row.gradient for row in limits] + list(bounds.values())
    # What is just met need not take its whole price: the rest goes to a column without gradient.
    spare = [name for name, (_, _, is_missed) in prices.items() if not is_missed]
    columns += [np.zeros(count)] * len(spare)
    left = [max(row.value for row in top) - row.value for row in top]
    left += [(prices[row.name][1] if row.name in prices else 0.0) - row.value for row in limits]
    slack = np.maximum([*left, *[0.0] * (len(bounds) + len(spare))], 0.0)
    # λ sum to one, those of a soft requirement to its price: rows so heavy that the sums are met to rounding. Of many
    # active rows those without slack.
    groups = [*[OBJECTIVE] * len(top), *(row.name for row in limits), *bounds, *spare]
    sums = {OBJECTIVE: 1.0, **{name: price for name, (price, _, _) in prices.items()}}
    heavy = [[_SUM_WEIGHT * (group == name) for group in groups] for name in sums]
    matrix = np.vstack([np.column_stack(columns), slack, heavy])
    weights, _ = nnls(matrix, np.concatenate([np.zeros(count + 1), _SUM_WEIGHT * np.array(list(sums.values()))]))
    balance = matrix[:count] @ weights
    merged: dict[str, float] = {}
    for name, weight in list(zip(groups, weights, strict=True))[len(top) : len(groups) - len(spare)]:
        merged[name] = merged.get(name, 0.0) + float(weight)
    exact = [row.is_exact for row in (*top, *limits)]
    return Optimality(
        residual=float(np.linalg.norm(balance)),
        gradient=max(float(np.linalg.norm(row.gradient)) for row in top),
        multipliers=dict(sorted(merged.items(), key=lambda pair: -pair[1])),
        scenarios=len(top),
        exact_share=float(np.mean(exact)),
        slack=float(slack @ weights),
    )


def _prices(problem: DesignProblem, top: list[Row], limits: tuple[Row, ...]) -> dict[str, tuple[float, float, bool]]:
    """Return for each active soft requirement p r/F, its largest c, and whether it is missed by more than a hair."""
    cost, found = math.exp(max(row.value for row in top)), {}
    for name, price in problem.requirements.soft_n.items():
        worst = max((row.value for row in limits if row.name == name), default=None)
        if worst is not None:
            ratio = math.exp(min(worst, math.log(LARGEST_SHARE)))
            found[name] = (price * ratio / cost, max(worst, 0.0), worst > _NEAR)
    return found


def active_rows(
    prepared: PreparedScenarios, design: FloatArray, near: float = _NEAR
) -> tuple[tuple[Row, ...], tuple[Row, ...]]:
    """Return the costs within `near` of the largest one, and the requirements within `near` of their limit.

    Of a soft requirement that is missed those within `near` of the worst.
    """
    rows = {key: row_at(prepared, design, key) for key in near_keys(prepared, design, near)}
    costs = tuple(row for (name, _), row in rows.items() if name == OBJECTIVE)
    return costs, tuple(row for (name, _), row in rows.items() if name != OBJECTIVE)


def near_keys(prepared: PreparedScenarios, design: FloatArray, near: float) -> tuple[Key, ...]:
    """Return which costs lie within `near` of the largest one, then which requirements of their limit or worst.

    A key is a name and the index of a scenario, of a plant, or 0.
    """
    problem, stable = prepared.problem, StableDesign(prepared, prepared.problem.controller(design))
    asked = problem.requirements
    values = problem.objective.costs(asked, stable)
    keys = [(OBJECTIVE, int(i)) for i in np.flatnonzero(np.log(values) >= math.log(float(np.max(values))) - near)]
    for requirement, value in asked.of("loop", "robot", "contact"):
        name = requirement.name
        logs = np.log(np.clip(requirement.ratios(value, stable), LEAST_RATIO, LARGEST_SHARE))
        limit = max(0.0, float(np.max(logs))) if name in asked.soft_n else 0.0
        keys += [(name, int(i)) for i in np.flatnonzero(logs >= limit - near)]
    return tuple(keys)


def row_at(prepared: PreparedScenarios, design: FloatArray, key: Key) -> Row:
    """Return value and gradient of one cost or requirement, named by `near_keys`, at a stable design (n,)."""
    problem, (name, index) = prepared.problem, key
    if name == OBJECTIVE:
        objective, of = problem.objective, problem.requirements
        return _row(
            prepared,
            design,
            name,
            lambda stable: objective.achieved(of, stable, index),
            lambda stable: objective.gradient(of, stable, index),
            lambda achieved: math.log(objective.value(achieved)),
            sign=1.0 if objective.direction == "minimize" else -1.0,
        )
    requirement, asked = problem.requirements.kind(name), problem.requirements.asked()[name]
    return _row(
        prepared,
        design,
        name,
        lambda stable: requirement.achieved(asked, stable, index),
        lambda stable: requirement.gradient(asked, stable, index),
        lambda achieved: math.log(min(max(requirement.ratio(asked, achieved), LEAST_RATIO), LARGEST_SHARE)),
        sign=1.0 if requirement.is_upper_limit else -1.0,
    )


def _row(
    prepared: PreparedScenarios,
    design: FloatArray,
    name: str,
    achieved: Callable[[StableDesign], float],
    gradient: Callable[[StableDesign], Gradient | None],
    logarithm: Callable[[float], float],
    sign: float = 1.0,
) -> Row:
    """Return the logarithm of what is achieved, which grows with it or falls (`sign`), and its gradient by u.

    The gradient is the exact one where that is of this very number: the payload may have left before, a force creep up
    to its rest, or another extremum be meant. Else central differences.
    """
    problem, widths = prepared.problem, unit_widths(prepared.problem, design)
    stable = StableDesign(prepared, problem.controller(design))
    value = achieved(stable)
    found = gradient(stable) if _moves_exactly(problem, stable.controller) else None
    if found is not None and abs(found.value - value) <= _AGREES * value:
        free = [CONTROLLER_VARIABLES.index(each) for each in problem.variables]
        by_u = sign * found.by_controller[free] * widths / found.value
        return Row(name=name, value=logarithm(found.value), gradient=by_u, is_exact=True)

    def log_of(moved: FloatArray) -> float:
        return logarithm(achieved(StableDesign(prepared, problem.controller(moved))))

    return Row(name=name, value=logarithm(value), gradient=_differences(log_of, design, widths), is_exact=False)


def unit_widths(problem: DesignProblem, design: FloatArray) -> FloatArray:
    """Return dx/du of every variable (n,): itself where u is a logarithm, else the width of the bounds.

    A variable that its bounds fix does not move: 0.
    """
    bounds = bounds_of(problem)
    width = bounds[:, 1] - bounds[:, 0]
    return np.where(width > 0.0, np.where(linear_variables(problem), width, design), 0.0)


def _moves_exactly(problem: DesignProblem, controller: AdmittanceController) -> bool:
    """Whether the symbolic form has every variable: without compensation it leaves P̂ out."""
    return controller.compensates or "compensation_mass_kg" not in problem.variables


def _differences(value: Callable[[FloatArray], float], design: FloatArray, widths: FloatArray) -> FloatArray:
    """Return central differences by u, one-sided where a parameter would become negative."""
    gradient = np.zeros(len(design))
    for i in np.flatnonzero(widths > 0.0):
        step = np.zeros(len(design))
        step[i] = _STEP * widths[i]
        up, down = design + step, np.maximum(design - step, 0.0)
        gradient[i] = (value(up) - value(down)) * widths[i] / (up[i] - down[i])
    return gradient


def _active_bounds(problem: DesignProblem, design: FloatArray) -> Iterator[tuple[str, FloatArray]]:
    """Yield the bounds that the design lies on, with the outward direction in u."""
    for i, name in enumerate(problem.variables):
        low, high = problem.bounds[name]
        for side, bound, sign in (("lower", low, -1.0), ("upper", high, 1.0)):
            if high > low and abs(design[i] - bound) <= _AT_BOUND * (high - low):
                normal = np.zeros(len(design))
                normal[i] = sign
                yield f"{side} bound of {name}", normal
