"""One axis of FZI's force controller: its gain and derivative, and the law that they make.

Its rule is `problems.model.third_party_controllers.ForwardDynamics`; its gains act along the axes of the base.
"""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property

from autotune.formats.controller_record import AxisGains
from autotune.formats.units import axis_units
from autotune.validation.law import AxisTask
from problems.contact.linear_controller_contact import force_per_speed
from problems.contact.transient import SampledContact, build_sampled_contact
from problems.design.problem import DEFAULT_BOUNDS
from problems.model.linear_controllers import LinearController
from problems.model.sampled import build_sampled_plant
from problems.model.third_party_controllers import VELOCITY_KEPT, ForwardDynamics

from .retune import Values, Variable, lost_gains

# Gains that a search may choose, as ratios of the translated one; the lead stays where our own K_l does, for noise.
_GAIN_RATIO, _LONGEST_LEAD_S = (0.03, 10.0), DEFAULT_BOUNDS["lead_s"][1]


@dataclass(frozen=True)
class FziAxis:
    """One axis: the gain p and the derivative's share of it (s), which leads as K_l does."""

    task: AxisTask
    gains: AxisGains

    @cached_property
    def pair(self) -> SampledContact:
        """The nominal plant; how fast this controller moves depends on the robot's lag."""
        return build_sampled_contact(build_sampled_plant(self.task.domain.plants.nominal, self.task.sample_time_s))

    @cached_property
    def translated(self) -> Values:
        """The gain that moves as fast per newton as B_a does, and K_l."""
        twice, once = (self._force_per_speed(ForwardDynamics(proportional=p, derivative=0.0)) for p in (1.0, 2.0))
        # What a speed takes is the drag, and what the gain is divided into.
        inverse = 2.0 * (twice - once)
        return inverse / (self.gains.damping + self.task.domain.drag_n_s_per_m - (twice - inverse)), self.gains.lead_s

    def _force_per_speed(self, rule: ForwardDynamics) -> float:
        return force_per_speed(self.pair, rule.law(self.task.sample_time_s))

    @property
    def variables(self) -> tuple[Variable, ...]:
        """p, and d/p (s)."""
        gain = self.translated[0]
        return (
            Variable(name="p", low=gain * _GAIN_RATIO[0], high=gain * _GAIN_RATIO[1]),
            Variable(name="lead", low=0.0, high=_LONGEST_LEAD_S, ratio=False, unit="s"),
        )

    def written(self, values: Values) -> Mapping[str, float]:
        """Return p and d with six digits, as the file holds them."""
        gain = float(f"{values[0]:.6g}")
        return {"p": gain, "d": float(f"{gain * values[1]:.6g}")}

    def law(self, values: Values) -> LinearController:
        """Return the law that runs with the numbers as they are written."""
        gains = self.written(values)
        return ForwardDynamics(proportional=gains["p"], derivative=gains["d"]).law(self.task.sample_time_s)

    def dropped(self) -> tuple[str, ...]:
        """Say what of the gains is left out."""
        units = axis_units(self.task.axis)
        mass = f"axis {self.task.axis}: mass M_a = {self.gains.mass:g} {units.mass} (it is not free)"
        return (mass, *lost_gains(self.task, self.gains, expressed=("lead_s",)))

    def notes(self, values: Values) -> Iterator[str]:
        """Say what mass and damping the gains come to on this robot at this rate."""
        units, h = axis_units(self.task.axis), self.task.sample_time_s
        damping = force_per_speed(self.pair, self.law(values)) - self.task.domain.drag_n_s_per_m
        lag = -h / math.log(VELOCITY_KEPT)
        yield (
            f"axis {self.task.axis}: rendered damping {damping:.4g} {units.damping} and mass {lag * damping:.3g} "
            f"{units.mass}; the speed dies out within {lag * 1e3:.3g} ms at this update rate, whatever the gains."
        )
