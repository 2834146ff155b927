"""The same robot, a little faster or slower, better or worse damped, with another delay."""

import math
from functools import lru_cache

import numpy as np

from .._checks import positive
from ..errors import ParameterError
from .robot import RobotModel

_LOWEST_HZ, _HIGHEST_HZ = 1e-2, 1e4
_HALVINGS = 80


@lru_cache(maxsize=256)
def bandwidth_hz(robot: RobotModel) -> float:
    """Return the frequency [Hz] at which |r| falls to 1/√2."""
    low, high = _LOWEST_HZ, _HIGHEST_HZ
    for _ in range(_HALVINGS):
        middle = math.sqrt(low * high)
        inside = abs(robot.position_response(np.array([2.0 * np.pi * middle]))[0]) > math.sqrt(0.5)
        low, high = (middle, high) if inside else (low, middle)
    return low


def has_damping_ratio(robot: RobotModel) -> bool:
    """Whether r(s) is ω²/(s² + 2ζω s + ω²), so that one number tells its damping."""
    return robot.order == 2 and len(robot.numerator) == 1


def damping_ratio(robot: RobotModel) -> float:
    """Return ζ of ω²/(s² + 2ζω s + ω²); raises ParameterError for another robot."""
    if not has_damping_ratio(robot):
        raise ParameterError("robot", robot.order, "one with two poles and no zero, to have a damping ratio")
    return float(robot.denominator[1] / (2.0 * math.sqrt(robot.denominator[2])))


def bandwidth_share(ratio: float) -> float:
    """Return bandwidth over natural frequency of ω²/(s² + 2ζω s + ω²): √(1 − 2ζ² + √((1 − 2ζ²)² + 1))."""
    middle = 1.0 - 2.0 * ratio**2
    # For a large ζ the plain form is a difference of nearly equal numbers.
    root = math.hypot(middle, 1.0)
    return math.sqrt(middle + root if middle >= 0.0 else 1.0 / (root - middle))


def vary_robot(
    robot: RobotModel,
    *,
    bandwidth_hz: float | None = None,
    damping_ratio: float | None = None,
    delay_s: float | None = None,
) -> RobotModel:
    """Return the robot with another bandwidth [Hz], damping ratio or delay [s]; None keeps what it is.

    Another bandwidth b makes r(s) into r(s b₀/b): all its frequencies move together. Another damping ratio keeps the
    bandwidth, unless that is given too. Raises ParameterError for a damping ratio of a robot that has none.
    """
    if bandwidth_hz is None and damping_ratio is None:
        if delay_s is None or delay_s == robot.delay_s:
            return robot
        return RobotModel(numerator=robot.numerator, denominator=robot.denominator, delay_s=delay_s)
    delay = robot.delay_s if delay_s is None else delay_s
    own = _own_bandwidth_hz(robot)
    wanted = own if bandwidth_hz is None else positive("robot_bandwidth_hz", bandwidth_hz)
    if damping_ratio is not None:
        if not has_damping_ratio(robot):
            raise ParameterError("robot_damping_ratio", damping_ratio, "asked of a robot with two poles and no zero")
        ratio = positive("robot_damping_ratio", damping_ratio)
        omega = 2.0 * math.pi * wanted / bandwidth_share(ratio)
        return RobotModel(
            numerator=np.array([omega**2]), denominator=np.array([1.0, 2.0 * ratio * omega, omega**2]), delay_s=delay
        )
    if wanted == own:
        return RobotModel(numerator=robot.numerator, denominator=robot.denominator, delay_s=delay)
    slower = own / wanted
    return RobotModel(
        numerator=robot.numerator * slower ** np.arange(len(robot.numerator) - 1, -1, -1),
        denominator=robot.denominator * slower ** np.arange(len(robot.denominator) - 1, -1, -1),
        delay_s=delay,
    )


# The argument of `vary_robot` has the function's name.
_own_bandwidth_hz = bandwidth_hz
