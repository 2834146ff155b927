import math
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import control
import matplotlib as mpl
import numpy as np
import pytest
from hypothesis import given

from examples.paper.continuous import continuous_loop
from problems.model.controller import AdmittanceController
from problems.model.plant import Environment, Plant
from problems.model.python_control import ControlObjects, to_control
from problems.model.response import controller_response, loop_response, plant_response
from problems.model.robot import RobotModel
from problems.model.sampled import build_loop, build_sampled_plant, spectral_radius, stability_matrix
from tests.problems.axes import LAW, PERIOD_S, admittance, between, one_pole, paper_plant
from tests.problems.whole_model import whole_controllers, whole_plants

mpl.use("Agg")
from matplotlib import pyplot as plt

FREQUENCIES = between(1.0, 0.99 * math.pi / PERIOD_S)


@pytest.fixture(autouse=True)
def _closed_figures() -> Iterator[None]:
    yield
    plt.close("all")


def objects_of(plant: Plant, controller: AdmittanceController) -> ControlObjects:
    return to_control(build_sampled_plant(plant, PERIOD_S), controller)


def loops_of(objects: ControlObjects) -> list[Any]:
    return [objects.at_force, objects.at_command]


DAMPED_WALL = Environment(stiffness_n_per_m=2e5, damping_n_s_per_m=80.0, mass_kg=0.7)
UNANCHORED = Environment(stiffness_n_per_m=0.0, damping_n_s_per_m=80.0, mass_kg=0.7)
COMPENSATED = replace(admittance(mass=15.0, damping=2500.0, feedback=6e-3), compensation_mass_kg=8.0)
CELLS = [
    pytest.param(paper_plant(), admittance(), 0, id="contact"),
    pytest.param(paper_plant(), admittance(mass=10.0, lead=0.0), 2, id="contact, the printed example"),
    pytest.param(paper_plant(stiffness=0.0), admittance(), 0, id="free space"),
    pytest.param(paper_plant(stiffness=0.0, drag=300.0), admittance(mass=10.0, lead=0.0), 2, id="free, little drag"),
    pytest.param(
        paper_plant(robot=one_pole(2.3 * PERIOD_S)).in_contact_with(DAMPED_WALL), COMPENSATED, 0, id="whole model"
    ),
    pytest.param(
        paper_plant(robot=one_pole(0.4 * PERIOD_S), coupling_damping=100.0).in_contact_with(UNANCHORED),
        replace(COMPENSATED, compensation="ideal", discretization="backward_euler"),
        0,
        id="free with a mass, ideal compensation",
    ),
]


@pytest.mark.parametrize(("plant", "controller", "unstable"), CELLS)
def test_nyquist_counts_the_unstable_poles(plant: Plant, controller: AdmittanceController, unstable: int) -> None:
    """No pole of L or L_x is outside the unit circle, so encirclements are unstable poles of the closed loop."""
    loop = build_loop(build_sampled_plant(plant, PERIOD_S), controller)
    assert np.sum(np.abs(np.linalg.eigvals(stability_matrix(loop))) > 1.0) == unstable
    for open_loop in loops_of(objects_of(plant, controller)):
        assert control.nyquist_response(open_loop).count == unstable


@pytest.mark.parametrize(("plant", "controller", "unstable"), CELLS)
def test_without_an_anchor_the_loops_have_no_integrator_and_the_closed_loop_has_one(
    plant: Plant, controller: AdmittanceController, unstable: int
) -> None:
    del unstable
    objects, anchored = objects_of(plant, controller), plant.environment.is_anchored

    def integrators(system: Any) -> int:
        # The next slowest poles of these cells are those of the robot, exp(−20 h) = 0.984.
        return int(np.sum(np.abs(control.poles(system) - 1.0) < 1e-6))

    assert [integrators(loop) for loop in loops_of(objects)] == [int(anchored)] * 2
    assert integrators(objects.closed_loop) == int(not anchored)


@pytest.mark.parametrize("stiffness", [0.0, 5e5])
def test_pictures_are_drawn_without_a_warning(stiffness: float) -> None:
    objects = objects_of(paper_plant(stiffness=stiffness), admittance(feedback=5e-3))
    control.nyquist_plot(loops_of(objects))
    control.bode_plot(loops_of(objects))
    # In free space F_e is nothing, which a logarithm does not like.
    seen = objects.closed_loop if stiffness else objects.closed_loop[["F", "x_d"], ["F_d", "f"]]
    control.bode_plot(seen, np.geomspace(1.0, 1000.0, 20))
    control.bode_plot([objects.robot, objects.coupling, objects.payload, objects.forward, objects.feedback])
    control.bode_plot(objects.acceleration)
    assert len(plt.get_fignums()) >= 1
    response = control.frequency_response(objects.closed_loop, np.array([10.0, 100.0]))
    assert response.magnitude.shape == (3, 2, 2)


@LAW
@given(whole_plants(), whole_controllers(), FREQUENCIES)
def test_frequency_responses_are_those_of_the_sampled_loop(
    plant: Plant, controller: AdmittanceController, omega: float
) -> None:
    # One radian per second as well, where the gain is large (python-control sorts).
    sampled, at = build_sampled_plant(plant, PERIOD_S), np.array([1.0, omega])
    objects, expected = to_control(sampled, controller), loop_response(sampled, controller, at)
    # F is a difference of K_s x and K_s x_p, and x is known to 1e-12 where the robot is slow.
    forward, _ = controller_response(controller, np.exp(1j * at * PERIOD_S), PERIOD_S)
    size = np.abs(forward * plant.coupling.stiffness_n_per_m * plant_response(sampled, at).position)
    for loop, theirs in zip(loops_of(objects), (expected.at_force, expected.at_command), strict=True):
        found = [solved(loop, z) for z in np.exp(1j * at * PERIOD_S)]
        # Matrices are rounded relative to the largest gain.
        floor = 1e-12 * size + 1e-14 * abs(theirs[0])
        assert np.all(np.abs(found - theirs) < 1e-9 * np.abs(theirs) + floor)
        # Where slycot is installed, python-control lets it rotate the states first, which costs two digits.
        found = control.frequency_response(loop, at).frdata[0, 0]
        assert np.all(np.abs(found - theirs) < 1e-7 * np.abs(theirs) + 100.0 * floor)


def solved(system: Any, z: complex) -> complex:
    """Return C (z − A)^(−1) B + D."""
    return complex((system.C @ np.linalg.solve(z * np.eye(len(system.A)) - system.A, system.B) + system.D)[0, 0])


def test_a_tustin_derivative_rings_where_nyquist_cannot_pass() -> None:
    """2/h (z − 1)/(z + 1): L_x has its pole at z = −1, L has it closed over."""
    objects = objects_of(paper_plant(), replace(COMPENSATED, compensation="ideal"))
    ringing = [float(np.min(np.abs(control.poles(loop) + 1.0))) for loop in loops_of(objects)]
    assert ringing[0] > 1e-3
    assert ringing[1] < 1e-9


@LAW
@given(whole_plants(), whole_controllers(), between(0.05, math.pi))
def test_closing_either_loop_gives_the_poles_of_the_sampled_loop(
    plant: Plant, controller: AdmittanceController, angle: float
) -> None:
    """Equal monic polynomials, compared where no root is; poles that meet would be known to half the digits only."""
    sampled, z = build_sampled_plant(plant, PERIOD_S), 1.3 * np.exp(1j * angle)
    expected = stability_matrix(build_loop(sampled, controller))
    for open_loop in loops_of(to_control(sampled, controller)):
        closed = control.feedback(open_loop, 1).A
        assert closed.shape == expected.shape
        eye = np.eye(len(expected))
        assert np.linalg.det(z * eye - closed) / np.linalg.det(z * eye - expected) == pytest.approx(1.0, abs=1e-9)


@LAW
@given(whole_plants(), whole_controllers())
def test_a_step_of_either_input_runs_as_in_the_sampled_loop(plant: Plant, controller: AdmittanceController) -> None:
    sampled = build_sampled_plant(plant, PERIOD_S)
    loop, closed = build_loop(sampled, controller), to_control(sampled, controller).closed_loop
    count = 30
    for column, drive in enumerate((loop.b, loop.b_push)):
        inputs = np.zeros((2, count))
        inputs[column] = 1.0
        found = control.forced_response(closed, inputs=inputs).outputs
        state, direct = np.zeros(len(drive)), 1.0 if column == 0 else 0.0
        for k in range(count):
            assert found[0, k] == pytest.approx(loop.c_force @ state + loop.d_force * direct, rel=1e-9, abs=1e-12)
            assert found[1, k] == pytest.approx(loop.c_command @ state + loop.d_command * direct, rel=1e-9, abs=1e-12)
            state = loop.a @ state + drive


@LAW
@given(whole_plants(contact=True), whole_controllers())
def test_the_contact_force_closes_the_balance_of_the_payload(plant: Plant, controller: AdmittanceController) -> None:
    """F_e = f − F − B_p v_p − M_p dv_p/dt, the acceleration taken from the plant's rates at the tick."""
    sampled = build_sampled_plant(plant, PERIOD_S)
    loop, closed = build_loop(sampled, controller), to_control(sampled, controller).closed_loop
    n, chain = sampled.state_count, sampled.chain_length
    inputs = np.array([[1.0, -2.0, 0.5, 3.0, 0.0, 1.0], [0.0, 1.0, 2.0, -1.0, 4.0, 1.0]])
    found, state = control.forced_response(closed, inputs=inputs).outputs, np.zeros(len(loop.a))
    for k, (desired, push) in enumerate(inputs.T):
        command = loop.c_command @ state + loop.d_command * desired
        held = state[n + chain - 1] if chain else command
        rate = sampled.rate @ state[:n] + sampled.drive * held + sampled.push * push
        force = loop.c_force @ state + loop.d_force * desired
        # The last plant state is h v_p; its rate is that per period.
        terms = [push, force, plant.payload.drag_n_s_per_m * state[n - 1] / PERIOD_S]
        terms.append(plant.payload.mass_kg * rate[n - 1] / PERIOD_S**2)
        # Sums of terms of this size.
        size = sum(abs(term) for term in terms)
        assert abs(found[2, k] - (terms[0] - sum(terms[1:]))) < 1e-10 * size + 1e-300
        state = loop.a @ state + loop.b * desired + loop.b_push * push


def test_states_are_scaled_for_methods_that_mix_them() -> None:
    """Unscaled, the state of the acceleration filter, above 1e3 per metre, stands beside states in metres."""
    sampled = build_sampled_plant(paper_plant(), PERIOD_S)
    assert np.max(np.abs(build_loop(sampled, COMPENSATED).a)) > 1e3
    objects = to_control(sampled, COMPENSATED)
    for system in (*loops_of(objects), objects.closed_loop):
        assert np.max(np.abs(system.A)) < 10.0


def test_signals_have_names_and_the_statics_their_signs() -> None:
    """At rest against a wall: F = −F^d, F_e = F^d + f, x^d = (F^d + f)/K_e + F^d/K_s."""
    plant = paper_plant(robot=one_pole(0.0), coupling_damping=50.0).in_contact_with(DAMPED_WALL)
    closed = objects_of(plant, admittance()).closed_loop
    assert (closed.input_labels, closed.output_labels) == (["F_d", "f"], ["F", "x_d", "F_e"])
    k_e, k_s = 2e5, 3e5
    # The slowest pole is about 0.99: a solve with 1 − A.
    np.testing.assert_allclose(
        closed.dcgain(), [[-1.0, 0.0], [1.0 / k_e + 1.0 / k_s, 1.0 / k_e], [1.0, 1.0]], rtol=1e-9, atol=1e-9
    )
    objects = objects_of(plant, admittance())
    assert objects.at_force.output_labels == ["-F"]
    assert objects.at_command.output_labels == ["-x_d"]
    assert (objects.at_force.dt, objects.robot.dt) == (PERIOD_S, 0)


@pytest.mark.parametrize("delay", [0.0, 0.4, 1.0])
def test_the_contact_force_is_the_continuous_one_at_a_small_period(delay: float) -> None:
    """F_e = E v_p with (M_p s + B_p + E) v_p = −F + f, damper and mass of the environment included."""
    h, omega = 2e-5, 60.0
    plant = paper_plant(robot=one_pole(delay * h), coupling_damping=50.0).in_contact_with(DAMPED_WALL)
    controller = admittance(mass=20.0, damping=3000.0, lead=0.02)
    found = to_control(build_sampled_plant(plant, h), controller).closed_loop(np.exp(1j * omega * h))
    exact = continuous_loop(plant, controller, np.array([omega]), half_sample_of_s=h)
    wall, payload = exact.plant.environment[0], 1.0 / exact.plant.payload[0]
    for column, push in ((0, 0.0), (1, 1.0)):
        expected = wall * (push - found[0, column]) / (payload + wall)
        # F at the tick stands for F at all times: ω h = 1e-3.
        assert found[2, column] == pytest.approx(expected, rel=3e-3)
    assert found[0, 0] == pytest.approx(exact.closed_loop[0], rel=3e-3)


def test_in_free_space_the_command_runs_away_with_the_steady_speed() -> None:
    """The integrator's residue: x^d grows by F^d/(B_a + B_p) h a tick."""
    closed = objects_of(paper_plant(stiffness=0.0), admittance()).closed_loop
    near = 1.0 + 1e-5
    # To first order in z − 1 over the slowest pole, 1e-5/0.01.
    assert closed(near)[1, 0] * (near - 1.0) == pytest.approx(PERIOD_S / 1630.0, rel=5e-3)


@LAW
@given(whole_plants(), whole_controllers(forms=("tustin",)), between(0.1, 4000.0))
def test_the_continuous_blocks_make_the_continuous_loop(
    plant: Plant, controller: AdmittanceController, omega: float
) -> None:
    """L = A(1 + C_ff) R Ē/(1 + R C_fb/s − A(1 + C_ff) R P̂ O_a/s) put together from transfer functions."""
    objects, s = objects_of(plant, controller), 1j * omega
    position = objects.robot(s) * np.exp(-s * objects.delay_s)
    coupling, payload, wall = objects.coupling(s), objects.payload(s), objects.environment(s)
    felt = coupling * (1.0 + payload * wall) / (1.0 + payload * wall + payload * coupling)
    forward, pressed = objects.forward(s), objects.forward(s) * position * s * felt
    observed = controller.compensation_mass_kg * objects.acceleration(s)
    damped = position * (objects.feedback(s) - forward * observed)
    expected = continuous_loop(plant, controller, np.array([omega]))
    assert pressed / (1.0 + damped) == pytest.approx(expected.at_force[0], rel=1e-9)
    # The terms of L_x may cancel.
    assert abs(pressed + damped - expected.at_command[0]) < 1e-12 * (abs(pressed) + abs(damped))
    assert expected.plant.environment[0] == pytest.approx(wall, rel=1e-12)


def test_the_robot_keeps_its_own_delay() -> None:
    robot = RobotModel(numerator=np.array([100.0, 400.0]), denominator=np.array([5.0, 120.0, 400.0]), delay_s=2.4e-3)
    objects = objects_of(paper_plant(robot=robot), admittance())
    assert objects.delay_s == 2.4e-3
    # docs/method.md, erratum 1: 20/(s + 20).
    np.testing.assert_allclose(control.poles(objects.robot), [-20.0], rtol=1e-9)


def test_an_unstable_loop_is_reported_by_both_forms() -> None:
    """docs/method.md, erratum 4."""
    printed = admittance(mass=10.0, lead=0.0)
    sampled = build_sampled_plant(paper_plant(), PERIOD_S)
    radius = float(np.max(np.abs(control.poles(to_control(sampled, printed).closed_loop))))
    # One matrix, one eigenvalue routine.
    assert radius == pytest.approx(spectral_radius(build_loop(sampled, printed)), rel=1e-12)
    assert radius > 1.001
