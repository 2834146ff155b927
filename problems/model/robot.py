"""The position-controlled robot r(s) e^(-s T_d) (docs/method.md, "The loop"), its bandwidth and its variations."""

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from .._checks import frozen_vector, non_negative, positive
from ..arrays import FloatArray
from ..errors import ParameterError

# Two roots closer than this share of their size are one factor: printed coefficients carry about four digits.
_SAME_ROOT = 1e-6
_UNIT_GAIN = 1e-6
_LOWEST_HZ, _HIGHEST_HZ = 1e-2, 1e4
_HALVINGS = 80


@dataclass(frozen=True, kw_only=True, eq=False)
class RobotModel:
    """Closed position loop X/X^d = r(s) e^(-s T_d) with r(0) = 1.

    `numerator` and `denominator` hold descending powers of s [rad/s]; `delay_s` is T_d without the hold.
    Common factors are removed on construction (docs/method.md, erratum 1): the paper's printed example
    (100 s + 400)/(5 s² + 120 s + 400) becomes 20/(s + 20).

    Raises ParameterError for an unstable, not strictly proper or wrongly normalised r(s).
    """

    numerator: FloatArray
    denominator: FloatArray
    delay_s: float

    def __post_init__(self) -> None:
        printed = frozen_vector("denominator", self.denominator)
        numerator, denominator = cancel_common_factors(frozen_vector("numerator", self.numerator), printed)
        if len(numerator) >= len(denominator):
            raise ParameterError("robot r(s)", _text(numerator, denominator), "strictly proper")
        # A cancelled pole on the right stays inside the robot, unseen and unstable.
        if np.any(np.roots(printed).real >= 0.0):
            raise ParameterError("robot r(s)", _text(numerator, denominator), "stable (every pole left of the axis)")
        if abs(numerator[-1] / denominator[-1] - 1.0) > _UNIT_GAIN:
            raise ParameterError("r(0)", float(numerator[-1] / denominator[-1]), "1 (a position loop without offset)")
        object.__setattr__(self, "numerator", frozen_vector("numerator", numerator))
        object.__setattr__(self, "denominator", frozen_vector("denominator", denominator))
        object.__setattr__(self, "delay_s", non_negative("delay_s", self.delay_s))

    def __eq__(self, other: object) -> bool:
        return isinstance(other, RobotModel) and self._key() == other._key()

    def __hash__(self) -> int:
        return hash(self._key())

    def _key(self) -> tuple[bytes, bytes, float]:
        return self.numerator.tobytes(), self.denominator.tobytes(), self.delay_s

    @classmethod
    def from_bandwidth(cls, *, bandwidth_rad_per_s: float, delay_s: float) -> "RobotModel":
        """Build the one-pole robot ω_b/(s + ω_b) of `bandwidth_rad_per_s`."""
        return cls(
            numerator=np.array([bandwidth_rad_per_s]), denominator=np.array([1.0, bandwidth_rad_per_s]), delay_s=delay_s
        )

    @property
    def order(self) -> int:
        """Number of states of r(s)."""
        return len(self.denominator) - 1

    def ascending(self) -> tuple[FloatArray, FloatArray]:
        """Return numerator (n,) and monic denominator (n + 1,) in ascending powers of s."""
        lead = self.denominator[0]
        numerator = np.zeros(self.order)
        numerator[: len(self.numerator)] = self.numerator[::-1] / lead
        return numerator, np.ascontiguousarray(self.denominator[::-1] / lead)

    def position_response(self, frequency_rad_per_s: FloatArray) -> NDArray[np.complex128]:
        """Return r(jω) e^(-jω T_d)."""
        s = 1j * np.asarray(frequency_rad_per_s)
        rational = np.polyval(self.numerator, s) / np.polyval(self.denominator, s)
        return np.asarray(rational * np.exp(-s * self.delay_s), dtype=np.complex128)


def cancel_common_factors(numerator: FloatArray, denominator: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Remove roots that numerator and denominator share; the denominator comes back monic."""
    numerator, denominator = np.trim_zeros(numerator, "f"), np.trim_zeros(denominator, "f")
    if numerator.size == 0 or denominator.size == 0:
        raise ParameterError("robot r(s)", _text(numerator, denominator), "a ratio of two non-zero polynomials")
    if numerator.size == 1:
        return numerator / denominator[0], denominator / denominator[0]
    zeros, poles = list(np.roots(numerator)), list(np.roots(denominator))
    gain = numerator[0] / denominator[0]
    kept = []
    for zero in zeros:
        gaps = [abs(zero - pole) for pole in poles]
        nearest = int(np.argmin(gaps)) if gaps else -1
        if gaps and gaps[nearest] <= _SAME_ROOT * max(abs(zero), 1.0):
            poles.pop(nearest)
        else:
            kept.append(zero)
    if len(kept) == len(zeros):
        return numerator / denominator[0], denominator / denominator[0]
    return np.atleast_1d(gain * np.real(np.poly(kept))), np.atleast_1d(np.real(np.poly(poles)))


def _text(numerator: FloatArray, denominator: FloatArray) -> str:
    return f"{np.array2string(numerator, precision=6)} / {np.array2string(denominator, precision=6)}"


@lru_cache(maxsize=256)
def bandwidth_hz(robot: RobotModel) -> float:
    """Return the frequency [Hz] at which |r| falls to 1/√2."""
    low, high = _LOWEST_HZ, _HIGHEST_HZ
    for _ in range(_HALVINGS):
        middle = math.sqrt(low * high)
        s = 2.0j * math.pi * middle
        inside = abs(_at(robot.numerator, s) / _at(robot.denominator, s)) > math.sqrt(0.5)
        low, high = (middle, high) if inside else (low, middle)
    return low


def _at(coefficients: FloatArray, s: complex) -> complex:
    """Return a polynomial at one point; numpy's own way takes longer for an array of one."""
    value = 0.0j
    for coefficient in coefficients.tolist():
        value = value * s + coefficient
    return value


def has_damping_ratio(robot: RobotModel) -> bool:
    """Whether r(s) is ω²/(s² + 2ζω s + ω²), so that one number gives its damping."""
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


@lru_cache(maxsize=1024)
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
