"""The admittance controller of ros2_controllers: what it can be, and its parameter file.

Its rule is `problems.peer_laws.SpringAdmittance`. Read in the package's sources and changelogs from 4.0.0 (2023-11) to
4.41.0 (Jazzy), 5.11.0 (Kilted) and 6.4.0 (Rolling); docs/targets.md tells what was read where.
"""

import math
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType

from autotune.errors import UsageError
from autotune.files.controller_record import AxisGains, Controller
from autotune.files.records import ROTATIONAL_AXES
from autotune.validation.law import AxisTask
from problems.laws import LinearLaw
from problems.peer_laws import SpringAdmittance

from .ros_yaml import Tree, check_keys, check_names, update_rate_hz
from .structure import Values, Variable, lost_gains

AXES = ("x", "y", "z", "rx", "ry", "rz")
STANDARD_GRAVITY = 9.80665
RELEASES: Mapping[str, tuple[int, int, int]] = MappingProxyType(
    {"jazzy": (4, 41, 0), "kilted": (5, 11, 0), "rolling": (6, 4, 0)}
)
"""The releases that are known by name, with the newest version of the package that was read for each."""
OLDEST, NEXT_UNKNOWN = (4, 0, 0), (7, 0, 0)
FIRST_WITH_WRENCH_REFERENCE = (4, 18, 0)
FIRST_WITH_MASS_IN_CONTROL_FRAME = (6, 4, 0)
DEFAULT_JOINT_DAMPING_PER_S = 5.0
DEFAULT_FILTER_COEFFICIENT = 0.05

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
# The inverse of the Jacobian is damped by this; it takes motion away, at 0.0005 less than 1 % beyond singularities.
_ALPHA = 0.0005


@dataclass(frozen=True, kw_only=True)
class Ros2Options:
    """What the file needs beyond the controller: version, names, and the numbers that the user may choose.

    `return_stiffness` (N/m; N·m/rad about rx, ry, rz) is the spring without which there is no damping.
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
    return_stiffness: float = 1.0
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
        if not 0.0 < self.return_stiffness < math.inf:
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
    if not OLDEST <= version < NEXT_UNKNOWN:
        raise UsageError(
            f"--ros2-version must be {', '.join(RELEASES)} or a version of ros2_controllers from 4.0.0 to 6.x, "
            f"found {text}."
        )
    return version[0], version[1], version[2]


@dataclass(frozen=True, kw_only=True)
class Ros2Axis:
    """One axis: mass and damping are free, the latter written as a ratio at a fixed small stiffness.

    A search goes by M/D and D, since M ≥ h·D (see `SpringAdmittance.own_pole`) is then a bound of its box. With
    `fixed_mass` D alone is free (the masses of versions that read them in the base frame must be equal).
    """

    task: AxisTask
    gains: AxisGains
    options: Ros2Options
    fixed_mass: float | None = None

    @property
    def variables(self) -> tuple[Variable, ...]:
        """M/D (s) and D (N·s/m), or D alone."""
        h, damping = self.task.sample_time_s, self.gains.damping
        low, high = damping * _DAMPING_RATIO[0], damping * _DAMPING_RATIO[1]
        if self.fixed_mass is not None:
            most = self.fixed_mass / (_LEAST * h)
            return (Variable(name="damping", low=min(low, _DAMPING_RATIO[0] * most), high=min(high, most)),)
        longest = _LONGEST * max(self.gains.mass / damping, h)
        return (
            Variable(name="mass over damping", low=_LEAST * h, high=longest),
            Variable(name="damping", low=low, high=high),
        )

    @property
    def translated(self) -> Values:
        """M_a/B_a and B_a, or B_a alone."""
        damping = self.gains.damping
        return (damping,) if self.fixed_mass is not None else (self.gains.mass / damping, damping)

    def written(self, values: Values) -> Mapping[str, float]:
        """Return mass, damping ratio and stiffness with six digits, as the file holds them."""
        damping = values[-1]
        mass = float(f"{self.fixed_mass or values[0] * damping:.6g}")
        stiffness = self.options.return_stiffness
        ratio = float(f"{damping / (2.0 * math.sqrt(mass * stiffness)):.6g}")
        return {"mass": mass, "damping_ratio": ratio, "stiffness": stiffness}

    def rule(self, values: Values) -> SpringAdmittance:
        """Return the rule that runs with the numbers as they are written."""
        return SpringAdmittance(
            **self.written(values), joint_damping_per_s=0.0, filter_coefficient=self.options.filter_coefficient
        )

    def law(self, values: Values) -> LinearLaw:
        """Return its difference equation."""
        return self.rule(values).law(self.task.sample_time_s)

    def dropped(self) -> tuple[str, ...]:
        """Say what of the gains is left out."""
        return lost_gains(self.task, self.gains)

    def told(self, values: Values) -> Iterator[str]:
        """Say what the return spring does, and where the law's own pole is."""
        rule, turns = self.rule(values), self.task.axis in ROTATIONAL_AXES
        h = self.task.sample_time_s
        travel, force = ("0.1 rad", "N·m") if turns else ("100 mm", "N")
        yield (
            f"axis {self.task.axis}: the spring that the damping needs pulls back to the reference with "
            f"{0.1 * rule.stiffness:.3g} {force} per {travel}, with a time constant of "
            f"{rule.total_damping / rule.stiffness:.3g} s."
        )
        yield (
            f"axis {self.task.axis}: the law's own pole is z = 1 − h·D/M = {rule.own_pole(h):.3g} at this update rate; "
            "M ≥ h·D keeps it from being negative, where the speed would change sign in every cycle."
        )


def frame_notes(version: tuple[int, int, int], options: Ros2Options) -> Iterator[str]:
    """Say what differs between versions and what the controller does not do."""
    if version < FIRST_WITH_MASS_IN_CONTROL_FRAME:
        yield (
            "admittance.mass is read in the frame of kinematics.base before 6.4.0 (and in the control frame from then "
            "on); x, y, z have one mass here, and so have rx, ry, rz, which holds in any frame."
        )
    if version < FIRST_WITH_WRENCH_REFERENCE:
        yield "Before 4.18.0 there is no desired force (~/wrench_reference); the reference alone moves to a contact."
    yield (
        "joint_damping is 0 here; its default of 5 would add 5 times the mass to every damping. filter_coefficient is "
        f"{options.filter_coefficient:g} per cycle; its default of 0.05 would be a low-pass far below the loop."
    )


def parameter_tree(
    controller: Controller, values: Mapping[str, Mapping[str, float]], options: Ros2Options
) -> tuple[Tree, int]:
    """Return the whole file as a tree, and the update rate [Hz] that it holds for; `values` by axis, as written."""
    rate = update_rate_hz(controller.sample_time_s)
    payload, frame = controller.payload, options.sensor_frame
    # An axis that is not selected must not move: no stiffness, and the mass of the others of its kind.
    groups = {axis: AXES[3:] if axis in ROTATIONAL_AXES else AXES[:3] for axis in AXES}
    masses = {
        axis: max((values[each]["mass"] for each in group if each in values), default=1.0)
        for axis, group in groups.items()
    }
    none: Mapping[str, float] = {"damping_ratio": 0.0, "stiffness": 0.0}
    rows = {axis: values.get(axis, {**none, "mass": masses[axis]}) for axis in AXES}
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
            "joint_damping": 0.0,
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
