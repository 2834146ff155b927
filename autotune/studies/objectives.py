"""A requirement that is registered in `pyproject.toml` as anyone's is: passive over the band of the admittance."""

import math
from typing import ClassVar

from problems.design.evaluation import Evaluation
from problems.design.objectives import admittance_band_hz, free_plants
from problems.design.problem import DesignProblem
from problems.model.controller import AdmittanceController
from problems.model.sampled import SampledPlant
from problems.stability.passivity import check_passivity

from .plugins import Requirement


class PassiveBand(Requirement):
    """The port F → V takes energy only over the band of the admittance target (`problems.stability.passivity`)."""

    name: ClassVar[str] = "passive_band"

    def __call__(self, controller: AdmittanceController, problem: DesignProblem, evaluation: Evaluation) -> float:
        """Return the band's upper end over the frequency above which passivity fails."""
        by_robot = {free.plant.port: free for free in free_plants(problem, evaluation)}
        return max(self._share(free, controller, admittance_band_hz(problem)[1]) for free in by_robot.values())

    @staticmethod
    def _share(free: SampledPlant, controller: AdmittanceController, end_hz: float) -> float:
        fails_hz = check_passivity(free, controller).fails_above_hz
        if fails_hz is None:
            return 0.0
        return end_hz / fails_hz if fails_hz > 0.0 else math.inf
