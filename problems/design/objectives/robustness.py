"""How far the loops stay from instability: the least modulus margin."""

from typing import ClassVar

from ...model.controller import AdmittanceController
from ...stability.margins import find_margins
from ..evaluation import Evaluation
from ..problem import DesignProblem
from .base import Direction, Objective, contact_plants, free_plants


class Robustness(Objective):
    """min |1 + L| over frequency, both break points and all plants, in contact and in free space."""

    name: ClassVar[str] = "robustness"
    unit: ClassVar[str] = ""
    direction: ClassVar[Direction] = "maximize"

    def __call__(self, controller: AdmittanceController, problem: DesignProblem, evaluation: Evaluation) -> float:
        """Return the least modulus margin."""
        plants = (*contact_plants(problem, evaluation), *free_plants(problem, evaluation))
        return min(find_margins(plant, controller).modulus for plant in plants)
