"""Say what holds the peak force up: the requirements and bounds that the design rests on, and their price."""

from dataclasses import dataclass, replace

from problems.design.problem import DesignProblem

from .bounds import LINEAR_VARIABLES
from .optimality import Optimality

_PERCENT = 0.01


def relaxed(problem: DesignProblem, requirement: str, share: float) -> DesignProblem:
    """Return the problem with one requirement asked for less by `share`."""
    if requirement not in problem.requirements.asked():
        return problem
    return replace(problem, requirements=problem.requirements.relaxed(requirement, share))


@dataclass(frozen=True, kw_only=True)
class Active:
    """A requirement or bound that the design rests on; `price_n` is what one percent of it costs in peak force.

    `soft` tells a requirement that may be missed at a price: then that is counted in.
    """

    name: str
    price_n: float
    soft: bool = False


def explain(problem: DesignProblem, peak_n: float, optimality: Optimality) -> tuple[Active, ...]:
    """Return the active requirements and bounds, dearest first, by their multipliers at a design with this peak."""
    found = [
        Active(
            name=name,
            price_n=_PERCENT * _moved(problem, name) * multiplier * peak_n,
            soft=name in problem.requirements.soft_n,
        )
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
