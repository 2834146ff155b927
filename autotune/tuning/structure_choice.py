"""What the structures of a law save beside four gains in their bounds, in words."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

from autotune.formats.problem import Structure
from autotune.formats.units import axis_units
from problems.design.problem import DesignProblem
from problems.design.requirements import HeldByHand

from .noise_limit import UNKNOWN, NoiseOf, jitter_source

PRICE = 0.01
"""The share of the objective that a structure must save beside the simpler one, or the simpler one is kept."""
_HELD = "held_by_hand"
# From this share of the speed of approach on the robot's jitter is a doubtful limit.
_MUCH = 0.5


@dataclass(frozen=True, kw_only=True)
class StructureChoice:
    """The objective's cost of each structure that was searched, None where no design was found, and the one taken.

    All make the commanded speed's noise at most `noise_m_s_per_n` per newton of the force's: what `is_asked` in
    problem.yaml, else that of four gains in their bounds, or the robot's own jitter at rest where the log shows it and
    it is larger (`measured`, by which `jitter_m_s_per_n` is that; None where it is not known). It `counts_pose` where
    the pose's noise is part of that. `bounds` are those of the four gains, `approach_m_s` their speed of approach,
    `total_m_s_per_n` their noise with the pose's. Where four gains have no design all of it is said of those that come
    nearest to what is asked.
    """

    costs: Mapping[Structure, float | None]
    taken: Structure
    noise_m_s_per_n: float
    is_asked: bool = False
    counts_pose: bool = False
    gains_m_s_per_n: float = math.nan
    total_m_s_per_n: float = math.nan
    jitter_m_s_per_n: float | None = None
    approach_m_s: float = math.inf
    measured: NoiseOf = UNKNOWN
    bounds: Mapping[str, tuple[float, float]] = field(default_factory=dict)

    def message(self, name: str, problem: DesignProblem) -> str:
        """Return a sentence on what the structures do for an axis."""
        units, objective = axis_units(name), problem.objective
        unit = objective.unit_on(turning=units.force != "N")

        def shown(structure: Structure) -> str:
            cost = self.costs[structure]
            if cost is None:
                return "no design"
            first = next(each for each, known in self.costs.items() if known is not None)
            return f"{f'{objective.title} ' if structure == first else ''}{objective.value(cost):.4g} {unit}".rstrip()

        also = ", the pose's counted too" if self.counts_pose else ""
        noise = f"{1e3 * self.noise_m_s_per_n:.3g} m{units.speed} per {units.force}{also}"
        said = f"Axis {name}: {shown('gains')} with four gains in their bounds"
        if "noise" in self.costs:
            nearest = "" if self._has_gains else " of those that come nearest"
            whose = (
                "the noise of the command that is asked"
                if self.is_asked
                else f"{'their' if self._has_gains else 'the'} noise of the command{nearest}"
            )
            whose = (
                "at most as much noise of the command as the robot's jitter at rest" if self._is_of_jitter else whose
            )
            said += f", {shown('noise')} with {whose} ({noise}) in the place of these bounds"
        if "biquad" in self.costs:
            said += f", {shown('biquad')} with a biquad too"
        words = {
            "gains": "the four gains in their bounds",
            "noise": "the four gains at that noise",
            "biquad": "the biquad",
        }
        best = min(cost for cost in self.costs.values() if cost is not None)
        kept = f", since more saves less than {100.0 * PRICE:g} %"
        if best == self.costs[self.taken]:
            # Structures ask what keeps a hand and a start from rest as calm, which four gains alone are not asked.
            kept = ", since more saves nothing"
        if all(cost is None for name, cost in self.costs.items() if name != self.taken):
            kept = ", the only design"
        elif self.taken == list(self.costs)[-1]:
            kept = ""
        limited = self._limited(name, problem.sample_time_s) + self._beside_approach(name)
        held = problem.requirements.asked().get(_HELD)
        alike = f" (|1 + L| ≥ {held.min_modulus:g} while one holds the payload)" if isinstance(held, HeldByHand) else ""
        return (
            f"{said}. Taken: {words[self.taken]}{kept}; margins, admittance and a hand{alike} are asked for alike."
            f"{limited}"
        )

    @property
    def _has_gains(self) -> bool:
        return self.costs["gains"] is not None

    @property
    def _is_of_jitter(self) -> bool:
        return self.jitter_m_s_per_n is not None and self.jitter_m_s_per_n > self.gains_m_s_per_n

    def _limited(self, name: str, sample_time_s: float) -> str:
        """Return a sentence on which of the two limits is the larger, where both are known."""
        if self.jitter_m_s_per_n is None or "noise" not in self.costs:
            return ""
        rms, units = self.measured.force or 1.0, axis_units(name)
        of_gains, of_robot, both = (
            f"{1e3 * rms * each:.3g} m{units.speed}"
            for each in (self.gains_m_s_per_n, self.jitter_m_s_per_n, self.total_m_s_per_n)
        )
        gains = "the four gains in their bounds" if self._has_gains else "the four gains that come nearest"
        whose = f"that {gains} make of the sensor's noise ({both} with the pose's)"
        jitter = jitter_source(self.measured.position or 0.0, name, sample_time_s)
        if self._is_of_jitter:
            return (
                f" The noise of the command is limited to {of_robot} RMS, the robot's jitter at rest ({jitter}), which "
                f"is more than the {of_gains} {whose}."
            )
        return (
            f" The noise of the command is limited to the {of_gains} RMS {whose}, which is more than the {of_robot} of "
            f"the robot's jitter at rest ({jitter})."
        )

    def _beside_approach(self, name: str) -> str:
        """Return a sentence where the noise that is limited is much beside the speed of the approach, unless asked."""
        rms, units = self.measured.force, axis_units(name)
        share = (rms or 0.0) * self.noise_m_s_per_n / self.approach_m_s
        if rms is None or share < _MUCH or self.is_asked or "noise" not in self.costs:
            return ""
        speed = f"{1e3 * self.approach_m_s:.3g} m{units.speed}"
        if not self._is_of_jitter:
            return (
                f" That noise is {100.0 * share:.0f} % of the {speed} of the approach: a calmer sensor would help most."
            )
        key = "max_speed_rms_m_s" if units.force == "N" else "max_speed_rms_rad_s"
        less = f"requirements: {{command_noise: {{{key}: {rms * self.gains_m_s_per_n:.3g}}}}}"
        less = less if units.force == "N" else f"rotational: {{{less}}}"
        return (
            f" That noise is {100.0 * share:.0f} % of the {speed} of the approach, and the pose's may be no motion at "
            f"all; for as little as the four gains make of the sensor's say {less}."
        )
