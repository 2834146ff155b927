"""Inside a sample: integration, meetings and departures, and the largest force."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.linalg import expm

from problems.arrays import FloatArray
from problems.contact.events import (
    MOST_SUBSTEPS,
    advance,
    advance_surface,
    apply_impact,
    contact_force,
    is_in_contact,
    rate_bound,
    substeps_apart,
)
from problems.contact.kernel import switch_within
from problems.contact.kernel_types import HeldInputs, Inputs, Wall
from problems.contact.peaks import largest_force, largest_in_sample
from problems.model.plant import Plant, build_plant_matrices
from tests.problems.axes import (
    LAW,
    PERIOD_S,
    any_plants,
    between,
    environments,
    one_pole,
    or_zero,
    pair_of,
    paper_plant,
    plants,
)


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
@given(st.integers(0, 2**32 - 1), st.integers(1, 6))
def test_nothing_turns_faster_than_the_bound_of_its_rate(seed: int, n: int) -> None:
    rate = np.random.default_rng(seed).standard_normal((n, n))
    norm = float(np.linalg.norm(rate, np.inf))
    assert np.max(np.abs(np.linalg.eigvals(rate))) <= (1.0 + 1e-12) * rate_bound(rate) <= (1.0 + 2e-12) * norm


def test_the_bound_of_an_oscillator_is_its_frequency_and_not_the_square() -> None:
    assert rate_bound(np.array([[0.0, 1.0], [-64.0, 0.0]])) == pytest.approx(8.0)


@LAW
@given(plants(), st.floats(0.0, 1.0), st.floats(-1.0, 1.0))
def test_advance_in_two_parts_is_advance(plant: Plant, share: float, command: float) -> None:
    m = build_plant_matrices(plant, PERIOD_S)
    state, push = np.linspace(0.5, -0.5, len(m.b)), command * m.b
    parts = advance(m.a, push, advance(m.a, push, state, share), 1.0 - share)
    # Entries of one and below, a few pieces.
    np.testing.assert_allclose(parts, advance(m.a, push, state, 1.0), atol=1e-14)


@LAW
@given(
    or_zero(between(1e-4, 1e4)),
    or_zero(between(1e-3, 1e2)),
    between(0.01, 10.0),
    st.sampled_from([None, 1e-9, 1e-3]),
    st.floats(0.0, 1.0),
)
def test_a_mass_alone_swings_as_the_matrix_exponential_has_it(
    stiffness: float, damping: float, mass: float, from_critical: float | None, duration: float
) -> None:
    """Undamped, damped, overdamped, and as near to critical damping as rounding goes; without spring it coasts."""
    if from_critical is not None:
        damping = 2.0 * math.sqrt(stiffness * mass) * (1.0 + from_critical)
    surface = np.array([0.7, -0.4])
    expected = expm(duration * np.array([[0.0, 1.0], [-stiffness / mass, -damping / mass]])) @ surface
    advance_surface(surface, Wall(stiffness, damping, mass, 0.5), duration)
    # Up to 1e3 rad: scipy squares ten to twenty times. The speed's unit is the frequency's.
    frequency = 1.0 + math.sqrt(stiffness / mass) + damping / mass
    np.testing.assert_allclose(surface, expected, rtol=0.0, atol=1e-10 * frequency)


def test_a_surface_without_mass_does_not_move_by_itself() -> None:
    surface = np.array([0.0, 0.0])
    advance_surface(surface, Wall(5e5, 3.0, 0.0, 1.0), 1.0)
    assert surface.tolist() == [0.0, 0.0]


# Rows of x, F and F_e over (x_p, v_p, held command, outside force) of a payload of one on a spring of 100 and damper 7.
ROWS = np.array([[0.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 0.0], [100.0, 7.0, 0.0, 0.0]])


@pytest.mark.parametrize("touching", [True, False])
@pytest.mark.parametrize(
    ("position", "velocity", "expected"),
    [
        (0.5, 0.0, True),
        (0.5, 1.0, True),
        (0.5, -7.0, True),
        (0.5, -7.5, False),
        (0.0, 1.0, True),
        (0.0, -1.0, False),
        (-0.1, 100.0, False),
    ],
)
def test_a_massless_wall_pushes_behind_its_surface_and_pulls_nowhere(
    position: float, velocity: float, expected: bool, touching: bool
) -> None:
    state, wall = np.array([position, velocity]), Wall(100.0, 7.0, 0.0, 1.0)
    assert is_in_contact(state, np.zeros(2), wall, ROWS, HeldInputs(0.0, 0.0), touching) is expected


@pytest.mark.parametrize(("gap", "expected"), [(0.1, False), (0.0, False), (-1e-9, True)])
def test_a_mass_is_met_where_it_is(gap: float, expected: bool) -> None:
    state, wall = np.array([0.3, 1.0]), Wall(100.0, 7.0, 2.0, 1.0 / 3.0)
    assert is_in_contact(state, np.array([0.3 + gap, -5.0]), wall, ROWS, HeldInputs(0.0, 0.0), False) is expected


@LAW
@given(st.integers(0, 2**32 - 1))
def test_the_contact_force_is_a_row_times_state_and_inputs(seed: int) -> None:
    rng = np.random.default_rng(seed)
    rows, state, inputs = rng.standard_normal((3, 6)), rng.standard_normal(4), HeldInputs(*rng.standard_normal(2))
    # The same six products in another order.
    assert contact_force(state, rows, inputs) == pytest.approx(rows[2] @ [*state, *inputs], abs=1e-14)


@LAW
@given(between(0.5, 60.0), between(1e-3, 100.0), st.floats(-1.0, 1.0), st.floats(-1.0, 1.0))
def test_a_meeting_keeps_the_momentum_and_nothing_rebounds(
    payload: float, mass: float, speed: float, surface_speed: float
) -> None:
    wall = Wall(1e5, 0.0, mass, payload / (payload + mass))
    state, surface = np.array([0.0, 0.0, speed]), np.array([0.0, surface_speed])
    impulse = apply_impact(state, surface, wall, False)
    together = (payload * speed + mass * surface_speed) / (payload + mass)
    assert state[2] == pytest.approx(together, abs=1e-14)
    assert impulse == pytest.approx(payload * mass / (payload + mass) * (speed - surface_speed), abs=1e-12)


def test_the_surface_is_left_where_and_as_fast_as_the_payload_leaves_it() -> None:
    state, surface = np.array([0.5, 0.2, -0.3]), np.zeros(2)
    assert apply_impact(state, surface, Wall(1e5, 0.0, 2.0, 0.5), True) == 0.0
    assert surface.tolist() == [0.2, -0.3]
    assert state.tolist() == [0.5, 0.2, -0.3]


def cross(
    state: list[float],
    stiffness: float,
    *,
    touching: bool,
    fraction: float = 0.0,
    mass: float = 0.0,
    surface: tuple[float, float] = (0.0, 0.0),
    pushes: tuple[float, float] = (0.0, 0.0),
    substeps: int = 1,
) -> tuple[FloatArray, FloatArray, tuple[bool, float, float, float]]:
    """Cross one sample with a free mass of one that is pushed, against a spring of `stiffness` with `mass` on it."""
    whole = 1.0 + mass
    contact = np.array([[0.0, 1.0, 0.0, 0.0], [-stiffness / whole, 0.0, 1.0 / whole, 1.0 / whole]])
    free = np.array([[0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 1.0]])
    rows = np.zeros((3, 4))
    rows[2] = stiffness / whole, 0.0, mass / whole, mass / whole
    end, surface_end = np.array(state), np.array(surface)
    found = switch_within(
        np.array([contact, free]),
        end,
        surface_end,
        Wall(stiffness, 0.0, mass, 1.0 / whole),
        rows,
        Inputs(*pushes, 0.0),
        fraction,
        touching,
        substeps,
    )
    return end, surface_end, found


@pytest.mark.parametrize("fraction", [0.0, 0.2, 0.3, 0.9])
@pytest.mark.parametrize("substeps", [1, 3])
def test_touching_inside_a_sample_is_found_where_it_happens(fraction: float, substeps: int) -> None:
    end, _, (touching, impulse, largest, moment) = cross(
        [-0.3, 1.0], 4.0, touching=False, fraction=fraction, substeps=substeps
    )
    # At the surface after 0.3, then a sine of 2 rad per sample; the event is bisected to 2^-44.
    np.testing.assert_allclose(end, [math.sin(1.4) / 2.0, math.cos(1.4)], atol=1e-13)
    assert touching
    assert impulse == 0.0
    # The sine rises to the end of the sample.
    assert (largest, moment) == pytest.approx((2.0 * math.sin(1.4), 1.0), rel=1e-12)


@pytest.mark.parametrize("fraction", [0.0, 0.5, 0.99])
def test_leaving_inside_a_sample_is_found_where_it_happens(fraction: float) -> None:
    end, _, (touching, _, largest, moment) = cross(
        [math.sin(1.0) / 4.0, -math.cos(1.0)], 16.0, touching=True, fraction=fraction
    )
    # A sine of 4 rad per sample that is 1 rad before its zero: out after a quarter, at speed −1; it only falls.
    np.testing.assert_allclose(end, [-0.75, -1.0], atol=1e-13)
    assert not touching
    assert (largest, moment) == pytest.approx((4.0 * math.sin(1.0), 0.0), abs=1e-13)


@pytest.mark.parametrize("fraction", [0.0, 0.1, 0.6])
def test_a_bounce_within_one_sample_is_seen_with_its_peak(fraction: float) -> None:
    """8 rad per sample: at its end a payload that had stayed would press again, but it has left after π/8."""
    end, _, (touching, _, largest, moment) = cross([0.0, 1.0], 64.0, touching=True, fraction=fraction, substeps=16)
    np.testing.assert_allclose(end, [-(1.0 - math.pi / 8.0), -1.0], atol=1e-12)
    assert not touching
    # A maximum is flat: its moment is known to the root of what its value is.
    assert largest == pytest.approx(8.0, rel=1e-10)
    assert moment == pytest.approx(math.pi / 16.0, abs=1e-5)


def test_a_payload_that_falls_back_within_the_sample_touches_again() -> None:
    """Pushed by u it leaves at speed −1, is back after 2/u at speed 1, and the second sine begins."""
    end, _, (touching, _, _, _) = cross([0.0, 1.0], 400.0, touching=True, pushes=(3.0, 3.0), substeps=40)
    # On the spring: x = (u/ω²)(1 − cos ωt) + sin(ωt)/ω, back at zero after 2 (π − atan(ω/u))/ω.
    omega, u = 20.0, 3.0
    on = 2.0 * (math.pi - math.atan(omega / u)) / omega
    rest = 1.0 - on - 2.0 / u
    assert 0.0 < rest < on
    expected = [
        u / omega**2 * (1.0 - math.cos(omega * rest)) + math.sin(omega * rest) / omega,
        u / omega * math.sin(omega * rest) + math.cos(omega * rest),
    ]
    np.testing.assert_allclose(end, expected, atol=1e-11)
    assert touching


def test_a_push_that_changes_inside_the_sample_acts_for_its_part() -> None:
    fraction = 0.25
    end, _, (touching, _, largest, _) = cross([-9.0, 1.0], 1.0, touching=False, fraction=fraction, pushes=(2.0, -6.0))
    # Far from the wall: parabolas of 2 and then −6.
    speed = 1.0 + 2.0 * fraction
    where = -9.0 + fraction + fraction**2
    np.testing.assert_allclose(end, [where + speed * 0.75 - 3.0 * 0.75**2, speed - 6.0 * 0.75], atol=1e-14)
    assert not touching
    assert largest == 0.0


def test_a_mass_that_swings_back_meets_the_payload_and_they_part_again() -> None:
    """Payload at rest at −a, surface x_s = −A sin ωt: they meet at sin ωt = a/A, and the spring pulls the mass away."""
    mass, omega, a, amplitude = 0.25, 3.0, 0.2, 0.5
    end, surface, (touching, impulse, largest, _) = cross(
        [-a, 0.0],
        mass * omega**2,
        touching=False,
        mass=mass,
        surface=(0.0, -amplitude * omega),
        substeps=8,
    )
    meeting = math.asin(a / amplitude) / omega
    speed = -omega * math.sqrt(amplitude**2 - a**2)
    common = mass / (1.0 + mass) * speed
    assert meeting < 1.0
    assert not touching
    # The mass loses speed to the payload: an impulse on it in +x.
    assert impulse == pytest.approx(mass * (common - speed), rel=1e-11)
    left = 1.0 - meeting
    np.testing.assert_allclose(end, [-a + common * left, common], atol=1e-11)
    phase = omega * left
    alone = [
        -a * math.cos(phase) + common / omega * math.sin(phase),
        omega * a * math.sin(phase) + common * math.cos(phase),
    ]
    np.testing.assert_allclose(surface, alone, atol=1e-11)
    assert largest == 0.0


def test_a_mass_in_front_of_the_payload_presses_with_its_inertia_while_it_is_pushed() -> None:
    """No spring: a push u on a payload of one before a mass m makes F_e = u m/(1 + m), an acceleration of u/(1 + m)."""
    end, _, (touching, _, largest, _) = cross([0.0, 0.0], 0.0, touching=True, mass=3.0, pushes=(8.0, 8.0))
    assert touching
    np.testing.assert_allclose(end, [1.0, 2.0], rtol=1e-14)
    assert largest == pytest.approx(6.0, rel=1e-14)


def test_a_mass_that_is_not_pushed_any_more_is_torn_off_at_once() -> None:
    """A pull on the payload at the tick leaves the mass behind it, which goes on at its speed."""
    end, surface, (touching, _, largest, _) = cross([0.0, 1.0], 0.0, touching=True, mass=3.0, pushes=(-2.0, -2.0))
    assert not touching
    np.testing.assert_allclose(end, [0.0, -1.0], atol=1e-14)
    np.testing.assert_allclose(surface, [1.0, 1.0], rtol=1e-14)
    assert largest == 0.0


@pytest.mark.parametrize(
    ("wall", "substeps"),
    [
        (Wall(1e6, 5.0, 0.0, 1.0), 1),
        (Wall(0.0, 5.0, 2.0, 0.5), 1),
        (Wall(0.01, 0.0, 1.0, 0.5), 1),
        (Wall(4.0, 0.0, 1.0, 0.5), 4),
        (Wall(1e8, 0.0, 1.0, 0.5), MOST_SUBSTEPS),
    ],
)
def test_a_mass_apart_is_crossed_in_two_substeps_per_radian(wall: Wall, substeps: int) -> None:
    assert substeps_apart(wall) == substeps


def bounce(plant: Plant, speed_m_s: float, samples: int) -> tuple[FloatArray, int]:
    """Throw the payload at the wall with the robot held still; return the energy [J] at every tick and the flights."""
    _, flow, rows, inside, _, wall = pair_of(plant).arguments
    n, mass = flow.shape[1], plant.environment.mass_kg
    state, surface = np.zeros(n), np.zeros(2)
    state[n - 1] = speed_m_s * PERIOD_S
    apply_impact(state, surface, wall, False)
    energies, touching, flights = [], True, 0
    substeps = max(len(inside) + 1, substeps_apart(wall))
    for _ in range(samples):
        still, *_ = switch_within(flow, state, surface, wall, rows, Inputs(0.0, 0.0, 0.0), 0.0, touching, substeps)
        flights, touching = flights + (touching and not still), bool(still)
        where, fast = (state[n - 2], state[n - 1]) if touching else (surface[0], surface[1])
        spring = plant.coupling.stiffness_n_per_m * state[n - 2] ** 2 + plant.environment.stiffness_n_per_m * where**2
        moving = plant.payload.mass_kg * (state[n - 1] / PERIOD_S) ** 2 + mass * (fast / PERIOD_S) ** 2
        energies.append(0.5 * (moving + spring))
    return np.array(energies), flights


@pytest.mark.parametrize(("stiffness", "flights"), [(5e5, 5), (1e8, 5)])
def test_a_payload_that_nothing_damps_bounces_forever_on_the_same_energy(stiffness: float, flights: int) -> None:
    plant = paper_plant(stiffness=stiffness, mass=3.0, drag=0.0, coupling=3e3)
    energy, found = bounce(plant, 0.1, 1500)
    assert found > flights
    # 1500 samples of rounding and a few events, each located to 2^-44 of a sample.
    np.testing.assert_allclose(energy, 0.5 * 3.0 * 0.1**2, rtol=1e-9)


@LAW
@given(any_plants(touched=environments()), st.floats(0.01, 1.0))
def test_a_wall_and_a_payload_alone_never_gain_energy(plant: Plant, speed: float) -> None:
    """Springs, dampers and masses of any kind: each meeting and each sample may only lose."""
    energy, _ = bounce(plant, speed, 60)
    before = 0.5 * plant.payload.mass_kg * speed**2
    assert np.all(np.diff(energy) <= 1e-10 * before)  # an event is located to 2^-44, at forces up to 1e3 of the mean
    assert energy[0] <= before * (1.0 + 1e-10)


def test_the_energy_that_an_impact_takes_is_that_of_the_relative_motion() -> None:
    """½ M_e M_p/(M_e + M_p) v² is lost in the meeting without rebound, and nothing afterwards while they stay."""
    plant = paper_plant(stiffness=2e5, mass=6.0, drag=0.0, coupling=3e3, environment_mass=2.0)
    energy, flights = bounce(plant, 0.2, 4)
    assert flights == 0
    np.testing.assert_allclose(energy, 0.5 * 6.0 * 0.2**2 * 6.0 / 8.0, rtol=1e-11)


@LAW
@given(any_plants(touched=environments()), st.integers(0, 2**32 - 1), st.floats(0.0, 0.99))
def test_the_largest_force_of_a_sample_is_that_of_a_fine_grid(plant: Plant, seed: int, fraction: float) -> None:
    _, flow, rows, _, _, _ = pair_of(plant).arguments
    rng = np.random.default_rng(seed)
    state = rng.standard_normal((flow.shape[1],))
    inputs = Inputs(rng.normal(), rng.normal(), rng.normal())
    grid = force_on_grid(flow[0], rows, state, inputs, fraction)
    value, moment = largest_in_sample(flow[0], rows, inputs, state, fraction)
    scale = np.max(np.abs(grid))
    # A parabola is missed by (ω/400)²/8 of its height between the points of a sample without a fraction, at up to
    # 0.6 rad per sample: 2.8e-7, and only upwards.
    assert -1e-12 * scale <= value - np.max(grid) <= 3e-7 * scale
    assert 0.0 <= moment <= 1.0


@pytest.mark.parametrize("stiffness", [1e3, 1e5, 1e7, 1e8])
@pytest.mark.parametrize("mass", [0.5, 16.0])
def test_the_largest_force_is_found_at_any_stiffness(stiffness: float, mass: float) -> None:
    """Up to 11 rad per sample, with the payload swinging freely: the sine's amplitude and its moment."""
    plant = paper_plant(stiffness=stiffness, mass=mass, drag=0.0, coupling=1e3, robot=one_pole(2.2e-3))
    _, flow, rows, _, _, wall = pair_of(plant).arguments
    state = np.array([0.0, 0.0, 1e-3])
    omega = math.sqrt((stiffness + 1e3) / mass) * PERIOD_S
    value, moment = largest_force(flow[0], rows, HeldInputs(0.0, 0.0), state, 1.0)
    phase = min(omega, 0.5 * math.pi)
    assert value == pytest.approx(wall.stiffness * 1e-3 / omega * math.sin(phase), rel=1e-9)
    # One of the equal crests, each as flat as its value is exact to 1e-10.
    assert math.sin(omega * moment) == pytest.approx(math.sin(phase), rel=1e-9)


def force_on_grid(
    flow: FloatArray, rows: FloatArray, state: FloatArray, inputs: tuple[float, ...], fraction: float
) -> FloatArray:
    """Return F_e at 400 points for each command of a sample, the older first, by products of one small exponential."""
    n, out = len(state), []
    parts = ((inputs[0], fraction), (inputs[1], 1.0 - fraction))
    for held, duration in parts if fraction > 0.0 else parts[1:]:
        augmented = np.zeros((n + 1, n + 1))
        augmented[:n, :n] = flow[:, :n]
        augmented[:n, n] = flow[:, n] * held + flow[:, n + 1] * inputs[2]
        small, current = expm(augmented * duration / 400.0), np.append(state, 1.0)
        for _ in range(401):
            out.append(rows[2, :n] @ current[:n] + rows[2, n] * held + rows[2, n + 1] * inputs[2])
            last, current = current, small @ current
        state = last[:n]
    return np.array(out)
