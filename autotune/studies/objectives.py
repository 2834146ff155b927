"""The built-in objectives and requirements, registered in `pyproject.toml` as anyone's are."""

import math
from typing import ClassVar

import numpy as np

from problems.design.evaluation import Evaluation
from problems.design.problem import DesignProblem
from problems.design.requirements import AdmittanceTarget, band_frequencies, smallest_admittance
from problems.design.uncertainty import Scenario
from problems.model.controller import AdmittanceController
from problems.model.plant import FREE_SPACE
from problems.model.response import hand_admittance
from problems.model.sampled import SampledPlant, build_sampled_plant
from problems.stability.noise import predict_command_noise
from problems.stability.passivity import check_passivity

from .plugins import Direction, Objective, Requirement


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


class Admittance(Objective):
    """The least free-space admittance min |G(j2πf)| over the band of the problem's target (MODEL.md)."""

    name: ClassVar[str] = "admittance"
    unit: ClassVar[str] = "m/s/N"
    rotational_unit: ClassVar[str | None] = "rad/s/(N·m)"
    direction: ClassVar[Direction] = "maximize"

    def __call__(self, controller: AdmittanceController, problem: DesignProblem, evaluation: Evaluation) -> float:
        """Return min |G|; the payload does not enter G, so one plant of each robot will do."""
        by_robot = {free.plant.port: free for free in free_plants(problem, evaluation)}
        return min(smallest_admittance(free, controller, admittance_band_hz(problem)) for free in by_robot.values())


class HandForce(Objective):
    """The largest force of a hand on the payload per speed of the payload, max |F_h/V_p| over the same band.

    Slowly led it is B_a + B_p (MODEL.md, "the steady hand force per speed"); towards the end of the band what
    accelerates M_a joins. In the closed sampled loop, in free space, for every payload mass.
    """

    name: ClassVar[str] = "hand_force"
    unit: ClassVar[str] = "N/(m/s)"
    rotational_unit: ClassVar[str | None] = "N·m/(rad/s)"
    direction: ClassVar[Direction] = "minimize"

    def __call__(self, controller: AdmittanceController, problem: DesignProblem, evaluation: Evaluation) -> float:
        """Return max 1/|V_p/F_h|."""
        omega = band_frequencies(problem.robot, admittance_band_hz(problem))
        responses = [hand_admittance(free, controller, omega) for free in free_plants(problem, evaluation)]
        return max(float(np.max(1.0 / np.abs(response))) for response in responses)


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
            contact = [build_sampled_plant(problem.plant(each), problem.sample_time_s) for each in scenarios]
            self._known = problem, scenarios, (*contact, *free_plants(problem, evaluation))
        return self._known[2]


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


def admittance_band_hz(problem: DesignProblem) -> tuple[float, float]:
    """Return the band [Hz] of the problem's admittance target, that of the default one if it has none."""
    return (problem.requirements.free_space_admittance or AdmittanceTarget()).band_hz


def free_plants(problem: DesignProblem, evaluation: Evaluation) -> tuple[SampledPlant, ...]:
    """Return the free space of the scenarios, each distinct plant once."""
    plants = dict.fromkeys(problem.plant(peak.scenario).in_contact_with(FREE_SPACE) for peak in evaluation.peaks)
    return tuple(build_sampled_plant(plant, problem.sample_time_s) for plant in plants)
