"""What lies above half the sampling frequency of a contact under a sampled loop: bounds for all of it at once."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from problems.arrays import FloatArray
from problems.contact.multiplier import Multiplier
from problems.design.uncertainty import MASS
from problems.model.robot import bandwidth_hz

from .family import LAG, Family

_OUT = 1.0 + 1e-9
# ζ(2) and ζ(4) bound the sums over the frequencies that the sampler mixes: they are at least mπ/h for m = 1, 2, …
_SUM_OF_SQUARES, _SUM_OF_FOURTH = math.pi**2 / 6.0, math.pi**4 / 90.0


def _robot_bound(family: Family, omega: float) -> float:
    """Return a bound of |r| from a frequency [rad/s] on, at which it is the largest; infinite where there is none."""
    numerator, denominator = family.nominal.robot.ascending()
    faster = family.range_of("robot_bandwidth_hz")[1] / bandwidth_hz(family.nominal.robot)
    powers = (omega / faster / _OUT) ** np.arange(len(denominator))
    least = powers[-1] - float(np.sum(np.abs(denominator[:-1]) * powers[:-1])) * _OUT
    return float(np.sum(np.abs(numerator) * powers[: len(numerator)])) / least if least > 0.0 else math.inf


@dataclass(frozen=True, kw_only=True)
class OtherFrequencies:
    """What lies above π/h, in units of the least real part there: bounds of A times M (or κ s)/h, and of W.

    `damper` is κ, `compliance` 1/B_e; both are 0 for a surface without damping.
    """

    drives: float
    senses: float
    damper: float = 0.0
    compliance: float = 0.0

    @classmethod
    def of(cls, family: Family, multiplier: Multiplier, stiffness: float, damping: float) -> "OtherFrequencies":
        """Return them over all plants of a family in free space; infinite where there are none.

        |P|, |r| and |K_s + B_s s| over ω are bounded at ω = π/h, and fall from there on.
        """
        nothing = cls(drives=math.inf, senses=math.inf)
        omega, ranges = math.pi / family.sample_time_s, family.range_of
        k_s, b_s = ranges("coupling_stiffness_n_per_m")[1], ranges("coupling_damping_n_s_per_m")[1]
        payload = ranges(MASS)[0] * omega**2 / _OUT - k_s
        robot = _robot_bound(family, omega)
        if not (payload > 0.0 and math.isfinite(robot)):
            return nothing
        gain = (k_s + b_s * omega) / payload
        real = multiplier.least_real(omega) / stiffness / _OUT - multiplier.weight / payload * _OUT
        moved = gain * robot / family.sample_time_s
        size = multiplier.rate_s + multiplier.weight / omega
        if not real > 0.0:
            return nothing
        if damping == 0.0:
            return cls(
                drives=size * moved * math.sqrt(_SUM_OF_FOURTH / real) * _OUT,
                senses=gain * math.sqrt(_SUM_OF_SQUARES / real) * _OUT,
            )
        damper = multiplier.damper_s
        # What spring and damper have in common at one frequency takes a share of both.
        lossy = damper / damping
        left = 1.0 - 0.5 * (size + damper) * omega / payload / math.sqrt(real * lossy) * _OUT if lossy > 0.0 else 0.0
        if not left > 0.0:
            return nothing
        real, lossy = real * left / _OUT, lossy * left / _OUT
        return cls(
            drives=moved * math.sqrt(_SUM_OF_FOURTH * (size**2 / real + damper**2 / lossy)) * _OUT,
            senses=gain * math.sqrt(_SUM_OF_SQUARES * (1.0 / real + 1.0 / lossy)) * _OUT,
            damper=damper,
            compliance=1.0 / damping,
        )

    @classmethod
    def of_velocity(cls, family: Family) -> "OtherFrequencies":
        """Return them for M = s and no spring, over plants of a family in free space; infinite where there are none.

        Re jωP = ω² B/|K_s + jωB − M_p ω²|² with B = B_p + B_s is at least β/ω². A force that is no more than the
        derivative of a function of finite energy, as impulses are, is only felt where sampling it is bounded: without
        damping in the coupling, or through a filter.
        """
        nothing = cls(drives=math.inf, senses=math.inf)
        omega, ranges = math.pi / family.sample_time_s, family.range_of
        k_s, b_s = ranges("coupling_stiffness_n_per_m")[1], ranges("coupling_damping_n_s_per_m")
        lag = min(ranges(LAG)[0], family.nominal.wrench_filter.time_constant_s)
        (light, heavy), drag = ranges(MASS), ranges("drag_n_s_per_m")
        payload = light * omega**2 / _OUT - k_s
        robot = _robot_bound(family, omega)
        lossy = (drag[0] + b_s[0]) / (heavy**2 + ((drag[1] + b_s[1]) / omega) ** 2) / _OUT
        if not (payload > 0.0 and lossy > 0.0 and math.isfinite(robot) and (b_s[1] == 0.0 or lag > 0.0)):
            return nothing
        gain = (k_s + b_s[1] * omega) / payload
        moved = gain * robot / family.sample_time_s
        # Without damping the coupling's force falls with the square of the frequency, else with it alone.
        falls = _SUM_OF_FOURTH if b_s[1] == 0.0 else _SUM_OF_SQUARES
        felt = omega if b_s[1] == 0.0 else 1.0 / lag
        return cls(
            drives=moved * omega * math.sqrt(falls / lossy) * _OUT,
            senses=gain * felt * math.sqrt(_SUM_OF_SQUARES / lossy) * _OUT,
        )

    # What is not bounded overflows, and compares as false.
    @np.errstate(over="ignore", invalid="ignore")
    def leave(
        self,
        spring: FloatArray,
        velocity: FloatArray,
        driven: FloatArray,
        sensed: FloatArray,
        closed: FloatArray,
        moved: FloatArray,
        across: FloatArray,
    ) -> NDArray[np.bool_]:
        """Return where the part below π/h is positive whatever the others add: a Schur complement, bounded.

        `spring` and `velocity` are least real parts, the others bounds of what the contact answers with.
        """
        if not math.isfinite(self.drives):
            return np.zeros(len(spring), dtype=bool)
        drives = closed * self.drives
        room = 1.0 - drives * self.senses
        lost = (driven * self.senses + sensed * drives) ** 2 * _OUT
        if self.damper == 0.0:
            return np.asarray((room > 0.0) & (spring * room > 0.25 * lost))
        lost_there = (self.damper * moved * self.senses + sensed * drives) ** 2 * _OUT
        rest = spring * room - 0.5 * lost
        rest_there = self.damper * (velocity + self.compliance / _OUT) * room - 0.5 * lost_there
        common = (across * room) ** 2 * _OUT
        return np.asarray((room > 0.0) & (rest > 0.0) & (rest_there > 0.0) & (rest * rest_there > common))
