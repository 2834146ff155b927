"""Say what holds the peak force up: the requirements and bounds that the design rests on, and their price."""

from dataclasses import dataclass, replace

from problems.design import VARIABLES, DesignProblem
from problems.evaluation import build_scenarios

from .search import Search, SearchResult

_ACTIVE = 0.995


def relaxed(problem: DesignProblem, requirement: str, share: float) -> DesignProblem:
    """Return the problem with one requirement asked for less by `share`."""
    requirements = problem.requirements
    if requirement == "free_space_admittance":
        target = requirements.free_space_admittance
        if target is None:
            return problem
        eased = replace(target, min_m_s_per_n=target.min_m_s_per_n * (1.0 - share))
        return replace(problem, requirements=replace(requirements, free_space_admittance=eased))
    value = getattr(requirements, requirement)
    factor = 1.0 + share if requirement == "max_peak_force_n" else 1.0 - share
    return replace(problem, requirements=replace(requirements, **{requirement: value * factor}))


@dataclass(frozen=True, kw_only=True)
class Active:
    """A requirement or bound that the design rests on; `price_n` is what one percent of it costs in peak force."""

    name: str
    price_n: float


def explain(result: SearchResult) -> tuple[Active, ...]:
    """Return the active requirements and bounds, dearest first.

    Each active requirement is eased by one percent and the design polished again; each active bound is moved by one
    percent of its value.
    """
    problem, found = result.problem, []
    base = result.active.evaluate(result.design, peaks_if_missed=True).objective_n
    for name, value in result.evaluation.requirements.items():
        if value > _ACTIVE:
            found.append(Active(name=name, price_n=base - _eased_objective(result, relaxed(problem, name, 0.01))))
    for i, name in enumerate(VARIABLES):
        low, high = problem.bounds[name]
        for side, bound in (("lower", low), ("upper", high)):
            if high > low and abs(result.design[i] - bound) <= 1e-6 * (high - low):
                moved = (max(low * 0.99, 0.0), high) if side == "lower" else (low, high * 1.01)
                eased = replace(problem, bounds={**problem.bounds, name: moved})
                price = 0.0 if bound == 0.0 else base - _eased_objective(result, eased)
                found.append(Active(name=f"{side} bound of {name}", price_n=price))
    return tuple(sorted(found, key=lambda active: -active.price_n))


def _eased_objective(result: SearchResult, problem: DesignProblem) -> float:
    search = Search(problem, 0)
    prepared = build_scenarios(problem, result.active.scenarios)
    unit = search.box.unit(result.design)
    candidate = search.local(prepared, unit)
    evaluation = prepared.evaluate(search.box.design(candidate))
    unchanged = prepared.evaluate(result.design, peaks_if_missed=True).objective_n
    return min(evaluation.objective_n, unchanged) if evaluation.is_feasible else unchanged
