"""The uncertain set: what lies in it, how it is cut, and that its points are the plants that they say."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import chi2

from problems.design.uncertainty import ALWAYS_UNCERTAIN, MOST_CORNERS, UNCERTAIN, Ellipsoid, PlantSet, Scenario
from problems.errors import ParameterError
from problems.model.plant import Coupling, Environment, PayloadDynamics, Plant
from problems.model.robot import RobotModel, bandwidth_hz, bandwidth_share, damping_ratio, vary_robot
from tests.problems.axes import LAW, between, one_pole

K_E, M_P = ALWAYS_UNCERTAIN
K_S, T_D = "coupling_stiffness_n_per_m", "delay_s"
BOX: dict[str, tuple[float, float]] = {K_E: (2e4, 5e5), M_P: (8.0, 16.0), K_S: (2.9e5, 3.1e5), T_D: (2.3e-3, 2.5e-3)}
# 3 kN/m and 20 µs, nine decades apart and correlated by 0.8.
CUT = Ellipsoid(names=(K_S, T_D), centre=(3e5, 2.4e-3), covariance=((9e6, 0.048), (0.048, 4e-10)))
NOMINAL = Plant(
    robot=one_pole(),
    coupling=Coupling(stiffness_n_per_m=3e5, damping_n_s_per_m=100.0),
    payload=PayloadDynamics(mass_kg=10.0, drag_n_s_per_m=400.0),
    environment=Environment(stiffness_n_per_m=1e5),
)
BOTH = PlantSet(nominal=NOMINAL, ranges=BOX, ellipsoid=CUT)
UNITS = st.lists(st.floats(0.0, 1.0), min_size=4, max_size=4)


def point(scenario: Scenario) -> np.ndarray[Any, np.dtype[np.float64]]:
    return np.array([getattr(scenario, name) for name in CUT.names])


def quadratic_form(scenario: Scenario) -> float:
    """The definition, by a plain inverse of the scaled covariance."""
    scale = np.array([1e3, 1e-5])
    left = (point(scenario) - np.array(CUT.centre)) / scale
    return float(left @ np.linalg.inv(np.array(CUT.covariance) / np.outer(scale, scale)) @ left)


@LAW
@given(UNITS)
def test_every_point_of_the_cube_becomes_a_point_of_the_set(unit: list[float]) -> None:
    scenario = BOTH.from_unit(unit)
    for name, (low, high) in BOX.items():
        assert low <= getattr(scenario, name) <= high
    # Rounding of a square root and a division.
    assert quadratic_form(scenario) <= chi2.ppf(0.95, 2) * (1.0 + 1e-9)
    assert BOTH.contains(scenario)


def test_an_ellipsoid_of_mass_and_stiffness_cuts_them() -> None:
    """24 radii away is outside, whatever the box says."""
    cut = Ellipsoid(
        names=("payload_mass_kg", "environment_stiffness_n_per_m"),
        centre=(20.0, 1e5),
        covariance=((0.01, 0.0), (0.0, 1e6)),
    )
    box = {"environment_stiffness_n_per_m": (1e4, 1e6), "payload_mass_kg": (1.0, 40.0)}
    whole = PlantSet(nominal=NOMINAL, ranges=box, ellipsoid=cut)
    radius = math.sqrt(chi2.ppf(0.95, 2))
    for radii, is_inside in ((0.0, True), (0.99, True), (1.01, False), (24.0, False)):
        heavier = Scenario(environment_stiffness_n_per_m=1e5, payload_mass_kg=20.0 + 0.1 * radius * radii)
        stiffer = Scenario(environment_stiffness_n_per_m=1e5 + 1e3 * radius * radii, payload_mass_kg=20.0)
        assert whole.contains(heavier) is is_inside
        assert whole.contains(stiffer) is is_inside


@LAW
@given(UNITS)
def test_a_box_is_the_image_of_the_cube_and_back(unit: list[float]) -> None:
    box = PlantSet(nominal=NOMINAL, ranges=BOX)
    np.testing.assert_allclose(box.to_unit(box.from_unit(unit)), unit, atol=1e-9)


def test_what_keeps_its_nominal_value_lies_in_the_middle_of_the_cube() -> None:
    box = PlantSet(nominal=NOMINAL, ranges=BOX)
    of_two = Scenario(environment_stiffness_n_per_m=1e5, payload_mass_kg=10.0)
    # K_e by ratio of 2e4 to 5e5, which is 5²; the mass by size of 8 to 16 kg.
    np.testing.assert_allclose(box.to_unit(of_two), [0.5, 0.25, 0.5, 0.5])


def test_the_level_is_the_share_of_a_normal_distribution_inside() -> None:
    draws = np.random.default_rng(5).multivariate_normal(CUT.centre, np.array(CUT.covariance), 20000)
    inside = np.mean([CUT.size(each) <= 1.0 for each in draws])
    # Four standard deviations of a share of 20,000.
    assert inside == pytest.approx(0.95, abs=4.0 * math.sqrt(0.95 * 0.05 / 20000))


def test_the_box_around_an_ellipsoid_touches_it_in_every_direction() -> None:
    angles = np.linspace(0.0, 2.0 * np.pi, 2000)
    root = np.linalg.cholesky(np.array(CUT.covariance)) * math.sqrt(CUT.quantile)
    surface = np.array(CUT.centre)[:, None] + root @ np.array([np.cos(angles), np.sin(angles)])
    for row, (low, high) in zip(surface, CUT.box().values(), strict=True):
        # The grid of angles misses the extreme by the square of half a step.
        assert (low, high) == pytest.approx((row.min(), row.max()), rel=1e-5)


def test_the_box_of_a_damping_near_none_ends_at_none() -> None:
    name = "drag_n_s_per_m"
    low, high = Ellipsoid(names=(name,), centre=(1.0,), covariance=((4.0,),)).box()[name]
    assert low == 0.0
    assert high == pytest.approx(1.0 + 2.0 * 1.959964, rel=1e-6)


def test_corners_are_all_combinations_and_samples_are_the_same_for_a_seed() -> None:
    box = PlantSet(nominal=NOMINAL, ranges=BOX)
    corners = {tuple(getattr(s, name) for name in BOX) for s in box.corners()}
    assert len(corners) == 16
    assert all(value in BOX[name] for corner in corners for name, value in zip(BOX, corner, strict=True))
    assert BOTH.samples(32, seed=3) == BOTH.samples(32, seed=3) != BOTH.samples(32, seed=4)
    assert all(BOTH.contains(s) for s in (*BOTH.corners(), *BOTH.samples(64)))


def test_samples_fill_the_box_evenly() -> None:
    """Every sixteenth of K_e by ratio and of M_p by size holds its share of a Sobol' sequence of 64."""
    units = np.array(
        [
            PlantSet(nominal=NOMINAL, ranges=BOX).to_unit(s)
            for s in PlantSet(nominal=NOMINAL, ranges=BOX).samples(64, seed=1)
        ]
    )
    for column in units.T:
        counts, _ = np.histogram(column, bins=16, range=(0.0, 1.0))
        assert set(counts) == {4}


@pytest.mark.parametrize("plants", [PlantSet(nominal=NOMINAL, ranges=BOX), BOTH])
def test_many_points_at_once_are_the_points_one_by_one(plants: PlantSet) -> None:
    units = np.random.default_rng(4).random((40, len(plants.varying)))
    columns = plants.from_units(units)
    for i, unit in enumerate(units):
        scenario = plants.from_unit(unit)
        for name, column in columns.items():
            assert column[i] == pytest.approx(getattr(scenario, name), rel=1e-14)


def test_many_parameters_have_no_more_corners_than_are_looked_at() -> None:
    ranges = dict.fromkeys(UNCERTAIN, (1.0, 2.0))
    two_poles = RobotModel(numerator=np.array([900.0]), denominator=np.array([1.0, 42.0, 900.0]), delay_s=1.5)
    corners = PlantSet(nominal=replace(NOMINAL, robot=two_poles), ranges=ranges).corners()
    assert len(corners) == MOST_CORNERS
    for name in UNCERTAIN:
        assert {getattr(s, name) for s in corners} == {1.0, 2.0}


def test_without_spread_there_is_one_point() -> None:
    one = PlantSet(nominal=NOMINAL, ranges={K_E: (1e5, 1e5), M_P: (8.0, 8.0)})
    assert one.corners() == one.samples(16) == (Scenario(environment_stiffness_n_per_m=1e5, payload_mass_kg=8.0),)


@pytest.mark.parametrize(
    ("ranges", "ellipsoid", "must"),
    [
        ({K_E: (1.0, 2.0)}, None, "given as a range"),
        ({**BOX, "mass": (1.0, 2.0)}, None, "one of environment_stiffness_n_per_m"),
        ({**BOX, K_S: (0.0, 2.0)}, None, "above 0"),
        ({**BOX, K_S: (3.0, 2.0)}, None, "from low to high"),
        ({K_E: (1.0, 2.0), M_P: (1.0, 2.0)}, CUT, "one of the parameters that vary"),
        ({**BOX, K_S: (1e5, 2e5)}, CUT, "inside the range"),
    ],
)
def test_a_set_that_cannot_be_is_refused(ranges: Any, ellipsoid: Ellipsoid | None, must: str) -> None:
    with pytest.raises(ParameterError, match=must):
        PlantSet(nominal=NOMINAL, ranges=ranges, ellipsoid=ellipsoid)


@pytest.mark.parametrize(
    "changes",
    [
        {"names": (K_S, K_S)},
        {"names": (K_S, "K_s")},
        {"covariance": ((9e6, 0.06), (0.06, 4e-10))},  # a correlation of 1
        {"covariance": ((9e6, 0.0), (0.048, 4e-10))},
        {"covariance": ((math.nan, 0.0), (0.0, 4e-10))},
        {"covariance": ((9e6, 0.0),)},
        {"level": 1.0},
    ],
)
def test_an_ellipsoid_that_cannot_be_is_refused(changes: Any) -> None:
    with pytest.raises(ParameterError, match="ellipsoid"):
        replace(CUT, **changes)


def test_a_scenario_is_the_nominal_plant_with_its_values() -> None:
    plain = Scenario(environment_stiffness_n_per_m=7e4, payload_mass_kg=9.0)
    assert plain.plant(NOMINAL) == replace(
        NOMINAL, payload=replace(NOMINAL.payload, mass_kg=9.0), environment=Environment(stiffness_n_per_m=7e4)
    )
    everything = replace(
        plain,
        coupling_stiffness_n_per_m=2.8e5,
        coupling_damping_n_s_per_m=50.0,
        drag_n_s_per_m=300.0,
        environment_damping_n_s_per_m=20.0,
        delay_s=3e-3,
        robot_bandwidth_hz=4.0,
    )
    plant = everything.plant(NOMINAL)
    assert plant.parameters().tolist() == [2.8e5, 50.0, 9.0, 300.0, 7e4, 20.0, 0.0]
    assert plant.robot.delay_s == 3e-3
    # A one-pole robot's bandwidth is its pole.
    np.testing.assert_allclose(plant.robot.denominator, [1.0, 8.0 * np.pi], rtol=1e-9)


@LAW
@given(between(0.2, 3.0), between(5.0, 200.0), between(0.3, 3.0))
def test_another_bandwidth_is_reached_and_keeps_the_shape(ratio: float, omega: float, share: float) -> None:
    robot = RobotModel(
        numerator=np.array([omega**2]), denominator=np.array([1.0, 2.0 * ratio * omega, omega**2]), delay_s=1e-3
    )
    own = bandwidth_hz(robot)
    assert own == pytest.approx(omega * bandwidth_share(ratio) / (2.0 * np.pi), rel=1e-9)
    moved = vary_robot(robot, bandwidth_hz=share * own)
    assert bandwidth_hz(moved) == pytest.approx(share * own, rel=1e-9)
    assert damping_ratio(moved) == pytest.approx(ratio, rel=1e-9)
    frequency = np.array([0.3, 1.0, 4.0]) * omega
    still = replace(robot, delay_s=0.0)
    np.testing.assert_allclose(
        replace(moved, delay_s=0.0).position_response(share * frequency), still.position_response(frequency), rtol=1e-8
    )
    # Another damping at the same bandwidth.
    damped = vary_robot(robot, damping_ratio=0.9)
    assert bandwidth_hz(damped) == pytest.approx(own, rel=1e-9)
    assert damping_ratio(damped) == pytest.approx(0.9)


def test_a_robot_with_a_zero_keeps_it_in_place() -> None:
    robot = RobotModel(numerator=np.array([2.0, 400.0]), denominator=np.array([1.0, 30.0, 400.0]), delay_s=0.0)
    moved = vary_robot(robot, bandwidth_hz=2.0 * bandwidth_hz(robot))
    np.testing.assert_allclose(np.roots(moved.numerator), 2.0 * np.roots(robot.numerator), rtol=1e-9)
    np.testing.assert_allclose(np.sort(np.roots(moved.denominator)), np.sort(2.0 * np.roots(robot.denominator)))
    with pytest.raises(ParameterError, match="two poles and no zero"):
        vary_robot(robot, damping_ratio=0.5)
