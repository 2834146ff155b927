"""Where the numbers of each role stand in the standard message types."""

from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum

from problems.frozen import FrozenDict

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

TRANSFORMS = frozenset({TRANSFORM_STAMPED, TF_MESSAGE, OLD_TF_MESSAGE})
"""Types of which a pair of frames is read."""


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
class Layout:
    """Paths of a role's numbers, in the order that the role has them, and of the header, empty without one."""

    fields: tuple[str, ...]
    header: str


def _vectors(prefix: str, parts: tuple[str, str]) -> tuple[str, ...]:
    return tuple(f"{prefix}{part}.{axis}" for part in parts for axis in "xyz")


_QUATERNION = tuple(f"orientation.{axis}" for axis in "xyzw")
TRANSFORM_FIELDS = (*(f"translation.{axis}" for axis in "xyz"), *(f"rotation.{axis}" for axis in "xyzw"))
_POSE_FIELDS = tuple(f"pose.{name}" for name in (*(f"position.{axis}" for axis in "xyz"), *_QUATERNION))
_WRENCHES = {
    WRENCH_STAMPED: Layout(fields=_vectors("wrench.", ("force", "torque")), header="header"),
    WRENCH: Layout(fields=_vectors("", ("force", "torque")), header=""),
}
_POSES = {
    POSE_STAMPED: Layout(fields=_POSE_FIELDS, header="header"),
    TRANSFORM_STAMPED: Layout(fields=TRANSFORM_FIELDS, header="header"),
    TF_MESSAGE: Layout(fields=TRANSFORM_FIELDS, header="header"),
    OLD_TF_MESSAGE: Layout(fields=TRANSFORM_FIELDS, header="header"),
}
_STATE_WRENCH = Layout(fields=_vectors("wrench_base.wrench.", ("force", "torque")), header="")
_STATE_GAINS = Layout(fields=tuple(f"{name}.data[{i}]" for name in ("mass", "damping") for i in range(6)), header="")

LAYOUTS: Mapping[Role, Mapping[str, Layout]] = FrozenDict(
    {
        Role.WRENCH: {**_WRENCHES, ADMITTANCE_STATE: _STATE_WRENCH},
        Role.POSE: _POSES,
        Role.COMMAND: _POSES,
        Role.TWIST: {TWIST_STAMPED: Layout(fields=_vectors("twist.", ("linear", "angular")), header="header")},
        Role.GAINS: {ADMITTANCE_STATE: _STATE_GAINS},
        Role.DESIRED_FORCE: _WRENCHES,
    }
)

TIERS: Mapping[Role, tuple[frozenset[str], ...]] = FrozenDict(
    {
        Role.WRENCH: (frozenset(_WRENCHES), frozenset({ADMITTANCE_STATE})),
        Role.POSE: (frozenset({POSE_STAMPED}), TRANSFORMS),
        Role.COMMAND: (frozenset({POSE_STAMPED, TRANSFORM_STAMPED}),),
        Role.TWIST: (frozenset({TWIST_STAMPED}),),
        Role.GAINS: (frozenset({ADMITTANCE_STATE}),),
        Role.DESIRED_FORCE: (frozenset(_WRENCHES),),
    }
)
"""Types that serve a role; those of a later tier only where a log has none of the tiers before."""

UNDECLARED = frozenset({JOINT_STATE, FLOAT_ARRAY})
"""Types that hold numbers whose meaning must be declared."""
