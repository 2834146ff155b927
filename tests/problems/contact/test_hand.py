"""A hand on the payload: the closed loop's answer to it, against simulations by other means and closed forms."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy import signal

from problems.arrays import FloatArray
from problems.model.controller import AdmittanceController
from problems.model.plant import Plant
from problems.model.response import hand_admittance, hand_force_per_speed
from tests.problems.axes import PERIOD_S, admittance, one_pole, paper_plant
from tests.problems.random_loops import radius_of, random_controller, random_environment, random_plant, sampled_of
from tests.problems.reference import SampledLaw, continuous_motion, payload_admittance, robot_gain

COMPENSATED = AdmittanceController(mass_kg=20.0, damping_n_s_per_m=1500.0, lead_s=0.01, compensation_mass_kg=8.0)
LAWS = [
    pytest.param(admittance(), id="lead"),
    pytest.param(admittance(feedback=7.5e-3), id="feedback damping"),
    pytest.param(COMPENSATED, id="filtered compensation"),
    pytest.param(replace(COMPENSATED, compensation="ideal", lead_s=0.0, feedback_damping_s=5e-3), id="ideal, damped"),
    pytest.param(replace(admittance(feedback=4e-3), discretization="backward_euler"), id="backward Euler"),
]


def pushed(plant: Plant, controller: AdmittanceController, push: FloatArray) -> FloatArray:
    """Return x_p at the ticks under a hand's force that is held from tick to tick; whole delay, zero state."""
    m = continuous_motion(plant)
    a, b, c, d = signal.cont2discrete((m.a, m.b, m.c, m.d), PERIOD_S, "zoh")[:4]
    law, state, whole = SampledLaw(controller, PERIOD_S), np.zeros(len(a)), round(plant.robot.delay_s / PERIOD_S)
    commands, out = [0.0] * (whole + len(push) + 1), np.empty(len(push))
    for k, force in enumerate(push):
        inputs = np.array([commands[k], force])
        sensed = c @ state + d @ inputs
        commands[k + whole] = law.step(float(sensed[0]), float(sensed[1]))
        out[k] = state[-2]
        state = a @ state + b @ np.array([commands[k], force])
    return out


@pytest.mark.parametrize("controller", LAWS)
def test_a_steady_hand_leads_the_payload_at_its_force_over_the_two_dampings(controller: AdmittanceController) -> None:
    plant, ticks = paper_plant(stiffness=0.0), 2500
    position = pushed(plant, controller, np.full(ticks, 10.0))
    speed = (position[-1] - position[-501]) / (500 * PERIOD_S)
    # After two seconds the loop has settled; the command's steps ripple F between the ticks by some parts in 10⁴.
    assert 10.0 / speed == pytest.approx(hand_force_per_speed(plant, controller), rel=1e-3)


@pytest.mark.parametrize("period", [1250, 250, 50])
@pytest.mark.parametrize("controller", LAWS)
def test_a_shaking_hand_moves_the_payload_as_the_response_says(controller: AdmittanceController, period: int) -> None:
    """1, 5 and 25 Hz, in whole periods of samples."""
    plant = paper_plant(stiffness=0.0)
    omega = 2.0 * math.pi / (period * PERIOD_S)
    ticks = np.arange(3750 + 1250)
    turning = np.exp(-1j * omega * PERIOD_S * ticks)
    position = pushed(plant, controller, turning.real)
    last = slice(-1250, None)
    # What is left of the start after three seconds is a constant shift, which whole periods do not see.
    found = 1j * omega * np.mean(position[last] * 2.0 * turning[last])
    expected = hand_admittance(sampled_of(plant), controller, np.array([omega]))[0]
    assert found == pytest.approx(expected, rel=1e-6)


def test_the_slow_limit_is_the_hand_force_per_speed_for_every_controller() -> None:
    rng, omega = np.random.default_rng(41), np.array([1e-3])
    compared = 0
    while compared < 40:
        plant, controller = random_plant(rng, contact=False), random_controller(rng)
        if not radius_of(sampled_of(plant), controller) < 0.9999:
            continue
        compared += 1
        found = hand_admittance(sampled_of(plant), controller, omega)[0]
        # First order in ω times the slowest time constant (h/1e-4 = 8 s at most), and the ripple of F.
        assert found * hand_force_per_speed(plant, controller) == pytest.approx(1.0, abs=1e-2)


@pytest.mark.parametrize("hertz", [0.3, 2.0, 10.0, 25.0])
@pytest.mark.parametrize("controller", [admittance(), admittance(feedback=7.5e-3), COMPENSATED])
def test_the_response_is_the_continuous_one_with_half_a_sample_more(
    controller: AdmittanceController, hertz: float
) -> None:
    """V_p/F_h = 1/(M_p s + B_p + C_s/(1 + C_s G)): behind the coupling the hand feels the rendered admittance."""
    plant, c, s = paper_plant(stiffness=0.0), controller, np.array([2j * math.pi * hertz])
    position = robot_gain(plant, s) * np.exp(-s * (plant.robot.delay_s + 0.5 * PERIOD_S))
    forward = (1.0 + c.lead_s * s) / (c.mass_kg * s * s + c.damping_n_s_per_m * s)
    w_v, w_a = c.velocity_filter_rad_per_s, c.acceleration_filter_rad_per_s
    damped = c.feedback_damping_s * w_v * s / (s + w_v)
    compensated = forward * c.compensation_mass_kg * w_v * w_a * s * s / ((s + w_a) * (s + w_v))
    admittance_g = s * forward * position / (1.0 + (damped - compensated) * position)
    spring = plant.coupling.stiffness_n_per_m / s
    # The loop's equations hold the hand's force from tick to tick too: half a sample once more.
    held = np.exp(-0.5 * s * PERIOD_S)
    expected = held / (1.0 / payload_admittance(plant, s) + spring / (1.0 + spring * admittance_g))
    found = hand_admittance(sampled_of(plant), controller, s.imag)
    # docs/method.md, "The loop": within about 1 %.
    np.testing.assert_allclose(found, expected, rtol=0.01)


def test_on_a_wall_a_slow_hand_presses_the_payload_into_it_alone() -> None:
    """The controller gives way until F is zero, so the wall alone holds the hand: V_p → jω F_h/K_e."""
    rng, compared = np.random.default_rng(42), 0
    while compared < 20:
        plant, controller = (
            random_plant(rng, contact=False).in_contact_with(random_environment(rng)),
            random_controller(rng),
        )
        if not radius_of(sampled_of(plant), controller) < 0.9999:
            continue
        compared += 1
        omega = 1e-3
        found = hand_admittance(sampled_of(plant), controller, np.array([omega]))[0]
        # First order in ω times the slowest time constant, under 8 s as above.
        assert found / (1j * omega) * plant.environment.stiffness_n_per_m == pytest.approx(1.0, abs=1e-2)


def test_a_fast_hand_feels_the_payload_and_a_slow_one_both_dampings() -> None:
    plant = paper_plant(stiffness=0.0, robot=one_pole(0.0))
    found = np.abs(hand_admittance(sampled_of(plant), admittance(), 2.0 * math.pi * np.array([0.05, 300.0])))
    assert found[0] == pytest.approx(1.0 / 1630.0, rel=2e-3)
    # 1/(M_p ω) under a held force; the spring's share is (22/300)², and 3 % comes from beyond the Nyquist frequency.
    held = float(np.sinc(300.0 * PERIOD_S))
    assert found[1] == pytest.approx(held / (16.0 * 2.0 * math.pi * 300.0), rel=0.03)
