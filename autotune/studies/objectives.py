"""A requirement that is registered in `pyproject.toml` as anyone's is: passive over the band of the admittance."""

import math
from typing import ClassVar

from problems.design.evaluation import Evaluation
from problems.design.objectives import admittance_target
from problems.design.problem import DesignProblem
from problems.model.controller import AdmittanceController
from problems.model.plant import FREE_SPACE
from problems.model.sampled import SampledPlant, build_sampled_plant
from problems.stability.passivity import prepare_port

from .plugins import Requirement


class PassiveBand(Requirement):
    """The port F → V takes energy only over the band of the admittance target (`problems.stability.passivity`)."""

    name: ClassVar[str] = "passive_band"

    def __call__(self, controller: AdmittanceController, problem: DesignProblem, evaluation: Evaluation) -> float:
        """Return the band's upper end over the frequency above which passivity fails."""
        plants = (problem.plant(peak.scenario).in_contact_with(FREE_SPACE) for peak in evaluation.peaks)
        by_robot = {plant.port: plant for plant in plants}
        free = [build_sampled_plant(plant, problem.sample_time_s) for plant in by_robot.values()]
        end_hz = admittance_target(problem.requirements).band_hz[1]
        return max(self._share(each, controller, end_hz) for each in free)

    @staticmethod
    def _share(free: SampledPlant, controller: AdmittanceController, end_hz: float) -> float:
        fails_hz = prepare_port(free).fails_above_hz(controller)
        if fails_hz is None:
            return 0.0
        return end_hz / fails_hz if fails_hz > 0.0 else math.inf
