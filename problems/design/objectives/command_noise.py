"""How much of the force sensor's noise reaches the velocity command."""

from typing import ClassVar

from ...model.controller import AdmittanceController
from ...model.sampled import SampledPlant
from ...stability.noise import predict_command_noise
from ..evaluation import Evaluation
from ..problem import DesignProblem
from ..uncertainty import Scenario
from .base import Direction, Objective, contact_plants, free_plants


class CommandNoise(Objective):
    """RMS of the velocity command per RMS of white noise on the force signal, worst over contact and free space."""

    name: ClassVar[str] = "command_noise"
    unit: ClassVar[str] = "m/s per N"
    rotational_unit: ClassVar[str | None] = "rad/s per N·m"
    direction: ClassVar[Direction] = "minimize"

    def __init__(self) -> None:
        # Plants do not depend on the controller, and one front asks for thousands of controllers.
        self._known: tuple[DesignProblem, tuple[Scenario, ...], tuple[SampledPlant, ...]] | None = None

    def __call__(self, controller: AdmittanceController, problem: DesignProblem, evaluation: Evaluation) -> float:
        """Return the largest RMS of (x^d_k − x^d_{k−1})/h under noise of 1 N."""
        plants = self._plants(problem, evaluation)
        return max(predict_command_noise(plant, controller, 1.0).speed_rms_m_s for plant in plants)

    def _plants(self, problem: DesignProblem, evaluation: Evaluation) -> tuple[SampledPlant, ...]:
        scenarios = tuple(peak.scenario for peak in evaluation.peaks)
        if self._known is None or self._known[0] is not problem or self._known[1] != scenarios:
            plants = (*contact_plants(problem, evaluation), *free_plants(problem, evaluation))
            self._known = problem, scenarios, plants
        return self._known[2]
