"""Seeded random loops of the whole model, for laws that need hundreds of cases in a second."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.random import Generator

from problems.arrays import BoolArray
from problems.design.batch_evaluation import check_alike, controller_numbers
from problems.design.batch_kernel import judge_stability, stack_loops
from problems.model.controller import AdmittanceController
from problems.model.plant import FREE_SPACE, Environment, Plant
from problems.model.robot import RobotModel
from problems.model.sampled import SampledPlant, build_loop, build_sampled_plant, spectral_radius
from problems.stability.polynomials import DOUBTFUL, STABLE, UNSTABLE
from tests.problems.axes import PERIOD_S, paper_plant

FORMS = ("tustin", "forward_euler", "backward_euler")


def even(rng: Generator, low: float, high: float) -> float:
    """Draw evenly in the logarithm."""
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def sometimes(rng: Generator, value: float) -> float:
    return value if rng.random() < 0.5 else 0.0


def random_robot(rng: Generator, order: int, delay_s: float) -> RobotModel:
    """Draw r(s) of this order: one pole, a pair, or both; the pair may have a zero."""
    omega = even(rng, 10.0, 80.0)
    numerator, denominator = np.array([1.0]), np.array([1.0])
    if order >= 2:
        numerator, denominator = np.array([omega**2]), np.array([1.0, 2.0 * rng.uniform(0.4, 1.3) * omega, omega**2])
        if rng.random() < 0.5:
            numerator = np.array([omega**2 / even(rng, 20.0, 300.0), omega**2])
    if order != 2:
        pole = even(rng, 10.0, 200.0)
        numerator, denominator = pole * numerator, np.polymul(denominator, [1.0, pole])
    return RobotModel(numerator=numerator, denominator=denominator, delay_s=delay_s)


def random_delay(rng: Generator) -> float:
    """Draw up to five samples, whole ones half of the time."""
    samples = rng.uniform(0.0, 5.0)
    return PERIOD_S * (round(samples) if rng.random() < 0.5 else samples)


def random_plant(
    rng: Generator, *, order: int | None = None, delay_s: float | None = None, contact: bool | None = None
) -> Plant:
    delay = random_delay(rng) if delay_s is None else delay_s
    robot = random_robot(rng, int(rng.integers(1, 4)) if order is None else order, delay)
    plant = paper_plant(
        stiffness=0.0,
        mass=even(rng, 2.0, 60.0),
        drag=even(rng, 50.0, 1500.0),
        coupling=even(rng, 5e4, 1e6),
        coupling_damping=sometimes(rng, even(rng, 10.0, 1000.0)),
        robot=robot,
    )
    touching = rng.random() < 0.7 if contact is None else contact
    return plant.in_contact_with(random_environment(rng) if touching else FREE_SPACE)


def random_environment(rng: Generator) -> Environment:
    return Environment(
        stiffness_n_per_m=even(rng, 1e3, 1e6),
        damping_n_s_per_m=sometimes(rng, even(rng, 1.0, 500.0)),
        mass_kg=sometimes(rng, even(rng, 0.1, 10.0)),
    )


def random_controller(
    rng: Generator, *, forms: Sequence[Any] = FORMS, compensations: Sequence[Any] = ("none", "filtered", "ideal")
) -> AdmittanceController:
    compensation = compensations[int(rng.integers(len(compensations)))]
    known = [form for form in forms if (compensation, form) != ("ideal", "forward_euler")]
    base = AdmittanceController(
        mass_kg=even(rng, 5.0, 60.0),
        damping_n_s_per_m=even(rng, 300.0, 8000.0),
        lead_s=sometimes(rng, even(rng, 1e-3, 0.05)),
        feedback_damping_s=sometimes(rng, even(rng, 1e-3, 0.02)),
        velocity_filter_rad_per_s=even(rng, 60.0, 400.0),
        discretization=known[int(rng.integers(len(known)))],
    )
    if compensation == "none":
        return base
    return replace(
        base,
        compensation=compensation,
        compensation_mass_kg=even(rng, 0.5, 30.0),
        acceleration_filter_rad_per_s=even(rng, 100.0, 600.0),
    )


def sampled_of(plant: Plant) -> SampledPlant:
    return build_sampled_plant(plant, PERIOD_S)


def radius_of(sampled: SampledPlant, controller: AdmittanceController) -> float:
    return spectral_radius(build_loop(sampled, controller))


def stable_loops(
    rng: Generator, count: int, *, below: float = 1.0, **kinds: Any
) -> Iterator[tuple[SampledPlant, AdmittanceController]]:
    """Yield so many loops with a spectral radius below `below`; `kinds` as in `random_plant`."""
    found = 0
    while found < count:
        sampled, controller = sampled_of(random_plant(rng, **kinds)), random_controller(rng)
        if radius_of(sampled, controller) < below:
            found += 1
            yield sampled, controller


def are_stable(plants: Sequence[SampledPlant], controllers: Sequence[AdmittanceController]) -> BoolArray:
    """Return the verdicts (m, p) that searches go by: Routh's test, and the eigenvalues where it is in doubt."""
    check_alike(plants)
    parameters, theta, ideal = controller_numbers(controllers)
    verdicts = judge_stability(stack_loops(plants), parameters, plants[0].sample_time_s, theta, ideal)
    for i, j in np.argwhere(verdicts == DOUBTFUL):
        verdicts[i, j] = STABLE if radius_of(plants[j], controllers[i]) < 1.0 else UNSTABLE
    return np.asarray(verdicts == STABLE)
