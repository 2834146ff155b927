"""The sampled equations of the joint fit against closed forms, scipy's integrator and the laws of impact."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.signal import lsim

from identification.joint_fit.kernel import MOST_TAKEN, pressing, returns_at_once, switch
from identification.joint_fit.model import ParameterLayout, body, held, payload_step, robot_model
from identification.joint_fit.noise import Smoother
from identification.joint_fit.path import commanded_path, measured_path
from identification.joint_fit.segments import Segment, predict_force
from problems.arrays import FloatArray
from tests.identification.synthetic import Load, felt_force, sweep, touch

H_S = 1e-3
LOAD = Load()
FREE = ParameterLayout(robot_order=0, surfaces=0)


# A filter that keeps everything: only the spline's own coefficients.
KEEP_ALL = Smoother(taps=np.sqrt(3.0) * (np.sqrt(3.0) - 2.0) ** np.abs(np.arange(-24, 25)))


@pytest.mark.parametrize("values", [np.array([24.0, 3.7e-3]), np.array([35.0, 0.7, 2e-3])])
def test_the_robots_path_is_that_of_the_continuous_robot_behind_a_hold(values: FloatArray) -> None:
    command, fine = sweep(2.0, 1.0 / H_S), 20
    model = robot_model(values)
    # The delay is a whole number of the fine steps: lsim is exact under a hold.
    late = round(float(values[-1]) / H_S * fine)
    steps = np.concatenate([np.zeros(late), np.repeat(command, fine)])[: len(command) * fine]
    time = np.arange(len(steps)) * H_S / fine
    _, position, _ = lsim((model.numerator, model.denominator), steps, time, interp=False)
    path = commanded_path(values, command, np.zeros(len(command)), Smoother(taps=None), H_S)
    np.testing.assert_allclose(-path.misfit(slice(0, len(command))), position[::fine], rtol=0.0, atol=1e-12)


def test_a_delay_is_split_into_samples_and_a_part() -> None:
    late, whole = held(3.25 * H_S, H_S), held(3.0 * H_S, H_S)
    assert late.older == whole.older == 4
    assert late.fraction == pytest.approx(0.25)
    assert whole.fraction == 0.0


def test_the_force_in_free_motion_is_that_of_scipys_linear_system() -> None:
    fine = 8
    position = sweep(3.0, fine / H_S)
    force = felt_force(position, H_S / fine, LOAD)[::fine]
    path = measured_path(position[::fine], KEEP_ALL)
    whole = Segment(start=0, stop=len(force))
    predicted = predict_force(LOAD.vector(), np.zeros(3), whole, path, FREE, H_S)
    # At 50 Hz the spline errs by (ω h)⁴/720, 1e-5; scipy's straight lines between eighths by (ω h/8)²/12, 1e-4.
    np.testing.assert_allclose(predicted, force, rtol=0.0, atol=1e-4 * np.ptp(force))


@pytest.mark.parametrize(("stiffness", "depth_m"), [(2.0e4, 3e-3), (6.0e4, 1e-3), (2.0e5, 5e-4)])
def test_the_force_in_a_contact_is_that_of_scipys_integrator(stiffness: float, depth_m: float) -> None:
    made = touch(LOAD, stiffness, 50.0, H_S, depth_m=depth_m)
    path = measured_path(made.position_m, KEEP_ALL)
    layout = ParameterLayout(robot_order=0, surfaces=1)
    values = np.concatenate([LOAD.vector(), [stiffness, 50.0, 0.0]])
    segment = Segment(start=0, stop=len(made.force_n), surface=0)
    predicted = predict_force(values, np.array([0.0, 0.0, 0.0, 8e-3]), segment, path, layout, H_S)
    # scipy steps over the onset without locating it: a few thousandths of a newton of 40.
    np.testing.assert_allclose(predicted, made.force_n, rtol=0.0, atol=0.02)


def test_a_wall_on_the_other_side_is_the_same_wall() -> None:
    made = touch(LOAD, 6.0e4, 50.0, H_S, depth_m=1e-3)
    layout, values = ParameterLayout(robot_order=0, surfaces=1), np.concatenate([LOAD.vector(), [6.0e4, 50.0, 1.0]])
    forces = []
    for sign in (1, -1):
        path = measured_path(sign * made.position_m, KEEP_ALL)
        segment = Segment(start=0, stop=len(made.force_n), surface=0, sign=sign)
        own = np.array([2.0, 0.5, 0.0, sign * 8e-3])
        forces.append(sign * predict_force(values, own, segment, path, layout, H_S))
    np.testing.assert_allclose(forces[0], forces[1], rtol=0.0, atol=1e-9)


def test_a_commanded_path_holds_what_the_robot_alone_does_between_the_ticks() -> None:
    """With the command the force is exact though the flange jumps in speed at every tick."""
    values = np.concatenate([LOAD.vector(), [20.0, 2.3e-3]])
    layout = ParameterLayout(robot_order=1, surfaces=0)
    command = sweep(1.0, 1.0 / H_S, high_hz=20.0)
    path = commanded_path(values[4:], command, np.zeros(len(command)), Smoother(taps=None), H_S)
    # What the pose shows beside the robot is left out here, but for its mean, which no force depends on.
    predicted = predict_force(values, np.zeros(3), Segment(start=0, stop=len(command)), path, layout, H_S)
    k, b, p, m = LOAD.vector()

    def motion(t: float, state: FloatArray) -> list[float]:
        acting = command[max(0, int(np.floor((t - 2.3e-3) / H_S + 1e-9)))]
        speed = 20.0 * (acting - state[0])
        force = k * (state[1] - state[0]) + b * (state[2] - speed)
        return [speed, state[2], (-force - p * state[2]) / m]

    state, edges = np.zeros(3), []
    for tick in range(400):
        for first, last in ((0.0, 0.3), (0.3, 1.0)):
            span = (tick + first) * H_S, (tick + last) * H_S
            inner = span[0] + 1e-9 * H_S, span[1] - 1e-9 * H_S
            state = solve_ivp(motion, inner, state, rtol=1e-10, atol=1e-14).y[:, -1]
        edges.append(state.copy())
    reached = np.array(edges)
    acting = np.array([command[max(0, tick + 1 - 3)] for tick in range(400)])
    force = k * (reached[:, 1] - reached[:, 0]) + b * (reached[:, 2] - 20.0 * (acting - reached[:, 0]))
    np.testing.assert_allclose(predicted[1:401], force, rtol=0.0, atol=1e-4)


@pytest.mark.parametrize("values", [np.array([24.0, 3.7e-3]), np.array([35.0, 0.7, 2e-3])])
@pytest.mark.parametrize("used", [slice(0, 40), slice(255, 259), slice(700, 1900), slice(1950, 2000)])
def test_a_part_of_the_path_is_that_of_the_whole(values: FloatArray, used: slice) -> None:
    """At the ends of the log and at the marks, from which the robot is run again, too."""
    command = sweep(2.0, 1.0 / H_S)
    beside = 1e-4 * np.sin(np.arange(len(command)) / 90.0)
    for smoother in (KEEP_ALL, Smoother(taps=None)):
        path = commanded_path(values, command, command + beside, smoother, H_S)
        whole, part = path.cut(slice(0, len(command))), path.cut(used)
        np.testing.assert_allclose(part.drive, whole.drive[used], rtol=0.0, atol=1e-15)
        np.testing.assert_allclose(part.ends, whole.ends[used], rtol=0.0, atol=1e-15)
        np.testing.assert_array_equal(path.misfit(used), path.misfit(slice(0, len(command)))[used])


def test_a_cut_ends_where_the_next_begins() -> None:
    """The flange's position does not jump at a tick; its speed does, where a held command steps."""
    command = sweep(1.0, 1.0 / H_S)
    path = commanded_path(np.array([24.0, 3.7e-3]), command, 0.9 * command, KEEP_ALL, H_S)
    ends = path.cut(slice(100, 600)).ends
    np.testing.assert_array_equal(ends[:-1, 2], ends[1:, 0])
    stepped = np.diff(command)[97:596]  # with a delay of 3.7 samples the command of four ticks before begins to act
    assert float(np.max(np.abs(ends[1:, 1] - ends[:-1, 3]))) < 1e-12 + 24.0 * H_S * float(np.max(np.abs(stepped)))


def test_an_impact_with_mass_keeps_the_momentum() -> None:
    of = body(np.array([1e-3, 0.0, 0.0, 6.0]), np.array([1e-3, 0.0, 2.0]), 1.0)
    # A payload just before the wall with next to no springs: v · 6 kg is shared by 8 kg.
    state = np.array([-1e-6, 1e-3, 0.0, 0.0])
    assert not pressing(state, (0.0, 0.0, 0.0, 0.0), 0.0, of, False)
    touching, _ = switch(state, (-1e-6, 0.0, -1e-6, 0.0), of, False, np.empty((MOST_TAKEN, 2)))
    assert touching
    assert state[1] == pytest.approx(0.75e-3, rel=1e-3)
    np.testing.assert_array_equal(state[2:], state[:2])


@pytest.mark.parametrize("radians", [0.5, 2.0, 5.0])
def test_an_environment_that_was_left_swings_back_as_a_damped_spring_does(radians: float) -> None:
    """Within one sample, beside a payload that is far away and hardly moves."""
    ratio, mass, start = 0.1, 0.5, 1e-3
    surface = np.array([radians**2 * mass, 2.0 * ratio * radians * mass, mass])
    of = body(np.array([1e-6, 0.0, 0.0, 6.0]), surface, 1.0)
    assert not returns_at_once(of)
    state = np.array([-1.0, 0.0, start, 0.0])
    touching, steps = switch(state, (-1.0, 0.0, -1.0, 0.0), of, False, np.empty((MOST_TAKEN, 2)))
    assert not touching
    assert steps >= radians / 0.15
    damped = radians * np.sqrt(1.0 - ratio**2)
    swing = np.exp(-ratio * radians) * (np.cos(damped) + ratio * radians / damped * np.sin(damped))
    # Steps of 0.15 rad by the fourth-order rule: 1e-6 of the amplitude each.
    assert state[2] == pytest.approx(start * swing, abs=1e-4 * start)


def test_a_step_in_contact_is_one_in_free_space_with_the_environment_added() -> None:
    coupling, surface = LOAD.vector(), np.array([5.0e4, 40.0, 3.0])
    touched, _ = payload_step(body(coupling, surface, H_S), None, 0.0, touching=True)
    heavier = coupling + np.array([0.0, 0.0, surface[1], surface[2]])
    # K_e pulls at the payload as K_s does, when the flange stands still.
    alike, _ = payload_step(body(heavier, np.array([5.0e4, 0.0, 0.0]), H_S), None, 0.0, touching=True)
    np.testing.assert_allclose(touched, alike, rtol=1e-12)


def test_a_step_that_is_kept_cannot_be_changed() -> None:
    phi, gamma = payload_step(body(LOAD.vector(), np.zeros(3), H_S), None, 0.0, touching=False)
    for array in (phi, gamma):
        with pytest.raises(ValueError, match="read-only"):
            array[0, 0] = 1.0


def test_names_stand_where_the_slices_say() -> None:
    layout = ParameterLayout(robot_order=2, surfaces=2)
    assert layout.names[layout.robot] == ("robot_frequency_rad_per_s", "robot_damping_ratio", "delay_s")
    assert layout.names[layout.surface(1)][0] == "environment2_stiffness_n_per_m"
    assert len(layout) == 13
