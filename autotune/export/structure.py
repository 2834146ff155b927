"""What another controller can be: its free numbers, the law that they make, and how a translation of our own begins."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

from autotune.formats.controller_record import AxisGains
from autotune.validation.law import AxisTask
from problems.model.linear_controllers import LinearController

Values = tuple[float, ...]


@dataclass(frozen=True, kw_only=True)
class Variable:
    """A free number of a structure and its bounds; a search goes by equal ratios, or by equal steps without `ratio`."""

    name: str
    low: float
    high: float
    ratio: bool = True


class Structure(Protocol):
    """One axis of another controller."""

    @property
    def variables(self) -> tuple[Variable, ...]:
        """What a search may choose."""

    @property
    def translated(self) -> Values:
        """The numbers that come nearest to the gains of the file."""

    def written(self, values: Values) -> Mapping[str, float]:
        """Return the axis' numbers as they are written into the file, in its own terms."""

    def law(self, values: Values) -> LinearController:
        """Return the law that runs with the numbers as they are written."""

    def dropped(self) -> tuple[str, ...]:
        """Say what of the gains the structure cannot express."""


def lost_gains(task: AxisTask, gains: AxisGains, expressed: tuple[str, ...] = ()) -> tuple[str, ...]:
    """Say which gains of an axis have no place in a structure that expresses but the named ones beside M_a and B_a."""
    told = {
        "lead_s": ("lead K_l", gains.lead_s, "s"),
        "feedback_damping_s": ("feedback damping B_fb", gains.feedback_damping_s, "s"),
        "deadband": ("deadband", gains.deadband, "N·m" if task.axis.startswith("r") else "N"),
    }
    return tuple(
        f"axis {task.axis}: {what} = {value:g} {unit}"
        for name, (what, value, unit) in told.items()
        if name not in expressed and value != 0.0
    )
