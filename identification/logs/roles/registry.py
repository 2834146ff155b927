"""The registry of roles: what a channel can be used for by its type and name, and what to record."""

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from enum import StrEnum
from itertools import pairwise

from ...errors import listed
from ...result import Finding
from ..containers.channel import Channel, ChannelInfo, Infos
from .cell import ExertedBy, Frame, PoseFields, PoseSource, Source, WrenchSource
from .orientation import COLUMN_MAJOR

WRENCH_STAMPED = "geometry_msgs/msg/WrenchStamped"
WRENCH = "geometry_msgs/msg/Wrench"
POSE_STAMPED = "geometry_msgs/msg/PoseStamped"
TRANSFORM_STAMPED = "geometry_msgs/msg/TransformStamped"
TF_MESSAGE = "tf2_msgs/msg/TFMessage"
OLD_TF_MESSAGE = "tf/msg/tfMessage"
TWIST_STAMPED = "geometry_msgs/msg/TwistStamped"
ADMITTANCE_STATE = "control_msgs/msg/AdmittanceControllerState"
JOINT_STATE = "sensor_msgs/msg/JointState"
FLOAT_ARRAY = "std_msgs/msg/Float64MultiArray"

FRANKA_STATE = "franka_msgs/msg/FrankaState"
FRANKA_ROBOT_STATE = "franka_msgs/msg/FrankaRobotState"
ROBOT_STATES = (FRANKA_STATE, FRANKA_ROBOT_STATE)
"""Types that hold what was measured and what was commanded side by side."""

TRANSFORMS = frozenset({TRANSFORM_STAMPED, TF_MESSAGE, OLD_TF_MESSAGE})
"""Types of which a pair of frames is read."""
_QUATERNION = tuple(f"orientation.{axis}" for axis in "xyzw")
TRANSFORM_FIELDS = (*(f"translation.{axis}" for axis in "xyz"), *(f"rotation.{axis}" for axis in "xyzw"))
_POSE_FIELDS = tuple(f"pose.{name}" for name in (*(f"position.{axis}" for axis in "xyz"), *_QUATERNION))
UNDECLARED = frozenset({JOINT_STATE, FLOAT_ARRAY})
"""Types that hold numbers whose meaning must be declared."""

_COMMANDS = frozenset({"command", "cmd", "desired", "target", "reference", "setpoint", "goal", "ref"})
COMMAND_WORDS = _COMMANDS | {f"{word}s" for word in _COMMANDS} | {"commanded", "des"}
PROCESSED_WORDS = frozenset(
    {"compensated", "filtered", "filter", "unbiased", "zeroed", "tared", "external", "ext", "contact", "processed"}
)

_NEVER_COMMANDS = frozenset({ADMITTANCE_STATE, *TRANSFORMS} - {TRANSFORM_STAMPED})
"""Types that hold what was measured, whatever the topic is called."""


class Role(StrEnum):
    """What a channel can be used for."""

    WRENCH = "wrench"
    POSE = "pose measured"
    COMMAND = "pose commanded"
    TWIST = "twist"
    GAINS = "gains"
    DESIRED_FORCE = "desired force"
    JOINT_STATE = "joint state"
    NUMBERS = "numbers"


@dataclass(frozen=True, kw_only=True)
class FieldPaths:
    """Paths of a role's numbers, in the order that the role has them, and of the header, empty without one.

    `meaning` holds what the type says of the numbers, in place of what a cell would declare; `caution` is a finding
    about it, whose message names the `{topic}`.
    """

    fields: tuple[str, ...]
    header: str
    meaning: Source | None = None
    caution: Finding | None = None


def _vectors(prefix: str, parts: tuple[str, str]) -> tuple[str, ...]:
    return tuple(f"{prefix}{part}.{axis}" for part in parts for axis in "xyz")


_WRENCHES = {
    WRENCH_STAMPED: FieldPaths(fields=_vectors("wrench.", ("force", "torque")), header="header"),
    WRENCH: FieldPaths(fields=_vectors("", ("force", "torque")), header=""),
}
_POSES = {
    POSE_STAMPED: FieldPaths(fields=_POSE_FIELDS, header="header"),
    TRANSFORM_STAMPED: FieldPaths(fields=TRANSFORM_FIELDS, header="header"),
    TF_MESSAGE: FieldPaths(fields=TRANSFORM_FIELDS, header="header"),
    OLD_TF_MESSAGE: FieldPaths(fields=TRANSFORM_FIELDS, header="header"),
}
_STATE_WRENCH = FieldPaths(
    fields=_vectors("wrench_base.wrench.", ("force", "torque")),
    header="",
    meaning=WrenchSource(expressed_in=Frame.BASE, gravity_compensated=True),
    caution=Finding.warning(
        "admittance-state-wrench",
        "The wrench of {topic} is what the admittance controller acts on: taken as given in base axes, with the "
        "configured gravity removed and filtered.",
        "Record the sensor's own wrench, or declare `expressed_in` and `gravity_compensated`.",
    ),
)
_STATE_GAINS = FieldPaths(
    fields=tuple(f"{name}.data[{i}]" for name in ("mass", "damping") for i in range(6)), header=""
)

_FRANKA_MEANING = WrenchSource(expressed_in=Frame.BASE, exerted_by=ExertedBy.SENSOR, gravity_compensated=True)
_FRANKA_CAUTION = Finding.warning(
    "franka-wrench",
    "The wrench of {topic} (O_F_ext_hat_K) is the robot's estimate from its joint torques: taken as the robot's force "
    "on its surroundings about the stiffness frame, in base axes, with the weight of the configured load removed.",
    "Record a sensor at the wrist if there is one; a simulated robot's force may have the other sign (`exerted_by`).",
)


def _franka_pose(name: str) -> FieldPaths:
    """Return the paths of a pose in a FrankaState, a 4 by 4 matrix column by column."""
    matrix = PoseSource(fields=PoseFields(orientation=(f"{name}[0:16]",)), orientation_as=COLUMN_MAJOR).fields
    paths = () if matrix is None else tuple(path for path in (*matrix.position, *matrix.orientation) if path)
    return FieldPaths(fields=paths, header="header", meaning=PoseSource(orientation_as=COLUMN_MAJOR))


_FRANKA_WRENCHES = {
    FRANKA_STATE: FieldPaths(
        fields=tuple(f"O_F_ext_hat_K[{i}]" for i in range(6)),
        header="header",
        meaning=_FRANKA_MEANING,
        caution=_FRANKA_CAUTION,
    ),
    FRANKA_ROBOT_STATE: FieldPaths(
        fields=_vectors("o_f_ext_hat_k.wrench.", ("force", "torque")),
        header="header",
        meaning=_FRANKA_MEANING,
        caution=_FRANKA_CAUTION,
    ),
}
_FRANKA_POSES = {
    FRANKA_STATE: _franka_pose("O_T_EE"),
    FRANKA_ROBOT_STATE: FieldPaths(fields=tuple(f"o_t_ee.{path}" for path in _POSE_FIELDS), header="header"),
}
_FRANKA_COMMANDS = {
    FRANKA_STATE: _franka_pose("O_T_EE_d"),
    FRANKA_ROBOT_STATE: FieldPaths(fields=tuple(f"o_t_ee_d.{path}" for path in _POSE_FIELDS), header="header"),
}


@dataclass(frozen=True, kw_only=True)
class RoleKind:
    """What is known of a role: its entry in cell.yaml, its name in messages, and the message types that carry it.

    `layouts` has the paths of its numbers in each type. The types in `tiers` are looked for, those of a later tier only
    where a log has none of the tiers before; the first one is what to record. `is_command` says whether a word of the
    topic must name a command or must not. `option` is that of the command line, which decides between several channels;
    without one the role is left empty then. `is_required` says that a log without it is refused, and `record` is the
    advice in that message.
    """

    entry: str
    label: str
    layouts: Mapping[str, FieldPaths]
    tiers: tuple[tuple[str, ...], ...]
    is_command: bool = False
    option: str = ""
    is_required: bool = False
    record: str = "record it"

    @property
    def main_type(self) -> str:
        """The message type to record."""
        return self.tiers[0][0]


ROLES: dict[Role, RoleKind] = {
    Role.WRENCH: RoleKind(
        entry="wrench",
        label="wrench",
        layouts={**_WRENCHES, ADMITTANCE_STATE: _STATE_WRENCH, **_FRANKA_WRENCHES},
        tiers=(tuple(_WRENCHES), ROBOT_STATES, (ADMITTANCE_STATE,)),
        option="--wrench-topic",
        is_required=True,
        record=f"record the force/torque sensor as {WRENCH_STAMPED}, raw (gravity, bias and no deadband), "
        "with header stamps, at the control rate",
    ),
    Role.POSE: RoleKind(
        entry="pose",
        label="measured pose",
        layouts={**_POSES, **_FRANKA_POSES},
        tiers=((POSE_STAMPED,), ROBOT_STATES, tuple(sorted(TRANSFORMS))),
        option="--pose-topic",
        is_required=True,
        record=f"record the measured flange pose as {POSE_STAMPED} with header stamps, at the control rate",
    ),
    Role.COMMAND: RoleKind(
        entry="command",
        label="commanded pose",
        layouts={**_POSES, **_FRANKA_COMMANDS},
        tiers=((POSE_STAMPED, TRANSFORM_STAMPED), ROBOT_STATES),
        is_command=True,
        option="--command-topic",
        record=f"record the commanded flange pose as {POSE_STAMPED} on a topic whose name says so "
        "(e.g. /commanded_pose), or name it with --command-topic",
    ),
    Role.TWIST: RoleKind(
        entry="twist",
        label="twist",
        layouts={TWIST_STAMPED: FieldPaths(fields=_vectors("twist.", ("linear", "angular")), header="header")},
        tiers=((TWIST_STAMPED,),),
    ),
    Role.GAINS: RoleKind(
        entry="gains",
        label="set of the controller's gains",
        layouts={ADMITTANCE_STATE: _STATE_GAINS},
        tiers=((ADMITTANCE_STATE,),),
    ),
    Role.DESIRED_FORCE: RoleKind(
        entry="desired_force",
        label="desired force",
        layouts=_WRENCHES,
        tiers=(tuple(_WRENCHES),),
        is_command=True,
    ),
}
"""The roles that `inspect` and `identify` look for, in this order; to add one, write its `Role` and an entry here."""


def layout_of(role: Role, channel: Channel) -> FieldPaths:
    """Return where a channel of a known type has the numbers of a role."""
    layout = ROLES[role].layouts[channel.type_name]
    if channel.type_name == FRANKA_STATE and b"O_T_EE" not in channel.schema:
        # ROS 2 allows no capitals in names of fields.
        return replace(layout, fields=tuple(path.lower() for path in layout.fields))
    return layout


def roles_of(channel: Channel) -> tuple[Role, ...]:
    """Return what a channel can serve as by its type and the words in its topic."""
    if channel.encoding not in ("cdr", "ros1"):
        return ()
    if channel.type_name == JOINT_STATE:
        return (Role.JOINT_STATE,)
    if channel.type_name == FLOAT_ARRAY:
        return (Role.NUMBERS,)
    is_command = is_command_name(channel.topic) and channel.type_name not in _NEVER_COMMANDS
    return tuple(
        role
        for role, kind in ROLES.items()
        if channel.type_name in kind.layouts and (channel.type_name in ROBOT_STATES or kind.is_command == is_command)
    )


def is_command_name(topic: str) -> bool:
    """Return whether a word of the topic says that it carries a command."""
    words = _words(topic)
    pairs = {first + second for first, second in pairwise(words)}
    return bool(COMMAND_WORDS & ({*words} | (pairs & {"setpoint"})))


def is_processed_name(topic: str) -> bool:
    """Return whether a word of the topic says that a wrench is not as the sensor showed it."""
    return bool(PROCESSED_WORDS & {*_words(topic)})


def missing_sentence(role: Role, log: str, infos: Infos, source: Source | None = None) -> str:
    """Say that a log has no channel for a role, what it has instead and what to record.

    Where what the cell declares (`source`) rules channels of the right type out, that is said instead.
    """
    ruled_out = _ruled_out(role, log, infos, source)
    if ruled_out:
        return ruled_out
    types = sorted({info.channel.type_name for info in infos if info.count and info.channel.type_name})
    empty = sorted(info.channel.topic for info in infos if not info.count and role in roles_of(info.channel))
    silent = f" ({listed(empty)} is there but without messages)" if empty else ""
    sentence = (
        f"{log} has no channel for the {ROLES[role].label}{silent}: it needs {ROLES[role].main_type}, "
        f"the log holds {listed(types, empty='nothing')}; {ROLES[role].record}."
    )
    undeclared = [info.channel.topic for info in infos if info.count and is_undeclared(info)]
    if not undeclared:
        return sentence
    declare = f"declare `{ROLES[role].entry}: {{topic: …, fields: …}}` in cell.yaml"
    if role is Role.COMMAND:
        return f"{sentence} If {listed(undeclared)} has it, {declare}."
    return (
        f"{sentence} {listed(undeclared)} may carry it, but the log does not say what its numbers mean: {declare}; "
        "`autotune inspect LOG --write-cell cell.yaml` begins such a file."
    )


def _ruled_out(role: Role, log: str, infos: Infos, source: Source | None) -> str:
    """Say why channels of the type that a role needs do not serve it, nothing where there are none."""
    typed = [info for info in infos if info.count and info.channel.type_name == ROLES[role].main_type]
    if not typed:
        return ""
    start = f"None of {listed(typed)} in {log} serves as the {ROLES[role].label}"
    if source is not None and getattr(source, "fields", None) is not None:
        return (
            f"{start}: `{ROLES[role].entry}: {{fields: …}}` is for messages whose type does not say what they mean; "
            "name the `topic` as well if those of a typed one are meant, or leave `fields` out."
        )
    if source is not None and source.frame is not None:
        return f"{start}: cell.yaml asks for the frame {source.frame!r}; correct `{ROLES[role].entry}: {{frame: …}}`."
    if role is Role.POSE and all(is_command_name(info.channel.topic) for info in typed):
        return (
            f"{start}, since by their names they are commands; record the measured flange pose as {POSE_STAMPED} too, "
            "or name it with --pose-topic if one of them is measured."
        )
    return ""


def is_undeclared(info: ChannelInfo) -> bool:
    """Return whether a channel holds numbers whose meaning has to be declared."""
    return info.channel.type_name in UNDECLARED or info.channel.encoding not in ("cdr", "ros1")


def _words(topic: str) -> list[str]:
    spaced = re.sub(r"(?<=[a-z0-9])(?=[A-Z])", " ", topic).lower()
    return re.findall(r"[a-z]+", spaced)


def ambiguous_sentence(role: Role, found: Infos, log: str) -> str:
    """List the candidates for a role and say what chooses among them."""
    names = ", ".join(map(str, found))
    option = f"{ROLES[role].option} or " if ROLES[role].option else ""
    also = " (and, if another is the command, --command-topic)" if role is Role.POSE else ""
    return (
        f"{len(found)} channels of {log} could be the {ROLES[role].label}: {names}; say which one with "
        f"{option}`{ROLES[role].entry}: {{topic: …}}` in cell.yaml{also}."
    )
