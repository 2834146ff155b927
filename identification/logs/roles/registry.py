"""The registry of roles: what a channel can be used for, which message types carry it, and what to record."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from enum import StrEnum

from ...result import Finding
from ..containers.channel import Channel
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
        label="controller's gains",
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
