"""An objective and a requirement of one's own: how long a controller leaves until the contact force peaks.

autotune optimize identified.yaml --pareto --objectives peak_force,time_to_peak --require time_to_react
"""

from typing import ClassVar

from autotune.studies.plugins import Direction, Objective, Requirement
from problems.design.evaluation import Evaluation
from problems.design.problem import DesignProblem
from problems.model.controller import AdmittanceController

# A person who leads the payload and a collision response both need some time to answer.
REACTION_S = 0.02


def earliest_peak_s(evaluation: Evaluation) -> float:
    return min(peak.time_of_peak_s for peak in evaluation.peaks)


class TimeToPeak(Objective):
    name: ClassVar[str] = "time_to_peak"
    unit: ClassVar[str] = "s"
    direction: ClassVar[Direction] = "maximize"

    def __call__(self, controller: AdmittanceController, problem: DesignProblem, evaluation: Evaluation) -> float:
        return earliest_peak_s(evaluation)


class TimeToReact(Requirement):
    name: ClassVar[str] = "time_to_react"

    def __call__(self, controller: AdmittanceController, problem: DesignProblem, evaluation: Evaluation) -> float:
        return REACTION_S / earliest_peak_s(evaluation)
