"""Parameter files of ROS 2 controllers: plain YAML whose numbers, lists and keys are what the readers there take.

Their reader takes a number without a point for an integer, which a parameter of type double refuses, and a number with
an exponent but without a point for text. Keys that nobody declared are passed over in silence.
"""

import json
import math
import re
import shlex
import textwrap
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, fields

from autotune.errors import UsageError
from problems.errors import ParameterError
from problems.frozen import FrozenDict

from .target import ExportRequest, TargetOption

Quaternion = tuple[float, float, float, float]
Tree = Mapping[str, "Tree | float | bool | int | str | list[float] | list[bool] | list[str]"]

NAME_OPTIONS = (
    TargetOption(flag="--controller-name", metavar="NAME", help="The name of the controller in the parameter file."),
    TargetOption(
        flag="--joints",
        metavar="NAME,…",
        help="The robot's joints, from base to tip (joint_1 to joint_6).",
        parse=lambda text: tuple(name.strip() for name in text.split(",")),
    ),
    TargetOption(flag="--base-link", metavar="NAME", help="The robot's base (base_link)."),
    TargetOption(flag="--tip-link", metavar="NAME", help="The robot's last link (tool0)."),
    TargetOption(flag="--sensor-frame", metavar="NAME", help="The frame of the sensor's wrench (ft_frame)."),
)
"""Options for the names of an installation, which every parameter file needs."""
SENSOR_NAME = TargetOption(
    flag="--sensor-name", metavar="NAME", help="The sensor in the robot description (ft_sensor)."
)
CONTROL_FRAME = TargetOption(flag="--control-frame", metavar="NAME", help="The frame of the tuned axes (the sensor's).")

# How far from 1 the length of a quaternion may be that a person types.
_UNIT = 0.01


def parse_orientation(text: str) -> Quaternion:
    """Return the quaternion (x, y, z, w) of a text as "0,0,0,1"; raises UsageError for one that is none."""
    try:
        numbers = [float(each) for each in text.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) != len("xyzw"):
        raise UsageError(f"--orientation must be four numbers QX,QY,QZ,QW, a quaternion; found {text}.")
    return numbers[0], numbers[1], numbers[2], numbers[3]


def check_orientation(orientation: Quaternion) -> None:
    """Raise UsageError for a quaternion that is not of length 1."""
    length = math.hypot(*orientation)
    if not abs(length - 1.0) <= _UNIT:
        raise UsageError(
            f"--orientation must be a quaternion QX,QY,QZ,QW of length 1, found {orientation} of length {length:.6g}."
        )


ORIENTATION = TargetOption(
    flag="--orientation",
    metavar="QX,QY,QZ,QW",
    help="The sensor's orientation in the base where it is used, for gains that are not alike.",
    parse=parse_orientation,
)

UPRIGHT: Mapping[str, Quaternion] = FrozenDict({"orientation": (0.0, 0.0, 0.0, 1.0)})
"""An orientation for what does not depend on it: the certificate of gains, which are then turned to their axes."""

DOWNWARDS: Mapping[str, Quaternion] = FrozenDict({"orientation": (1.0, 0.0, 0.0, 0.0)})
"""The orientation of a sensor on a tool that points down, as an example."""

INVERSE_DAMPING = 0.0005
"""Damps the inverse of the Jacobian; it takes motion away, less than 1 % where the arm is not near a singularity."""

_NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_./-]*")
_WIDTH = 110
# The ways in which a body can move.
_DIRECTIONS = 6


def check_names(what: str, names: Iterable[str]) -> None:
    """Raise UsageError for a name that ROS would not take, or none at all."""
    given = tuple(names)
    if not given or len(set(given)) != len(given):
        raise UsageError(f"{what}: names must be given, each once; found {', '.join(given) or 'none'}.")
    for name in given:
        if not _NAME.fullmatch(name):
            must = "a letter or _ first, then letters, digits and _ . / - only"
            raise UsageError(f"{what}: {json.dumps(name, ensure_ascii=False)} is no name ({must}).")


@dataclass(frozen=True, kw_only=True)
class InstallationNames:
    """The names of controller, joints, links and frames in an installation; raises UsageError for what is no name."""

    controller_name: str = "admittance_controller"
    joints: tuple[str, ...] = tuple(f"joint_{i}" for i in range(1, 7))
    base_link: str = "base_link"
    tip_link: str = "tool0"
    sensor_frame: str = "ft_frame"

    def __post_init__(self) -> None:
        check_names("--joints", self.joints)
        for name in (each.name for each in fields(self) if each.name.endswith(("_name", "_link", "_frame"))):
            if getattr(self, name) is not None:
                check_names(f"--{name.replace('_', '-')}", (getattr(self, name),))


@dataclass(frozen=True, kw_only=True)
class OrientedNames(InstallationNames):
    """The names, and the sensor's orientation in the base where it is used; raises UsageError for what is none.

    `orientation` is a quaternion (x, y, z, w) that takes vectors from the sensor's axes to the base's.
    """

    orientation: Quaternion | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.orientation is not None:
            check_orientation(self.orientation)


def check_joint_count(joints: tuple[str, ...], axes: int) -> None:
    """Raise UsageError for fewer joints than controlled axes: they cannot move each by itself."""
    if len(joints) < axes:
        raise UsageError(
            f"--joints names {len(joints)} joint{'s' * (len(joints) != 1)} ({', '.join(joints)}) for {axes} controlled "
            "axes, which need at least as many; name all joints of the robot, from base to tip."
        )


def joint_notes(joints: tuple[str, ...], axis: str) -> Iterator[str]:
    """Warn of a robot with fewer joints than a body has directions."""
    if len(joints) < _DIRECTIONS:
        yield (
            f"axis {axis}: only {len(joints)} joint{'s are' if len(joints) != 1 else ' is'} named (--joints), and a "
            f"body has {_DIRECTIONS} ways to move; the certificate takes it that they move this axis alone."
        )


def spawner(default_name: str) -> Callable[[ExportRequest], str]:
    """Return what names the command that loads a controller with its parameter file into the controller manager."""

    def command(request: ExportRequest) -> str:
        name = request.options.get("controller_name", default_name)
        return shlex.join(["ros2", "run", "controller_manager", "spawner", name, "--param-file", str(request.out)])

    return command


def update_rate_hz(sample_time_s: float) -> int:
    """Return 1/h, which a controller manager takes in whole hertz only; raises UsageError for any other h."""
    rate = round(1.0 / sample_time_s)
    if rate < 1 or abs(rate * sample_time_s - 1.0) > 1e-6:
        raise UsageError(
            f"The controller manager's update_rate is in whole hertz, and 1/h = {1.0 / sample_time_s:.6f} Hz is not; "
            "what is certified for one period is not for another. Tune at a period of 1/(whole number) s."
        )
    return rate


def managed_parameters(name: str, kind: str, rate: int, parameters: Tree, known: frozenset[str] | None = None) -> Tree:
    """Return the parameters of a controller of a type, and those of the manager that loads it at `rate` [Hz].

    Raises ParameterError for a key that is not among the `known` ones.
    """
    if known is not None:
        check_keys(parameters, known)
    manager: Tree = {"update_rate": rate, name: {"type": kind}}
    return {"controller_manager": {"ros__parameters": manager}, name: {"ros__parameters": parameters}}


def check_keys(parameters: Tree, known: frozenset[str]) -> None:
    """Raise ParameterError for a key that the controller does not declare: it would be ignored in silence."""
    unknown = sorted(set(_paths(parameters)) - known)
    if unknown:
        raise ParameterError("parameters", unknown, "declared by the controller")


def _paths(tree: Tree, within: str = "") -> Iterator[str]:
    for key, value in tree.items():
        if isinstance(value, Mapping):
            yield from _paths(value, f"{within}{key}.")
        else:
            yield f"{within}{key}"


def dump_parameters(tree: Tree, comments: Iterable[str]) -> str:
    """Return the comments and the tree as the text of a parameter file, floats with a point and no exponent."""
    return render_commented(tree, comments)


def render_commented(content: Tree | str, comments: Iterable[str]) -> str:
    """Return the comments, and below them a tree as above, or a text as it is."""
    lines = [line for comment in comments for line in _wrapped(comment)]
    below = [content.rstrip("\n")] if isinstance(content, str) else list(_lines(content, 0))
    return "\n".join([*lines, *below, ""])


def _wrapped(comment: str) -> list[str]:
    found = textwrap.wrap(comment, _WIDTH, initial_indent="# ", subsequent_indent="#   ", break_on_hyphens=False)
    return found or ["#"]


def _lines(tree: Tree, depth: int) -> Iterator[str]:
    for key, value in tree.items():
        if isinstance(value, Mapping):
            yield f"{'  ' * depth}{key}:"
            yield from _lines(value, depth + 1)
        else:
            yield f"{'  ' * depth}{key}: {_scalar(value)}"


def _scalar(value: object) -> str:
    if isinstance(value, list):
        return f"[{', '.join(_scalar(each) for each in value)}]"
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, float):
        if not math.isfinite(value):
            raise ParameterError("parameters", value, "finite")
        import numpy as np  # noqa: PLC0415 - slow to import, and the list of options does without

        return np.format_float_positional(value, trim="0")
    return str(value) if isinstance(value, int) else json.dumps(value, ensure_ascii=False)
