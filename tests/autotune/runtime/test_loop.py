"""The runtime's own loop against that of the library: the same verdict, in plain arithmetic and in milliseconds."""

import dataclasses
import time
from typing import Any

import numpy as np
import pytest

from autotune.runtime import AxisLaw
from autotune.runtime.loop import MOST_STATES, LoopPlant, corner_plants, is_stable
from problems.errors import ParameterError
from problems.model.controller import AdmittanceController
from problems.model.plant import Coupling, Environment, PayloadDynamics, Plant
from problems.model.robot import RobotModel
from problems.model.sampled import build_loop, build_sampled_plant, spectral_radius
from tests.autotune.runtime.cases import PERIOD_S, make_axis

PLANT = LoopPlant(
    numerator=[20.0],
    denominator=[1.0, 20.0],
    delay_s=2.4e-3,
    coupling_stiffness=3e5,
    coupling_damping=120.0,
    mass=16.0,
    drag=330.0,
    stiffness=1e5,
    damping=0.0,
    environment_mass=0.0,
    filter_s=0.0,
)


def radius(axis: AxisLaw, plant: LoopPlant) -> float:
    """The largest |eigenvalue| but the one at 1 of free space, by the library."""
    exact = Plant(
        robot=RobotModel(
            numerator=np.array(plant.numerator), denominator=np.array(plant.denominator), delay_s=plant.delay_s
        ),
        coupling=Coupling(stiffness_n_per_m=plant.coupling_stiffness, damping_n_s_per_m=plant.coupling_damping),
        payload=PayloadDynamics(mass_kg=plant.mass, drag_n_s_per_m=plant.drag),
        environment=Environment(stiffness_n_per_m=plant.stiffness, damping_n_s_per_m=plant.damping),
    )
    law = AdmittanceController(
        mass_kg=axis.mass,
        damping_n_s_per_m=axis.damping,
        lead_s=axis.lead_s,
        feedback_damping_s=axis.feedback_damping_s,
        velocity_filter_rad_per_s=axis.velocity_filter_rad_per_s,
        acceleration_filter_rad_per_s=axis.acceleration_filter_rad_per_s,
        compensation_mass_kg=axis.compensation_mass_kg,
    )
    return float(spectral_radius(build_loop(build_sampled_plant(exact, PERIOD_S), law)))


def test_the_verdict_is_that_of_the_eigenvalues() -> None:
    rng, verdicts = np.random.default_rng(4), list[bool]()
    while len(verdicts) < 150:
        axis = dataclasses.replace(
            make_axis("x", compensation_mass_kg=float(rng.choice([0.0, 8.0]))),
            mass=float(np.exp(rng.uniform(0.0, 4.0))),
            damping=float(np.exp(rng.uniform(4.0, 8.0))),
            lead_s=float(rng.uniform(0.0, 0.03)),
            feedback_damping_s=float(rng.uniform(0.0, 0.03)),
        )
        second = rng.random() < 0.5
        plant = dataclasses.replace(
            PLANT,
            numerator=[100.0, 400.0] if second else [20.0],
            denominator=[5.0, 120.0, 400.0] if second else [1.0, 20.0],
            delay_s=float(rng.choice([0.0, 1.3, 3.0, 3.4])) * PERIOD_S,
            stiffness=float(rng.choice([0.0, 2e4, 5e5])),
            damping=float(rng.choice([0.0, 100.0])),
        )
        largest = radius(axis, plant)
        # The powers tell a decay of 1e-5 per period; nearer to 1 neither verdict is asked for.
        if abs(largest - 1.0) < 1e-5:
            continue
        assert is_stable(axis, plant) == (largest < 1.0), (axis, plant, largest)
        verdicts.append(largest < 1.0)
    assert 20 < sum(verdicts) < 130


def test_a_filter_of_the_wrench_makes_a_loop_unstable_that_was_not() -> None:
    axis = make_axis("x")
    assert is_stable(axis, PLANT)
    assert is_stable(axis, dataclasses.replace(PLANT, filter_s=1e-5))
    assert not is_stable(axis, dataclasses.replace(PLANT, filter_s=0.05))


@pytest.mark.parametrize("filter_s", [2e-4, 8e-4, 1.1e-3, 3e-3])
@pytest.mark.parametrize("stiffness", [0.0, 1e5])
def test_a_loop_behind_a_filter_keeps_its_digits_on_a_stiff_coupling(filter_s: float, stiffness: float) -> None:
    """Slow periods behind a filter: its state is a length, or the motion that stays would be lost in rounding."""
    plant = LoopPlant(
        numerator=[959.8],
        denominator=[1.0, 51.89, 959.8],
        delay_s=4.66e-3,
        coupling_stiffness=5.6e5,
        coupling_damping=93.0,
        mass=9.36,
        drag=38.5,
        stiffness=stiffness,
        damping=0.0,
        environment_mass=0.0,
        filter_s=filter_s,
    )
    axis = dataclasses.replace(
        make_axis("z"), sample_time_s=2e-3, mass=97.0, damping=9949.0, lead_s=0.03, feedback_damping_s=0.0
    )
    assert is_stable(axis, plant)


@pytest.mark.parametrize(
    "change",
    [
        {"numerator": [10.0]},
        {"numerator": [20.0, 1.0, 1.0, 1.0]},
        {"denominator": [0.0, 20.0]},
        {"mass": 0.0},
        {"coupling_stiffness": 1e300},
        {"delay_s": float("inf")},
    ],
)
def test_what_is_no_plant_is_not_stable(change: dict[str, float | list[float]]) -> None:
    plant = dataclasses.replace(PLANT, stiffness=0.0, **change)  # type: ignore[arg-type]  # as the field is
    assert not is_stable(make_axis("x"), plant) or plant.delay_s / PERIOD_S > MOST_STATES


def test_the_corners_of_a_domain_are_looked_at_in_milliseconds() -> None:
    domain = {
        "environment_stiffness_n_per_m": [2e4, 5e5],
        "payload_mass_kg": [14.0, 18.0],
        "environment_damping_n_s_per_m": 10.0,
        "environment_mass_kg": 0.0,
        "coupling_stiffness_n_per_m": 3e5,
        "coupling_damping_n_s_per_m": 120.0,
        "drag_n_s_per_m": 330.0,
        "robot_numerator": [20.0],
        "robot_denominator": [1.0, 20.0],
        "delay_s": 2.4e-3,
    }
    plants = corner_plants(domain, turns=False)
    assert [(each.mass, each.stiffness, each.damping) for each in plants] == [
        (mass, stiffness, 10.0 if stiffness else 0.0) for mass in (14.0, 18.0) for stiffness in (0.0, 2e4, 5e5)
    ]
    begin = time.process_time()
    assert all(is_stable(make_axis("x"), plant) for plant in plants)
    # Measured 6 to 10 ms; ten times that is a machine that is busy with something else.
    assert time.process_time() - begin < 0.1
    assert corner_plants(domain | {"wrench_filter": {"delay_s": 1e-3}}, turns=False) == []


@pytest.mark.parametrize("change", [{"damping": 1e-310}, {"mass": 1e308, "damping": 1e-3}])
def test_an_axis_whose_equation_overflows_anywhere_is_refused(change: dict[str, Any]) -> None:
    with pytest.raises(ParameterError, match="gains whose difference equation has finite coefficients"):
        dataclasses.replace(make_axis("x"), **change)
