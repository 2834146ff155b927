import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from problems.controller import AdmittanceController
from problems.plant import Plant
from problems.response import controller_response, free_space_admittance, loop_response, plant_response
from problems.sampled import build_loop, build_sampled_plant
from tests.problems.axes import (
    DELAY_S,
    LAW,
    PERIOD_S,
    WHOLE_DELAYS,
    admittance,
    between,
    controllers,
    paper_plant,
    plants,
)
from tests.problems.reference import rendered_impedance, robot_gain, sampled_controller, sampled_plant

NYQUIST = math.pi / PERIOD_S
FREQUENCIES = between(1.0, 0.99 * NYQUIST)


@LAW
@given(plants(), controllers(), FREQUENCIES)
def test_the_two_break_points_share_the_closed_loop(
    plant: Plant, controller: AdmittanceController, omega: float
) -> None:
    """1 + L_x = (1 + C_fb X/X^d)(1 + L)."""
    sampled, at = build_sampled_plant(plant, PERIOD_S), np.array([omega])
    loop, open_loop = loop_response(sampled, controller, at), plant_response(sampled, at)
    _, feedback = controller_response(controller, open_loop.z, PERIOD_S)
    # Both sides sum terms of the size of L.
    np.testing.assert_allclose(
        1.0 + loop.at_command,
        (1.0 + feedback * open_loop.position) * (1.0 + loop.at_force),
        rtol=1e-11,
        atol=1e-13 * abs(loop.at_command[0]),
    )


@LAW
@given(plants(WHOLE_DELAYS), controllers(), FREQUENCIES)
def test_both_loops_are_python_controls(plant: Plant, controller: AdmittanceController, omega: float) -> None:
    at, z = np.array([omega]), np.exp(1j * omega * PERIOD_S)
    ours = loop_response(build_sampled_plant(plant, PERIOD_S), controller, at)
    forward, feedback = (system(z) for system in sampled_controller(controller, PERIOD_S))
    force, position = sampled_plant(plant, PERIOD_S, round(plant.robot.delay_s / PERIOD_S))(z)[:, 0]
    # Forces are differences of K_s x and K_s x_p, which cost python-control's SI matrices some digits.
    size = abs(forward) * plant.coupling.stiffness_n_per_m * abs(position)
    assert abs(ours.at_command[0] - (feedback * position - force * forward)) < 1e-8 * (
        abs(force * forward) + 1e-4 * size
    )
    assert abs(ours.at_force[0] + force * forward / (1.0 + feedback * position)) < 1e-8 * (
        abs(force * forward / (1.0 + feedback * position)) + 1e-4 * size
    )


@LAW
@given(plants(), controllers(), st.floats(0.05, math.pi))
def test_the_return_difference_is_the_ratio_of_determinants(
    plant: Plant, controller: AdmittanceController, angle: float
) -> None:
    """det(z − a) of the loop is (1 + L_x) times that of the open loop, for every delay."""
    sampled = build_sampled_plant(plant, PERIOD_S)
    loop, z = build_loop(sampled, controller), np.exp(1j * angle)
    b, corner = controller.damping_n_s_per_m, controller.velocity_filter_rad_per_s
    poles = [1.0, *((2.0 / PERIOD_S - w) / (2.0 / PERIOD_S + w) for w in (b / controller.mass_kg, corner))]
    open_loop = np.linalg.det(z * np.eye(sampled.state_count) - sampled.phi) * z**sampled.chain_length
    closed = np.linalg.det(z * np.eye(len(loop.a)) - loop.a) / (open_loop * np.prod(z - np.array(poles)))
    # With a direct path (zero delay, damped coupling) the determinant is that of the loop per 1 + D C.
    direct = 1.0
    if sampled.chain_length == 0:
        forward_at_infinity = controller_response(controller, np.array([1e12 + 0j]), PERIOD_S)[0][0].real
        direct = 1.0 - forward_at_infinity * sampled.d_force
    found = loop_response(sampled, controller, np.array([angle / PERIOD_S])).at_command[0]
    # Determinants of lightly damped loops near their poles: 1e-15 over |z − pole| > 1e-3 for some poles.
    assert abs(closed * direct - (1.0 + found)) < 1e-8 * (1.0 + abs(found))


@LAW
@given(plants(contact=True), controllers())
def test_at_low_frequency_the_loop_is_the_series_stiffness_over_the_damping(
    plant: Plant, controller: AdmittanceController
) -> None:
    """L → K/(B_a s), K of coupling and wall in series; what F/F^d → −1 at rest rests upon."""
    omega = 1e-3
    found = loop_response(build_sampled_plant(plant, PERIOD_S), controller, np.array([omega])).at_force[0]
    ke, ks = plant.environment.stiffness_n_per_m, plant.coupling.stiffness_n_per_m
    series = ke * ks / (ke + ks)
    # First order in ω times the slowest time constants: (B_p + B_e)/K_e, M_a/B_a, K_l, delay, robot; all under 2 s.
    assert found * 1j * omega * controller.damping_n_s_per_m == pytest.approx(series, rel=5e-3)


@pytest.mark.parametrize("hertz", [0.5, 2.0, 8.0, 20.0, 30.0])
@pytest.mark.parametrize(
    "controller", [admittance(), admittance(feedback=7.5e-3), admittance(lead=0.0, damping=3000.0)]
)
def test_the_sampled_loop_is_the_continuous_one_with_half_a_sample_more(
    controller: AdmittanceController, hertz: float
) -> None:
    """MODEL.md, "What runs in the cell": at T_d + h/2 the continuous form is within about 1 %."""
    s = np.array([2j * np.pi * hertz])
    plant, c = paper_plant(), controller
    lag = np.exp(-s * (DELAY_S + 0.5 * PERIOD_S))
    forward = (1.0 + c.lead_s * s) / (c.mass_kg * s * s + c.damping_n_s_per_m * s)
    corner = c.velocity_filter_rad_per_s
    position = robot_gain(plant, s) * lag
    damped = 1.0 + position * c.feedback_damping_s * corner * s / (s + corner)
    admittance_g = forward * s * position / damped
    at = s.imag
    sampled = build_sampled_plant(plant, PERIOD_S)
    np.testing.assert_allclose(
        loop_response(sampled, c, at).at_force, admittance_g * rendered_impedance(plant, s), rtol=0.01
    )
    np.testing.assert_allclose(free_space_admittance(sampled, c, at), admittance_g, rtol=0.01)


def test_the_payload_does_not_enter_the_rendered_admittance() -> None:
    omega = np.geomspace(1.0, 1000.0, 20)
    light, heavy = (
        free_space_admittance(build_sampled_plant(paper_plant(stiffness=0.0, mass=m), PERIOD_S), admittance(), omega)
        for m in (2.0, 50.0)
    )
    # The same sum without and with a decoupled part in the linear system.
    np.testing.assert_allclose(light, heavy, rtol=1e-10)


def test_a_slow_hand_feels_the_admittance_damping() -> None:
    """G → 1/B_a: the steady hand force per speed."""
    sampled = build_sampled_plant(paper_plant(stiffness=0.0), PERIOD_S)
    found = free_space_admittance(sampled, admittance(damping=1000.0), np.array([0.01]))
    # Second order in ω (M_a/B_a + ...) = 1e-3.
    assert abs(found[0]) == pytest.approx(1e-3, rel=1e-5)
