"""The peak force of the hardest contact, which `optimize` minimises too."""

from typing import ClassVar

from ...model.controller import AdmittanceController
from ..evaluation import Evaluation
from ..problem import DesignProblem
from .base import Direction, Objective


class PeakForce(Objective):
    """The peak force that the problem minimises: at the contact, or at the sensor if it says so."""

    name: ClassVar[str] = "peak_force"
    unit: ClassVar[str] = "N"
    rotational_unit: ClassVar[str | None] = "N·m"
    direction: ClassVar[Direction] = "minimize"

    def __call__(self, controller: AdmittanceController, problem: DesignProblem, evaluation: Evaluation) -> float:
        """Return max F over the scenarios."""
        del controller, problem
        return evaluation.peak_n
