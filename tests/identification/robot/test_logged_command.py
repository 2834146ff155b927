"""The robot behind a logged command, of a controller that may run faster than the log; the robots are scipy's."""

import numpy as np
import pytest

from identification.robot.logged_command import SECOND_POLE, LoggedRobot, identify_logged_robot
from tests.identification.robot.test_position_loop import (
    H_S,
    ONE_POLE,
    PARTS,
    TWO_POLES,
    followed,
    led_by_hand,
    noisy,
)
from tests.identification.synthetic import sweep

DELAY_S = 3.2e-3


def logged(every: int, control_period_s: float | None = None, *, poles: int = 1) -> LoggedRobot:
    """Identify from one of `every` samples of a controller of 1 kHz."""
    command = sweep(12.0, 1.0 / H_S)
    robot = ONE_POLE if poles == 1 else TWO_POLES
    position = noisy(followed(robot, round(DELAY_S / H_S * PARTS), command))
    return identify_logged_robot(command[::every], position[::every], every * H_S, control_period_s=control_period_s)


def test_a_fast_log_has_every_command() -> None:
    found = logged(1)
    assert found.is_held
    assert found.longer_s == (0.0, 0.0)
    assert found.fit.model.delay_s == pytest.approx(DELAY_S, abs=2e-5)


@pytest.mark.parametrize("poles", [1, 2])
def test_a_hold_that_the_log_does_not_show_widens_the_delay_and_keeps_the_command(poles: int) -> None:
    """Held for 2 ms or for less: the delay lies between those two, by a uniform distribution of h/2."""
    found = logged(2, poles=poles)
    assert found.behind_hold is not None
    assert not found.is_held
    shortest = found.behind_hold.model.delay_s
    longer, deviation = found.longer_s
    assert longer == pytest.approx(2 * H_S / 4.0, rel=1e-9)
    assert deviation == pytest.approx(2 * H_S / 4.0 / 3.0**0.5, rel=0.01)
    # What a controller of 2 ms would have, 1 ms of its hold in it, and what this one of 1 ms has.
    assert shortest == pytest.approx(DELAY_S - 0.5 * H_S, abs=3e-5)
    assert abs(shortest + longer - DELAY_S) < 2.0 * deviation
    assert "give `sample_time_s`" in found.note


@pytest.mark.parametrize("every", [2, 4])
def test_the_known_period_of_a_faster_controller_gives_the_delay(every: int) -> None:
    found = logged(every, H_S, poles=2)
    assert found.behind_hold is not None
    assert found.fit.model.delay_s == pytest.approx(DELAY_S, abs=3e-5)
    assert found.behind_hold.model.delay_s + found.longer_s[0] == pytest.approx(DELAY_S, abs=5e-5)


@pytest.mark.parametrize("period_s", [2.0 * H_S, 4.0 * H_S])
def test_a_controller_no_faster_than_the_log_holds_its_commands(period_s: float) -> None:
    found = logged(2, period_s)
    assert found.is_held
    assert found.note == ""


def test_a_log_that_contradicts_the_hold_says_so() -> None:
    """Eight samples of the controller in one of the log: a path in steps of 8 ms explains the pose far worse."""
    found = logged(8)
    assert found.behind_hold is None
    assert abs(found.fit.model.delay_s - DELAY_S) < 2.0 * found.fit.delay_std_s


def test_a_second_pole_slower_than_the_log_is_no_delay_behind_a_smooth_command() -> None:
    """A servo of 70 rad/s and ζ = 1.2, led by hand: one pole and 6 ms more explain the pose nearly as well."""
    rng = np.random.default_rng(1)
    command = led_by_hand(40.0, rng)
    robot = (np.array([4900.0]), np.array([1.0, 168.0, 4900.0]))
    position = followed(robot, round(DELAY_S / H_S * PARTS), command)
    position += 1e-5 * rng.standard_normal(len(position))
    found = identify_logged_robot(command[::2], position[::2], 2 * H_S)
    assert found.behind_samples is not None
    assert found.fit.model.order == found.behind_samples.model.order == 2
    assert abs(found.fit.model.delay_s - DELAY_S) < 2.0 * found.fit.delay_std_s
    assert found.fit.delay_std_s < 0.6e-3
    assert SECOND_POLE not in found.delay_note


def test_a_second_pole_that_the_log_may_hide_is_said() -> None:
    rng = np.random.default_rng(1)
    command = led_by_hand(20.0, rng)
    position = followed(ONE_POLE, round(DELAY_S / H_S * PARTS), command)
    position += 4e-5 * rng.standard_normal(len(position))
    found = identify_logged_robot(command, position, H_S)
    assert found.fit.model.order == 1
    assert found.note == ""
    assert SECOND_POLE in found.delay_note
