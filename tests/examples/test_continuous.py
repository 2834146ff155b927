import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from numpy.typing import NDArray

from examples.paper.continuous import ContinuousLoop, continuous_loop, controller_blocks, plant_blocks
from problems.arrays import FloatArray
from problems.errors import ParameterError
from problems.model.controller import AdmittanceController
from problems.model.plant import Environment, Plant
from problems.model.response import free_space_admittance, loop_response
from problems.model.robot import RobotModel
from problems.model.sampled import build_sampled_plant
from tests.problems.axes import DELAY_S, LAW, PERIOD_S, admittance, between, one_pole, paper_plant
from tests.problems.whole_model import whole_controllers, whole_plants

FREQUENCIES = between(0.1, 4000.0)


def at(plant: Plant, controller: AdmittanceController, *omega: float) -> ContinuousLoop:
    return continuous_loop(plant, controller, np.array(omega))


@LAW
@given(whole_plants(), whole_controllers(), FREQUENCIES)
def test_the_loops_solve_the_equations_of_motion(plant: Plant, controller: AdmittanceController, omega: float) -> None:
    """Every signal as an unknown of one linear system, each equation as docs/method.md states it; no block diagram."""
    s, c = 1j * omega, controller
    robot = np.polyval(plant.robot.numerator, s) / np.polyval(plant.robot.denominator, s)
    k_s, b_s, m_p, b_p, k_e, b_e, m_e = plant.parameters()
    m_a, b_a, k_l, b_fb, w_v, w_a, p = c.parameters()
    observer = s * s if c.is_ideal else w_v * w_a * s * s / ((s + w_a) * (s + w_v))
    # Unknowns x^d, x, x_p, F. `to_robot` is what reaches the robot, `to_controller` what reaches the controller.
    law, damper = (1.0 + k_l * s) / (m_a * s * s + b_a * s), b_fb * w_v * s / (s + w_v)

    def solve(command_fed: float, force_fed: float, right: list[float]) -> NDArray[np.complex128]:
        system = np.array(
            [
                [1.0, damper - law * p * observer, 0.0, -law * force_fed],
                [-robot * np.exp(-s * plant.robot.delay_s) * command_fed, 1.0, 0.0, 0.0],
                [0.0, k_s + b_s * s, -(k_s + b_s * s), 1.0],
                [0.0, 0.0, m_p * s * s + b_p * s + m_e * s * s + b_e * s + k_e, 1.0],
            ]
        )
        return np.asarray(np.linalg.solve(system, np.array(right)))

    found = at(plant, controller, omega)
    delayed = robot * np.exp(-s * plant.robot.delay_s)
    closed, cut_force = solve(1.0, 1.0, [law, 0.0, 0.0, 0.0]), solve(1.0, 0.0, [law, 0.0, 0.0, 0.0])
    cut_command = solve(0.0, 1.0, [0.0, delayed, 0.0, 0.0])
    # F is a difference of forces K_s x up to 1e6 times larger.
    close = {"rel": 1e-9, "abs": 1e-15 * k_s * abs(closed[1])}
    assert found.closed_loop[0] == pytest.approx(closed[3], **close)
    assert found.at_force[0] == pytest.approx(-cut_force[3], rel=1e-9, abs=1e-14 * k_s * abs(cut_force[1]))
    assert found.at_command[0] == pytest.approx(-cut_command[0], rel=1e-9, abs=1e-13 * k_s * abs(law))
    assert found.rendered_admittance[0] == pytest.approx(s * cut_force[1], rel=1e-9)
    assert found.plant.felt_impedance[0] == pytest.approx(-cut_force[3] / (s * cut_force[1]), rel=1e-6)


@LAW
@given(whole_plants(), whole_controllers(), FREQUENCIES)
def test_the_two_break_points_share_the_closed_loop(
    plant: Plant, controller: AdmittanceController, omega: float
) -> None:
    """1 + L_x = (1 + R C_fb/s − A(1 + C_ff) R P̂ O_a/s)(1 + L) and S + F/F^d·(−1) = 1."""
    found, s = at(plant, controller, omega), 1j * omega
    robot, law = found.plant.robot, found.controller
    damped = 1.0 + robot * law.feedback / s
    damped -= law.forward * robot * controller.compensation_mass_kg * law.acceleration / s
    size = (1.0 + abs(damped)) * (1.0 + abs(found.at_force[0]))
    assert abs((1.0 + found.at_command - damped * (1.0 + found.at_force))[0]) < 1e-13 * size[0]
    assert abs((found.sensitivity - found.closed_loop - 1.0)[0]) < 1e-12 * (1.0 + abs(found.sensitivity[0]))


def test_a_rigid_coupling_carries_payload_and_wall_as_one() -> None:
    """K_s → ∞: Ē = M_p s + B_p + E."""
    plant = paper_plant(coupling=1e13, environment_damping=40.0)
    omega = np.geomspace(0.1, 1e3, 7)
    s = 1j * omega
    expected = 16.0 * s + 630.0 + 40.0 + 5e5 / s
    # The coupling's impedance is 1e13/ω against at most 5e6.
    np.testing.assert_allclose(plant_blocks(plant, omega).felt_impedance, expected, rtol=1e-5)


def test_without_a_payload_the_springs_are_in_series() -> None:
    """M_p, B_p → 0: Ē = (1/C_s + 1/E)^(−1)."""
    plant = paper_plant(mass=1e-12, drag=0.0, stiffness=2e5, coupling=3e5)
    omega = np.geomspace(0.1, 1e3, 7)
    np.testing.assert_allclose(plant_blocks(plant, omega).felt_impedance, 1.2e5 / (1j * omega), rtol=1e-9)


def test_a_pure_spring_and_a_cancelled_lag_make_a_second_order_loop() -> None:
    """K_l = M_a/B_a, no delay: L = ω_b K/(B_a s (s + ω_b)), and F/F^d = −ω_n²/(s² + ω_b s + ω_n²)."""
    plant = paper_plant(mass=1e-12, drag=0.0, stiffness=2e5, coupling=3e5, robot=one_pole(0.0, 40.0))
    controller, omega = admittance(mass=10.0, damping=2000.0, lead=0.005), np.geomspace(0.1, 1e3, 9)
    s, square = 1j * omega, 40.0 * 1.2e5 / 2000.0
    found = continuous_loop(plant, controller, omega)
    np.testing.assert_allclose(found.at_force, square / (s * (s + 40.0)), rtol=1e-9)
    np.testing.assert_allclose(found.at_command, found.at_force, rtol=1e-12)
    np.testing.assert_allclose(found.closed_loop, -square / (s * s + 40.0 * s + square), rtol=1e-9)


def test_pressing_reads_negative_and_settles_at_the_desired_force() -> None:
    """Signs: F → −F^d at rest in contact; in free space F lags behind as −B_p/(B_a + B_p) F^d."""
    controller = admittance()
    # At 1e-4 rad/s what is left is ω times seconds.
    assert at(paper_plant(), controller, 1e-4).closed_loop[0] == pytest.approx(-1.0, abs=1e-4)
    free = at(paper_plant(stiffness=0.0), controller, 1e-4)
    assert free.closed_loop[0] == pytest.approx(-630.0 / 1630.0, abs=1e-4)
    assert free.rendered_admittance[0] == pytest.approx(1.0 / 1000.0, abs=1e-7)
    assert free.plant.felt_impedance[0] == pytest.approx(630.0, abs=1e-2)
    assert np.all(free.plant.environment == 0.0)


def test_the_delay_is_exact_and_half_a_sample_is_on_top() -> None:
    omega = np.array([1.0, 100.0, 3000.0])
    late, early = plant_blocks(paper_plant(), omega), plant_blocks(paper_plant(robot=one_pole(0.0)), omega)
    np.testing.assert_allclose(late.robot, early.robot * np.exp(-1j * omega * DELAY_S), rtol=1e-13)
    held = plant_blocks(paper_plant(), omega, half_sample_of_s=PERIOD_S)
    np.testing.assert_allclose(held.robot, late.robot * np.exp(-0.5j * omega * PERIOD_S), rtol=1e-13)
    np.testing.assert_array_equal(held.felt_impedance, late.felt_impedance)


def test_the_observer_sees_the_acceleration_below_its_corners() -> None:
    omega = np.array([0.1, 1.0, 1e5])
    filtered, ideal = (
        controller_blocks(replace(admittance(), compensation=kind), omega).acceleration
        for kind in ("filtered", "ideal")
    )
    np.testing.assert_array_equal(ideal, -(omega**2))
    # Corners at 120 and 200 rad/s: at 1 rad/s they turn by ω/120 + ω/200; far above, ω_v ω_a is left.
    np.testing.assert_allclose(filtered[:2], ideal[:2], rtol=1.4e-2)
    assert filtered[2] == pytest.approx(120.0 * 200.0, rel=4e-3)


WHOLE = [
    pytest.param(
        paper_plant().in_contact_with(Environment(stiffness_n_per_m=2e5, damping_n_s_per_m=50.0, mass_kg=1.0)),
        admittance(feedback=5e-3),
        id="contact",
    ),
    pytest.param(paper_plant(stiffness=0.0), replace(admittance(), compensation_mass_kg=16.0), id="free, filtered"),
    pytest.param(
        # The damper of a coupling behind one pole makes F jump at the ticks; sampling a jump is of first order in h.
        paper_plant(
            coupling_damping=100.0,
            robot=RobotModel(
                numerator=np.array([900.0]), denominator=np.array([1.0, 40.0, 900.0]), delay_s=2.5 * PERIOD_S
            ),
        ),
        replace(admittance(), compensation_mass_kg=8.0, compensation="ideal"),
        id="two poles, ideal, half a sample",
    ),
]


def difference(plant: Plant, controller: AdmittanceController, omega: FloatArray, h: float) -> list[FloatArray]:
    sampled = build_sampled_plant(plant, h)
    exact, found = (
        loop_response(sampled, controller, omega),
        continuous_loop(plant, controller, omega, half_sample_of_s=h),
    )
    admittance_g = free_space_admittance(sampled, controller, omega)
    return [
        np.abs(found.at_force / exact.at_force - 1.0),
        np.abs(found.at_command / exact.at_command - 1.0),
        np.abs(found.rendered_admittance / admittance_g - 1.0),
    ]


@pytest.mark.parametrize(("plant", "controller"), WHOLE)
def test_the_sampled_loop_tends_to_the_continuous_one_with_half_a_sample_more(
    plant: Plant, controller: AdmittanceController
) -> None:
    """Tustin and the hold are of second order: half the period, a quarter of the difference; 1 % at 0.8 ms."""
    omega = 2.0 * math.pi * np.array([0.5, 3.0, 12.0, 30.0])
    coarse, middle, fine = (difference(plant, controller, omega, PERIOD_S / k) for k in (1, 2, 4))
    for one, two, four in zip(coarse, middle, fine, strict=True):
        assert np.all(one < 0.01)
        # Below 1e-8 rounding is what is left of the differences.
        assert np.all((two < 0.27 * one) | (two < 1e-8))
        assert np.all((four < 0.27 * two) | (four < 1e-8))


@pytest.mark.parametrize("omega", [0.0, -1.0, math.nan, math.inf])
def test_a_frequency_must_be_above_zero(omega: float) -> None:
    with pytest.raises(ParameterError, match="frequency_rad_per_s"):
        at(paper_plant(), admittance(), 1.0, omega)


def test_the_period_must_be_positive() -> None:
    with pytest.raises(ParameterError, match="half_sample_of_s"):
        plant_blocks(paper_plant(), np.array([1.0]), half_sample_of_s=0.0)


def test_frequencies_may_have_any_shape() -> None:
    omega = np.geomspace(1.0, 100.0, 6).reshape(2, 3)
    found = continuous_loop(paper_plant(), admittance(), omega)
    assert found.at_force.shape == (2, 3)
    assert found.at_force[1, 2] == at(paper_plant(), admittance(), omega[1, 2]).at_force[0]
