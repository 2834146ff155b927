"""What a requirement is: a number of a stable design that must stay above, or below, what is asked."""

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Generic, Literal, TypeVar

import numpy as np

from ..._checks import positive
from ...arrays import FloatArray
from ...errors import ParameterError
from ...model.sampled import Controller, SampledPlant
from ..stable_design import Gradient, PreparedPlants, StableDesign, StableLoop
from ..uncertainty import Scenario

Value = TypeVar("Value")
"""What is asked: a number, or a frozen value that holds one (`Requirement.threshold`) and what else must be said."""


class Titled:
    """What has a `name`, and a `title` in words, which is the name where a subclass says no other."""

    name: ClassVar[str]
    title: ClassVar[str]

    def __init_subclass__(cls, **options: Any) -> None:
        """Give a subclass that says its name only a title."""
        super().__init_subclass__(**options)
        if "name" in cls.__dict__ and "title" not in cls.__dict__:
            cls.title = cls.name.replace("_", " ")


@dataclass(frozen=True)
class Requirement(Titled, ABC, Generic[Value]):
    """One kind of requirement: what it is called, how it is computed, and how what is asked is relaxed and shown.

    `name` is the key in `problem.yaml` and `controller.yaml`; `unit` that of the threshold, `turning_unit` on rx, ry,
    rz where it is another one, and a threshold there is the straight one times the lever to the power `lever_power`.
    `depends_on` says what is evaluated for it: every plant's loop, the robot alone, or the simulated contacts. One
    with `is_upper_limit` is met from below; `must_be_below` is what no threshold reaches, and why; `asked_as` is the
    type of what is asked where that is no number.

    A number that is achieved is computed for each of `count` rows (plants, robots, scenarios); each row is smooth in
    the controller, the worst of them is not.
    """

    depends_on: ClassVar[Literal["loop", "robot", "contact"]]
    unit: ClassVar[str] = ""
    turning_unit: ClassVar[str | None] = None
    shown_scale: ClassVar[float] = 1.0
    lever_power: ClassVar[int] = 0
    is_upper_limit: ClassVar[bool] = False
    must_be_below: ClassVar[tuple[float, str] | None] = None
    asked_as: ClassVar[type | None] = None

    def checked(self, asked: Value) -> Value:
        """Return what is asked, checked; raises ParameterError for a threshold that cannot be one."""
        if self.asked_as is not None and not isinstance(asked, self.asked_as):
            raise ParameterError(self.name, asked, f"of the type {self.asked_as.__name__}")
        value = positive(self.name, self.threshold(asked))
        if self.must_be_below is not None and value >= self.must_be_below[0]:
            limit, reason = self.must_be_below
            raise ParameterError(self.name, value, f"below {limit:g} ({reason})")
        return self.with_threshold(asked, value)

    def read(self, entry: Mapping[str, Any]) -> Value:
        """Return what a mapping of plain data asks: `value`, or the fields of a value that has more than one."""
        value: Any = float(entry["value"])
        return value  # type: ignore[no-any-return]

    def check_sampling(self, asked: Value, sample_time_s: float) -> None:
        """Raise ParameterError for a threshold that no loop with this period can have."""

    def threshold(self, asked: Value) -> float:
        """Return the number that is asked for more or less of."""
        value: Any = asked
        return value  # type: ignore[no-any-return]

    def with_threshold(self, asked: Value, threshold: float) -> Value:
        """Return the same with another threshold."""
        del asked
        value: Any = threshold
        return value  # type: ignore[no-any-return]

    def relaxed(self, asked: Value, share: float) -> Value:
        """Return what is asked for less by a share."""
        factor = 1.0 + share if self.is_upper_limit else 1.0 - share
        return self.with_threshold(asked, self.threshold(asked) * factor)

    def turned(self, asked: Value, lever: float) -> Value:
        """Return the same about an axis of rotation, at a lever in metres; with nine digits, for people read them."""
        if self.lever_power == 0:
            return asked
        return self.with_threshold(asked, float(f"{self.threshold(asked) * lever**self.lever_power:.9g}"))

    def ratio(self, asked: Value, achieved: float) -> float:
        """Return required/achieved, of an upper limit achieved/allowed: ≤ 1 is met, and 0 without any limit."""
        if self.is_upper_limit:
            return achieved / self.threshold(asked)
        return self.threshold(asked) / achieved if achieved > 0.0 else math.inf

    def achieved_at(self, asked: Value, ratio: float) -> float:
        """Return the inverse of `ratio`: what was achieved, in the unit of what is asked."""
        if self.is_upper_limit:
            return self.threshold(asked) * ratio
        return self.threshold(asked) / ratio if ratio > 0.0 else math.inf

    def unit_on(self, *, turning: bool) -> str:
        """Return the unit on an axis of translation, or of rotation."""
        return self.turning_unit or self.unit if turning else self.unit

    def describe(self, asked: Value, *, turning: bool = False) -> str:
        """Return what is asked in words, without the title."""
        words = f"{self.shown_scale * self.threshold(asked):g} {self.unit_on(turning=turning)}".strip()
        return f"at most {words}" if self.is_upper_limit else words

    def easing_note(self, asked: Value, possible: float, *, turning: bool = False) -> str:
        """Return a sentence on what else than the threshold could be eased, `possible` being what would be met."""
        del asked, possible, turning
        return ""

    @abstractmethod
    def count(self, prepared: PreparedPlants) -> int:
        """Return the number of rows."""

    @abstractmethod
    def achieved(self, asked: Value, design: StableDesign, row: int) -> float:
        """Return what a design achieves in one row, exactly; infinite without any limit."""

    def ratios(self, asked: Value, design: StableDesign) -> FloatArray:
        """Return required/achieved of every row (k,)."""
        rows = range(self.count(design.prepared))
        return np.array([self.ratio(asked, self.achieved(asked, design, row)) for row in rows])

    def gradient(self, asked: Value, design: StableDesign, row: int) -> Gradient | None:
        """Return the exact derivative of what one row achieves; None where there is none, for central differences."""
        del asked, design, row
        return None

    @abstractmethod
    def scenario(self, prepared: PreparedPlants, row: int) -> Scenario:
        """Return a scenario that brings one row along."""

    def worst_scenario(self, asked: Value, design: StableDesign) -> Scenario:
        """Return a scenario that brings the worst row along."""
        return self.scenario(design.prepared, int(np.argmax(self.ratios(asked, design))))


class LoopRequirement(Requirement[Value]):
    """A requirement of every plant's loop, in contact and in free space."""

    depends_on: ClassVar[Literal["loop", "robot", "contact"]] = "loop"

    @abstractmethod
    def of_loop(self, asked: Value, loop: StableLoop) -> float:
        """Return what one stable loop achieves."""

    def verified(self, asked: Value, sampled: SampledPlant, controller: Controller) -> float:
        """Return what a stable loop achieves by a second method, for validation; the first one where there is none."""
        return self.of_loop(asked, StableLoop(sampled=sampled, controller=controller))

    def count(self, prepared: PreparedPlants) -> int:
        """Return the number of plants."""
        return len(prepared.plants)

    def achieved(self, asked: Value, design: StableDesign, row: int) -> float:
        """Return what the loop of one plant achieves."""
        return self.of_loop(asked, design.loop(row))

    def scenario(self, prepared: PreparedPlants, row: int) -> Scenario:
        """Return the scenario that the plant belongs to."""
        return prepared.scenario_of(row)
