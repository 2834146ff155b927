"""How freely the robot moves in free space: the least admittance, and the force of a hand per speed."""

from typing import ClassVar

import numpy as np

from ...model.controller import AdmittanceController
from ...model.response import hand_admittance
from ..evaluation import Evaluation
from ..problem import DesignProblem
from ..requirements import band_frequencies, smallest_admittance
from .base import Direction, Objective, admittance_band_hz, free_plants


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
        omega = band_frequencies(problem.plants.nominal.robot, admittance_band_hz(problem))
        responses = [hand_admittance(free, controller, omega) for free in free_plants(problem, evaluation)]
        return max(float(np.max(1.0 / np.abs(response))) for response in responses)
