"""Report what a design meets, how well it meets the conditions of an optimum, and its gap to a reference.

The reference is the least cost that descents from elsewhere find where less is asked: of all scenarios only those count
that the search ended with, and nothing is kept in reserve. Whatever is best for the whole uncertainty is allowed there
too, so the best design there is at least as low: a lower bound, as far as the descents find it. They start from the
best of a Sobol' sequence over the bounds, of which the search knows nothing, and from the design itself.
"""

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from problems.arrays import FloatArray
from problems.design.batch_evaluation import build_batch_evaluator
from problems.design.batch_result import BatchEvaluation
from problems.design.objectives import Objective, PeakObjective
from problems.design.problem import DesignProblem
from problems.sobol import sobol_points

from .bounds import LINEAR_VARIABLES, Box, spread_out
from .descent import descend
from .optimality import Optimality, check_optimality
from .search import SearchResult

# Below these a number is rounding only.
_LEAST_RESIDUAL, _LEAST_SHARE, _LEAST_PRICE = 1e-6, 1e-5, 1e-6
_LOG2_OF_DESIGNS = 7
_DESCENTS = 4
_APART = 0.3
# What a descent that keeps nothing in reserve misses by its last step; a lower bound may.
_HAIR = 1e-4
_SAME = 1e-3
_MISSED, _UNSTABLE = 1e12, 1e15
_PERCENT = 0.01


@dataclass(frozen=True, kw_only=True)
class Reference:
    """What was found over `scenarios`, the hardest of all, with nothing in reserve, and where it was looked for.

    `elsewhere` is the least cost of the `descents` from the best of `designs` spread over the bounds,
    infinite where none of them met the requirements; `arrived` is how many of them ended within 0.1 % of the least;
    `from_here` is that of the descent from the design itself, `design` (n,) the one of the least cost.
    """

    elsewhere: float
    from_here: float
    designs: int
    descents: int
    arrived: int
    scenarios: int
    design: FloatArray = field(default_factory=lambda: np.zeros(0), compare=False)

    @property
    def least(self) -> float:
        """The lower of both."""
        return min(self.elsewhere, self.from_here)

    def gap(self, cost: float) -> float:
        """Return the share by which a cost lies above the least that was found, at least 0."""
        return max(cost / self.least - 1.0, 0.0)


@dataclass(frozen=True, kw_only=True)
class ActiveConstraint:
    """A requirement or bound that the design rests on; `price` is what one percent of it costs.

    The price is in the unit of the objective.

    `soft` is a requirement that may be missed at a price: then that is counted in.
    """

    name: str
    price: float
    soft: bool = False


@dataclass(frozen=True, kw_only=True)
class OptimalityReport:
    """What is recomputed of one axis's design as it is written.

    `cost` is the objective's with the price of missed soft requirements; `nearest` the hard requirement nearest to its
    limit, None without any, and `ratio` its required/achieved over `scenario_count` scenarios; `active` what the design
    rests on, with prices.
    """

    objective: Objective
    cost: float
    nearest: str | None
    ratio: float
    scenario_count: int
    optimality: Optimality
    reference: Reference
    active: tuple[ActiveConstraint, ...]

    @property
    def is_feasible(self) -> bool:
        """Whether every requirement is met."""
        return self.ratio <= 1.0

    @property
    def gap(self) -> float:
        """The share by which the cost lies above the least that was found where less is asked."""
        return self.reference.gap(self.cost)

    def shown(self, cost: float, digits: int = 5) -> float | None:
        """Return the objective's value at a cost, in so many digits; None of an infinite cost."""
        return _digits(float(self.objective.value(cost)), digits) if math.isfinite(cost) else None


def report_optimality(search: SearchResult) -> OptimalityReport:
    """Recompute feasibility, the conditions of an optimum and the gap of a search's result."""
    optimality = check_optimality(search.active, search.design)
    ratios = search.evaluation.requirements
    nearest = max(ratios, key=lambda name: ratios[name]) if ratios else None
    return OptimalityReport(
        objective=search.problem.objective,
        cost=search.evaluation.cost,
        nearest=nearest,
        ratio=0.0 if nearest is None else ratios[nearest],
        scenario_count=search.scenario_count,
        optimality=optimality,
        reference=find_reference(search),
        active=active_constraints(search.problem, search.evaluation.objective_cost, optimality),
    )


def optimality_tree(report: OptimalityReport, *, rotational: bool) -> dict[str, Any]:
    """Return the plain tree of a report, for `controller.yaml`; forces in N, on a rotational axis in N·m.

    Another objective than a peak force is named, with its unit. Rounded upwards to the digits that mean something: a
    residual of 3e-12 and one of 5e-12 are both at most 1e-6.
    """
    reference, objective = report.reference, report.objective
    is_force = isinstance(objective, PeakObjective)
    best = f"least{force_suffix(objective, rotational=rotational)}" if is_force else "best"
    return {
        **({} if is_force else {"objective": objective.tree(turning=rotational)}),
        "feasible": report.is_feasible,
        "scenarios": report.scenario_count,
        "nearest_requirement": report.nearest,
        "required_per_achieved": _digits(report.ratio, 6),
        "kkt_residual": _upwards(report.optimality.relative_residual, _LEAST_RESIDUAL),
        "unused_slack": _upwards(report.optimality.slack, _LEAST_SHARE),
        "gap": _upwards(report.gap, _LEAST_SHARE),
        "gap_against": {
            best: report.shown(reference.least),
            f"from_elsewhere{force_suffix(objective, rotational=rotational)}": report.shown(reference.elsewhere),
            "scenarios": reference.scenarios,
            "designs": reference.designs,
            "descents": reference.descents,
            "arrived": reference.arrived,
        },
        "active": [
            {
                "name": each.name,
                price_key(objective, rotational=rotational): _digits(each.price, 3)
                if each.price > _LEAST_PRICE
                else 0.0,
                **({"soft": True} if each.soft else {}),
            }
            for each in report.active
        ],
    }


def force_suffix(objective: Objective, *, rotational: bool) -> str:
    """Return what the names of an objective's numbers end in: the unit of a force, else nothing."""
    if not isinstance(objective, PeakObjective):
        return ""
    return "_n_m" if rotational else "_n"


def price_key(objective: Objective, *, rotational: bool) -> str:
    """Return the name of a price in the file and in `--json`."""
    return f"price{force_suffix(objective, rotational=rotational)}_per_percent"


def _digits(value: float, count: int) -> float:
    return float(f"{value:.{count}g}")


def _upwards(value: float, least: float) -> float:
    """Return at least `least`, with two digits, no smaller than the value."""
    raised = max(value, least)
    unit = 10.0 ** (math.floor(math.log10(raised)) - 1)
    return _digits(math.ceil(raised / unit * (1.0 - 1e-12)) * unit, 2)


def find_reference(search: SearchResult) -> Reference:
    """Look for a better design than the search's, where less is asked; the same for the same search."""
    problem, screen, box = search.problem, build_batch_evaluator(search.active), Box(search.problem)
    units = sobol_points(len(problem.variables), 2**_LOG2_OF_DESIGNS, seed=None)
    order = np.argsort(_costs(screen.evaluate(box.design(units))), kind="stable")
    starts = spread_out(units[order], _APART, _DESCENTS)
    ends = [descend(screen, box, start, reserve=0.0).unit for start in (box.unit(search.design), *starts)]
    found = screen.evaluate(box.design(np.array(ends)), peaks_if_missed=True)
    values = np.where(found.violation <= _HAIR, found.cost, np.inf)
    # The design itself is allowed here: a descent from it that went astray is no worse.
    here, elsewhere = min(float(values[0]), search.evaluation.cost), values[1:]
    least = min(here, float(np.min(elsewhere)))
    return Reference(
        elsewhere=float(np.min(elsewhere)),
        from_here=here,
        designs=len(units),
        descents=len(starts),
        arrived=int(np.sum(elsewhere <= (1.0 + _SAME) * least)),
        scenarios=len(search.active.scenarios),
        design=box.design(ends[int(np.argmin(values))]) if float(np.min(values)) < here else search.design,
    )


def _costs(found: BatchEvaluation) -> FloatArray:
    """Order designs (m,): feasible ones by their cost, before the others by what they miss, before unstable ones."""
    with np.errstate(invalid="ignore"):
        judged = np.where(found.violation > 0.0, _MISSED * (1.0 + np.minimum(found.violation, 500.0)), found.cost)
    return np.where(found.is_stable, judged, _UNSTABLE * found.radius)


def active_constraints(problem: DesignProblem, cost: float, optimality: Optimality) -> tuple[ActiveConstraint, ...]:
    """Return the active requirements and bounds, dearest first, by their multipliers at a design of this cost."""
    value = float(problem.objective.value(cost))
    found = [
        ActiveConstraint(
            name=name,
            price=_PERCENT * _moved(problem, name) * multiplier * value,
            soft=name in problem.requirements.soft_n,
        )
        for name, multiplier in optimality.multipliers.items()
    ]
    return tuple(sorted(found, key=lambda active: -active.price))


def _moved(problem: DesignProblem, name: str) -> float:
    """Return by how much u moves per share of the requirement or bound."""
    side, _, variable = name.partition(" bound of ")
    if variable not in LINEAR_VARIABLES:
        return 1.0
    low, high = problem.bounds[variable]
    return (low if side == "lower" else high) / (high - low)
