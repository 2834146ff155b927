"""One axis of FZI's force controller, and which axis of the robot's base each tuned axis lies along.

Its rule is `problems.model.third_party_controllers.ForwardDynamics`; its gains act along the axes of the base.
"""

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from autotune.errors import UsageError
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

Quaternion = tuple[float, float, float, float]

KINDS = (("x", "y", "z"), ("rx", "ry", "rz"))
# How far an orientation may be from a turn by right angles: at 1° an axis keeps cos² = 0.9997 of its gain.
_TOLERANCE_DEG = 1.0


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
            Variable(name="lead", low=0.0, high=_LONGEST_LEAD_S, ratio=False),
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


def check_kinds(tuned: Iterable[str], orientation: Quaternion | None) -> None:
    """Raise UsageError where one or two axes of three are tuned and `orientation` is no turn by right angles.

    Whether three are alike is known only once their gains are.
    """
    for kind in KINDS:
        found = [axis for axis in kind if axis in tuned]
        if 0 < len(found) < len(kind):
            if orientation is None:
                still = [axis for axis in kind if axis not in found]
                raise UsageError(_needed(f"{', '.join(found)} must move and {', '.join(still)} must not"))
            right_angles(orientation)


def base_axes(gains: Mapping[str, Mapping[str, float]], orientation: Quaternion | None) -> dict[str, str]:
    """Return by tuned axis the axis of the base whose gains are to be those; all stay where three are alike.

    A gain along an axis does not ask for its direction, so a base's axis may point either way. Raises UsageError for
    unequal gains of a kind without an orientation, or with one that is not a turn by right angles.
    """
    found = dict[str, str]()
    for kind in KINDS:
        places: tuple[str, ...] = kind
        if not _alike(gains, kind):
            if orientation is None:
                raise UsageError(_needed(_unequal(gains, kind)))
            places = tuple(kind[each] for each in right_angles(orientation))
        found |= {axis: place for axis, place in zip(kind, places, strict=True) if axis in gains}
    return found


def right_angles(orientation: Quaternion) -> tuple[int, int, int]:
    """Return which axis of the base each axis of the sensor lies along; raises UsageError if one does not."""
    turn = np.abs(rotation(orientation))
    places = np.argmax(turn, axis=0)
    off = np.degrees(np.arccos(np.minimum(np.max(turn, axis=0), 1.0)))
    if np.max(off) > _TOLERANCE_DEG:
        worst = int(np.argmax(off))
        raise UsageError(
            f"--orientation must be a turn by right angles: the sensor's {'xyz'[worst]} is {off[worst]:.3g}° off the "
            f"nearest axis of the base, more than {_TOLERANCE_DEG:g}°, and gains along the base's axes cannot be "
            "unequal along the sensor's there; hold the tool otherwise, or tune x, y, z alike."
        )
    return int(places[0]), int(places[1]), int(places[2])


def rotation(orientation: Quaternion) -> NDArray[np.float64]:
    """Return R_BS (3, 3), which takes a vector from the sensor's axes to the base's."""
    x, y, z, w = np.array(orientation) / math.hypot(*orientation)
    return np.array(
        [
            [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - z * w), 2.0 * (x * z + y * w)],
            [2.0 * (x * y + z * w), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - x * w)],
            [2.0 * (x * z - y * w), 2.0 * (y * z + x * w), 1.0 - 2.0 * (x * x + y * y)],
        ]
    )


def orientation_notes(
    gains: Mapping[str, Mapping[str, float]], orientation: Quaternion | None, base_link: str
) -> Iterator[str]:
    """Say along which axes of the base the gains act, and what turning the wrist does to that."""
    places = base_axes(gains, orientation)
    turned = [axis for kind in KINDS if not _alike(gains, kind) for axis in kind if axis in gains]
    if not turned or orientation is None:
        yield (
            f"The gains act along the axes of {base_link}. They are alike for all straight axes, and for all turning "
            "ones, so that they hold in every orientation of the sensor."
        )
        return
    along = ", ".join(f"{axis} along its {places[axis]}" for axis in turned)
    yield (
        f"The gains act along the axes of {base_link}, not the sensor's, and were assigned for the orientation "
        f"({', '.join(f'{each:g}' for each in orientation)}) of the sensor in it: {along}. The file holds in that "
        "orientation only: 8° beside it an axis that moves alone moves 2 % less, and 14 % as far sideways; after a "
        "quarter turn the wrong axis moves."
    )


def _alike(gains: Mapping[str, Mapping[str, float]], kind: tuple[str, ...]) -> bool:
    rows = [gains.get(axis) for axis in kind]
    return all(row == rows[0] for row in rows)


def _unequal(gains: Mapping[str, Mapping[str, float]], kind: tuple[str, ...]) -> str:
    numbers = (
        f"{axis} has {', '.join(f'{key} {value:g}' for key, value in gains.get(axis, {}).items())}" for axis in kind
    )
    return "; ".join(numbers)


def _needed(why: str) -> str:
    return (
        f"The gains of that controller act along the base's axes, those of the file along the sensor's, and {why}: "
        "what is certified holds in one orientation only. Give that of the sensor in the base where it is used with "
        "--orientation QX,QY,QZ,QW, a turn by right angles."
    )
