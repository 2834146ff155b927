"""How freely the robot moves in free space: the least admittance, and the force of a hand per speed."""

from typing import Any, ClassVar

import numpy as np

from ...model.response import hand_admittance
from ..requirements import AdmittanceRequirement, AdmittanceTarget, Requirement, Requirements, band_frequencies
from ..stable_design import PreparedPlants, StableDesign
from ..uncertainty import Scenario
from .base import BatchColumn, Direction, Objective, RequirementObjective

_ADMITTANCE = AdmittanceRequirement()


class Admittance(RequirementObjective):
    """The least free-space admittance min |G(j2πf)| over the band of the problem's target (docs/method.md)."""

    name: ClassVar[str] = "admittance"
    title: ClassVar[str] = "least free-space admittance"
    unit: ClassVar[str] = "m/s/N"
    rotational_unit: ClassVar[str | None] = "rad/s/(N·m)"
    direction: ClassVar[Direction] = "maximize"
    batch_column: ClassVar[BatchColumn | None] = "admittance"

    def limited(self, asked: Requirements) -> tuple[Requirement[Any], Any]:
        """Return the requirement with the band of the problem's target; the payload does not enter G."""
        return _ADMITTANCE, admittance_target(asked)


class HandForce(Objective):
    """The largest force of a hand on the payload per speed of the payload, max |F_h/V_p| over the same band.

    Slowly led it is B_a + B_p (docs/method.md, "The loop"); towards the end of the band what
    accelerates M_a joins. In the closed sampled loop, in free space, for every payload mass.
    """

    name: ClassVar[str] = "hand_force"
    title: ClassVar[str] = "hand force per speed"
    unit: ClassVar[str] = "N/(m/s)"
    rotational_unit: ClassVar[str | None] = "N·m/(rad/s)"
    direction: ClassVar[Direction] = "minimize"

    def count(self, prepared: PreparedPlants) -> int:
        """Return the number of different plants in free space."""
        return len(prepared.free_of)

    def achieved(self, asked: Requirements, design: StableDesign, row: int) -> float:
        """Return max 1/|V_p/F_h| of one plant in free space."""
        free = design.prepared.free[row]
        omega = band_frequencies(free.plant.robot, admittance_target(asked).band_hz)
        return float(np.max(1.0 / np.abs(hand_admittance(free, design.controller, omega))))

    def scenario(self, prepared: PreparedPlants, row: int) -> Scenario:
        """Return the scenario that the plant belongs to."""
        return prepared.free_of[row]


def admittance_target(asked: Requirements) -> AdmittanceTarget:
    """Return the problem's admittance target, the default one if it has none: what is looked at is its band."""
    return asked.free_space_admittance or AdmittanceTarget()
