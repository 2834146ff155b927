"""Report what a design meets, how well it meets the conditions of an optimum, and its gap to a reference."""

import math
from dataclasses import dataclass
from typing import Any

from .explain import Active, explain
from .multistart import Reference, find_reference
from .optimality import Optimality, check_optimality
from .search import SearchResult

# Below these a number is rounding only.
_LEAST_RESIDUAL, _LEAST_SHARE, _LEAST_PRICE = 1e-6, 1e-5, 1e-6


@dataclass(frozen=True, kw_only=True)
class OptimalityReport:
    """What is recomputed of one axis's design as it is written.

    `objective_n` is the worst peak with the price of missed soft requirements (N, or N·m); `nearest` the hard
    requirement nearest to its limit, None without any, and `ratio` its required/achieved over `scenario_count`
    scenarios; `active` what the design rests on, with prices.
    """

    objective_n: float
    nearest: str | None
    ratio: float
    scenario_count: int
    optimality: Optimality
    reference: Reference
    active: tuple[Active, ...]

    @property
    def is_feasible(self) -> bool:
        """Whether every requirement is met."""
        return self.ratio <= 1.0

    @property
    def gap(self) -> float:
        """The share by which the objective lies above the least that was found where less is asked."""
        return self.reference.gap(self.objective_n)


def report_optimality(search: SearchResult) -> OptimalityReport:
    """Recompute feasibility, the conditions of an optimum and the gap of a search's result."""
    optimality = check_optimality(search.active, search.design)
    ratios = search.evaluation.requirements
    nearest = max(ratios, key=lambda name: ratios[name]) if ratios else None
    return OptimalityReport(
        objective_n=search.evaluation.objective_n,
        nearest=nearest,
        ratio=0.0 if nearest is None else ratios[nearest],
        scenario_count=search.scenario_count,
        optimality=optimality,
        reference=find_reference(search),
        active=explain(search.problem, search.evaluation.peak_n, optimality),
    )


def optimality_tree(report: OptimalityReport, *, rotational: bool) -> dict[str, Any]:
    """Return the plain tree of a report, for `controller.yaml`; forces in N, on a rotational axis in N·m.

    Rounded upwards to the digits that mean something: a residual of 3e-12 and one of 5e-12 are both at most 1e-6.
    """
    unit = "n_m" if rotational else "n"
    reference, elsewhere = report.reference, report.reference.elsewhere_n
    return {
        "feasible": report.is_feasible,
        "scenarios": report.scenario_count,
        "nearest_requirement": report.nearest,
        "required_per_achieved": _digits(report.ratio, 6),
        "kkt_residual": _upwards(report.optimality.relative_residual, _LEAST_RESIDUAL),
        "unused_slack": _upwards(report.optimality.slack, _LEAST_SHARE),
        "gap": _upwards(report.gap, _LEAST_SHARE),
        "gap_against": {
            f"least_{unit}": _digits(reference.least_n, 5),
            f"from_elsewhere_{unit}": _digits(elsewhere, 5) if math.isfinite(elsewhere) else None,
            "scenarios": reference.scenarios,
            "designs": reference.designs,
            "descents": reference.descents,
            "arrived": reference.arrived,
        },
        "active": [
            {
                "name": each.name,
                f"price_{unit}_per_percent": _digits(each.price_n, 3) if each.price_n > _LEAST_PRICE else 0.0,
                **({"soft": True} if each.soft else {}),
            }
            for each in report.active
        ],
    }


def _digits(value: float, count: int) -> float:
    return float(f"{value:.{count}g}")


def _upwards(value: float, least: float) -> float:
    """Return at least `least`, with two digits, no smaller than the value."""
    raised = max(value, least)
    unit = 10.0 ** (math.floor(math.log10(raised)) - 1)
    return _digits(math.ceil(raised / unit * (1.0 - 1e-12)) * unit, 2)
