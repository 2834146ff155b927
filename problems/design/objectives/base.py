"""What an objective is: one number of a stable design that should be small, or large."""

from abc import ABC, abstractmethod
from typing import ClassVar, Literal

from ...model.controller import AdmittanceController
from ...model.plant import FREE_SPACE
from ...model.sampled import SampledPlant, build_sampled_plant
from ..evaluation import Evaluation
from ..problem import DesignProblem
from ..requirements import AdmittanceTarget

Direction = Literal["minimize", "maximize"]


class Objective(ABC):
    """One number of a controller that should be small, or large.

    A subclass says its `name`, `unit` and `direction`; `rotational_unit` is the unit on rx, ry, rz where it is another
    one. It is made without arguments, once per front.
    """

    name: ClassVar[str]
    unit: ClassVar[str]
    direction: ClassVar[Direction]
    rotational_unit: ClassVar[str | None] = None

    @abstractmethod
    def __call__(self, controller: AdmittanceController, problem: DesignProblem, evaluation: Evaluation) -> float:
        """Return the number, worst over the scenarios of `evaluation.peaks`; the loop is stable in all of them.

        The same arguments must give the same number, to the last bit: trials of different processes are compared.
        """


def admittance_band_hz(problem: DesignProblem) -> tuple[float, float]:
    """Return the band [Hz] of the problem's admittance target, that of the default one if it has none."""
    return (problem.requirements.free_space_admittance or AdmittanceTarget()).band_hz


def free_plants(problem: DesignProblem, evaluation: Evaluation) -> tuple[SampledPlant, ...]:
    """Return the free space of the scenarios, each distinct plant once."""
    plants = dict.fromkeys(problem.plant(peak.scenario).in_contact_with(FREE_SPACE) for peak in evaluation.peaks)
    return tuple(build_sampled_plant(plant, problem.sample_time_s) for plant in plants)


def contact_plants(problem: DesignProblem, evaluation: Evaluation) -> tuple[SampledPlant, ...]:
    """Return the plants of the scenarios in contact."""
    return tuple(build_sampled_plant(problem.plant(peak.scenario), problem.sample_time_s) for peak in evaluation.peaks)
