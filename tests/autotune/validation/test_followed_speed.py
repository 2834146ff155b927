"""The largest speed of a robot whose command is limited behind a lag, against commands that take it there."""

import numpy as np
import pytest
from scipy.signal import lfilter

from autotune.formats.controller_record import admittance_controller
from autotune.validation.followed_speed import _impulse_answers, followed_speeds, robot_lag_s, robot_share
from problems.arrays import FloatArray
from problems.model.controller import controller_blocks
from problems.model.difference import ControlState, controller_step
from problems.model.robot import RobotModel
from tests.autotune.formats.samples import make_controller

PERIOD_S = 2e-3
ONE_POLE = RobotModel(numerator=np.array([20.0]), denominator=np.array([1.0, 20.0]), delay_s=2.4e-3)
SWINGING = RobotModel(numerator=np.array([900.0]), denominator=np.array([1.0, 24.0, 900.0]), delay_s=3e-3)
LEADING = RobotModel(numerator=np.array([30.0, 900.0]), denominator=np.array([1.0, 60.0, 900.0]), delay_s=0.0)


def weight_of(lag_s: float) -> float:
    return float(-np.expm1(-PERIOD_S / lag_s))


def test_the_lag_of_a_robot_is_that_of_its_first_moment() -> None:
    assert robot_lag_s(ONE_POLE) == pytest.approx(0.05)
    assert robot_lag_s(SWINGING) == pytest.approx(24.0 / 900.0)
    assert robot_lag_s(LEADING) == pytest.approx(30.0 / 900.0)


def test_a_robot_of_one_pole_follows_as_its_own_lag_and_the_hold() -> None:
    """Each step Δ makes a speed of Δ/τ at once: h/τ/(1 − e^(−h/τ)) of what is behind the lag."""
    expected = PERIOD_S / 0.05 / weight_of(0.05)
    assert robot_share(ONE_POLE, PERIOD_S, weight_of(0.05)) == pytest.approx(expected, rel=1e-9)
    # Behind twice the lag it is (2τ s + 1)/(τ s + 1): 2 at once, and 1 is taken back.
    assert robot_share(ONE_POLE, 5e-5, float(-np.expm1(-5e-5 / 0.1))) == pytest.approx(3.0, rel=2e-3)


def robot_speeds(robot: RobotModel, commands: FloatArray, substeps: int) -> FloatArray:
    """The robot's speeds under a staircase of commands, integrated by the implicit midpoint rule in tiny steps."""
    dt = PERIOD_S / substeps
    num, den = robot.ascending()
    size = len(den) - 1
    rate = np.zeros((size, size))
    rate[:-1, 1:] = np.eye(size - 1)
    rate[-1] = -den[:-1]
    drive = np.zeros(size)
    drive[-1] = 1.0
    half = 0.5 * dt * rate
    forward = np.linalg.solve(np.eye(size) - half, np.eye(size) + half)
    pushed = np.linalg.solve(np.eye(size) - half, dt * drive)
    state, found = np.zeros(size), []
    for command in commands:
        for _ in range(substeps):
            found.append(num @ (rate @ state + drive * command))
            state = forward @ state + pushed * command
    return np.array(found)


@pytest.mark.parametrize("robot", [ONE_POLE, SWINGING, LEADING])
@pytest.mark.parametrize("lag_s", [0.02, 0.05])
def test_no_command_within_the_limit_takes_the_robot_beyond_its_share_and_one_takes_it_there(
    robot: RobotModel, lag_s: float
) -> None:
    weight, count = weight_of(lag_s), 400
    share = robot_share(robot, PERIOD_S, weight)

    def answer(behind: FloatArray) -> FloatArray:
        speeds = lfilter([1.0, weight - 1.0], [weight], behind)
        np.testing.assert_allclose(followed_speeds(speeds, weight), behind, atol=1e-9)
        return robot_speeds(robot, np.cumsum(speeds) * PERIOD_S, 20)

    # What one period behind the lag does from then on, and the signs that make it all add up at the end.
    impulse = np.zeros(count)
    impulse[0] = 1.0
    single = answer(impulse).reshape(count, 20)
    worst = max(
        float(np.max(np.abs(answer(np.sign(single[::-1, phase])).reshape(count, 20)[-1, phase])))
        for phase in (0, 10, 19)
    )
    assert worst <= share * 1.001
    # Between two of the places that are looked at the sum is at most that much larger.
    assert worst >= share * 0.99
    rng = np.random.default_rng(0)
    for _ in range(3):
        drawn = np.repeat(rng.choice([-1.0, 1.0], count // 10), 10)
        assert np.max(np.abs(answer(drawn))) <= share * 1.001


def test_a_force_of_one_period_moves_the_command_by_its_impulse_over_the_damping() -> None:
    controller = make_controller(("x",))
    law, h = admittance_controller(controller, "x"), controller.sample_time_s
    force, pose = _impulse_answers(controller, "x", 0.05)
    assert np.sum(force) == pytest.approx(1.0 / law.damping_n_s_per_m, rel=1e-5)
    # From the first period on: what a constant force makes of the command, period by period.
    blocks, commands = controller_blocks(law, h), [0.0]
    state: ControlState = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    for _ in range(50):
        command, state = controller_step(blocks, state, 1.0, 0.0)
        commands.append(command)
    np.testing.assert_allclose(np.cumsum(force)[:50] * h, np.diff(commands), rtol=1e-9, atol=1e-15)
    # A displaced pose is answered only while it changes.
    assert pose[0] != 0.0
    assert abs(np.sum(pose)) < 1e-3 * np.sum(np.abs(pose))
