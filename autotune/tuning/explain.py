"""Say what holds the peak force up: the requirements and bounds that the design rests on, and their price."""

from dataclasses import dataclass, replace

from problems.design import DesignProblem

from .optimality import LINEAR_VARIABLES, Optimality

_PERCENT = 0.01


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


def explain(problem: DesignProblem, peak_n: float, optimality: Optimality) -> tuple[Active, ...]:
    """Return the active requirements and bounds, dearest first, by their multipliers at a design with this peak."""
    found = [
        Active(name=name, price_n=_PERCENT * _moved(problem, name) * multiplier * peak_n)
        for name, multiplier in optimality.multipliers.items()
    ]
    return tuple(sorted(found, key=lambda active: -active.price_n))


def _moved(problem: DesignProblem, name: str) -> float:
    """Return by how much u moves per share of the requirement or bound."""
    side, _, variable = name.partition(" bound of ")
    if variable not in LINEAR_VARIABLES:
        return 1.0
    low, high = problem.bounds[variable]
    return (low if side == "lower" else high) / (high - low)
