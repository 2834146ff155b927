"""The admittance controller of ros2_controllers: what it can be, and its parameter file.

Its rule is `problems.model.third_party_controllers.SpringAdmittance` on every axis, those that were tuned and those
that must not move. docs/targets.md says which versions were read, and what in which file.
"""

import math
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

from autotune.errors import UsageError
from autotune.formats.controller_record import AxisGains, Controller
from autotune.formats.records import ROTATIONAL_AXES
from autotune.formats.units import axis_units
from autotune.validation.law import AxisTask
from problems.frozen import FrozenDict
from problems.model.linear_controllers import LinearController
from problems.model.third_party_controllers import SpringAdmittance

from .ros_yaml import Tree, check_keys, check_names, update_rate_hz
from .structure import Values, Variable, lost_gains

AXES = ("x", "y", "z", "rx", "ry", "rz")
STANDARD_GRAVITY = 9.80665
RELEASES: Mapping[str, tuple[int, int, int]] = FrozenDict(
    {
        "humble": (2, 54, 0),
        "jazzy": (4, 42, 0),
        "kilted": (5, 11, 0),
        "lyrical": (6, 9, 0),
        "rolling": (6, 9, 0),
    }
)
"""The releases that are known by name, with the newest version of the package that is known of each."""
KNOWN_RANGES = (((2, 54, 0), (3, 0, 0)), ((4, 0, 0), (7, 0, 0)))
"""The versions that run this rule: from, and before."""
FIRST_WITH_MASS_IN_CONTROL_FRAME = (6, 4, 0)
JOINT_DAMPING_PER_S = 5.0
"""What takes 5 times the joints' speed off their acceleration: the controller's default, written as it is."""
RETURN_TIME_S = 36e3
"""The time constant of the return spring where none is given: a minute takes back 0.17 % of the way."""

KNOWN_KEYS = frozenset(
    {
        "joints",
        "command_joints",
        "command_interfaces",
        "state_interfaces",
        "chainable_command_interfaces",
        "kinematics.plugin_name",
        "kinematics.plugin_package",
        "kinematics.base",
        "kinematics.tip",
        "kinematics.alpha",
        "ft_sensor.name",
        "ft_sensor.frame.id",
        "ft_sensor.filter_coefficient",
        "control.frame.id",
        "fixed_world_frame.frame.id",
        "gravity_compensation.frame.id",
        "gravity_compensation.CoG.pos",
        "gravity_compensation.CoG.force",
        "admittance.selected_axes",
        "admittance.mass",
        "admittance.damping_ratio",
        "admittance.stiffness",
        "admittance.joint_damping",
        "enable_parameter_update_without_reactivation",
    }
)
"""Every parameter that the controller declares in 4.x, 5.x and 6.x (admittance_controller_parameters.yaml)."""

# The dampings that a search may choose, as ratios of the file's own, and the longest M/D, of the file's own or of h.
_DAMPING_RATIO, _LONGEST = (0.1, 30.0), 50.0
# The least M/(h·D) of a search: numbers with six digits then still have M ≥ h·D.
_LEAST = 1.0 + 2e-5
# The least share of the damping that is the axis' own, beside that of the joints: D ≥ 0.1 (D + J M).
_OWN_SHARE = 0.1
_LONGEST_S = (1.0 - _OWN_SHARE) / JOINT_DAMPING_PER_S
# The inverse of the Jacobian is damped by this; it takes motion away, at 0.0005 less than 1 % beyond singularities.
_ALPHA = 0.0005


@dataclass(frozen=True, kw_only=True)
class Ros2Options:
    """What the file needs beyond the controller: version, names, and the numbers that the user may choose.

    `return_stiffness` (N/m; N·m/rad about rx, ry, rz) is the spring without which there is no damping; without one
    it is the damping over `RETURN_TIME_S`.
    Raises UsageError for a version or a name that is none, and numbers out of range.
    """

    version: str = "jazzy"
    controller_name: str = "admittance_controller"
    joints: tuple[str, ...] = tuple(f"joint_{i}" for i in range(1, 7))
    base_link: str = "base_link"
    tip_link: str = "tool0"
    sensor_name: str = "ft_sensor"
    sensor_frame: str = "ft_frame"
    control_frame: str | None = None
    return_stiffness: float | None = None
    filter_coefficient: float = 1.0

    def __post_init__(self) -> None:
        parse_version(self.version)
        check_names("--joints", self.joints)
        for what, name in (
            ("--controller-name", self.controller_name),
            ("--base-link", self.base_link),
            ("--tip-link", self.tip_link),
            ("--sensor-name", self.sensor_name),
            ("--sensor-frame", self.sensor_frame),
            ("--control-frame", self.control_frame or self.sensor_frame),
        ):
            check_names(what, (name,))
        if self.return_stiffness is not None and not 0.0 < self.return_stiffness < math.inf:
            raise UsageError(
                f"--return-stiffness must be above 0, found {self.return_stiffness:g}: the damping of that controller "
                "is 2ζ√(M·S), so a stiffness S of 0 leaves none."
            )
        if not 0.0 < self.filter_coefficient <= 1.0:
            raise UsageError(
                f"--filter-coefficient must be above 0 and at most 1 (no filter), found {self.filter_coefficient:g}."
            )


def parse_version(text: str) -> tuple[int, int, int]:
    """Return the version of a release's name or of a number as 6.4.0; raises UsageError for one that is not known."""
    if text in RELEASES:
        return RELEASES[text]
    found = re.fullmatch(r"(\d+)\.(\d+)\.(\d+)", text)
    version = tuple(int(each) for each in found.groups()) if found else (0, 0, 0)
    if not any(first <= version < after for first, after in KNOWN_RANGES):
        raise UsageError(
            f"--ros2-version must be {', '.join(RELEASES)} or a version of ros2_controllers of 2.x from 2.54.0 on or "
            f"from 4.0.0 to 6.x, found {text}."
        )
    return version[0], version[1], version[2]


@dataclass(frozen=True, kw_only=True)
class Ros2Axis:
    """One axis: mass and damping are free, the latter written as a ratio at a small stiffness.

    The damping B = D + J M is that of the axis and the joints together. A search goes by M/B and B, since M ≥ h·B (see
    `SpringAdmittance.own_pole`) and D ≥ 0.1 B are then bounds of its box. With `fixed_mass` B alone is free (the masses
    of versions that read them in the base frame must be equal).
    """

    task: AxisTask
    gains: AxisGains
    options: Ros2Options
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
            Variable(name="mass over damping", low=_LEAST * h, high=longest),
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
        damping, given = values[-1], self.options.return_stiffness
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
            filter_coefficient=self.options.filter_coefficient,
        )

    def law(self, values: Values) -> LinearController:
        """Return its difference equation."""
        return self.rule(values).law(self.task.sample_time_s)

    def dropped(self) -> tuple[str, ...]:
        """Say what of the gains is left out."""
        return lost_gains(self.task, self.gains)

    def told(self, values: Values) -> Iterator[str]:
        """Say what the return spring does, and where the law's own pole is."""
        rule, turns = self.rule(values), self.task.axis in ROTATIONAL_AXES
        h, units = self.task.sample_time_s, axis_units(self.task.axis)
        travel, force = ("0.1 rad", "N·m") if turns else ("100 mm", "N")
        returns_s = rule.total_damping / rule.stiffness
        yield (
            f"axis {self.task.axis}: the spring that the damping needs pulls back to the reference with "
            f"{0.1 * rule.stiffness:.3g} {force} per {travel}, with a time constant of {returns_s:.3g} s: what was "
            f"pushed away comes back by {100.0 * -math.expm1(-60.0 / returns_s):.2g} % in a minute."
        )
        yield (
            f"axis {self.task.axis}: of the damping {rule.total_damping:.6g} {units.damping}, joint_damping makes "
            f"{JOINT_DAMPING_PER_S:g} 1/s times the mass, {JOINT_DAMPING_PER_S * rule.mass:.4g}; the law's own pole is "
            f"z = 1 − h·(D/M + J) = {rule.own_pole(h):.3g} at this update rate; M ≥ h·(D + J·M) keeps it from being "
            "negative, where the speed would change sign in every cycle."
        )


def damped_rows(values: Mapping[str, Mapping[str, float]]) -> dict[str, Mapping[str, float]]:
    """Return mass, damping ratio and stiffness of all six axes, from those of the tuned ones as written.

    An axis that was not tuned is not selected, so no force moves it. But the rule integrates the joints' speed, and as
    the arm turns that becomes speed along every axis, which damping must take away. It gets D/M and S/M of the tuned
    axis that is damped most (by ζ unchanged and S in proportion to M), and the mass of the others of its kind, or 1.
    """
    most = max(values.values(), key=lambda each: each["damping_ratio"] * math.sqrt(each["stiffness"] / each["mass"]))
    rows = dict[str, Mapping[str, float]]()
    for axis in AXES:
        kind = AXES[3:] if axis in ROTATIONAL_AXES else AXES[:3]
        mass = max((values[each]["mass"] for each in kind if each in values), default=1.0)
        stiffness = float(f"{most['stiffness'] * mass / most['mass']:.6g}")
        still = {"mass": mass, "damping_ratio": most["damping_ratio"], "stiffness": stiffness}
        rows[axis] = values.get(axis, still)
    return rows


def parameter_tree(
    controller: Controller, values: Mapping[str, Mapping[str, float]], options: Ros2Options
) -> tuple[Tree, int]:
    """Return the whole file as a tree, and the update rate [Hz] that it holds for; `values` by axis, as written."""
    rate = update_rate_hz(controller.sample_time_s)
    payload, frame = controller.payload, options.sensor_frame
    rows = damped_rows(values)
    parameters: Tree = {
        "joints": list(options.joints),
        "command_interfaces": ["position"],
        "state_interfaces": ["position", "velocity"],
        "chainable_command_interfaces": ["position", "velocity"],
        "kinematics": {
            "plugin_name": "kinematics_interface_kdl/KinematicsInterfaceKDL",
            "plugin_package": "kinematics_interface",
            "base": options.base_link,
            "tip": options.tip_link,
            "alpha": _ALPHA,
        },
        "ft_sensor": {
            "name": options.sensor_name,
            "frame": {"id": frame},
            "filter_coefficient": options.filter_coefficient,
        },
        "control": {"frame": {"id": options.control_frame or frame}},
        "fixed_world_frame": {"frame": {"id": options.base_link}},
        "gravity_compensation": {
            "frame": {"id": frame},
            "CoG": {"pos": list(payload.com_m), "force": float(f"{payload.mass_kg * STANDARD_GRAVITY:.9g}")},
        },
        "admittance": {
            "selected_axes": [axis in values for axis in AXES],
            "mass": [rows[axis]["mass"] for axis in AXES],
            "damping_ratio": [rows[axis]["damping_ratio"] for axis in AXES],
            "stiffness": [rows[axis]["stiffness"] for axis in AXES],
            "joint_damping": JOINT_DAMPING_PER_S,
        },
        "enable_parameter_update_without_reactivation": False,
    }
    check_keys(parameters, KNOWN_KEYS)
    name = options.controller_name
    manager: Tree = {"update_rate": rate, name: {"type": "admittance_controller/AdmittanceController"}}
    return {"controller_manager": {"ros__parameters": manager}, name: {"ros__parameters": parameters}}, rate


def with_common_masses(axes: Mapping[str, Ros2Axis], version: tuple[int, int, int]) -> dict[str, Ros2Axis]:
    """Give x, y, z one mass, and rx, ry, rz too, where the version reads masses in the base frame.

    It is the largest of theirs, and no less than h·B_a of any. Equal masses are held as well: a search for one axis
    alone would part them.
    """
    found = dict(axes)
    if version >= FIRST_WITH_MASS_IN_CONTROL_FRAME:
        return found
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
