"""One axis of the admittance controller of ros2_controllers: its free numbers and the law that they make.

Its rule is `problems.model.third_party_controllers.SpringAdmittance`.
"""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

from autotune.formats.controller_record import AxisGains
from autotune.formats.units import AXES, ROTATIONAL_AXES, axis_units
from autotune.validation.law import AxisTask
from problems.model.linear_controllers import LinearController
from problems.model.third_party_controllers import SpringAdmittance
from problems.text import significant

from .retune import Values, Variable, lost_gains

JOINT_DAMPING_PER_S = 5.0
"""What takes 5 times the joints' speed off their acceleration: the controller's default, written as it is."""
RETURN_TIME_S = 36e3
"""The time constant of the return spring where none is given: a minute takes back 0.17 % of the way."""

# The dampings that a search may choose, as ratios of the file's own, and the longest M/D, of the file's own or of h.
_DAMPING_RATIO, _LONGEST = (0.1, 30.0), 50.0
# The least M/(h·D) of a search: numbers with six digits then still have M ≥ h·D.
_LEAST = 1.0 + 2e-5
# The least share of the damping that is the axis' own, beside that of the joints: D ≥ 0.1 (D + J M).
_OWN_SHARE = 0.1
_LONGEST_S = (1.0 - _OWN_SHARE) / JOINT_DAMPING_PER_S


@dataclass(frozen=True, kw_only=True)
class Ros2Axis:
    """One axis: mass and damping are free, the latter written as a ratio at a small stiffness.

    The damping B = D + J M is that of the axis and the joints together. A search goes by M/B and B, since M ≥ h·B (see
    `SpringAdmittance.own_pole`) and D ≥ 0.1 B are then bounds of its box. With `fixed_mass` B alone is free (the masses
    of versions that read them in the base frame must be equal).
    """

    task: AxisTask
    gains: AxisGains
    return_stiffness: float | None = None
    filter_coefficient: float = 1.0
    fixed_mass: float | None = None

    @property
    def variables(self) -> tuple[Variable, ...]:
        """M/B (s) and B (N·s/m), or B alone."""
        h, damping = self.task.sample_time_s, self.gains.damping
        low, high = damping * _DAMPING_RATIO[0], damping * _DAMPING_RATIO[1]
        if self.fixed_mass is not None:
            least, most = self.fixed_mass / _LONGEST_S, self.fixed_mass / (_LEAST * h)
            low = max(least, min(low, _DAMPING_RATIO[0] * most))
            return (Variable(name="damping", low=low, high=max(low, min(high, most))),)
        longest = min(_LONGEST * max(self.gains.mass / damping, h), _LONGEST_S)
        return (
            Variable(name="mass over damping", low=_LEAST * h, high=longest, unit="s"),
            Variable(name="damping", low=low, high=high),
        )

    @property
    def translated(self) -> Values:
        """M_a/B_a and B_a, or B_a alone; more than B_a where the joints alone would take most of it."""
        mass = self.gains.mass if self.fixed_mass is None else self.fixed_mass
        damping = max(self.gains.damping, mass / _LONGEST_S)
        return (damping,) if self.fixed_mass is not None else (mass / damping, damping)

    def written(self, values: Values) -> Mapping[str, float]:
        """Return mass, damping ratio and stiffness with six digits, as the file holds them."""
        damping, given = values[-1], self.return_stiffness
        mass = float(f"{self.fixed_mass or values[0] * damping:.6g}")
        stiffness = float(f"{damping / RETURN_TIME_S:.6g}") if given is None else given
        own = damping - JOINT_DAMPING_PER_S * mass
        ratio = float(f"{own / (2.0 * math.sqrt(mass * stiffness)):.6g}")
        return {"mass": mass, "damping_ratio": ratio, "stiffness": stiffness}

    def rule(self, values: Values) -> SpringAdmittance:
        """Return the rule that runs with the numbers as they are written."""
        return SpringAdmittance(
            **self.written(values),
            joint_damping_per_s=JOINT_DAMPING_PER_S,
            filter_coefficient=self.filter_coefficient,
        )

    def law(self, values: Values) -> LinearController:
        """Return its difference equation."""
        return self.rule(values).law(self.task.sample_time_s)

    def dropped(self) -> tuple[str, ...]:
        """Say what of the gains is left out."""
        return lost_gains(self.task, self.gains)

    def notes(self, values: Values) -> Iterator[str]:
        """Say what the return spring does, and where the law's own pole is."""
        rule, turns = self.rule(values), self.task.axis in ROTATIONAL_AXES
        h, units = self.task.sample_time_s, axis_units(self.task.axis)
        travel, force = ("0.1 rad", "N·m") if turns else ("100 mm", "N")
        returns_s = rule.total_damping / rule.stiffness
        yield (
            f"axis {self.task.axis}: the spring that the damping needs pulls back to the reference with "
            f"{0.1 * rule.stiffness:.3g} {force} per {travel}, with a time constant of {significant(returns_s, 3)} s: "
            f"what was pushed away comes back by {100.0 * -math.expm1(-60.0 / returns_s):.2g} % in a minute."
        )
        yield (
            f"axis {self.task.axis}: of the damping {rule.total_damping:.6g} {units.damping}, joint_damping makes "
            f"{JOINT_DAMPING_PER_S:g} 1/s times the mass, {JOINT_DAMPING_PER_S * rule.mass:.4g}; the law's own pole is "
            f"z = 1 − h·(D/M + J) = {rule.own_pole(h):.3g} at this update rate; M ≥ h·(D + J·M) keeps it from being "
            "negative, where the speed would change sign in every cycle."
        )


def with_common_masses(axes: Mapping[str, Ros2Axis]) -> dict[str, Ros2Axis]:
    """Give x, y, z one mass, and rx, ry, rz too, for versions that read masses in the base frame.

    It is the largest of theirs, and no less than h·B_a of any. Equal masses are held as well: a search for one axis
    alone would part them.
    """
    found = dict(axes)
    for group in (AXES[:3], AXES[3:]):
        members = {axis: axes[axis] for axis in group if axis in axes}
        if len(members) > 1:
            mass = max(_least_mass(each) for each in members.values())
            found |= {axis: replace(each, fixed_mass=mass) for axis, each in members.items()}
    return found


def _least_mass(axis: Ros2Axis) -> float:
    """Return M_a, or what B_a needs if that is more."""
    needed = axis.task.sample_time_s * axis.gains.damping
    return axis.gains.mass if axis.gains.mass >= needed else _LEAST * needed
