"""One axis of a law M dv/dt = f − D v − K x in the discretisation of another program: its free numbers and its law.

A program is described by a `MdkForm`; its rule is `problems.model.mass_damper_controllers.MassDamper`.
"""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property

from autotune.formats.controller_record import AxisGains
from autotune.formats.units import ROTATIONAL_AXES, axis_units
from autotune.validation.law import AxisTask
from problems.contact.linear_controller_contact import force_per_speed
from problems.contact.transient import build_sampled_contact
from problems.errors import ParameterError
from problems.model.linear_controllers import LinearController
from problems.model.mass_damper_controllers import Discretization, MassDamper
from problems.model.sampled import build_sampled_plant
from problems.text import significant

from .retune import Values, Variable, lost_gains

# The dampings that a search may choose, as ratios of the file's own; the longest M/D (s); the most of the damping that
# D may be where the measured motion is what the command starts from.
_DAMPING_RATIO, _LONGEST_S, _MOST_OWN = (0.1, 30.0), 2.0, 0.9
# The least M/(h·D) of a search: numbers with six digits then still have M ≥ h·D.
_LEAST = 1.0 + 2e-5
# The time constant of a spring without which there is no damping, where the ratio's own limit leaves the choice.
_RETURN_TIME_S = 36e3


@dataclass(frozen=True, kw_only=True)
class MdkForm:
    """How a program steps its law, and which numbers it takes.

    `mass` and `damping` are the ranges that it declares; with `most_damping_ratio` the damping is written as
    ζ = D/(2√(M K)) of at most that, so that a stiffness K, of at most `most_stiffness`, is needed for any. With
    `keeps_deadband` the program has one too.
    """

    discretization: Discretization
    filter_time_s: float = 0.0
    mass: tuple[float, float] = (0.0, math.inf)
    damping: tuple[float, float] = (0.0, math.inf)
    most_damping_ratio: float | None = None
    most_stiffness: float = 0.0
    keeps_deadband: bool = False


@dataclass(frozen=True, kw_only=True)
class MdkAxis:
    """One axis: a search goes by M/D and D, or, where the command starts from the measured position, by B and D/B.

    There B = f/v in free space less the payload's drag, most of which is the robot's own lag.
    """

    task: AxisTask
    gains: AxisGains
    form: MdkForm

    @property
    def _is_from_measured(self) -> bool:
        return self.form.discretization is Discretization.FROM_MEASURED

    @property
    def variables(self) -> tuple[Variable, ...]:
        """M/D (s) and D (N·s/m), or B (N·s/m) and D/B."""
        damping, h = self.gains.damping, self.task.sample_time_s
        low, high = damping * _DAMPING_RATIO[0], damping * _DAMPING_RATIO[1]
        if self._is_from_measured:
            return (
                Variable(name="damping in free space", low=low, high=high),
                Variable(name="D over the damping in free space", low=0.0, high=_MOST_OWN, ratio=False),
            )
        least, most = self.form.damping
        high = max(least, min(high, most))
        return (
            Variable(name="mass over damping", low=_LEAST * h, high=_LONGEST_S, unit="s"),
            Variable(name="damping", low=max(min(low, high), least), high=high),
        )

    @property
    def translated(self) -> Values:
        """The numbers that come nearest to M_a and B_a."""
        if self._is_from_measured:
            return self.gains.damping, 0.0
        return max(self.gains.mass / self.gains.damping, _LEAST * self.task.sample_time_s), self.gains.damping

    @cached_property
    def _drag_per_mass(self) -> float:
        """What each kilogram adds to f/v where the command starts from the measured position [N·s/m/kg]."""
        pair = build_sampled_contact(build_sampled_plant(self.task.domain.plants.nominal, self.task.sample_time_s))
        rule = MassDamper(discretization=self.form.discretization, mass=1.0, damping=0.0)
        return force_per_speed(pair, rule.law(self.task.sample_time_s)) - self.task.domain.drag_n_s_per_m

    def rule(self, values: Values) -> MassDamper:
        """Return the rule with six digits; raises ParameterError for numbers that the program does not take."""
        if self._is_from_measured:
            total, share = values
            damping = share * total
            mass = (total - damping) / self._drag_per_mass
        else:
            mass, damping = values[0] * values[1], values[1]
        mass, damping, stiffness = _rounded(mass), _rounded(damping), 0.0
        for name, value, (low, high) in (("mass", mass, self.form.mass), ("damping", damping, self.form.damping)):
            if not low <= value <= high:
                raise ParameterError(name, value, f"from {low:g} to {high:g}")
        if self.form.most_damping_ratio is not None:
            least = (damping / (2.0 * self.form.most_damping_ratio)) ** 2 / mass
            # A hair more, so that the ratio stays within its limit once both are rounded.
            stiffness = _rounded(max(least * _LEAST, damping / _RETURN_TIME_S))
            if stiffness > self.form.most_stiffness:
                raise ParameterError("stiffness", stiffness, f"at most {self.form.most_stiffness:g}")
            damping = 2.0 * self._ratio(mass, damping, stiffness) * math.sqrt(mass * stiffness)
        return MassDamper(
            discretization=self.form.discretization,
            mass=mass,
            damping=damping,
            stiffness=stiffness,
            filter_time_s=self.form.filter_time_s,
        )

    @staticmethod
    def _ratio(mass: float, damping: float, stiffness: float) -> float:
        return _rounded(damping / (2.0 * math.sqrt(mass * stiffness)))

    def written(self, values: Values) -> Mapping[str, float]:
        """Return the numbers of the axis as the file holds them."""
        rule = self.rule(values)
        if self.form.most_damping_ratio is None:
            return {"mass": rule.mass, "damping": rule.damping, "stiffness": rule.stiffness}
        ratio = self._ratio(rule.mass, rule.damping, rule.stiffness)
        return {"mass": rule.mass, "damping_ratio": ratio, "stiffness": rule.stiffness}

    def law(self, values: Values) -> LinearController:
        """Return the law that runs with the numbers as they are written."""
        return self.rule(values).law(self.task.sample_time_s)

    def dropped(self) -> tuple[str, ...]:
        """Say what of the gains is left out."""
        return lost_gains(self.task, self.gains, expressed=("deadband",) if self.form.keeps_deadband else ())

    def notes(self, values: Values) -> Iterator[str]:
        """Say what the numbers mean for who runs them."""
        rule, units = self.rule(values), axis_units(self.task.axis)
        if self._is_from_measured:
            total, _ = values
            yield (
                f"axis {self.task.axis}: a steady push meets {total:.4g} {units.damping} beside the payload's drag. "
                "The command starts from the measured position in every cycle, so the robot's own lag is in that: "
                "the mass that is written is no mass that a hand feels, and with another robot it is another damping."
            )
        if rule.stiffness > 0.0:
            returns_s = rule.damping / rule.stiffness
            force, travel = ("N·m", "0.1 rad") if self.task.axis in ROTATIONAL_AXES else ("N", "100 mm")
            yield (
                f"axis {self.task.axis}: the spring that the damping needs pulls back with {0.1 * rule.stiffness:.3g} "
                f"{force} per {travel}, with a time constant of {significant(returns_s, 3)} s."
            )


def _rounded(value: float) -> float:
    return float(f"{value:.6g}")
