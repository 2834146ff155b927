"""The paper's example in SI units: plant, controllers, and the colour each controller has in every picture.

Values and units: docs/method.md, "The loop" and "Errata".
"""

from dataclasses import replace

import numpy as np

from problems.model.controller import (
    AdmittanceController,
    feedback_damping_from_paper_mm,
    feedback_damping_from_paper_per_sample,
)
from problems.model.plant import FREE_SPACE, Coupling, Environment, PayloadDynamics, Plant
from problems.model.robot import RobotModel

SAMPLE_TIME_S = 8e-4
DELAY_S = 2.4e-3
CONTACT_N_PER_M = 5e5
COUPLING_N_PER_M = 3e5
PAYLOAD_KG = 16.0
DRAG_N_S_PER_M = 630.0
LEAD_S = 0.02
# The printed 2e-5 and 7.5e-6, read as s·m/mm (docs/method.md, erratum 2), and the other reading of the first.
FEEDBACK_S = feedback_damping_from_paper_mm(2e-5)
FEEDBACK_PER_SAMPLE_S = feedback_damping_from_paper_per_sample(2e-5, SAMPLE_TIME_S)
EXPERIMENT_FEEDBACK_S = feedback_damping_from_paper_mm(7.5e-6)
EXPERIMENT_FEEDBACK_PER_SAMPLE_S = feedback_damping_from_paper_per_sample(7.5e-6, SAMPLE_TIME_S)
# Stiffness of the compliant table, read as the secant of force over robot displacement (docs/method.md, erratum 6).
TABLE_N_PER_M = 32.3e3

STANDARD, LEAD, FEEDBACK, LEAD_FEEDBACK = "standard", "lead", "feedback", "lead + feedback"
IDEAL, FILTERED = "ideal compensation", "filtered compensation"
LEAD_IDEAL, LEAD_FILTERED = "lead + ideal comp.", "lead + filtered comp."
ALL_FILTERED = "lead + feedback + filtered comp."

# Told apart by colour-blind people too (Okabe and Ito, with brown and violet); the same in every picture.
COLOURS = {
    STANDARD: "#000000",
    LEAD: "#0072B2",
    FEEDBACK: "#E69F00",
    LEAD_FEEDBACK: "#009E73",
    IDEAL: "#56B4E9",
    FILTERED: "#D55E00",
    LEAD_IDEAL: "#CC79A7",
    LEAD_FILTERED: "#8C6D46",
    ALL_FILTERED: "#5D3A9B",
}


def printed_robot(delay_s: float = DELAY_S) -> RobotModel:
    """Return the robot as the paper prints it; docs/method.md, erratum 1: 20/(s + 20) stays."""
    return RobotModel(numerator=np.array([100.0, 400.0]), denominator=np.array([5.0, 120.0, 400.0]), delay_s=delay_s)


def example_plant(
    *,
    contact_n_per_m: float = CONTACT_N_PER_M,
    coupling_n_per_m: float = COUPLING_N_PER_M,
    coupling_n_s_per_m: float = 0.0,
    mass_kg: float = PAYLOAD_KG,
    drag_n_s_per_m: float = DRAG_N_S_PER_M,
    robot: RobotModel | None = None,
) -> Plant:
    """Return the paper's plant with some values changed; `contact_n_per_m` 0 is free space."""
    return Plant(
        robot=robot or printed_robot(),
        coupling=Coupling(stiffness_n_per_m=coupling_n_per_m, damping_n_s_per_m=coupling_n_s_per_m),
        payload=PayloadDynamics(mass_kg=mass_kg, drag_n_s_per_m=drag_n_s_per_m),
        environment=Environment(stiffness_n_per_m=contact_n_per_m) if contact_n_per_m > 0.0 else FREE_SPACE,
    )


def example_controllers(mass_kg: float = 10.0, damping_n_s_per_m: float = 1000.0) -> dict[str, AdmittanceController]:
    """Return every controller of the paper's analysis by name."""
    standard = AdmittanceController(mass_kg=mass_kg, damping_n_s_per_m=damping_n_s_per_m)
    lead, feedback = replace(standard, lead_s=LEAD_S), replace(standard, feedback_damping_s=FEEDBACK_S)
    both = replace(lead, feedback_damping_s=FEEDBACK_S)
    return {
        STANDARD: standard,
        LEAD: lead,
        FEEDBACK: feedback,
        LEAD_FEEDBACK: both,
        IDEAL: replace(standard, compensation_mass_kg=PAYLOAD_KG, compensation="ideal"),
        FILTERED: replace(standard, compensation_mass_kg=PAYLOAD_KG),
        LEAD_IDEAL: replace(lead, compensation_mass_kg=PAYLOAD_KG, compensation="ideal"),
        LEAD_FILTERED: replace(lead, compensation_mass_kg=PAYLOAD_KG),
        ALL_FILTERED: replace(both, compensation_mass_kg=PAYLOAD_KG),
    }


def in_series(secant_n_per_m: float, coupling_n_per_m: float) -> float:
    """Return the environment behind a coupling whose series stiffness is the secant (docs/method.md, erratum 6)."""
    return 1.0 / (1.0 / secant_n_per_m - 1.0 / coupling_n_per_m)
