import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.linalg import expm

from problems.contact import Approach, build_sampled_contact, steady_approach
from problems.contact_kernel import advance, run_contact, switch_within, wall_force
from problems.controller import AdmittanceController, controller_blocks
from problems.plant import FREE_SPACE, Plant, build_plant_matrices
from problems.sampled import build_loop, build_sampled_plant
from tests.problems.axes import LAW, PERIOD_S, admittance, controllers, one_pole, paper_plant, plants

FloatArray = NDArray[np.float64]

FREE_RATE = np.array([[0.0, 1.0], [0.0, 0.0]])


@LAW
@given(st.integers(0, 2**32 - 1), st.integers(2, 5), st.floats(0.0, 1.0), st.sampled_from([0.1, 1.0, 30.0]))
def test_advance_is_the_matrix_exponential(seed: int, n: int, duration: float, size: float) -> None:
    rng = np.random.default_rng(seed)
    rate, push, state = size * rng.standard_normal((n, n)), rng.standard_normal(n), rng.standard_normal(n)
    rate -= (1.0 + np.max(np.linalg.eigvals(rate).real)) * np.eye(n)  # decaying, as plants are
    augmented = np.zeros((n + 1, n + 1))
    augmented[:n, :n], augmented[:n, n] = rate, push
    whole = expm(augmented * duration)
    # Some hundred pieces, each to rounding; a non-normal matrix grows for a while before it decays.
    np.testing.assert_allclose(
        advance(rate, push, state, duration), whole[:n, :n] @ state + whole[:n, n], atol=1e-11 * (1.0 + size)
    )


@LAW
@given(plants(), st.floats(0.0, 1.0), st.floats(-1.0, 1.0))
def test_advance_in_two_parts_is_advance(plant: Plant, share: float, command: float) -> None:
    m = build_plant_matrices(plant, PERIOD_S)
    state, push = np.linspace(0.5, -0.5, len(m.b)), command * m.b
    parts = advance(m.a, push, advance(m.a, push, state, share), 1.0 - share)
    # Entries of one and below, a few pieces.
    np.testing.assert_allclose(parts, advance(m.a, push, state, 1.0), atol=1e-14)


@pytest.mark.parametrize(
    ("position", "velocity", "force"),
    [(0.5, 0.0, 50.0), (0.5, 1.0, 57.0), (0.5, -20.0, -90.0), (0.0, 1.0, 7.0), (-0.1, 100.0, -10.0)],
)
def test_the_wall_pushes_behind_its_surface_only(position: float, velocity: float, force: float) -> None:
    assert wall_force(np.array([0.0, position, velocity]), 3, 100.0, 7.0) == pytest.approx(force, rel=1e-15)


def cross(state: list[float], stiffness: float, *, touching: bool, fraction: float = 0.0) -> tuple[FloatArray, bool]:
    """Cross one sample with a free mass of one on a spring of `stiffness`."""
    contact = np.array([[0.0, 1.0], [-stiffness, 0.0]])
    nothing = np.zeros(2)
    end, still = switch_within(
        (contact, FREE_RATE), (nothing, nothing), np.array(state), fraction, touching, (stiffness, 0.0)
    )
    return end, bool(still)


@pytest.mark.parametrize("fraction", [0.0, 0.2, 0.3, 0.9])
def test_touching_inside_a_sample_is_found_where_it_happens(fraction: float) -> None:
    end, touching = cross([-0.3, 1.0], 4.0, touching=False, fraction=fraction)
    # At the surface after 0.3, then a sine of 2 rad per sample; the event is bisected to 2^-44.
    np.testing.assert_allclose(end, [math.sin(1.4) / 2.0, math.cos(1.4)], atol=1e-13)
    assert touching


@pytest.mark.parametrize("fraction", [0.0, 0.5, 0.99])
def test_leaving_inside_a_sample_is_found_where_it_happens(fraction: float) -> None:
    end, touching = cross([math.sin(1.0) / 4.0, -math.cos(1.0)], 16.0, touching=True, fraction=fraction)
    # A sine of 4 rad per sample that is 1 rad before its zero: out after a quarter, at speed −1.
    np.testing.assert_allclose(end, [-0.75, -1.0], atol=1e-13)
    assert not touching


def test_a_push_that_changes_inside_the_sample_acts_for_its_part() -> None:
    old, new, fraction = np.array([0.0, 2.0]), np.array([0.0, -6.0]), 0.25
    contact = np.array([[0.0, 1.0], [-1.0, 0.0]])
    end, touching = switch_within((contact, FREE_RATE), (old, new), np.array([-9.0, 1.0]), fraction, False, (1.0, 0.0))
    # Far from the wall: parabolas of 2 and then −6.
    speed = 1.0 + 2.0 * fraction
    where = -9.0 + fraction + fraction**2
    np.testing.assert_allclose(end, [where + speed * 0.75 - 3.0 * 0.75**2, speed - 6.0 * 0.75], atol=1e-14)
    assert not touching


def bounce(plant: Plant, speed_m_s: float, samples: int) -> tuple[FloatArray, int]:
    """Throw the payload at the wall with the robot held still; return the energy [J] at every tick and the flights."""
    contact = build_plant_matrices(plant, PERIOD_S)
    free = build_plant_matrices(plant.in_contact_with(FREE_SPACE), PERIOD_S)
    stiffness, damping = plant.environment.stiffness_n_per_m, plant.environment.damping_n_s_per_m / PERIOD_S
    n = len(contact.b)
    state, push = np.zeros(n), np.zeros(n)
    state[n - 1] = speed_m_s * PERIOD_S
    energies, touching, flights = [], True, 0
    for _ in range(samples):
        after, still = switch_within((contact.a, free.a), (push, push), state, 0.0, touching, (stiffness, damping))
        flights += touching and not still
        state, touching = after, bool(still)
        spring = plant.coupling.stiffness_n_per_m * state[n - 2] ** 2 + stiffness * max(0.0, state[n - 2]) ** 2
        energies.append(0.5 * (plant.payload.mass_kg * (state[n - 1] / PERIOD_S) ** 2 + spring))
    return np.array(energies), flights


def test_a_payload_that_nothing_damps_bounces_forever_on_the_same_energy() -> None:
    plant = paper_plant(stiffness=5e5, mass=3.0, drag=0.0, coupling=3e3)
    energy, flights = bounce(plant, 0.1, 2000)
    assert flights > 5
    # 2000 samples of rounding and a few events, each located to 2^-44 of a sample.
    np.testing.assert_allclose(energy, 0.5 * 3.0 * 0.1**2, rtol=1e-10)


@LAW
@given(plants(contact=True), st.floats(0.01, 1.0))
def test_a_wall_and_a_payload_alone_never_gain_energy(plant: Plant, speed: float) -> None:
    energy, _ = bounce(plant, speed, 60)
    assert np.all(np.diff(energy) <= 1e-12 * energy[0])
    assert energy[0] <= 0.5 * plant.payload.mass_kg * speed**2 * (1.0 + 1e-12)


def run(plant: Plant, controller: AdmittanceController, samples: int, force: float) -> tuple[FloatArray, FloatArray]:
    """Return F and F_e of the kernel, from the steady approach on."""
    pair = build_sampled_contact(build_sampled_plant(plant, PERIOD_S))
    contact, free = pair.contact, pair.free
    start = steady_approach(free, build_loop(free, controller), Approach(force_n=force))
    wall = plant.environment
    sensed, pressed = run_contact(
        (contact.phi, contact.gamma, contact.gamma_old, contact.rate),
        (free.phi, free.gamma, free.gamma_old, free.rate),
        free.drive,
        (free.c_position, free.c_force, free.d_force),
        (free.whole_delay, free.chain_length, free.fraction),
        (wall.stiffness_n_per_m, wall.damping_n_s_per_m / PERIOD_S),
        controller_blocks(controller.parameters(), PERIOD_S),
        start.state,
        start.force_n,
        samples,
    )
    return np.asarray(sensed), np.asarray(pressed)


@LAW
@given(plants(contact=True), controllers())
def test_while_it_touches_the_kernel_is_the_loop_matrix(plant: Plant, controller: AdmittanceController) -> None:
    sensed, pressed = run(plant, controller, 200, 30.0)
    sampled = build_sampled_plant(plant, PERIOD_S)
    free = build_sampled_plant(plant.in_contact_with(FREE_SPACE), PERIOD_S)
    loop = build_loop(sampled, controller)
    state = steady_approach(free, build_loop(free, controller), Approach(force_n=30.0)).state
    left = np.flatnonzero(pressed[1:] <= 0.0)
    stays = int(left[0]) + 1 if left.size else len(pressed)
    assert stays > 3
    expected, wall = [], plant.environment
    n = sampled.state_count
    contact_force = []
    for _ in range(stays):
        expected.append(loop.c_force @ state + loop.d_force * 30.0)
        contact_force.append(wall.stiffness_n_per_m * state[n - 2] + wall.damping_n_s_per_m / PERIOD_S * state[n - 1])
        state = loop.a @ state + loop.b * 30.0
    # The same sums in another order; F is a difference of terms up to a thousand times as large.
    scale = np.max(np.abs(expected))
    np.testing.assert_allclose(sensed[:stays], expected, atol=1e-10 * scale)
    np.testing.assert_allclose(pressed[1:stays], contact_force[1:], atol=1e-10 * scale)


@pytest.mark.parametrize("damping", [0.0, 400.0])
def test_at_the_impact_the_wall_pushes_with_its_damping_times_the_speed(damping: float) -> None:
    plant = paper_plant(stiffness=1e5, environment_damping=damping, robot=one_pole(2.2e-3))
    _, pressed = run(plant, admittance(damping=2000.0), 3, 30.0)
    # The sampled approach is 2e-4 from F^d/(B_a + B_p).
    assert pressed[0] == pytest.approx(damping * 30.0 / 2630.0, rel=1e-3, abs=1e-9)
