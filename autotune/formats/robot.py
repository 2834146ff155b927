"""A robot that a person writes: bandwidth, or coefficients, and delay."""

import math
from dataclasses import dataclass

from autotune.shown import Said
from problems.errors import ParameterError
from problems.model.robot import RobotModel, bandwidth_hz, bandwidth_share

from .quantity import Interval, Quantity, as_interval, as_numbers, as_quantity, nominal_value

LONGEST_DELAY_S = 0.1
SLOWEST_HZ, FASTEST_HZ = 0.01, 1000.0


@dataclass(frozen=True, kw_only=True, repr=False)
class Robot(Said):
    """A position-controlled robot: how its flange follows a commanded position, r(s) exp(-s delay) with r(0) = 1.

    Parameters
    ----------
    bandwidth
        Frequency at which the gain falls to 1/sqrt(2), 0.01 to 1000 [Hz]: a robot of one pole, or with
        `damping_ratio` of two.
    delay
        Dead time from command to motion, without the hold of one period, below 0.1 [s]; taken as 0, with a note, unless
        it is given.
    damping_ratio
        Of a robot with two poles [1].
    numerator, denominator
        Instead of a bandwidth: coefficients of r(s) in descending powers of s [rad/s].

    Raises
    ------
    ParameterError
        Neither or both of bandwidth and coefficients are given, a number is out of range, or r(s) is unstable, not
        strictly proper, or not 1 at s = 0.

    """

    bandwidth: Quantity | None = None
    delay: Quantity | None = None
    damping_ratio: Quantity | None = None
    numerator: tuple[float, ...] | None = None
    denominator: tuple[float, ...] | None = None

    def __post_init__(self) -> None:
        if (self.numerator is None) != (self.denominator is None):
            raise ParameterError("numerator", self.numerator, "given together with the denominator")
        if (self.bandwidth is None) == (self.numerator is None):
            if self.bandwidth is None:
                raise ParameterError("bandwidth", None, "given, or numerator and denominator instead")
            raise ParameterError("bandwidth", self.bandwidth, "left out where numerator and denominator are given")
        if self.damping_ratio is not None and self.bandwidth is None:
            raise ParameterError("damping_ratio", self.damping_ratio, "left out where coefficients are given")
        for name in ("numerator", "denominator"):
            if getattr(self, name) is not None:
                object.__setattr__(self, name, as_numbers(name, getattr(self, name)))
        for name in ("bandwidth", "delay", "damping_ratio"):
            if getattr(self, name) is not None:
                checked = as_quantity(name, getattr(self, name), may_vanish=name == "delay")
                object.__setattr__(self, name, checked)
        if self.delay is not None and self.ranges()["delay"][1] >= LONGEST_DELAY_S:
            must = f"below {LONGEST_DELAY_S:g} s: no contact is controlled through a robot that is later"
            raise ParameterError("delay", self.delay, must)
        model, given = self.model(), self.ranges().get("bandwidth")
        low, high = given or (bandwidth_hz(model),) * 2
        if not SLOWEST_HZ <= low <= high <= FASTEST_HZ:
            name, found = ("denominator", self.denominator) if given is None else ("bandwidth", self.bandwidth)
            must = f"{'' if given else 'of a bandwidth '}from {SLOWEST_HZ:g} to {FASTEST_HZ:g} Hz; mind its unit"
            raise ParameterError(name, found, must)

    def ranges(self) -> dict[str, Interval]:
        """Return lowest and highest value of bandwidth [Hz] and damping ratio, as far as given, and of delay [s]."""
        delay = 0.0 if self.delay is None else self.delay
        given = {"bandwidth": self.bandwidth, "damping_ratio": self.damping_ratio, "delay": delay}
        return {
            name: as_interval(name, each, may_vanish=name == "delay")
            for name, each in given.items()
            if each is not None
        }

    def model(self) -> RobotModel:
        """Return the nominal robot."""
        nominal = {name: nominal_value(getattr(self, name), each) for name, each in self.ranges().items()}
        if self.numerator is not None and self.denominator is not None:
            numerator, denominator = list(self.numerator), list(self.denominator)
        elif self.damping_ratio is None:
            # |r| = 1/sqrt(2) of one pole is at the pole itself.
            omega = 2.0 * math.pi * nominal["bandwidth"]
            numerator, denominator = [omega], [1.0, omega]
        else:
            ratio = nominal["damping_ratio"]
            omega = 2.0 * math.pi * nominal["bandwidth"] / bandwidth_share(ratio)
            numerator, denominator = [omega**2], [1.0, 2.0 * ratio * omega, omega**2]
        return RobotModel(numerator=numerator, denominator=denominator, delay_s=nominal["delay"])  # type: ignore[arg-type]
