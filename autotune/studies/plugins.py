"""Objectives and requirements as small classes found by entry points, the built-in ones like anyone's."""

import math
from dataclasses import dataclass

from autotune.errors import UsageError
from autotune.plugins import OBJECTIVES, REQUIREMENTS, load_objective, load_plugin, registered
from problems.design.evaluation import CustomObjective, CustomRequirement
from problems.design.objectives import Direction
from problems.design.objectives import Objective as AnyObjective
from problems.design.problem import DesignProblem
from problems.design.stable_design import StableDesign
from problems.errors import shown

Requirement = CustomRequirement
"""One thing that a controller must meet, as required/achieved: ≤ 1 is met. A subclass says its `name`."""
Objective = CustomObjective
"""One number of a controller that should be small or large. A subclass says its `name`, `unit` and `direction`."""


@dataclass(frozen=True, kw_only=True)
class ObjectiveLimit:
    """An objective held to a limit, in its unit: at most `value` where less is better, else at least."""

    objective: AnyObjective
    value: float

    @property
    def name(self) -> str:
        """The name under which the requirement is reported."""
        return f"{self.objective.name}_limit"

    def ratio(self, problem: DesignProblem, design: StableDesign) -> float:
        """Return required/achieved, ≤ 1 is met."""
        found = self.objective.beside(problem.objective).worst(problem.requirements, design)
        share = (self.value, found) if self.objective.direction == "maximize" else (found, self.value)
        return share[0] / share[1] if share[1] > 0.0 else math.inf


Demand = Requirement | ObjectiveLimit


def load_objectives(names: tuple[str, ...]) -> tuple[AnyObjective, ...]:
    """Return the objectives of these names, in this order; raises UsageError, see `load_objective`."""
    if len(set(names)) != len(names):
        raise UsageError(f"Each objective may be named once; found {', '.join(names)}.")
    return tuple(load_objective(name) for name in names)


def load_demands(texts: tuple[str, ...]) -> tuple[Demand, ...]:
    """Return the demands that `NAME` (a requirement) and `NAME=LIMIT` (an objective with its limit) mean.

    Raises UsageError for an unknown name, a limit that is no positive number, or the same name twice.
    """
    demands = tuple(_demand(text) for text in texts)
    names = [demand.name for demand in demands]
    if len(set(names)) != len(names):
        raise UsageError(f"Each requirement may be named once; found {', '.join(names)}.")
    return demands


def _demand(text: str) -> Demand:
    name, equals, number = text.partition("=")
    if not equals:
        return load_requirement(name)
    objective = load_objective(name)
    try:
        value = float(number)
    except ValueError:
        value = math.nan
    if not 0.0 < value < math.inf:
        raise UsageError(f"The limit of {name} must be a finite number above 0, found {shown(number)}.")
    return ObjectiveLimit(objective=objective, value=value)


def load_requirement(name: str) -> Requirement:
    """Import and make the requirement of this name; raises UsageError as `load_objective` does."""
    found: Requirement = load_plugin(REQUIREMENTS, name, Requirement)
    return found


__all__ = [
    "OBJECTIVES",
    "REQUIREMENTS",
    "Demand",
    "Direction",
    "Objective",
    "ObjectiveLimit",
    "Requirement",
    "load_demands",
    "load_objective",
    "load_objectives",
    "load_requirement",
    "registered",
]
