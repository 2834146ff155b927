"""The contact transient from the outside: approaches, peaks and laws."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from scipy.linalg import expm

from problems.contact.kernel import contact_forces, steady_start
from problems.contact.transient import Approach, SampledContact, simulate_contact
from problems.errors import ParameterError
from problems.model.controller import AdmittanceController, controller_blocks, needed_states
from problems.model.plant import Plant
from problems.model.sampled import build_loop, spectral_radius
from problems.stability.margins import UnstableLoopError
from tests.problems.axes import (
    BOUNCING,
    DAMPED,
    LAW,
    PERIOD_S,
    PRESS,
    QUIET,
    STRUCTURES,
    admittance,
    any_controllers,
    any_plants,
    environments,
    heavy_wall,
    one_pole,
    pair_of,
    paper_plant,
)
from tests.problems.model.test_sampled import in_other_units
from tests.problems.reference import SteadyApproach, steady_approach


def is_stable(pair: SampledContact, controller: AdmittanceController) -> bool:
    return all(spectral_radius(build_loop(side, controller)) < 0.9995 for side in (pair.contact, pair.free))


def oracle_approach(pair: SampledContact, controller: AdmittanceController, approach: Approach) -> SteadyApproach:
    return steady_approach(
        pair.free,
        build_loop(pair.free, controller),
        force=approach.force_n,
        speed=approach.speed_m_s,
        hand=approach.driven_by == "hand",
    )


@LAW
@given(any_plants(touched=environments()), any_controllers(), st.booleans(), st.booleans())
def test_the_start_is_the_steady_motion_of_the_free_loop(
    plant: Plant, controller: AdmittanceController, by_force: bool, by_hand: bool
) -> None:
    """The closed form against one linear system: the state that moves by the same step every period, with x_p = 0."""
    approach = Approach(
        force_n=30.0 if by_force else None,
        speed_m_s=None if by_force else 0.05,
        driven_by="hand" if by_hand else "desired_force",
    )
    pair, blocks = pair_of(plant), controller_blocks(controller, PERIOD_S)
    expected = oracle_approach(pair, controller, approach)
    resistance = controller.damping_n_s_per_m - pair.ramp[0, -1] * PERIOD_S
    speed, push, _ = contact_forces(approach.numbers(), resistance)
    chain, effort = pair.free.chain_length, controller.damping_n_s_per_m * speed
    state, past, control = steady_start(pair.ramp, pair.free.c_position, blocks, chain, PERIOD_S, speed, push, effort)
    # Solves of systems whose entries span 1e3 to 1e6.
    assert speed == pytest.approx(expected.speed_m_s, rel=1e-8)
    assert push == pytest.approx(expected.force_n if by_hand else 0.0, rel=1e-8)
    n = len(state)
    scale = np.max(np.abs(expected.state[: n + chain]))
    np.testing.assert_allclose(state, expected.state[:n], atol=1e-8 * scale)
    np.testing.assert_allclose(past[:chain], expected.state[n : n + chain], atol=1e-8 * scale)
    assert len(past) & (len(past) - 1) == 0 < len(past)
    # Filter states are speeds, and the ideal form's is a derivative of the position: 2/h of it.
    seen, size = needed_states(blocks), np.array([1.0, 1.0, 400.0, 2.0 / PERIOD_S])
    errors = np.abs(control[seen] - expected.state[n + chain :])
    assert np.all(errors < 1e-8 * (scale + speed) * size[seen])
    assert state[n - 2] == pytest.approx(0.0, abs=1e-12 * scale)


@LAW
@given(any_plants(touched=environments()), any_controllers(), st.booleans())
def test_a_free_loop_from_rest_arrives_at_the_start(
    plant: Plant, controller: AdmittanceController, by_hand: bool
) -> None:
    """Pushed for 26 s from rest, everything but the place where it happens is as at the impact."""
    pair = pair_of(plant)
    loop = build_loop(pair.free, controller)
    assume(spectral_radius(loop) < 0.999)
    size, steps = len(loop.a), 15
    drive = loop.b_push if by_hand else loop.b
    whole = np.zeros((size + 1, size + 1))
    whole[:size, :size], whole[:size, size], whole[size, size] = loop.a, 30.0 * drive, 1.0
    for _ in range(steps):  # 2^15 samples: 0.999^32768 = 6e-15
        whole = whole @ whole
    arrived = whole[:size, size]
    start = oracle_approach(pair, controller, Approach(force_n=30.0, driven_by="hand" if by_hand else "desired_force"))
    payload = pair.free.state_count - 2
    there = arrived - arrived[payload] * loop.translation
    # It has gone up to 2 m: 1e-16 of that, 15 squarings, in units of the state (2/h for the ideal form's derivative).
    tolerance = 1e-9 * (abs(arrived[payload]) + 1.0) * np.maximum(1.0, np.abs(loop.translation))
    assert np.all(np.abs(there - start.state) < tolerance)


@pytest.mark.parametrize("damping", [500.0, 1000.0, 3000.0])
@pytest.mark.parametrize("feedback", [0.0, 7.5e-3])
@pytest.mark.parametrize("driven_by_hand", [False, True])
def test_the_steady_speed_is_the_force_over_both_dampings(
    damping: float, feedback: float, driven_by_hand: bool
) -> None:
    """v = F^d/(B_a + B_p − K_s ω_b h²/12): C_fb blocks constants, and the last term is the hold's ripple.

    The staircase of commands leaves the flange a parabola of −v ω_b h²/12 at the ticks, and K_s turns it into force.
    A hand needs the same force.
    """
    approach = replace(PRESS, driven_by="hand") if driven_by_hand else PRESS
    controller = admittance(damping=damping, lead=0.02, feedback=feedback)
    assume_stable = paper_plant(stiffness=1e3)
    found = oracle_approach(pair_of(assume_stable), controller, approach)
    ripple = 3e5 * 20.0 * PERIOD_S**2 / 12.0
    assert found.force_n == 30.0
    # The ripple's own corrections are ω_b h = 1.6 % of 2e-4.
    assert found.speed_m_s == pytest.approx(30.0 / (damping + 630.0 - ripple), rel=5e-6)


@pytest.mark.parametrize("name", ["lead", "filtered, feedback", "ideal, backward Euler", "forward Euler"])
@pytest.mark.parametrize("driven_by_hand", [False, True])
@pytest.mark.parametrize("speed", [0.01, 0.25])
def test_a_speed_is_kept_by_the_force_that_sustains_it(name: str, speed: float, driven_by_hand: bool) -> None:
    pair, controller = pair_of(paper_plant()), replace(STRUCTURES[name], damping_n_s_per_m=3000.0)
    by_speed = Approach(speed_m_s=speed, driven_by="hand" if driven_by_hand else "desired_force")
    found = simulate_contact(pair, controller, by_speed)
    # A quotient and a product.
    assert found.contact_speed_m_s == pytest.approx(speed, rel=1e-14)
    # The hold's ripple, 2e-4.
    assert found.driving_force_n == pytest.approx(speed * 3630.0, rel=5e-4)
    same = simulate_contact(pair, controller, replace(by_speed, speed_m_s=None, force_n=found.driving_force_n))
    # The same linear system with another unknown.
    assert same.peak_contact_force_n == pytest.approx(found.peak_contact_force_n, rel=1e-10)


@pytest.mark.parametrize("stiffness", [2e4, 5e5])
@pytest.mark.parametrize("mass", [0.0, 6.0])
def test_at_rest_both_forces_are_the_desired_force(stiffness: float, mass: float) -> None:
    pair = pair_of(paper_plant(stiffness=stiffness, environment_mass=mass, environment_damping=50.0))
    usual = simulate_contact(pair, QUIET, PRESS)
    # The run ends when the force is within a thousandth of the largest.
    assert usual.is_settled
    assert usual.sensor_force_n[-1] == pytest.approx(30.0, abs=2e-3 * usual.peak_sensor_force_n)
    long = simulate_contact(pair, QUIET, PRESS, samples=8000)
    # 6.4 s are more than 30 times the slowest time constant, e^-30 = 1e-13.
    assert long.contact_force_n[-1] == pytest.approx(30.0, rel=1e-9)
    assert long.sensor_force_n[-1] == pytest.approx(30.0, rel=1e-9)


@pytest.mark.parametrize("after", [None, 12.0])
def test_at_rest_a_hand_is_on_the_wall_and_not_on_the_sensor(after: float | None) -> None:
    """e = F = 0 and F_e = f: the coupling is slack."""
    hand = Approach(force_n=30.0, driven_by="hand", after_impact_n=after)
    found = simulate_contact(pair_of(paper_plant(stiffness=1e5)), QUIET, hand, samples=8000)
    assert found.contact_force_n[-1] == pytest.approx(after or 30.0, rel=1e-9)
    assert found.sensor_force_n[-1] == pytest.approx(0.0, abs=1e-9)
    assert found.driving_force_n == (after or 30.0)


def test_a_wall_of_almost_nothing_is_almost_free_space() -> None:
    found = simulate_contact(pair_of(paper_plant(stiffness=1e-3)), QUIET, PRESS, samples=250)
    # In 0.2 s at 0.01 m/s the wall yields 2e-6 N; the sensor goes on to show the drag, plus the hold's ripple.
    assert 0.0 < np.max(found.contact_force_n) < 5e-6
    np.testing.assert_allclose(found.sensor_force_n, 630.0 * found.contact_speed_m_s, rtol=1e-3)
    # In the end it holds the payload all the same, some kilometres later.
    assert found.peak_contact_force_n == 30.0


def test_a_mass_that_vanishes_leaves_the_massless_wall() -> None:
    """M_e → 0: the impulse and all forces tend to those without it, in proportion to M_e."""
    controller = admittance(damping=800.0, lead=0.01)
    massless = simulate_contact(pair_of(BOUNCING), controller, PRESS, samples=400)
    gaps = []
    for mass in (1e-2, 1e-3, 1e-4):
        found = simulate_contact(pair_of(heavy_wall(mass)), controller, PRESS, samples=400)
        gaps.append(abs(found.peak_contact_force_n - massless.peak_contact_force_n))
        # The first meeting; a later one may be faster, but none by much.
        first = 4.0 * mass / (4.0 + mass) * found.contact_speed_m_s
        assert first * (1.0 - 1e-12) <= found.impulse_n_s < 10.0 * first
    assert massless.impulse_n_s == 0.0
    assert gaps[0] < 0.01 * massless.peak_contact_force_n
    # Where in its swing a meeting finds the mass is chance: not the exact tenth.
    assert gaps[1] < 0.3 * gaps[0]
    assert gaps[2] < 0.3 * gaps[1]


@pytest.mark.parametrize("plant", [BOUNCING, paper_plant(stiffness=2e4), paper_plant(stiffness=5e5), heavy_wall(2.0)])
def test_a_longer_run_finds_no_higher_peak(plant: Plant) -> None:
    pair = pair_of(plant)
    usual = simulate_contact(pair, QUIET, PRESS)
    longer = simulate_contact(pair, QUIET, PRESS, samples=4 * len(usual.time_s))
    assert usual.is_settled
    # What is left when it ends is a thousandth, around F^d; a force that creeps up to F^d counts with F^d.
    assert longer.peak_contact_force_n == pytest.approx(usual.peak_contact_force_n, rel=1e-3)
    assert longer.peak_sensor_force_n == pytest.approx(usual.peak_sensor_force_n, rel=1e-3)
    np.testing.assert_array_equal(longer.contact_force_n[: len(usual.time_s)], usual.contact_force_n)


@LAW
@given(any_plants(touched=environments()), any_controllers(), st.sampled_from([0.25, 2.0, 16.0]))
def test_forces_grow_with_the_desired_force_leaving_included(
    plant: Plant, controller: AdmittanceController, factor: float
) -> None:
    """Without a threshold the unilateral contact has no force of its own: everything scales."""
    pair = pair_of(plant)
    assume(is_stable(pair, controller))
    one = simulate_contact(pair, controller, PRESS, samples=150)
    other = simulate_contact(pair, controller, Approach(force_n=30.0 * factor), samples=150)
    # Powers of two change no digit but those that a pivoting solve rounds.
    np.testing.assert_allclose(other.contact_force_n, factor * one.contact_force_n, atol=1e-9 * factor * 30.0)
    assert other.peak_contact_force_n == pytest.approx(factor * one.peak_contact_force_n, rel=1e-9)
    assert other.impulse_n_s == pytest.approx(factor * one.impulse_n_s, rel=1e-9)
    assert other.time_of_peak_s == pytest.approx(one.time_of_peak_s, abs=1e-9)


@LAW
@given(any_plants(touched=environments()), any_controllers(), st.sampled_from([1000.0, 1.0 / 0.16]))
def test_a_contact_is_the_same_in_millimetres_and_as_a_rotation(
    plant: Plant, controller: AdmittanceController, factor: float
) -> None:
    pair = pair_of(plant)
    assume(is_stable(pair, controller))
    other_plant, other_controller = in_other_units(plant, controller, factor)
    one = simulate_contact(pair, controller, PRESS, samples=150)
    other = simulate_contact(pair_of(other_plant), other_controller, PRESS, samples=150)
    # The same numbers rounded elsewhere; events multiply rounding by the stiffness over the force.
    scale = one.peak_contact_force_n + one.peak_sensor_force_n
    np.testing.assert_allclose(other.contact_force_n, one.contact_force_n, atol=1e-8 * scale)
    np.testing.assert_allclose(other.sensor_force_n, one.sensor_force_n, atol=1e-8 * scale)
    assert other.contact_speed_m_s == pytest.approx(factor * one.contact_speed_m_s, rel=1e-9)
    assert other.peak_contact_force_n == pytest.approx(one.peak_contact_force_n, rel=1e-8)
    assert other.impulse_n_s == pytest.approx(one.impulse_n_s, rel=1e-8)


@LAW
@given(any_plants(touched=environments()), any_controllers())
def test_the_wall_never_pulls(plant: Plant, controller: AdmittanceController) -> None:
    pair = pair_of(plant)
    assume(is_stable(pair, controller))
    found = simulate_contact(pair, controller, PRESS, samples=150)
    assert np.min(found.contact_force_n) >= 0.0
    assert np.all(np.isfinite(found.sensor_force_n))
    # The only impulse that is certain is the first; it is Newton's, at a speed that has the hold's ripple at the tick.
    mass, own = plant.environment.mass_kg, plant.payload.mass_kg
    assert found.impulse_n_s >= mass * own / (mass + own) * found.contact_speed_m_s * 0.99


def test_stiff_contacts_peak_early_and_soft_ones_late() -> None:
    """docs/method.md, "Contact": about 20 ms, and 0.4 s and more at K_e = 2e4."""
    soft, stiff = (simulate_contact(pair_of(paper_plant(stiffness=k)), QUIET, PRESS) for k in (2e4, 5e5))
    assert stiff.time_of_peak_s < 0.05
    assert soft.time_of_peak_s > 0.4
    assert soft.peak_contact_force_n < stiff.peak_contact_force_n


def test_the_signs_are_those_of_pressing() -> None:
    found = simulate_contact(pair_of(paper_plant()), QUIET, PRESS)
    assert found.time_s[0] == 0.0
    assert found.contact_force_n[0] == pytest.approx(0.0, abs=1e-9)
    # Before the impact the sensor shows the drag.
    assert found.sensor_force_n[0] == pytest.approx(630.0 * found.contact_speed_m_s, rel=1e-3)
    assert found.peak_sensor_force_n > 30.0
    # The sensor's peak is one of the ticks, that of the contact is not below them and within a period of the highest.
    assert found.peak_sensor_force_n == np.max(found.sensor_force_n)
    assert found.time_of_sensor_peak_s == found.time_s[int(np.argmax(found.sensor_force_n))]
    highest = found.time_s[int(np.argmax(found.contact_force_n))]
    assert found.peak_contact_force_n >= np.max(found.contact_force_n)
    assert abs(found.time_of_peak_s - highest) < PERIOD_S


def test_a_hand_pushes_the_robot_until_the_wall_takes_over() -> None:
    found = simulate_contact(pair_of(paper_plant(stiffness=1e5)), QUIET, replace(PRESS, driven_by="hand"))
    # F = B_a v > 0 in free space: the sensor reads the opposite of pressing.
    assert found.sensor_force_n[0] == pytest.approx(-3000.0 * found.contact_speed_m_s, rel=1e-3)
    assert found.sensor_force_n[0] < 0.0 < found.contact_force_n[-1]


@pytest.mark.parametrize(
    ("plant", "controller"),
    [
        pytest.param(paper_plant(), admittance(mass=10.0, lead=0.0), id="in contact"),
        pytest.param(paper_plant(stiffness=1e3, drag=100.0), admittance(mass=10.0, lead=0.0), id="in free space"),
        pytest.param(paper_plant(), STRUCTURES["ideal, lead"], id="ideal compensation with lead"),
    ],
)
def test_an_unstable_loop_has_no_peak(plant: Plant, controller: AdmittanceController) -> None:
    with pytest.raises(UnstableLoopError):
        simulate_contact(pair_of(plant), controller, PRESS)


def test_a_run_that_is_cut_short_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("problems.contact.transient.LONGEST_TRANSIENT_S", 0.1)
    short = simulate_contact(pair_of(paper_plant(stiffness=2e4)), QUIET, PRESS)
    assert not short.is_settled
    assert len(short.time_s) == 125
    # The force at rest is known all the same.
    assert short.peak_contact_force_n == 30.0


def test_free_space_cannot_be_touched() -> None:
    with pytest.raises(ParameterError, match="a surface to touch"):
        pair_of(paper_plant(stiffness=0.0))


@pytest.mark.parametrize("kind", ["environment_damping", "environment_mass"])
def test_a_damper_or_a_mass_alone_can_be_touched(kind: str) -> None:
    pair = pair_of(paper_plant(stiffness=0.0, **{kind: 5.0}))  # type: ignore[arg-type]
    assert not pair.contact.plant.environment.is_free_space
    found = simulate_contact(pair, QUIET, PRESS)
    assert found.is_settled
    assert 0.0 < found.peak_contact_force_n < 30.0


@pytest.mark.parametrize(
    ("force", "speed"),
    [(None, None), (30.0, 0.1), (0.0, None), (-30.0, None), (None, 0.0), (None, math.nan), (math.inf, None)],
)
def test_an_approach_has_one_positive_number(force: float | None, speed: float | None) -> None:
    with pytest.raises(ParameterError, match="approach"):
        Approach(force_n=force, speed_m_s=speed)


@pytest.mark.parametrize(("name", "value"), [("driven_by", "wind"), ("after_impact_n", math.nan)])
def test_what_an_approach_cannot_be_is_refused(name: str, value: object) -> None:
    with pytest.raises(ParameterError, match=name):
        replace(PRESS, **{name: value})  # type: ignore[arg-type]


def test_both_sides_of_a_pair_share_everything_but_the_wall() -> None:
    pair = pair_of(DAMPED)
    assert pair.free.plant.environment.is_free_space
    assert replace(pair.free, plant=DAMPED).whole_delay == pair.contact.whole_delay == 2
    np.testing.assert_array_equal(pair.free.c_force, pair.contact.c_force)
    np.testing.assert_array_equal(pair.free.drive[:-1], pair.contact.drive[:-1])


@pytest.mark.parametrize("delay_s", [1.6e-3, 1.9e-3, 0.5e-3])
@pytest.mark.parametrize(("mass", "damping"), [(0.0, 0.0), (3.0, 40.0)])
def test_the_looks_between_the_ticks_are_the_force_there(delay_s: float, mass: float, damping: float) -> None:
    """F_e at equal parts of a sample, the older command held up to the fraction and the newer one from there on."""
    plant = paper_plant(
        stiffness=1e8,
        environment_mass=mass,
        environment_damping=damping,
        coupling_damping=300.0,
        robot=one_pole(delay_s),
    )
    _, flow, rows, inside, (_, _, fraction), _ = pair_of(plant).arguments
    state, (older, newer, push) = np.array([2e-5, 1e-5, 3e-5]), (3e-5, -1e-5, 7.0)
    assert len(inside) > 2
    for j, row in enumerate(inside):
        moment = (j + 1) / (len(inside) + 1)
        current, held = np.append(state, 1.0), older if moment < fraction else newer
        for command, duration in ((older, min(moment, fraction)), (newer, max(0.0, moment - fraction))):
            augmented = np.zeros((4, 4))
            augmented[:3, :3], augmented[:3, 3] = flow[0][:, :3], flow[0][:, 3] * command + flow[0][:, 4] * push
            current = expm(augmented * duration) @ current
        expected = rows[2] @ [*current[:3], held, push]
        # Exponentials of matrices of norm 4: rounding, of forces of 1e3 N.
        assert row @ [*state, newer, older, push] == pytest.approx(expected, rel=1e-11, abs=1e-9)
