"""What a channel's type means: the definition that the log carries, completed by the standard types it leaves out."""

from functools import cache
from typing import Any

from rosbags.interfaces import Nodetype
from rosbags.interfaces.typing import Typesdict
from rosbags.typesys import Stores, TypesysError, get_types_from_idl, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from ...errors import LogError
from ..containers.channel import Channel

WRENCH = "geometry_msgs/msg/WrenchStamped"
POSE = "geometry_msgs/msg/PoseStamped"
TWIST = "geometry_msgs/msg/TwistStamped"
TRANSFORM = "geometry_msgs/msg/TransformStamped"
TRANSFORMS = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")
JOINT_STATE = "sensor_msgs/msg/JointState"
HEADER = "std_msgs/msg/Header"
TIME = "builtin_interfaces/msg/Time"
ROS_ENCODINGS = ("cdr", "ros1")
_FOREIGN = (TypesysError, ValueError, LookupError, AssertionError, RecursionError, SyntaxError)


@cache
def _standard(encoding: str) -> Typestore:
    return get_typestore(Stores.ROS1_NOETIC if encoding == "ros1" else Stores.ROS2_HUMBLE)


@cache
def types_of(channel: Channel) -> Typesdict:
    """Parse the definition that the log carries, empty when it carries none; raise LogError if it cannot be parsed."""
    if not channel.schema or channel.schema_encoding not in ("ros2msg", "ros1msg", "ros2idl"):
        return {}
    try:
        text = channel.schema.decode()
        if channel.schema_encoding == "ros2idl":
            return get_types_from_idl(text)
        return get_types_from_msg(text, channel.type_name)
    except _FOREIGN as error:
        raise LogError(
            f"The definition of {channel.type_name} in the log, for topic {channel.topic}, cannot be parsed: {error}."
        ) from error


@cache
def needed_types(channel: Channel) -> Typesdict:
    """Return the definition of a ROS type and of all types inside it; raise LogError where one is missing."""
    own = types_of(channel)
    found: Typesdict = {}
    missing = [channel.type_name]
    while missing:
        name = missing.pop()
        if name in found:
            continue
        definition = own.get(name) or _standard(channel.encoding).fielddefs.get(name)
        if definition is None:
            raise LogError(f"Type {name} of topic {channel.topic} is not defined in the log and is no standard type.")
        found[name] = definition
        for _, description in found[name][1]:
            missing += _names_in(description)
    return found


def _names_in(description: Any) -> list[str]:
    """Return the type that a field consists of, if it is no primitive one."""
    kind, inside = description
    if kind in (Nodetype.ARRAY, Nodetype.SEQUENCE):
        return _names_in(inside[0])
    return [inside] if kind == Nodetype.NAME else []


def has_header(channel: Channel) -> bool:
    """Return whether messages begin with a `std_msgs/msg/Header`."""
    if channel.encoding not in ROS_ENCODINGS:
        return False
    try:
        fields = needed_types(channel)[channel.type_name][1]
    except LogError:
        return False
    return bool(fields) and fields[0][1][1] == HEADER


def is_standard(channel: Channel) -> bool:
    """Return whether the log's own definition, if there is one, has the fields of the standard type."""
    known = _standard(channel.encoding).fielddefs
    try:
        types = needed_types(channel)
    except LogError:
        return False
    return all(
        name in known and [tuple(field) for field in known[name][1]] == [tuple(field) for field in fields]
        for name, (_, fields) in types.items()
    )


@cache
def store_for(channel: Channel) -> Typestore:
    """Build a type store from the log's own definition, completed by standard types it leaves out."""
    types = needed_types(channel)
    store = get_typestore(Stores.EMPTY)
    try:
        store.register(types)
    except _FOREIGN as error:
        raise LogError(f"The definition of {channel.type_name} in the log cannot be used: {error}.") from error
    return store
