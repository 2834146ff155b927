"""The free motions of a log, poses and a sweep, period by period: of a first log and of the simulated cell."""

import math
from collections.abc import Iterator
from dataclasses import dataclass

from problems.errors import ParameterError

Three = tuple[float, float, float]

_GOLDEN_ANGLE_RAD = 2.399963
_GOLDEN_SHARE = 0.618034
_EDGE_SHARE = 0.05


@dataclass(frozen=True, kw_only=True)
class FreeMotions:
    """How long and how far the tool tilts and is swept; about a rotational axis the sweep is in rad.

    Parameters
    ----------
    rest_s
        Rest between phases [s], 1 s or more for a robot that settles slowly.
    pose_count, tilts_rad, pose_move_s, pose_hold_s
        Orientations, smallest and largest tilt [rad], duration of a move and of the rest after it [s].
    sweep_s, sweep_hz, sweep_speed_m_s, robot_bandwidth_hz
        Duration [s], first and last frequency [Hz], speed of the flange [m/s]; above the robot's bandwidth [Hz] the
        command is made larger in the same measure. 0 s leaves the sweep out.

    Raises
    ------
    ParameterError
        A number is out of range.

    """

    rest_s: float = 1.0
    pose_count: int = 8
    tilts_rad: tuple[float, float] = (0.5, 1.1)
    pose_move_s: float = 1.0
    pose_hold_s: float = 1.0
    sweep_s: float = 12.0
    sweep_hz: tuple[float, float] = (0.5, 50.0)
    sweep_speed_m_s: float = 0.01
    robot_bandwidth_hz: float = 3.0

    def __post_init__(self) -> None:
        for name in ("pose_count", "sweep_s"):
            if not getattr(self, name) >= 0:
                raise ParameterError(name, getattr(self, name), "not below 0")
        for name in ("rest_s", "pose_move_s", "pose_hold_s", "sweep_speed_m_s", "robot_bandwidth_hz"):
            check_above_zero(name, getattr(self, name))
        if not 0.0 < self.sweep_hz[0] < self.sweep_hz[1]:
            raise ParameterError("sweep_hz", self.sweep_hz, "an increasing pair above 0")
        if not 0.0 < self.tilts_rad[0] <= self.tilts_rad[1] < math.pi / 2.0:
            raise ParameterError("tilts_rad", self.tilts_rad, "an increasing pair between 0 and π/2")

    def rotations(self, period_s: float) -> Iterator[Three]:
        """Yield the rotation vector [rad] of each period: to well spread orientations, a rest at each, and back.

        Back is through the first orientation, so that every move turns about one fixed axis.
        """
        moving, holding = max(1, round(self.pose_move_s / period_s)), round(self.pose_hold_s / period_s)
        ramp = [smooth_ramp((k + 1) / moving) for k in range(moving)]
        low, high = self.tilts_rad
        for i in range(self.pose_count):
            # Golden angle and golden ratio spread any number of directions and tilts.
            tilt, direction = low + (high - low) * (_GOLDEN_SHARE * i % 1.0), _GOLDEN_ANGLE_RAD * i
            x, y = tilt * math.cos(direction), tilt * math.sin(direction)
            for share in (*ramp, *[1.0] * holding, *[1.0 - each for each in ramp]):
                yield x * share, y * share, 0.0

    def sweep(self, period_s: float) -> Iterator[float]:
        """Yield the displacement [m] of each period: a logarithmic sweep at one speed, from rest to rest."""
        samples = round(self.sweep_s / period_s)
        low, high = self.sweep_hz
        edge = max(2, round(_EDGE_SHARE * samples))
        for k in range(samples):
            rate = math.log(high / low) / self.sweep_s
            frequency = low * math.exp(rate * k * period_s)
            phase = 2.0 * math.pi * low * math.expm1(rate * k * period_s) / rate
            # A command of one speed would leave nothing above the robot's bandwidth.
            speed = self.sweep_speed_m_s * math.hypot(1.0, frequency / self.robot_bandwidth_hz)
            window = smooth_ramp(min(1.0, k / edge, (samples - 1 - k) / edge))
            yield window * speed / (2.0 * math.pi * frequency) * math.sin(phase)


def smooth_ramp(t: float) -> float:
    """Return a minimum-jerk ramp from 0 to 1 over 0 ≤ t ≤ 1."""
    return t**3 * (10.0 - 15.0 * t + 6.0 * t * t)


def check_above_zero(name: str, value: float) -> None:
    """Raise ParameterError for what is no finite number above 0."""
    if not (math.isfinite(value) and value > 0.0):
        raise ParameterError(name, value, "a finite number above 0")
