"""Margins from characteristic polynomials against margins from frequency responses."""

import numpy as np
import pytest
from hypothesis import assume, given

from autotune.validation.margins import sweep_margins
from problems.design.uncertainty import MASS, STIFFNESS, PlantSet
from problems.model.controller import AdmittanceController
from problems.model.plant import Plant
from problems.model.robot import RobotModel
from problems.model.sampled import build_loop, build_sampled_plant, spectral_radius
from problems.stability.margins import find_margins
from tests.autotune.certificate.plants import radius_at, uncertain
from tests.problems.axes import LAW, PERIOD_S, admittance, controllers, one_pole, plants

# Validation reads a grid of 6000 points, `find_margins` one that is refined: 1e-4 apart at most.
TWO_ROADS = 1e-3
# A gain margin beyond this is rounding: the loop gain of the Tustin form at the Nyquist frequency is 0.
NO_LIMIT_DB = 200.0
NAMES = ("modulus", "gain_db", "phase_deg", "delay_s")
EVERY_KIND = pytest.mark.parametrize(
    "robot",
    [
        one_pole(),
        one_pole(0.0),
        one_pole(2.7 * PERIOD_S),
        RobotModel(numerator=np.array([900.0]), denominator=np.array([1.0, 42.0, 900.0]), delay_s=2.0e-3),
    ],
    ids=["whole delay", "no delay", "fraction", "two poles"],
)


def only(plant: Plant) -> PlantSet:
    """The set of one plant."""
    mass, stiffness = plant.payload.mass_kg, plant.environment.stiffness_n_per_m
    return PlantSet(nominal=plant, ranges={MASS: (mass, mass), STIFFNESS: (stiffness, stiffness)})


def by_responses(these: list[Plant], law: AdmittanceController) -> dict[str, float]:
    """The smallest margins as the optimizer finds them."""
    found = [find_margins(build_sampled_plant(plant, PERIOD_S), law) for plant in these]
    return {name: min(getattr(margins, name) for margins in found) for name in NAMES}


def check_same(swept: dict[str, float], expected: dict[str, float]) -> None:
    for name in NAMES:
        if name == "gain_db" and expected[name] > NO_LIMIT_DB:
            assert swept[name] > NO_LIMIT_DB
        else:
            assert swept[name] == pytest.approx(expected[name], rel=TWO_ROADS), name


@EVERY_KIND
@pytest.mark.parametrize("coupling_damping", [0.0, 150.0])
@pytest.mark.parametrize("feedback", [0.0, 0.008])
def test_both_roads_lead_to_the_same_margins(robot: RobotModel, coupling_damping: float, feedback: float) -> None:
    stiffness, law = 1.5e5, admittance(20.0, 3500.0, 0.013, feedback)
    set_of_one = uncertain(
        robot=robot,
        coupling_damping=coupling_damping,
        environment_damping=40.0,
        mass=(16.0, 16.0),
        stiffness=(stiffness, stiffness),
    )
    swept = sweep_margins(set_of_one, law, PERIOD_S, stiffness=5, mass=3)
    assert swept.plants == 2  # in contact and in free space
    these = [set_of_one.at(16.0, stiffness), set_of_one.at(16.0, 0.0)]
    check_same(dict(swept.values), by_responses(these, law))
    largest = max(spectral_radius(build_loop(build_sampled_plant(plant, PERIOD_S), law)) for plant in these)
    assert swept.largest_radius == pytest.approx(largest, abs=1e-9)
    assert set(swept.worst) <= set(NAMES)


@LAW
@given(plant=plants(contact=True), law=controllers())
def test_both_roads_agree_on_random_stable_loops(plant: Plant, law: AdmittanceController) -> None:
    set_of_one = only(plant)
    free = set_of_one.at(plant.payload.mass_kg, 0.0)
    # Next to the limit a margin is a difference of almost equal numbers, and no road is exact.
    assume(all(spectral_radius(build_loop(build_sampled_plant(p, PERIOD_S), law)) < 0.9999 for p in (plant, free)))
    expected = by_responses([plant, free], law)
    assume(expected["modulus"] > 0.02)
    check_same(dict(sweep_margins(set_of_one, law, PERIOD_S, stiffness=1, mass=1).values), expected)


def test_the_worst_plant_of_a_sweep_is_reported() -> None:
    these, law = uncertain(mass=(14.0, 18.0), stiffness=(5e4, 3e5)), admittance(13.0, 1800.0, 0.013)
    swept = sweep_margins(these, law, PERIOD_S, stiffness=7, mass=3)
    assert swept.plants == 7 * 3 + 3
    for name, plant in swept.worst.items():
        there = getattr(find_margins(build_sampled_plant(plant, PERIOD_S), law), name)
        assert swept.values[name] == pytest.approx(there, rel=TWO_ROADS)


def test_an_unstable_plant_shows_as_a_radius_above_one() -> None:
    """docs/method.md, erratum 4: the printed example is unstable; its margins mean nothing, the radius does."""
    these, law = uncertain(mass=(16.0, 16.0), stiffness=(5e5, 5e5)), admittance(10.0, 1000.0, 0.0)
    swept = sweep_margins(these, law, PERIOD_S, stiffness=1, mass=1)
    assert swept.largest_radius == pytest.approx(radius_at(these, law, 16.0, 5e5), abs=1e-9)
    assert swept.largest_radius > 1.0
