import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

from problems.contact import (
    Approach,
    SampledContact,
    SteadyApproach,
    build_sampled_contact,
    settling_samples,
    simulate_contact,
    steady_approach,
)
from problems.controller import AdmittanceController, controller_blocks
from problems.errors import ParameterError
from problems.margins import UnstableLoopError
from problems.plant import Plant
from problems.sampled import build_loop, build_sampled_plant, spectral_radius
from tests.problems.axes import LAW, PERIOD_S, admittance, controllers, one_pole, paper_plant, plants

FloatArray = NDArray[np.float64]
PRESS = Approach(force_n=30.0)


def pair_of(plant: Plant) -> SampledContact:
    return build_sampled_contact(build_sampled_plant(plant, PERIOD_S))


def approach_of(pair: SampledContact, controller: AdmittanceController, approach: Approach = PRESS) -> SteadyApproach:
    return steady_approach(pair.free, build_loop(pair.free, controller), approach)


def is_stable(pair: SampledContact, controller: AdmittanceController) -> bool:
    return all(spectral_radius(build_loop(side, controller)) < 0.9995 for side in (pair.contact, pair.free))


# A light payload on a soft coupling against a hard wall leaves it several times.
BOUNCING = paper_plant(stiffness=5e5, mass=4.0, drag=50.0, coupling=3e4)
DAMPED = paper_plant(
    stiffness=5e5,
    mass=4.0,
    drag=20.0,
    coupling=3e4,
    coupling_damping=5.0,
    environment_damping=15.0,
    robot=one_pole(2.0e-3),
)


def integrate(plant: Plant, controller: AdmittanceController, start: SteadyApproach, samples: int) -> FloatArray:
    """Return F and F_e (2, samples) by a Runge–Kutta solver with events, one-pole robot, SI, straight from MODEL.md."""
    m, b_p = plant.payload.mass_kg, plant.payload.drag_n_s_per_m
    k_s, b_s = plant.coupling.stiffness_n_per_m, plant.coupling.damping_n_s_per_m
    k_e, b_e = plant.environment.stiffness_n_per_m, plant.environment.damping_n_s_per_m
    pole = float(plant.robot.denominator[1])

    def sensed(y: FloatArray, u: float) -> float:
        return float(k_s * (y[1] - y[0]) + b_s * (y[2] - pole * (u - y[0])))

    def pressed(y: FloatArray, *, touching: bool) -> float:
        return float(k_e * y[1] + b_e * y[2]) if touching else 0.0

    def segment(y: FloatArray, u: float, duration: float, *, touching: bool) -> tuple[FloatArray, bool]:
        def rate(_: float, y: FloatArray) -> list[float]:
            net = -sensed(y, u) - b_p * y[2] - pressed(y, touching=touching)
            return [pole * (u - y[0]), y[2], net / m]

        def switch(_: float, y: FloatArray) -> float:
            return pressed(y, touching=True) if touching else float(y[1])

        switch.terminal, switch.direction = True, -1.0 if touching else 1.0  # type: ignore[attr-defined]
        # A run that starts on the surface starts on the event, which the solver takes for none.
        run = solve_ivp(rate, (0.0, duration), y, "DOP853", events=switch, rtol=1e-11, atol=1e-16)
        if run.status == 1:
            return segment(run.y[:, -1], u, duration - run.t[-1], touching=not touching)
        return run.y[:, -1], touching

    delay = plant.robot.delay_s / PERIOD_S
    late = math.ceil(delay - 1e-9)
    part = late - delay if late - delay > 1e-9 else 0.0
    y, past = np.array([start.state[0], start.state[1], start.state[2] / PERIOD_S]), list(start.state[3 : 3 + late])
    control, blocks = start.state[3 + late :], controller_blocks(controller.parameters(), PERIOD_S)
    touching, out = True, np.empty((2, samples))
    for k in range(samples):
        force = sensed(y, past[-1])
        out[:, k] = force, max(0.0, pressed(y, touching=touching))
        inputs = np.array([start.force_n + force, start.force_n + force, y[0]])
        outputs = blocks[:, 0] * inputs + control
        control = blocks[:, 1] * control + blocks[:, 2] * inputs
        past = [float(outputs[0] + outputs[1] - outputs[2]), *past]
        oldest = past.pop()
        for u, duration in ((oldest, 1.0 - part), (past[-1], part)) if part else ((oldest, 1.0),):
            y, touching = segment(y, u, duration * PERIOD_S, touching=touching)
    return out


@pytest.mark.parametrize(
    ("plant", "controller", "flights"),
    [
        pytest.param(BOUNCING, admittance(damping=800.0, lead=0.01), 2, id="undamped wall, whole delay"),
        pytest.param(DAMPED, admittance(damping=1500.0, lead=0.02, feedback=5e-3), 2, id="dampers, half a sample"),
    ],
)
def test_leaving_and_touching_again_is_what_an_ode_solver_finds(
    plant: Plant, controller: AdmittanceController, flights: int
) -> None:
    samples, pair = 120, pair_of(plant)
    found = simulate_contact(pair, controller, PRESS, samples=samples)
    away = found.contact_force_n[1:] <= 0.0
    assert np.sum(np.diff(away.astype(int)) == 1) >= flights
    expected = integrate(plant, controller, approach_of(pair, controller), samples)
    # The solver keeps 1e-11 per step; a late event of a collision multiplies it by some orders of magnitude.
    scale = found.peak_contact_force_n
    np.testing.assert_allclose(-found.sensor_force_n, expected[0], atol=1e-6 * scale)
    np.testing.assert_allclose(found.contact_force_n, expected[1], atol=1e-6 * scale)


@pytest.mark.parametrize("damping", [500.0, 1000.0, 3000.0])
@pytest.mark.parametrize("feedback", [0.0, 7.5e-3])
def test_the_steady_speed_is_the_force_over_both_dampings(damping: float, feedback: float) -> None:
    """v = F^d/(B_a + B_p − K_s ω_b h²/12): C_fb blocks constants, and the last term is the hold's ripple.

    The staircase of commands leaves the flange a parabola of −v ω_b h²/12 at the ticks, and K_s turns it into force.
    """
    pair = pair_of(paper_plant())
    found = approach_of(pair, admittance(damping=damping, feedback=feedback))
    ripple = 3e5 * 20.0 * PERIOD_S**2 / 12.0
    assert found.force_n == 30.0
    # The ripple's own corrections are ω_b h = 1.6 % of 2e-4.
    assert found.speed_m_s == pytest.approx(30.0 / (damping + 630.0 - ripple), rel=5e-6)


@LAW
@given(plants(contact=True), controllers())
def test_the_approach_is_steady(plant: Plant, controller: AdmittanceController) -> None:
    pair = pair_of(plant)
    loop, found = build_loop(pair.free, controller), approach_of(pair, controller)
    after = loop.a @ found.state + loop.b * found.force_n
    step = found.speed_m_s * PERIOD_S
    # A solve of a system whose entries span 1e3; the state is of the size of the lag v·T, about 0.1 of v.
    np.testing.assert_allclose(after - found.state, step * loop.translation, atol=1e-9 * abs(found.speed_m_s))
    assert found.state[pair.free.state_count - 2] == pytest.approx(0.0, abs=1e-15)


@pytest.mark.parametrize("speed", [0.01, 0.25])
def test_a_speed_is_kept_by_the_force_that_sustains_it(speed: float) -> None:
    pair, controller = pair_of(paper_plant()), admittance(damping=3000.0, lead=0.02)
    found = simulate_contact(pair, controller, Approach(speed_m_s=speed))
    assert found.contact_speed_m_s == pytest.approx(speed, rel=1e-14)
    # The hold's ripple, 2e-4.
    assert found.driving_force_n == pytest.approx(speed * 3630.0, rel=5e-4)
    same = simulate_contact(pair, controller, Approach(force_n=found.driving_force_n))
    # The same linear system with another unknown.
    assert same.peak_contact_force_n == pytest.approx(found.peak_contact_force_n, rel=1e-10)


@pytest.mark.parametrize("stiffness", [2e4, 5e5])
def test_at_rest_both_forces_are_the_desired_force(stiffness: float) -> None:
    pair, controller = pair_of(paper_plant(stiffness=stiffness)), admittance(damping=3000.0, lead=0.02)
    usual = simulate_contact(pair, controller, PRESS)
    # The horizon ends at e^-7 of the transient, which is of the size of the force.
    assert usual.contact_force_n[-1] == pytest.approx(30.0, rel=5e-3)
    long = simulate_contact(pair, controller, PRESS, samples=4 * len(usual.time_s))
    # e^-28 = 7e-13.
    assert long.contact_force_n[-1] == pytest.approx(30.0, rel=1e-9)
    assert long.sensor_force_n[-1] == pytest.approx(30.0, rel=1e-9)


def test_a_wall_of_almost_nothing_is_almost_free_space() -> None:
    pair, controller = pair_of(paper_plant(stiffness=1e-3)), admittance()
    found = simulate_contact(pair, controller, PRESS, samples=250)
    # In 0.2 s at 0.02 m/s the wall yields 4e-6 N; the sensor goes on to show the drag, plus the hold's ripple.
    assert found.peak_contact_force_n < 1e-5
    np.testing.assert_allclose(found.sensor_force_n, 630.0 * found.contact_speed_m_s, rtol=1e-3)


@pytest.mark.parametrize("plant", [BOUNCING, paper_plant(stiffness=2e4), paper_plant(stiffness=5e5)])
def test_a_longer_horizon_finds_no_higher_peak(plant: Plant) -> None:
    pair, controller = pair_of(plant), admittance(damping=3000.0, lead=0.02)
    usual = simulate_contact(pair, controller, PRESS)
    twice = simulate_contact(pair, controller, PRESS, samples=2 * len(usual.time_s))
    # A force that creeps up to F^d has its supremum at infinity; the horizon ends at e^-7 = 9e-4 of the slowest part,
    # which is not much larger than F^d.
    assert twice.peak_contact_force_n == pytest.approx(usual.peak_contact_force_n, rel=2e-3)
    assert twice.peak_sensor_force_n == pytest.approx(usual.peak_sensor_force_n, rel=2e-3)
    np.testing.assert_array_equal(twice.contact_force_n[: len(usual.time_s)], usual.contact_force_n)


@LAW
@given(plants(contact=True), controllers(), st.sampled_from([0.25, 2.0, 16.0]))
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
    assert other.time_of_peak_s == pytest.approx(one.time_of_peak_s, abs=1e-12)


@LAW
@given(plants(contact=True), controllers())
def test_the_wall_never_pulls(plant: Plant, controller: AdmittanceController) -> None:
    pair = pair_of(plant)
    assume(is_stable(pair, controller))
    found = simulate_contact(pair, controller, PRESS, samples=150)
    assert np.min(found.contact_force_n) >= 0.0
    assert np.all(np.isfinite(found.sensor_force_n))


def test_stiff_contacts_peak_early_and_soft_ones_late() -> None:
    """MODEL.md, "The contact transient": about 20 ms, and 0.4 s and more at K_e = 2e4."""
    controller = admittance(damping=3000.0, lead=0.02)
    soft, stiff = (simulate_contact(pair_of(paper_plant(stiffness=k)), controller, PRESS) for k in (2e4, 5e5))
    assert stiff.time_of_peak_s < 0.05
    assert soft.time_of_peak_s > 0.4
    assert soft.peak_contact_force_n < stiff.peak_contact_force_n


def test_the_signs_are_those_of_pressing() -> None:
    found = simulate_contact(pair_of(paper_plant()), admittance(damping=3000.0, lead=0.02), PRESS)
    assert found.time_s[0] == 0.0
    assert found.contact_force_n[0] == pytest.approx(0.0, abs=1e-9)
    # Before the impact the sensor shows the drag.
    assert found.sensor_force_n[0] == pytest.approx(630.0 * found.contact_speed_m_s, rel=1e-3)
    assert found.peak_sensor_force_n > 30.0
    assert found.time_of_peak_s == found.time_s[int(np.argmax(found.contact_force_n))]


@pytest.mark.parametrize(
    ("plant", "controller"),
    [
        pytest.param(paper_plant(), admittance(mass=10.0, lead=0.0), id="in contact"),
        pytest.param(paper_plant(stiffness=1e3, drag=100.0), admittance(mass=10.0, lead=0.0), id="in free space"),
    ],
)
def test_an_unstable_loop_has_no_peak(plant: Plant, controller: AdmittanceController) -> None:
    with pytest.raises(UnstableLoopError):
        simulate_contact(pair_of(plant), controller, PRESS)


def test_free_space_cannot_be_touched() -> None:
    with pytest.raises(ParameterError, match="a surface to touch"):
        pair_of(paper_plant(stiffness=0.0))


@pytest.mark.parametrize(
    ("force", "speed"),
    [(None, None), (30.0, 0.1), (0.0, None), (-30.0, None), (None, 0.0), (None, math.nan), (math.inf, None)],
)
def test_an_approach_has_one_positive_number(force: float | None, speed: float | None) -> None:
    with pytest.raises(ParameterError, match="approach"):
        Approach(force_n=force, speed_m_s=speed)


@pytest.mark.parametrize(
    ("radius", "samples"), [(0.0, 64), (0.5, 64), (math.exp(-0.01), 700), (1.0 - 1e-12, 12500), (0.9999999, 12500)]
)
def test_the_horizon_follows_the_loop(radius: float, samples: int) -> None:
    # 7 e-folds, at least 64 samples and at most 10 s; 700 itself may round up.
    assert settling_samples(radius, PERIOD_S) == pytest.approx(samples, abs=1)


def test_both_sides_of_a_pair_share_everything_but_the_wall() -> None:
    pair = pair_of(DAMPED)
    assert pair.free.plant.environment.is_free_space
    assert replace(pair.free, plant=DAMPED).whole_delay == pair.contact.whole_delay == 2
    np.testing.assert_array_equal(pair.free.c_force, pair.contact.c_force)
    np.testing.assert_array_equal(pair.free.drive, pair.contact.drive)
