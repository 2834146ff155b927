"""Export to the admittance controller of ros2_controllers: options, parameter file and notes.

Its rule, on every axis, tuned or not, is that of `ros2_axis`. docs/targets.md says which versions were read, and what
in which file.
"""

import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from autotune.errors import UsageError
from autotune.formats.units import AXES
from problems.frozen import FrozenDict

from .ros_yaml import (
    CONTROL_FRAME,
    INVERSE_DAMPING,
    NAME_OPTIONS,
    SENSOR_NAME,
    InstallationNames,
    Tree,
    managed_parameters,
    spawner,
    update_rate_hz,
)
from .target import ExportTarget, TargetOption, begins_with, render_translation

if TYPE_CHECKING:
    from autotune.formats.controller import ControllerFile
    from autotune.formats.controller_record import AxisGains, Controller, RuntimePayload
    from autotune.validation.law import AxisTask

    from .retune import ControllerStructure
    from .third_party import ParameterFile, TranslatedAxis, Translation

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
FIRST_WITHOUT_ROBOT_DESCRIPTION = (4, 3, 0)
FIRST_WITH_WRENCH_REFERENCE = (4, 18, 0)
FIRST_WITH_MASS_IN_CONTROL_FRAME = (6, 4, 0)
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


@dataclass(frozen=True, kw_only=True)
class Ros2Options(InstallationNames):
    """What the file needs beyond the controller: version, names, and the numbers that the user may choose.

    `return_stiffness` (N/m; N·m/rad about rx, ry, rz) is the spring without which there is no damping; without one
    it is the damping over `ros2_axis.RETURN_TIME_S`.
    Raises UsageError for a version or a name that is none, and numbers out of range.
    """

    ros2_version: str = "jazzy"
    sensor_name: str = "ft_sensor"
    control_frame: str | None = None
    return_stiffness: float | None = None
    filter_coefficient: float = 1.0

    def __post_init__(self) -> None:
        parse_version(self.ros2_version)
        super().__post_init__()
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


def damped_rows(values: Mapping[str, Mapping[str, float]]) -> dict[str, Mapping[str, float]]:
    """Return mass, damping ratio and stiffness of all six axes, from those of the tuned ones as written.

    An axis that was not tuned is not selected, so no force moves it. But the rule integrates the joints' speed, and as
    the arm turns that becomes speed along every axis, which damping must take away. It gets D/M and S/M of the tuned
    axis that is damped most (by ζ unchanged and S in proportion to M), and the mass of the others of its kind, or 1.
    """
    most = max(values.values(), key=lambda each: each["damping_ratio"] * math.sqrt(each["stiffness"] / each["mass"]))
    rows = dict[str, Mapping[str, float]]()
    for axis in AXES:
        kind = AXES[3:] if axis in AXES[3:] else AXES[:3]
        mass = max((values[each]["mass"] for each in kind if each in values), default=1.0)
        stiffness = float(f"{most['stiffness'] * mass / most['mass']:.6g}")
        still = {"mass": mass, "damping_ratio": most["damping_ratio"], "stiffness": stiffness}
        rows[axis] = values.get(axis, still)
    return rows


def parameter_tree(
    controller: "Controller", values: Mapping[str, Mapping[str, float]], options: Ros2Options
) -> tuple[Tree, int]:
    """Return the whole file as a tree, and the update rate [Hz] that it holds for; `values` by axis, as written."""
    from .ros2_axis import JOINT_DAMPING_PER_S  # noqa: PLC0415

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
            "alpha": INVERSE_DAMPING,
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
    return managed_parameters(
        options.controller_name, "admittance_controller/AdmittanceController", rate, parameters, KNOWN_KEYS
    ), rate


def notes(payload: "RuntimePayload", tuned: Mapping[str, object], options: Ros2Options) -> Iterator[str]:
    """Say what differs between versions, what the rule does when it fails, and how bias and drift are kept off."""
    from .ros2_axis import JOINT_DAMPING_PER_S  # noqa: PLC0415

    version = parse_version(options.ros2_version)
    if version < FIRST_WITH_MASS_IN_CONTROL_FRAME:
        yield (
            "admittance.mass is read in the frame of kinematics.base before 6.4.0 (and in the control frame from then "
            "on); x, y, z have one mass here, and so have rx, ry, rz, which holds in any frame."
        )
    if version < FIRST_WITHOUT_ROBOT_DESCRIPTION:
        yield (
            "Before 4.3.0 the controller reads the URDF from its own parameter robot_description, which is not in this "
            "file: add it where the controller is launched."
        )
    yield from _bias_notes(payload, options, has_reference=version >= FIRST_WITH_WRENCH_REFERENCE)
    yield (
        "Where the kinematics plugin reports an error, at a singularity or beyond the reach, the rule commands its "
        "reference in that cycle: the arm jumps by the whole way that it was pushed. Keep the work away from there, "
        "limit the joints' speed below the controller, and reactivate it after a long push: it then starts from there."
    )
    still = [axis for axis in AXES if axis not in tuned]
    if still:
        yield (
            f"{', '.join(still)} {'was' if len(still) == 1 else 'were'} not tuned: no force moves them, and they are "
            "damped and sprung as the tuned ones. Without that the rule, which integrates the joints' speed, would "
            "make a drift of them that no force stops."
        )
    yield (
        f"joint_damping is {JOINT_DAMPING_PER_S:g} 1/s, the controller's default, and part of the damping that is "
        f"certified. filter_coefficient is {options.filter_coefficient:g} per cycle; its default of 0.05 would be a "
        "low-pass far below the loop."
    )


def _bias_notes(payload: "RuntimePayload", options: Ros2Options, *, has_reference: bool) -> Iterator[str]:
    """Say how the sensor's bias is taken off."""
    bias = (*payload.force_bias_n, *payload.torque_bias_n_m)
    if not has_reference:
        yield "Before 4.18.0 there is no desired force (~/wrench_reference); the reference alone moves to a contact."
    if not any(bias):
        return
    if has_reference:
        numbers = ", ".join(f"{0.0 - each:g}" for each in bias)
        yield (
            "The controller takes no bias off the wrench, which is a force that moves the arm. What is published on "
            f"~/wrench_reference in the frame {options.sensor_frame} is added to the measured wrench: publish −bias "
            f"there before a contact, ({numbers}) N and N·m, and F^d − bias for a desired force. Until the first "
            "message the bias acts. Where the sensor's driver already takes it off, publish F^d alone: once, not twice."
        )
    else:
        yield (
            "The controller takes no bias off the wrench, which is a force that moves the arm, and this version has no "
            "~/wrench_reference to add −bias on: take it off in the sensor's driver."
        )


def translate(
    source: "ControllerFile", options: Ros2Options, progress: Callable[[float], None] | None = None
) -> "Translation":
    """Return the controller as this program runs it, certified; raises as `third_party.translate_controller`."""
    from .ros2_axis import Ros2Axis, with_common_masses  # noqa: PLC0415
    from .third_party import ParameterFile, translate_controller  # noqa: PLC0415

    version = parse_version(options.ros2_version)

    def build_axes(
        tasks: Mapping[str, "AxisTask"], gains: Mapping[str, "AxisGains"]
    ) -> tuple[list["ControllerStructure"], bool]:
        axes = {
            name: Ros2Axis(
                task=task,
                gains=gains[name],
                return_stiffness=options.return_stiffness,
                filter_coefficient=options.filter_coefficient,
            )
            for name, task in tasks.items()
        }
        same = axes if version >= FIRST_WITH_MASS_IN_CONTROL_FRAME else with_common_masses(axes)
        return list(same.values()), same != axes

    def build_file(controller: "Controller", axes: Sequence["TranslatedAxis"]) -> "ParameterFile":
        written = {each.axis: each.written for each in axes}
        tree, rate = parameter_tree(controller, written, options)
        return ParameterFile(
            content=tree,
            update_rate_hz=rate,
            software=f"ros2_controllers admittance_controller {'.'.join(map(str, version))} ({options.ros2_version})",
            notes=tuple(notes(controller.payload, written, options)),
        )

    return translate_controller(source, options.joints, build_axes, build_file, progress)


ROS2_CONTROL = ExportTarget(
    name="ros2_control",
    summary="parameters of the admittance controller of ros2_controllers.",
    render=render_translation(translate, Ros2Options),
    is_own=begins_with(rb"# Written by autotune \S+ for ros2_controllers "),
    options=(
        TargetOption(
            flag="--ros2-version",
            metavar="NAME",
            help="humble, jazzy (default), kilted, lyrical, rolling, or 6.4.0.",
        ),
        *NAME_OPTIONS,
        SENSOR_NAME,
        CONTROL_FRAME,
        TargetOption(
            flag="--return-stiffness",
            metavar="N/M",
            type=float,
            help="The spring without which there is no damping there (so weak that it takes 10 h).",
        ),
        TargetOption(flag="--filter-coefficient", metavar="A", type=float, help="The force filter, 1 being none (1)."),
    ),
    runs_same_law=False,
    following=spawner("admittance_controller"),
    expresses=("mass", "damping"),
)
