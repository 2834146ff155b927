"""Design problems for the optimizer's benchmarks: the paper's cell, and others drawn at random."""

import numpy as np

from problems.contact.transient import Approach
from problems.design.objectives import BUILT_IN
from problems.design.problem import AdmittanceTarget, DesignProblem, Requirements
from problems.design.uncertainty import PlantSet
from problems.model.robot import RobotModel

STIFFNESS_N_PER_M = (2e4, 5e5)
MASS_KG = (8.0, 24.0)
PERIOD_S = 8e-4


def paper_cell(
    stiffness: tuple[float, float] = STIFFNESS_N_PER_M, mass: tuple[float, float] = MASS_KG
) -> DesignProblem:
    """The paper's 16 kg cell over ranges of surface and payload (docs/method.md, "The loop")."""
    return DesignProblem(
        plants=PlantSet.of(
            RobotModel.from_bandwidth(bandwidth_rad_per_s=20.0, delay_s=3.0 * PERIOD_S),
            coupling_stiffness_n_per_m=3e5,
            coupling_damping_n_s_per_m=0.0,
            drag_n_s_per_m=630.0,
            environment_stiffness_n_per_m=stiffness,
            payload_mass_kg=mass,
        ),
        sample_time_s=PERIOD_S,
    )


def draw_problem(seed: int) -> DesignProblem:
    """Draw one cell and what is asked of its controller; whether that can be had is not looked at.

    What spans more than a factor of three is drawn log-uniformly. Half of the delays are a whole number of samples.
    """
    rng = np.random.default_rng([seed, 20240])

    def ratio(low: float, high: float) -> float:
        return float(np.exp(rng.uniform(np.log(low), np.log(high))))

    h = float(rng.choice([8e-4, 1e-3]))
    mass = ratio(4.0, 30.0)
    coupling = ratio(1e5, 8e5)
    softest = ratio(5e3, 1e5)
    stiffest = softest * ratio(2.0, 25.0)
    samples = float(rng.integers(1, 6)) if rng.random() < 0.5 else float(rng.uniform(1.0, 5.0))
    if rng.random() < 0.5:
        approach = Approach(force_n=ratio(15.0, 60.0))
    else:
        approach = Approach(speed_m_s=ratio(0.01, 0.05))
    objective = BUILT_IN["contact_force" if rng.random() < 0.5 else "sensor_force"]
    return DesignProblem(
        plants=PlantSet.of(
            draw_robot(rng, samples * h),
            coupling_stiffness_n_per_m=coupling,
            coupling_damping_n_s_per_m=float(rng.uniform(0.01, 0.1)) * 2.0 * (coupling * mass) ** 0.5,
            drag_n_s_per_m=ratio(150.0, 900.0),
            environment_stiffness_n_per_m=(softest, min(stiffest, 6e5)),
            payload_mass_kg=(mass, mass * float(rng.uniform(1.05, 3.0))),
        ),
        sample_time_s=h,
        approach=approach,
        requirements=Requirements(
            modulus_margin=float(rng.uniform(0.4, 0.6)),
            delay_margin_s=float(rng.uniform(1e-3, 3e-3)),
            free_space_admittance=AdmittanceTarget(min_m_s_per_n=ratio(2e-4, 7e-4), band_hz=(0.1, ratio(1.0, 3.0))),
        ),
        objective=objective,
    )


def draw_robot(rng: np.random.Generator, delay_s: float) -> RobotModel:
    """Draw a position loop of 2 to 6 Hz with one pole, a pair of poles, or a pair and a zero that cancels nothing."""
    corner = 2.0 * np.pi * float(rng.uniform(2.0, 6.0))
    kind = int(rng.integers(3))
    if kind == 0:
        return RobotModel.from_bandwidth(bandwidth_rad_per_s=corner, delay_s=delay_s)
    damping = float(rng.uniform(0.7, 1.2))
    lead = 0.0 if kind == 1 else float(rng.uniform(0.2, 0.8)) / corner
    return RobotModel(
        numerator=np.array([lead * corner**2, corner**2]),
        denominator=np.array([1.0, 2.0 * damping * corner, corner**2]),
        delay_s=delay_s,
    )
