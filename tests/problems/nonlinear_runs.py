"""Full simulations that several tests run, and the exact transient beside them."""

from dataclasses import replace

import numpy as np

from problems.contact.nonlinear_simulation import NonlinearRun, simulate_nonlinear
from problems.contact.nonlinearities import Deadband, DeadbandType, Nonlinearities
from problems.contact.transient import Approach, ContactTransient, build_sampled_contact, simulate_contact
from problems.model.controller import AdmittanceController
from problems.model.plant import Plant
from problems.model.sampled import build_sampled_plant
from tests.problems.axes import PERIOD_S, PRESS, admittance, paper_plant

FIRM = admittance(damping=3000.0, lead=0.02)
COMPENSATING = replace(FIRM, feedback_damping_s=5e-3, compensation_mass_kg=8.0)
# The robot with the 6.3 kg payload; its drag is not printed, and below 243 N·s/m it stays under the threshold.
LIGHT_DRAG = 150.0
PRINTED = admittance(damping=800.0, lead=0.013, feedback=7.5e-3)
THRESHOLD, SUBTRACTIVE = Deadband(width_n=5.0), Deadband(width_n=5.0, kind=DeadbandType.SUBTRACTIVE)


def light_plant(stiffness: float) -> Plant:
    return paper_plant(stiffness=stiffness, mass=6.3, drag=LIGHT_DRAG)


def simulate(
    plant: Plant,
    controller: AdmittanceController = FIRM,
    approach: Approach = PRESS,
    *,
    duration: float = 0.32,
    h: float = PERIOD_S,
    effects: Nonlinearities | None = None,
    distance: float | None = None,
    substeps: int = 10,
    seed: int | None = None,
) -> NonlinearRun:
    return simulate_nonlinear(
        plant,
        controller,
        approach,
        sample_time_s=h,
        duration_s=duration,
        effects=effects if effects is not None else Nonlinearities(),
        start_distance_m=distance,
        substeps=substeps,
        noise=None if seed is None else np.random.default_rng(seed),
    )


def exactly(plant: Plant, controller: AdmittanceController, approach: Approach, samples: int) -> ContactTransient:
    pair = build_sampled_contact(build_sampled_plant(plant, PERIOD_S))
    return simulate_contact(pair, controller, approach, samples=samples)


def worst(run: NonlinearRun, exact: ContactTransient) -> float:
    return float(
        max(
            np.max(np.abs(run.sensor_force_n - exact.sensor_force_n)),
            np.max(np.abs(run.contact_force_n - exact.contact_force_n)),
        )
    )
