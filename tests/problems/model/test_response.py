import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from problems.model.controller import AdmittanceController, controller_blocks, needed_states
from problems.model.plant import Plant
from problems.model.response import controller_response, free_space_admittance, loop_response, plant_response
from problems.model.sampled import build_loop, build_sampled_plant
from tests.problems.axes import (
    DELAY_S,
    LAW,
    PERIOD_S,
    STRUCTURES,
    WHOLE_DELAYS,
    admittance,
    any_controllers,
    any_plants,
    between,
    one_pole,
    paper_plant,
)
from tests.problems.reference import rendered_impedance, robot_gain, sampled_controller, sampled_plant, transfer

NYQUIST = math.pi / PERIOD_S
FREQUENCIES = between(1.0, 0.99 * NYQUIST)


@LAW
@given(any_plants(), any_controllers(), FREQUENCIES)
def test_the_two_break_points_share_the_closed_loop(
    plant: Plant, controller: AdmittanceController, omega: float
) -> None:
    """1 + L_x = (1 + (C_fb − A(1 + C_ff) P̂ O_a) X/X^d)(1 + L)."""
    sampled, at = build_sampled_plant(plant, PERIOD_S), np.array([omega])
    loop, open_loop = loop_response(sampled, controller, at), plant_response(sampled, at)
    _, feedback = controller_response(controller, open_loop.z, PERIOD_S)
    # Both sides sum terms of the size of L and of the feedback.
    np.testing.assert_allclose(
        1.0 + loop.at_command,
        (1.0 + feedback * open_loop.position) * (1.0 + loop.at_force),
        rtol=1e-11,
        atol=1e-13 * (abs(loop.at_command[0]) + abs(feedback[0] * open_loop.position[0])),
    )


@LAW
@given(any_plants(WHOLE_DELAYS), any_controllers(), FREQUENCIES)
def test_both_loops_are_python_controls(plant: Plant, controller: AdmittanceController, omega: float) -> None:
    at, z = np.array([omega]), complex(np.exp(1j * omega * PERIOD_S))
    ours = loop_response(build_sampled_plant(plant, PERIOD_S), controller, at)
    forward, feedback = (transfer(system, z)[0, 0] for system in sampled_controller(controller, PERIOD_S))
    force, position = transfer(sampled_plant(plant, PERIOD_S, round(plant.robot.delay_s / PERIOD_S)), z)[:, 0]
    # Forces are differences of K_s x and K_s x_p, which cost python-control's SI matrices some digits.
    size = abs(forward) * plant.coupling.stiffness_n_per_m * abs(position)
    terms = abs(force * forward) + abs(feedback * position) + 1e-4 * size
    assert abs(ours.at_command[0] - (feedback * position - force * forward)) < 1e-8 * terms
    # Dividing by a return difference near zero magnifies its error.
    damped = 1.0 + feedback * position
    assert abs(ours.at_force[0] * damped + force * forward) < 1e-8 * (1.0 + abs(ours.at_force[0])) * terms


@LAW
@given(any_plants(), any_controllers(), st.floats(0.05, math.pi))
def test_the_return_difference_is_the_ratio_of_determinants(
    plant: Plant, controller: AdmittanceController, angle: float
) -> None:
    """det(z − a) of the loop is (1 + L_x) times that of the open loop, for every delay and structure."""
    sampled = build_sampled_plant(plant, PERIOD_S)
    loop, z, blocks = build_loop(sampled, controller), np.exp(1j * angle), controller_blocks(controller, PERIOD_S)
    open_loop = np.linalg.det(z * np.eye(sampled.state_count) - sampled.phi) * z**sampled.chain_length
    poles = blocks[needed_states(blocks), 1]
    closed = np.linalg.det(z * np.eye(len(loop.a)) - loop.a) / (open_loop * np.prod(z - poles))
    # With a direct path (zero delay, damped coupling) the determinant is that of the loop per 1 + D C.
    direct = 1.0
    if sampled.chain_length == 0:
        direct = 1.0 - (blocks[0, 0] + blocks[1, 0]) * sampled.d_force
    response = loop_response(sampled, controller, np.array([angle / PERIOD_S]))
    # Determinants of lightly damped loops near their poles: 1e-15 over |z − pole| > 1e-3 for some poles. Near z = −1
    # the ideal Tustin form is a small ratio of large terms.
    assert abs(closed * direct - (1.0 + response.at_command[0])) < 1e-8 * (1.0 + abs(response.at_command[0]))


@LAW
@given(any_plants(), any_controllers())
def test_at_low_frequency_the_loop_is_what_holds_the_payload_over_the_damping(
    plant: Plant, controller: AdmittanceController
) -> None:
    """L → K/(B_a s), K of coupling and wall in series; without stiffness L → (B_p + B_e)/B_a.

    The first is what F/F^d → −1 at rest rests upon, the second what the steady speed does.
    """
    omega = 1e-3
    found = loop_response(build_sampled_plant(plant, PERIOD_S), controller, np.array([omega])).at_force[0]
    wall, ks = plant.environment, plant.coupling.stiffness_n_per_m
    if wall.is_anchored:
        expected = wall.stiffness_n_per_m * ks / (wall.stiffness_n_per_m + ks) / (1j * omega)
    else:
        expected = plant.payload.drag_n_s_per_m + wall.damping_n_s_per_m + 0j
    # First order in ω times the slowest time constants: (B_p + B_e)/K_e, (M_p + M_e)/(B_p + B_e), M_a/B_a, K_l, delay,
    # robot; all under 3 s.
    tolerance = 5e-3 * abs(expected) + (0.0 if wall.is_anchored else _ripple(plant))
    assert abs(found * controller.damping_n_s_per_m - expected) < tolerance


def _ripple(plant: Plant) -> float:
    """Return the force per speed by which F at the ticks may differ from its mean: the commands are a staircase.

    Each step changes the flange's speed by w h v (w: the robot's velocity per step of the command), which makes a
    parabola of w h² v/8 against the straight line, and corrections of the order of the robot's second pole.
    """
    robot, coupling, h = plant.robot, plant.coupling, PERIOD_S
    w = robot.numerator[0] / robot.denominator[0] if len(robot.numerator) == robot.order else 0.0
    later = abs(robot.denominator[-1]) * coupling.stiffness_n_per_m * h**3 if robot.order > 1 else 0.0
    return float((coupling.stiffness_n_per_m * h / 6.0 + coupling.damping_n_s_per_m) * w * h + later)


@pytest.mark.parametrize("hertz", [0.5, 2.0, 8.0, 20.0, 30.0])
@pytest.mark.parametrize(
    "controller",
    [
        admittance(),
        admittance(feedback=7.5e-3),
        admittance(lead=0.0, damping=3000.0),
        STRUCTURES["filtered, feedback"],
        STRUCTURES["ideal"],
    ],
    ids=["lead", "feedback", "high damping", "filtered", "ideal"],
)
def test_the_sampled_loop_is_the_continuous_one_with_half_a_sample_more(
    controller: AdmittanceController, hertz: float
) -> None:
    """docs/method.md, "The loop": at T_d + h/2 the continuous form is within about 1 %."""
    s = np.array([2j * np.pi * hertz])
    plant, c = paper_plant(), controller
    lag = np.exp(-s * (DELAY_S + 0.5 * PERIOD_S))
    forward = (1.0 + c.lead_s * s) / (c.mass_kg * s * s + c.damping_n_s_per_m * s)
    corner = c.velocity_filter_rad_per_s
    position = robot_gain(plant, s) * lag
    second = c.acceleration_filter_rad_per_s
    acceleration = s * s if c.is_ideal else corner * second * s * s / ((s + second) * (s + corner))
    compensated = forward * c.compensation_mass_kg * acceleration
    damped = 1.0 + position * (c.feedback_damping_s * corner * s / (s + corner) - compensated)
    admittance_g = forward * s * position / damped
    at = s.imag
    sampled = build_sampled_plant(plant, PERIOD_S)
    np.testing.assert_allclose(
        loop_response(sampled, c, at).at_force, admittance_g * rendered_impedance(plant, s), rtol=0.01
    )
    np.testing.assert_allclose(free_space_admittance(sampled, c, at), admittance_g, rtol=0.01)


@pytest.mark.parametrize("name", STRUCTURES)
def test_the_payload_does_not_enter_the_rendered_admittance(name: str) -> None:
    """The robot ignores F; P̂ is the controller's and not the payload's."""
    omega = np.geomspace(1.0, 1000.0, 20)
    light, heavy = (
        free_space_admittance(
            build_sampled_plant(paper_plant(stiffness=0.0, mass=m), PERIOD_S), STRUCTURES[name], omega
        )
        for m in (2.0, 50.0)
    )
    # The same sum without and with a decoupled part in the linear system.
    np.testing.assert_allclose(light, heavy, rtol=1e-10)


@pytest.mark.parametrize("name", STRUCTURES)
def test_a_slow_hand_feels_the_admittance_damping(name: str) -> None:
    """G → 1/B_a: the steady hand force per speed; filters and compensation see no steady speed."""
    sampled = build_sampled_plant(paper_plant(stiffness=0.0), PERIOD_S)
    found = free_space_admittance(sampled, STRUCTURES[name], np.array([0.01]))
    # Second order in ω (M_a/B_a + ...) = 1e-3.
    assert abs(found[0]) == pytest.approx(1e-3, rel=1e-5)


@LAW
@given(any_controllers(), between(20.0, 400.0))
def test_an_ideally_compensated_admittance_is_that_of_a_smaller_mass(
    controller: AdmittanceController, bandwidth: float
) -> None:
    """With a robot that follows at once, M_a − P̂ is felt: G = (1 + K_l s)/((M_a − P̂) s + B_a − P̂ K_l s²)."""
    omega = np.array([0.3])
    robot = one_pole(0.0, 1e5 * bandwidth)
    found = free_space_admittance(
        build_sampled_plant(paper_plant(stiffness=0.0, robot=robot), PERIOD_S), controller, omega
    )
    c, s = controller, 1j * omega[0]
    inverse = (c.mass_kg * s + c.damping_n_s_per_m) / (1.0 + c.lead_s * s) - c.compensation_mass_kg * s
    damped = (inverse + c.feedback_damping_s * (c.mass_kg * s + c.damping_n_s_per_m) / (1.0 + c.lead_s * s) * s) ** -1
    # Half a sample of lag, and the filters' ω/ω_v and ω/ω_a below 1e-2, act on small terms only (ω M_a/B_a < 0.06).
    np.testing.assert_allclose(found, damped, rtol=1e-3)


@pytest.mark.parametrize("moving_kg", [0.5, 6.0])
def test_a_mass_that_moves_with_the_surface_makes_the_loop_of_a_heavier_payload(moving_kg: float) -> None:
    """While they touch, M_e s is beside M_p s: a range of M_p up to M_p + M_e holds the contact with a moving table."""
    law = admittance(12.0, 1200.0, 0.015)
    moving, heavier = (
        build_sampled_plant(each, PERIOD_S)
        for each in (
            paper_plant(stiffness=1e5, mass=16.0, coupling_damping=50.0, environment_mass=moving_kg),
            paper_plant(stiffness=1e5, mass=16.0 + moving_kg, coupling_damping=50.0),
        )
    )
    frequency = np.geomspace(0.1, 3000.0, 50)
    found, expected = (loop_response(each, law, frequency) for each in (moving, heavier))
    np.testing.assert_allclose(found.at_force, expected.at_force, rtol=1e-9)
    np.testing.assert_allclose(found.at_command, expected.at_command, rtol=1e-9)
