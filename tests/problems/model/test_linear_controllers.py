"""A law written as matrices closes the same loops as the controller that it came from."""

import numpy as np
import pytest

from problems.contact.linear_controller_contact import (
    force_per_speed,
    simulate_linear_contact,
    trace_linear_contact,
)
from problems.contact.transient import Approach, build_sampled_contact, simulate_contact
from problems.design.requirements import hand_approach
from problems.errors import ParameterError
from problems.model.controller import AdmittanceController
from problems.model.linear_controllers import LinearController
from problems.model.plant import FREE_SPACE
from problems.model.response import controller_response, loop_response, plant_response, rendered_admittance
from problems.model.sampled import build_cut_loop, build_loop, build_sampled_plant, spectral_radius
from problems.model.third_party_controllers import ForwardDynamics, SpringAdmittance
from problems.stability.margins import UnstableLoopError
from problems.stability.noise import command_speed_gain
from problems.stability.passivity import passive_below_hz
from tests.problems.axes import PERIOD_S, admittance, linear_controller, one_pole, paper_plant

CONTROLLERS = {
    "plain": AdmittanceController(mass_kg=13.0, damping_n_s_per_m=1400.0),
    "lead and feedback": admittance(feedback=0.005),
    "compensated": AdmittanceController(mass_kg=13.0, damping_n_s_per_m=1400.0, compensation_mass_kg=4.0),
    "euler": AdmittanceController(mass_kg=13.0, damping_n_s_per_m=1400.0, discretization="forward_euler"),
}
OMEGA = np.geomspace(0.5, 3900.0, 60)


@pytest.fixture(params=CONTROLLERS)
def controller(request: pytest.FixtureRequest) -> AdmittanceController:
    return CONTROLLERS[request.param]


@pytest.mark.parametrize("stiffness", [0.0, 9e4])
def test_a_controller_as_a_law_makes_the_same_loop(controller: AdmittanceController, stiffness: float) -> None:
    sampled = build_sampled_plant(paper_plant(stiffness=stiffness, coupling_damping=150.0), PERIOD_S)
    law = linear_controller(controller, PERIOD_S)
    ours, its = build_loop(sampled, controller), build_loop(sampled, law)
    for name in ("a", "b", "b_push", "c_force", "c_command", "translation"):
        np.testing.assert_array_equal(getattr(its, name), getattr(ours, name))
    assert its.is_anchored == ours.is_anchored == (stiffness > 0.0)
    assert command_speed_gain(sampled, law) == command_speed_gain(sampled, controller)
    assert passive_below_hz(sampled, law) == pytest.approx(passive_below_hz(sampled, controller), rel=1e-6)


def test_a_controller_as_a_law_has_the_same_response(controller: AdmittanceController) -> None:
    sampled = build_sampled_plant(paper_plant(stiffness=9e4), PERIOD_S)
    law, seen = linear_controller(controller, PERIOD_S), plant_response(sampled, OMEGA)
    for its, ours in zip(law.gains(seen.z), controller_response(controller, seen.z, PERIOD_S), strict=True):
        np.testing.assert_allclose(its, ours, rtol=1e-9, atol=1e-15)
    its_loop, our_loop = loop_response(sampled, law, OMEGA), loop_response(sampled, controller, OMEGA)
    np.testing.assert_allclose(its_loop.at_command, our_loop.at_command, rtol=1e-8, atol=1e-12)
    np.testing.assert_allclose(its_loop.at_force, our_loop.at_force, rtol=1e-8, atol=1e-12)


@pytest.mark.parametrize("delay_s", [0.0, 2.4e-3, 2.7e-3])
@pytest.mark.parametrize("coupling_damping", [0.0, 150.0])
def test_the_contact_of_a_law_is_that_of_the_exact_kernel(delay_s: float, coupling_damping: float) -> None:
    plant = paper_plant(stiffness=1.2e5, drag=330.0, coupling_damping=coupling_damping, robot=one_pole(delay_s))
    pair = build_sampled_contact(build_sampled_plant(plant, PERIOD_S))
    controller = AdmittanceController(mass_kg=6.0, damping_n_s_per_m=1300.0, lead_s=0.0209, feedback_damping_s=0.005)
    law = linear_controller(controller, PERIOD_S)
    for approach in (Approach(force_n=30.0), Approach(speed_m_s=0.02)):
        exact, found = simulate_contact(pair, controller, approach), simulate_linear_contact(pair, law, approach)
        assert found.contact_speed_m_s == pytest.approx(exact.contact_speed_m_s, rel=1e-9)
        assert found.driving_force_n == pytest.approx(exact.driving_force_n, rel=1e-9)
        assert found.peak_sensor_force_n == pytest.approx(exact.peak_sensor_force_n, rel=1e-9)
        # The parts of a sample miss a crest by the curvature over half a part.
        assert found.peak_contact_force_n == pytest.approx(exact.peak_contact_force_n, rel=1e-5)
        assert found.time_of_peak_s == pytest.approx(exact.time_of_peak_s, abs=PERIOD_S / 19.0)
    # B_a + B_p, but for the ripple of F that a damped coupling shows between the ticks.
    assert force_per_speed(pair, law) == pytest.approx(1630.0, rel=2e-3)


@pytest.mark.parametrize("after", [None, 12.0])
def test_the_forces_over_time_of_a_law_are_those_of_the_exact_kernel(after: float | None) -> None:
    """Also under another F^d after the impact, which both creep to."""
    plant = paper_plant(stiffness=1.2e5, drag=330.0, coupling_damping=150.0, robot=one_pole(2.7e-3))
    pair = build_sampled_contact(build_sampled_plant(plant, PERIOD_S))
    controller = AdmittanceController(mass_kg=6.0, damping_n_s_per_m=1300.0, lead_s=0.0209)
    law, approach = linear_controller(controller, PERIOD_S), Approach(speed_m_s=0.02, after_impact_n=after)
    found = trace_linear_contact(pair, law, approach)
    exact = simulate_contact(pair, controller, approach, samples=len(found.time_s))
    for name in ("time_s", "sensor_force_n", "contact_force_n"):
        np.testing.assert_allclose(getattr(found, name), getattr(exact, name), rtol=1e-9, atol=1e-7)
    for name in ("contact_speed_m_s", "peak_sensor_force_n", "time_of_sensor_peak_s"):
        assert getattr(found, name) == pytest.approx(getattr(exact, name), rel=1e-9)
    assert found.peak_contact_force_n == pytest.approx(exact.peak_contact_force_n, rel=1e-5)
    assert found.time_of_peak_s == pytest.approx(exact.time_of_peak_s, abs=PERIOD_S / 19.0)
    assert found.is_settled


@pytest.mark.parametrize("delay_s", [0.0, 2.7e-3])
def test_a_hand_that_lets_go_leaves_what_the_exact_kernel_says(delay_s: float) -> None:
    plant = paper_plant(stiffness=1.2e5, drag=330.0, coupling_damping=150.0, robot=one_pole(delay_s))
    pair = build_sampled_contact(build_sampled_plant(plant, PERIOD_S))
    controller = AdmittanceController(mass_kg=6.0, damping_n_s_per_m=1300.0, lead_s=0.0209, feedback_damping_s=0.005)
    law, approach = linear_controller(controller, PERIOD_S), hand_approach(0.05, "lets_go")
    found = trace_linear_contact(pair, law, approach)
    exact = simulate_contact(pair, controller, approach, samples=len(found.time_s))
    # It leaves the wall, on the grid of the parts.
    for name in ("time_s", "sensor_force_n", "contact_force_n"):
        np.testing.assert_allclose(getattr(found, name), getattr(exact, name), rtol=1e-9, atol=1e-3)
    assert found.contact_speed_m_s == pytest.approx(0.05, rel=1e-9)
    assert found.peak_contact_force_n == pytest.approx(exact.peak_contact_force_n, rel=1e-5)
    # A hand that goes on pushing is the F^d of that speed.
    pushing, driven = hand_approach(0.05, "pushes_on"), Approach(speed_m_s=0.05)
    peaks = simulate_contact(pair, controller, pushing), trace_linear_contact(pair, law, driven)
    assert peaks[1].peak_contact_force_n == pytest.approx(peaks[0].peak_contact_force_n, rel=1e-4)
    with pytest.raises(ParameterError, match="lets go"):
        trace_linear_contact(pair, law, pushing)


def test_a_payload_that_bounces_has_the_same_peak() -> None:
    plant = paper_plant(stiffness=4e5, mass=8.0, drag=700.0, coupling_damping=200.0)
    pair = build_sampled_contact(build_sampled_plant(plant, PERIOD_S))
    controller = AdmittanceController(mass_kg=12.0, damping_n_s_per_m=3000.0, lead_s=0.01)
    exact = simulate_contact(pair, controller, Approach(speed_m_s=0.2))
    found = simulate_linear_contact(pair, linear_controller(controller, PERIOD_S), Approach(speed_m_s=0.2))
    assert np.min(exact.contact_force_n[: int(exact.time_of_peak_s / PERIOD_S) + 200]) == 0.0  # it left the wall
    assert found.peak_contact_force_n == pytest.approx(exact.peak_contact_force_n, rel=2e-3)


def test_an_unstable_contact_and_a_hand_have_no_peak() -> None:
    pair = build_sampled_contact(build_sampled_plant(paper_plant(), PERIOD_S))
    law = linear_controller(AdmittanceController(mass_kg=10.0, damping_n_s_per_m=300.0), PERIOD_S)
    with pytest.raises(UnstableLoopError):
        simulate_linear_contact(pair, law, Approach(force_n=30.0))
    with pytest.raises(ParameterError, match="desired force"):
        simulate_linear_contact(pair, law, Approach(force_n=30.0, driven_by="hand"))


def test_margins_at_the_command_of_a_law_that_follows_the_position_are_those_of_what_it_adds() -> None:
    """Two roads: the cut loop with the increment as its signal, and the response with x closed around the robot."""
    law = ForwardDynamics(proportional=0.004, derivative=8e-5).law(PERIOD_S)
    for stiffness in (0.0, 9e4):
        sampled = build_sampled_plant(paper_plant(stiffness=stiffness, coupling_damping=100.0), PERIOD_S)
        cut, z = build_cut_loop(sampled, law), np.exp(1j * OMEGA * PERIOD_S)
        opened, n = cut.closed_at(cut.force), cut.state_count
        states = np.linalg.solve(z[:, None, None] * np.eye(n) - opened[:n, :n], opened[:n, [cut.command]])[..., 0]
        increment = -(states @ opened[cut.command, :n] + opened[cut.command, cut.command])
        np.testing.assert_allclose(loop_response(sampled, law, OMEGA).at_command, increment, rtol=1e-7, atol=1e-12)
        # The closed loop knows nothing of where it was cut.
        closed = cut.closed_at(cut.command, cut.force)[:n, :n]
        np.testing.assert_allclose(
            np.sort_complex(np.linalg.eigvals(closed)),
            np.sort_complex(np.linalg.eigvals(build_loop(sampled, law).a)),
            atol=1e-7,
        )


def test_a_law_that_holds_its_position_anchors_free_space() -> None:
    rule = SpringAdmittance(
        mass=8.0, damping_ratio=40.0, stiffness=50.0, joint_damping_per_s=0.0, filter_coefficient=1.0
    )
    sampled = build_sampled_plant(paper_plant(stiffness=0.0), PERIOD_S)
    loop = build_loop(sampled, rule.law(PERIOD_S))
    assert loop.is_anchored
    # The spring's return, K/(D + B_p) per second, is the slowest pole.
    assert -np.log(spectral_radius(loop)) / PERIOD_S == pytest.approx(50.0 / (rule.damping + 630.0), rel=0.01)
    # At low frequency the spring is what a push meets.
    seen = plant_response(sampled, np.array([1e-3, 60.0]))
    stiff, loose = rendered_admittance(seen, rule.law(PERIOD_S), PERIOD_S)
    assert abs(stiff) == pytest.approx(1e-3 / 50.0, rel=0.01)
    assert abs(loose) > 1e-4
    assert sampled.plant.environment == FREE_SPACE


@pytest.mark.parametrize(
    ("matrix", "rest", "message"),
    [
        (np.zeros((2, 2)), np.zeros(1), "states"),
        (np.array([[np.nan, 0.0, 0.0], [1.0, 0.0, 1.0]]), np.zeros(1), "finite"),
        (np.array([[0.5, 0.0, 0.0], [1.0, 0.0, 0.5]]), np.zeros(1), "one metre"),
    ],
)
def test_a_law_that_is_none_is_refused(matrix: np.ndarray, rest: np.ndarray, message: str) -> None:
    with pytest.raises(ParameterError, match=message):
        LinearController(matrix=matrix, rest=rest, sample_time_s=PERIOD_S)


def test_a_law_of_another_period_is_refused() -> None:
    sampled = build_sampled_plant(paper_plant(), PERIOD_S)
    with pytest.raises(ParameterError, match="that of the plant"):
        build_loop(sampled, ForwardDynamics(proportional=0.01, derivative=0.0).law(1e-3))
