"""The peak of the force on the environment, limited whatever the objective is."""

from typing import ClassVar, Literal

from ..stable_design import Gradient, PreparedPlants, StableDesign
from ..uncertainty import Scenario
from .base import Requirement


class PeakForceLimit(Requirement[float]):
    """max F_e of every scenario's contact [N]."""

    name, title = "max_peak_force_n", "peak force"
    depends_on: ClassVar[Literal["loop", "robot", "contact"]] = "contact"
    unit, turning_unit = "N", "N·m"
    lever_power = 1
    is_upper_limit = True

    def count(self, prepared: PreparedPlants) -> int:
        """Return the number of scenarios."""
        return len(prepared.scenarios)

    def achieved(self, asked: float, design: StableDesign, row: int) -> float:
        """Return the peak force on the environment in one scenario [N]."""
        del asked
        return design.peak(row).peak_contact_force_n

    def gradient(self, asked: float, design: StableDesign, row: int) -> Gradient | None:
        """Differentiate the force at the time of the peak."""
        from ..gradients import contact_peak_gradient  # noqa: PLC0415 - CasADi takes a second to import

        del asked
        return contact_peak_gradient(design, row, "contact")

    def scenario(self, prepared: PreparedPlants, row: int) -> Scenario:
        """Return the scenario."""
        return prepared.scenarios[row]

    def worst_scenario(self, asked: float, design: StableDesign) -> Scenario:
        """Return the scenario of the highest peak."""
        del asked
        return max(design.peaks, key=lambda peak: peak.peak_contact_force_n).scenario
