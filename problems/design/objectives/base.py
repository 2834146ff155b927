"""What an objective is: one number of a stable design that should be small, or large."""

from abc import ABC, abstractmethod
from typing import Any, ClassVar, Literal

import numpy as np

from ...arrays import FloatArray
from ...errors import ParameterError
from ..requirements import Requirement, Requirements
from ..requirements.base import Titled
from ..stable_design import Gradient, PreparedPlants, StableDesign
from ..uncertainty import Scenario

Direction = Literal["minimize", "maximize"]
BatchColumn = Literal["contact_peak", "sensor_peak", "modulus", "admittance"]
"""What the compiled evaluation of many designs computes by itself (`design.batch_evaluation`)."""


class Objective(Titled, ABC):
    """One number of a controller that should be small, or large.

    A subclass says its `name`, `unit` and `direction`; `title` is the name in words, `rotational_unit` the unit on rx,
    ry, rz where it is another one, `batch_column` the number in the compiled evaluation where that has it. It is made
    without arguments, and all that are of one class are equal.

    The number is computed for each of `count` rows (plants, robots, scenarios), and the worst row counts. What a search
    minimises is the largest `cost`; costs are compared by their ratio, so that the number must be above 0.
    """

    unit: ClassVar[str]
    direction: ClassVar[Direction]
    rotational_unit: ClassVar[str | None] = None
    batch_column: ClassVar[BatchColumn | None] = None

    def __eq__(self, other: object) -> bool:
        return type(self) is type(other)

    def __hash__(self) -> int:
        return hash(type(self))

    def __repr__(self) -> str:
        return f"{type(self).__name__}()"

    def unit_on(self, *, turning: bool) -> str:
        """Return the unit on an axis of translation, or of rotation."""
        return self.rotational_unit or self.unit if turning else self.unit

    def tree(self, *, turning: bool) -> dict[str, str]:
        """Return how files name the objective: name, unit and direction."""
        return {"name": self.name, "unit": self.unit_on(turning=turning), "direction": self.direction}

    def beside(self, minimised: "Objective") -> "Objective":
        """Return what the name means on the front of a problem that minimises another objective."""
        del minimised
        return self

    @abstractmethod
    def count(self, prepared: PreparedPlants) -> int:
        """Return the number of rows."""

    @abstractmethod
    def achieved(self, asked: Requirements, design: StableDesign, row: int) -> float:
        """Return the number of one row; `asked` is what the problem requires.

        The same arguments must give the same number, to the last bit: trials of different processes are compared.
        """

    @abstractmethod
    def scenario(self, prepared: PreparedPlants, row: int) -> Scenario:
        """Return a scenario that brings one row along."""

    def worst_scenario(self, asked: Requirements, design: StableDesign) -> Scenario:
        """Return a scenario that brings the worst row along."""
        return self.scenario(design.prepared, int(np.argmax(self.costs(asked, design))))

    def gradient(self, asked: Requirements, design: StableDesign, row: int) -> Gradient | None:
        """Return the exact derivative of one row's number; None where there is none, for central differences."""
        del asked, design, row
        return None

    def value(self, cost: Any) -> Any:
        """Return the number of a cost, or of an array of costs, and the cost of a number: its inverse if maximised."""
        if self.direction == "minimize":
            return cost
        with np.errstate(divide="ignore"):
            return 1.0 / np.asarray(cost)[()]

    def costs(self, asked: Requirements, design: StableDesign) -> FloatArray:
        """Return the costs of all rows (k,); raises ParameterError for a number that is not above 0 and finite."""
        rows = range(self.count(design.prepared))
        numbers = np.array([self.achieved(asked, design, row) for row in rows], dtype=np.float64)
        for number in numbers[~((numbers > 0.0) & (numbers < np.inf))]:
            must = "a finite number above 0 for a stable loop, for designs are compared by its ratio"
            raise ParameterError(f"objective {self.name}", float(number), must)
        return np.asarray(self.value(numbers))

    def worst(self, asked: Requirements, design: StableDesign) -> float:
        """Return the worst row's number: the largest of one that should be small, else the least."""
        numbers = [self.achieved(asked, design, row) for row in range(self.count(design.prepared))]
        return max(numbers) if self.direction == "minimize" else min(numbers)


class RequirementObjective(Objective):
    """The number that a requirement limits, here as small or large as it can be: its rows and gradients."""

    @abstractmethod
    def limited(self, asked: Requirements) -> tuple[Requirement[Any], Any]:
        """Return the requirement, and a value of it that says what else its number depends on."""

    def count(self, prepared: PreparedPlants) -> int:
        """Return the number of rows; what a requirement is asked for does not change it."""
        return self.limited(Requirements())[0].count(prepared)

    def achieved(self, asked: Requirements, design: StableDesign, row: int) -> float:
        """Return what the requirement calls achieved."""
        requirement, value = self.limited(asked)
        return requirement.achieved(value, design, row)

    def gradient(self, asked: Requirements, design: StableDesign, row: int) -> Gradient | None:
        """Return the requirement's gradient."""
        requirement, value = self.limited(asked)
        return requirement.gradient(value, design, row)

    def scenario(self, prepared: PreparedPlants, row: int) -> Scenario:
        """Return the requirement's scenario."""
        return self.limited(Requirements())[0].scenario(prepared, row)

    def worst_scenario(self, asked: Requirements, design: StableDesign) -> Scenario:
        """Return the requirement's worst scenario."""
        requirement, value = self.limited(asked)
        return requirement.worst_scenario(value, design)
