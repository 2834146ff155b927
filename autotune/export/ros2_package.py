"""Export to a ROS 2 package: a ros2_control controller plugin around the exported C, with parameters and launch file.

The C++ is written for ros2_control of Humble (2.x), Jazzy (4.x) and later; docs/targets.md says what was run of it.
"""

import re
import shlex
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from string import Template
from typing import TYPE_CHECKING

from autotune.errors import UsageError
from autotune.version import __version__

from .ros_yaml import (
    INVERSE_DAMPING,
    NAME_OPTIONS,
    SENSOR_NAME,
    InstallationNames,
    Tree,
    dump_parameters,
    managed_parameters,
    update_rate_hz,
)
from .target import ExportRequest, ExportTarget, Rendered, TargetOption

if TYPE_CHECKING:
    from autotune.runtime.controller import RuntimeController

_PACKAGE = re.compile(r"[a-z](?:_?[a-z0-9]){1,39}")
_INTERFACES = ("position", "velocity")
_KINEMATICS_FAILED, _INTERFACE_FAILED = 100, 101
# The file of the package that each template makes; $ is the package's name.
_TEMPLATES = {
    "package.xml": "package.xml.in",
    "CMakeLists.txt": "CMakeLists.txt.in",
    "$_plugin.xml": "plugin.xml.in",
    "README.md": "README.md.in",
    "include/$/admittance_controller.hpp": "admittance_controller.hpp.in",
    "src/admittance_controller.cpp": "admittance_controller.cpp.in",
    "src/$_parameters.yaml": "parameters.yaml.in",
    "launch/controller.launch.py": "controller.launch.py.in",
}
_HEADER, _SOURCE, _CONFIG = "include/$/$.h", "src/$.c", "config/controller.yaml"


@dataclass(frozen=True, kw_only=True)
class PackageOptions(InstallationNames):
    """The names of an installation and what is written to the joints; raises UsageError for what is none."""

    sensor_name: str = "ft_sensor"
    command_interface: str = "position"

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.command_interface not in _INTERFACES:
            raise UsageError(f"--command-interface must be {' or '.join(_INTERFACES)}, found {self.command_interface}.")


def package_files(out: Path) -> tuple[Path, ...]:
    """Return the files of the package; raises UsageError for a folder whose name is none of a package."""
    if not _PACKAGE.fullmatch(out.name):
        raise UsageError(
            f"{out} must be named as a ROS package: small letters, digits and single _, at least two and at most 40, a "
            "letter first; name another folder with -o."
        )
    names = (*_TEMPLATES, _HEADER, _SOURCE, _CONFIG)
    return tuple(out / name.replace("$", out.name) for name in names)


def config_tree(controller: "RuntimeController", package: str, options: PackageOptions, rate: int) -> Tree:
    """Return the parameters of the controller, and its type for the controller manager."""
    payload = controller.payload
    name = options.controller_name
    kind = f"{package}/AdmittanceController"
    parameters: Tree = {
        "type": kind,
        "joints": list(options.joints),
        "command_interface": options.command_interface,
        "ft_sensor": {"name": options.sensor_name, "frame": options.sensor_frame},
        "kinematics": {
            "plugin_name": "kinematics_interface_kdl/KinematicsInterfaceKDL",
            "plugin_package": "kinematics_interface",
            "base": options.base_link,
            "tip": options.tip_link,
            "alpha": INVERSE_DAMPING,
        },
        "payload": {
            "mass_kg": payload.mass_kg,
            "com_m": list(payload.com_S_m),
            "force_bias_n": list(payload.force_bias_S_n),
            "torque_bias_n_m": list(payload.torque_bias_S_n_m),
            "gravity_m_s2": list(payload.gravity_W_m_s2),
            # Of no payload: where a turning axis is tuned, the controller refuses until it is given.
            "inertia_kg_m2": [0.0, 0.0, 0.0],
        },
    }
    return managed_parameters(name, kind, rate, parameters)


def render(request: ExportRequest) -> Rendered:
    """Return the texts of the package's files, in the order of `package_files`."""
    from autotune.formats.canonical import short  # noqa: PLC0415
    from autotune.runtime.load import read_law  # noqa: PLC0415

    from .c_source import gains_text, render_c  # noqa: PLC0415

    source, package = request.source, request.out.name
    options = PackageOptions(**request.options)
    rate = update_rate_hz(source.controller.sample_time_s)
    if source.controller.payload.set_in_cell:
        raise UsageError(
            f"{source.path} holds no centre of mass and no sensor bias, which the package takes off the wrench; give "
            "them in the plant, or identify the payload, and optimize again."
        )
    law = read_law(source.path)
    words = {
        "package": package,
        "PACKAGE": package.upper(),
        "controller": options.controller_name,
        "tool_version": __version__,
        "checksum": source.checksum,
        "short": short(source.checksum),
        "rate": rate,
        "rest": law.limits.rest_samples,
        "command": "positions" if options.command_interface == "position" else "velocities",
        "axes": "; ".join(gains_text(each) for each in law.axes),
        "masses": _masses(law),
        "kinematics_failed": _KINEMATICS_FAILED,
        "interface_failed": _INTERFACE_FAILED,
    }
    c = render_c(law, package, source.controller.provenance, request.signed_by)
    config = dump_parameters(config_tree(law, package, options, rate), _config_comments(law, short(source.checksum)))
    texts = (*(_filled(name, words) for name in _TEMPLATES.values()), c.header, c.source, config)
    note = (
        "The package was compiled against stubs of ROS 2's interfaces and driven beside the Python runtime; it was "
        "not built with colcon nor run on a robot. Read README.md in it before the first contact."
    )
    return Rendered(texts=texts, lines=(f"note: {note}",), tree={"notes": [note], "update_rate_hz": rate})


def _masses(law: "RuntimeController") -> str:
    found = [f"{each.payload_range[0]:g} to {each.payload_range[1]:g} kg" for each in law.axes if not each.turns]
    return found[0] if found else f"{law.payload.mass_kg:g} kg"


def _config_comments(law: "RuntimeController", checksum: str) -> tuple[str, ...]:
    lines = [f"Written by autotune {__version__}: parameters of the controller of checksum {checksum}."]
    lines.append("The names are those of the installation; the numbers of the payload are those of the file.")
    turning = [each for each in law.axes if each.turns]
    if turning:
        ranges = ", ".join(f"{each.name} {each.payload_range[0]:g} to {each.payload_range[1]:g}" for each in turning)
        lines.append(f"Give the payload's inertia about rx, ry, rz; certified is {ranges} kg·m².")
    return (*lines, "")


def _filled(template: str, words: Mapping[str, object]) -> str:
    return Template((files("autotune.export") / "ros2" / template).read_text("utf-8")).substitute(words)


ROS2_PACKAGE = ExportTarget(
    name="ros2_package",
    summary="a whole ROS 2 package: a ros2_control controller plugin around the exported C.",
    render=render,
    is_own=lambda _: False,
    options=(
        *NAME_OPTIONS,
        SENSOR_NAME,
        TargetOption(
            flag="--command-interface", metavar="NAME", help="What is written to the joints: position or velocity."
        ),
    ),
    files=package_files,
    is_folder=True,
    following=lambda request: shlex.join(["colcon", "build", "--base-paths", str(request.out)]),
)
