import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from problems.arrays import ComplexArray
from problems.errors import ParameterError
from problems.model.plant import (
    FREE_SPACE,
    Coupling,
    Environment,
    PayloadDynamics,
    Plant,
    PlantMatrices,
    build_plant_matrices,
)
from tests.problems.axes import LAW, PERIOD_S, any_plants, between, environments, paper_plant, plants
from tests.problems.reference import (
    continuous_motion,
    environment_impedance,
    payload_admittance,
    rendered_impedance,
    robot_gain,
)

# Entries and solutions are exact to rounding; near a resonance the solve loses up to the resonance's sharpness squared.
TOLERANCE = 1e-9


def respond(m: PlantMatrices, s: complex, *, push: bool = False) -> ComplexArray:
    """Return x, F, F_e and x_p per x^d, or per outside force, of the matrices at s."""
    size = len(m.b)
    drive, d_force, d_contact = (m.push, 0.0, m.push_contact) if push else (m.b, m.d_force, m.d_contact)
    state = np.linalg.solve(s * m.time_scale_s * np.eye(size) - m.a, drive.astype(complex))
    return np.array(
        [m.c_position @ state, m.c_force @ state + d_force, m.c_contact @ state + d_contact, state[size - 2]]
    )


@LAW
@given(any_plants(), between(0.05, 4000.0))
def test_the_matrices_are_the_transfer_functions(plant: Plant, omega: float) -> None:
    """x = r x^d, F = −Ē V, V_p = −F P/(1 + P E) and F_e = E V_p, docs/method.md, "The loop"."""
    s = np.array([1j * omega])
    payload, wall = payload_admittance(plant, s)[0], environment_impedance(plant, s)[0]
    position = robot_gain(plant, s)[0]
    force = -rendered_impedance(plant, s)[0] * s[0] * position
    payload_position = -force * payload / (1.0 + payload * wall) / s[0]
    # F is a difference of two spring forces: its error is measured against either of them.
    spring = (plant.coupling.stiffness_n_per_m + omega * plant.coupling.damping_n_s_per_m) * max(
        abs(position), abs(payload_position)
    )
    found = respond(build_plant_matrices(plant, PERIOD_S), s[0])
    np.testing.assert_allclose(found[0], position, rtol=TOLERANCE)
    np.testing.assert_allclose(found[1], force, rtol=TOLERANCE, atol=1e-13 * spring)
    np.testing.assert_allclose(found[3], payload_position, rtol=TOLERANCE)
    # At the resonance of mass and spring of the environment F_e is a difference as well.
    np.testing.assert_allclose(
        found[2], wall * s[0] * payload_position, rtol=TOLERANCE, atol=1e-13 * spring + _inertia(plant, found[3], omega)
    )


def _inertia(plant: Plant, payload_position: complex, omega: float) -> float:
    """Return the rounding of M_e a and K_e x_p, which F_e is the sum of."""
    wall = plant.environment
    return float(1e-12 * (wall.mass_kg * omega**2 + wall.stiffness_n_per_m) * abs(payload_position))


@LAW
@given(any_plants(), between(0.05, 4000.0))
def test_a_hand_moves_the_payload_against_everything_that_holds_it(plant: Plant, omega: float) -> None:
    """V_p = f P/(1 + P (E + C_s)), F = C_s V_p and F_e = E V_p with the robot at rest."""
    s = np.array([1j * omega])
    payload, wall = payload_admittance(plant, s)[0], environment_impedance(plant, s)[0]
    coupling = plant.coupling.stiffness_n_per_m / s[0] + plant.coupling.damping_n_s_per_m
    velocity = payload / (1.0 + payload * (wall + coupling))
    found = respond(build_plant_matrices(plant, PERIOD_S), s[0], push=True)
    # Elimination mixes the rows: rounding of the payload's motion.
    assert abs(found[0]) < 1e-12 * abs(found[3])
    np.testing.assert_allclose(found[1], coupling * velocity, rtol=TOLERANCE)
    np.testing.assert_allclose(found[3], velocity / s[0], rtol=TOLERANCE)
    # The three terms of F_e may cancel, and M_e a is a share of f.
    np.testing.assert_allclose(found[2], wall * velocity, rtol=TOLERANCE, atol=1e-13 + _inertia(plant, found[3], omega))


@LAW
@given(any_plants(), between(1.0, 3000.0), st.floats(-1.5, 1.5))
def test_the_matrices_are_scipys_state_space_in_si(plant: Plant, size: float, angle: float) -> None:
    """The same transfer functions from SI matrices around scipy's form of r(s), at complex s."""
    s, si = size * np.exp(1j * angle), continuous_motion(plant)
    expected = si.c @ np.linalg.solve(s * np.eye(len(si.a)) - si.a, si.b.astype(complex)) + si.d
    m = build_plant_matrices(plant, PERIOD_S)
    found = np.array([respond(m, s), respond(m, s, push=True)]).T[[1, 0, 2]]
    # SI entries reach from 1 to K_s/M_p = 1e6: six digits of sixteen, against the largest term of each force.
    stiffness = plant.coupling.stiffness_n_per_m + plant.environment.stiffness_n_per_m + size**2
    np.testing.assert_allclose(found[1], expected[1], rtol=1e-8, atol=1e-14)
    np.testing.assert_allclose(found[[0, 2], 0], expected[[0, 2], 0], rtol=1e-8, atol=1e-10 * stiffness)
    np.testing.assert_allclose(found[[0, 2], 1], expected[[0, 2], 1], rtol=1e-8, atol=1e-10)


@LAW
@given(any_plants(), between(1e-4, 1.0), between(0.5, 500.0))
def test_the_unit_of_time_changes_nothing(plant: Plant, unit_s: float, omega: float) -> None:
    one, other = (respond(build_plant_matrices(plant, t), 1j * omega) for t in (PERIOD_S, unit_s))
    # Coarser units mix entries of very different size, which costs some digits in the solve.
    np.testing.assert_allclose(one, other, rtol=1e-7, atol=_inertia(plant, one[3], omega))


@LAW
@given(any_plants(touched=environments()))
def test_at_rest_the_flange_feels_coupling_and_wall_in_series(plant: Plant) -> None:
    """Damper and mass are not felt at rest: a wall without stiffness leaves no force at all."""
    m = build_plant_matrices(plant, PERIOD_S)
    rest = np.linalg.solve(-m.a, m.b)
    coupling, wall = plant.coupling.stiffness_n_per_m, plant.environment.stiffness_n_per_m
    series = coupling * wall / (coupling + wall)
    # The largest and smallest stiffness differ by a factor of 1000: three digits of sixteen.
    np.testing.assert_allclose(m.c_position @ rest, 1.0, rtol=TOLERANCE)
    np.testing.assert_allclose(m.c_force @ rest + m.d_force, -series, rtol=TOLERANCE, atol=TOLERANCE * coupling)
    # M_e times an acceleration that is rounding: up to M_e/(M_p + M_e) of the spring forces.
    np.testing.assert_allclose(m.c_contact @ rest + m.d_contact, series, rtol=TOLERANCE, atol=TOLERANCE * coupling)


def test_pressing_on_a_wall_reads_negative_and_the_payload_hangs_behind() -> None:
    m = build_plant_matrices(paper_plant(), PERIOD_S)
    x, force, contact, payload = respond(m, 1e-6j).real
    assert force < 0.0 < payload < x
    assert contact > 0.0
    _, force, contact, payload = respond(m, 1e-6j, push=True).real
    assert min(force, contact, payload) > 0.0


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


@pytest.mark.parametrize(
    ("stiffness", "damping", "mass", "free", "anchored"),
    [
        (0.0, 0.0, 0.0, True, False),
        (1e-9, 0.0, 0.0, False, True),
        (0.0, 5.0, 0.0, False, False),
        (0.0, 0.0, 2.0, False, False),
        (2e4, 5.0, 2.0, False, True),
    ],
)
def test_only_stiffness_anchors_and_only_nothing_is_free_space(
    stiffness: float, damping: float, mass: float, free: bool, anchored: bool
) -> None:
    environment = Environment(stiffness_n_per_m=stiffness, damping_n_s_per_m=damping, mass_kg=mass)
    assert (environment.is_free_space, environment.is_anchored) == (free, anchored)
    assert FREE_SPACE.is_free_space


@LAW
@given(any_plants(touched=environments()))
def test_a_mass_in_front_is_a_heavier_payload_and_a_damper_more_drag(plant: Plant) -> None:
    """While they touch, M_e and B_e add to M_p and B_p."""
    wall, payload = plant.environment, plant.payload
    heavier = PayloadDynamics(
        mass_kg=payload.mass_kg + wall.mass_kg, drag_n_s_per_m=payload.drag_n_s_per_m + wall.damping_n_s_per_m
    )
    spring = Environment(stiffness_n_per_m=wall.stiffness_n_per_m)
    both = Plant(robot=plant.robot, coupling=plant.coupling, payload=heavier, environment=spring)
    one, other = build_plant_matrices(plant, PERIOD_S), build_plant_matrices(both, PERIOD_S)
    # The same sums, rounded once more.
    for name in ("a", "b", "push", "c_position", "c_force", "d_force"):
        np.testing.assert_allclose(getattr(one, name), getattr(other, name), rtol=1e-14)


@pytest.mark.parametrize("value", [-1.0, math.nan, math.inf])
@given(
    st.sampled_from(
        ["mass", "drag", "coupling", "coupling_damping", "stiffness", "environment_damping", "environment_mass"]
    )
)
def test_values_that_cannot_be_are_refused(value: float, name: str) -> None:
    with pytest.raises(ParameterError, match=name.rsplit("_", maxsplit=1)[-1].replace("coupling", "stiffness")):
        paper_plant(**{name: value})  # type: ignore[arg-type]


def test_mass_and_coupling_must_be_there() -> None:
    with pytest.raises(ParameterError, match="mass_kg"):
        PayloadDynamics(mass_kg=0.0, drag_n_s_per_m=0.0)
    with pytest.raises(ParameterError, match="stiffness_n_per_m"):
        Coupling(stiffness_n_per_m=0.0, damping_n_s_per_m=0.0)
    assert replace(FREE_SPACE, stiffness_n_per_m=1.0).stiffness_n_per_m == 1.0


@pytest.mark.parametrize("unit_s", [0.0, -1.0, math.nan])
def test_the_unit_of_time_must_be_positive(unit_s: float) -> None:
    with pytest.raises(ParameterError, match="time_scale_s"):
        build_plant_matrices(paper_plant(), unit_s)
