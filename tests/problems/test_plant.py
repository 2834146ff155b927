import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from problems.errors import ParameterError
from problems.plant import FREE_SPACE, Coupling, Environment, Payload, Plant, PlantMatrices, build_plant_matrices
from tests.problems.axes import LAW, PERIOD_S, between, paper_plant, plants
from tests.problems.reference import rendered_impedance, robot_gain

ComplexArray = NDArray[np.complex128]

# Entries and solutions are exact to rounding; near a resonance the solve loses up to the resonance's sharpness squared.
TOLERANCE = 1e-9


def respond(m: PlantMatrices, s: complex) -> ComplexArray:
    """Return x, F and x_p per x^d of the matrices at s."""
    size = len(m.b)
    state = np.linalg.solve(s * m.time_scale_s * np.eye(size) - m.a, m.b.astype(complex))
    return np.array([m.c_position @ state, m.c_force @ state + m.d_force, state[size - 2]])


@LAW
@given(plants(), between(0.05, 4000.0))
def test_the_matrices_are_the_transfer_functions(plant: Plant, omega: float) -> None:
    """x = r x^d, F = −Ē V and V_p = −F P/(1 + P E), MODEL.md "Continuous blocks"."""
    s = np.array([1j * omega])
    position = robot_gain(plant, s)[0]
    force = -rendered_impedance(plant, s)[0] * s[0] * position
    payload = 1.0 / (plant.payload.mass_kg * s[0] + plant.payload.drag_n_s_per_m)
    wall = plant.environment.stiffness_n_per_m / s[0] + plant.environment.damping_n_s_per_m
    payload_position = -force * payload / (1.0 + payload * wall) / s[0]
    # F is a difference of two spring forces: its error is measured against either of them.
    spring = (plant.coupling.stiffness_n_per_m + omega * plant.coupling.damping_n_s_per_m) * max(
        abs(position), abs(payload_position)
    )
    found = respond(build_plant_matrices(plant, PERIOD_S), s[0])
    np.testing.assert_allclose(found[0], position, rtol=TOLERANCE)
    np.testing.assert_allclose(found[1], force, rtol=TOLERANCE, atol=1e-13 * spring)
    np.testing.assert_allclose(found[2], payload_position, rtol=TOLERANCE)


@LAW
@given(plants(), between(1e-4, 1.0), between(0.5, 500.0))
def test_the_unit_of_time_changes_nothing(plant: Plant, unit_s: float, omega: float) -> None:
    one, other = (respond(build_plant_matrices(plant, t), 1j * omega) for t in (PERIOD_S, unit_s))
    # Coarser units mix entries of very different size, which costs some digits in the solve.
    np.testing.assert_allclose(one, other, rtol=1e-7)


@LAW
@given(plants(contact=True))
def test_at_rest_the_flange_feels_coupling_and_wall_in_series(plant: Plant) -> None:
    m = build_plant_matrices(plant, PERIOD_S)
    rest = np.linalg.solve(-m.a, m.b)
    coupling, wall = plant.coupling.stiffness_n_per_m, plant.environment.stiffness_n_per_m
    # The largest and smallest stiffness differ by a factor of 1000: three digits of sixteen.
    np.testing.assert_allclose(m.c_position @ rest, 1.0, rtol=TOLERANCE)
    np.testing.assert_allclose(m.c_force @ rest + m.d_force, -coupling * wall / (coupling + wall), rtol=TOLERANCE)


def test_pressing_on_a_wall_reads_negative_and_the_payload_hangs_behind() -> None:
    m = build_plant_matrices(paper_plant(), PERIOD_S)
    x, force, payload = respond(m, 1e-6j).real
    assert force < 0.0 < payload < x


@LAW
@given(plants(contact=False))
def test_in_free_space_rest_is_without_force(plant: Plant) -> None:
    m = build_plant_matrices(plant, PERIOD_S)
    rest = np.linalg.solve(-m.a, m.b)
    # Two springs forces of K_s · 1 m cancel.
    assert abs(m.c_force @ rest + m.d_force) < TOLERANCE * plant.coupling.stiffness_n_per_m


def test_in_contact_with_changes_the_environment_and_nothing_else() -> None:
    free, wall = paper_plant(stiffness=0.0), Environment(stiffness_n_per_m=2e4, damping_n_s_per_m=7.0)
    touching = free.in_contact_with(wall)
    assert touching.environment is wall
    assert (touching.robot, touching.coupling, touching.payload) == (free.robot, free.coupling, free.payload)
    assert free.environment.is_free_space


@pytest.mark.parametrize(("stiffness", "damping", "free"), [(0.0, 0.0, True), (1e-9, 0.0, False), (0.0, 5.0, False)])
def test_free_space_is_no_stiffness_and_no_damping(stiffness: float, damping: float, free: bool) -> None:
    assert Environment(stiffness_n_per_m=stiffness, damping_n_s_per_m=damping).is_free_space is free
    assert FREE_SPACE.is_free_space


@pytest.mark.parametrize("value", [-1.0, math.nan, math.inf])
@given(st.sampled_from(["mass", "drag", "coupling", "coupling_damping", "stiffness", "environment_damping"]))
def test_values_that_cannot_be_are_refused(value: float, name: str) -> None:
    with pytest.raises(ParameterError, match=name.rsplit("_", maxsplit=1)[-1].replace("coupling", "stiffness")):
        paper_plant(**{name: value})  # type: ignore[arg-type]


def test_mass_and_coupling_must_be_there() -> None:
    with pytest.raises(ParameterError, match="mass_kg"):
        Payload(mass_kg=0.0, drag_n_s_per_m=0.0)
    with pytest.raises(ParameterError, match="stiffness_n_per_m"):
        Coupling(stiffness_n_per_m=0.0, damping_n_s_per_m=0.0)
    assert replace(FREE_SPACE, stiffness_n_per_m=1.0).stiffness_n_per_m == 1.0


@pytest.mark.parametrize("unit_s", [0.0, -1.0, math.nan])
def test_the_unit_of_time_must_be_positive(unit_s: float) -> None:
    with pytest.raises(ParameterError, match="time_scale_s"):
        build_plant_matrices(paper_plant(), unit_s)
