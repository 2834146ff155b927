"""What a channel's type means: does the log define it as the standard does, and does it start with a header."""

from functools import cache

from rosbags.interfaces.typing import Typesdict
from rosbags.typesys import Stores, TypesysError, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from ..errors import LogError
from .channel import Channel

WRENCH = "geometry_msgs/msg/WrenchStamped"
POSE = "geometry_msgs/msg/PoseStamped"
JOINT_STATE = "sensor_msgs/msg/JointState"
_HEADER = "std_msgs/msg/Header"
_NEEDED_WITH = (
    _HEADER,
    "builtin_interfaces/msg/Time",
    "geometry_msgs/msg/Wrench",
    "geometry_msgs/msg/Vector3",
    "geometry_msgs/msg/Pose",
    "geometry_msgs/msg/Point",
    "geometry_msgs/msg/Quaternion",
)


@cache
def _standard_store(encoding: str) -> Typestore:
    return get_typestore(Stores.ROS1_NOETIC if encoding == "ros1" else Stores.ROS2_HUMBLE)


@cache
def types_of(channel: Channel) -> Typesdict:
    """Parse the definition that the log carries; empty when it carries none or one that cannot be parsed."""
    if not channel.definition:
        return {}
    try:
        return get_types_from_msg(channel.definition, channel.type_name)
    except (TypesysError, ValueError, LookupError, AssertionError, RecursionError):
        return {}


def has_header(channel: Channel) -> bool:
    """Tell whether messages begin with a `std_msgs/msg/Header`."""
    if channel.encoding not in ("cdr", "ros1"):
        return False
    types = types_of(channel) or _standard_store(channel.encoding).fielddefs
    fields = types.get(channel.type_name, ([], []))[1]
    return bool(fields) and fields[0][1][1] == _HEADER


def is_standard(channel: Channel) -> bool:
    """Tell whether the log's own definition, if there is one, has the fields of the standard type."""
    known = _standard_store(channel.encoding).fielddefs
    return channel.type_name in known and all(
        name in known and [field[1] for field in known[name][1]] == [field[1] for field in fields]
        for name, (_, fields) in types_of(channel).items()
        if name == channel.type_name or name in _NEEDED_WITH
    )


@cache
def store_for(channel: Channel) -> Typestore:
    """Build a type store from the log's own definition, completed by standard types it leaves out."""
    known = _standard_store(channel.encoding).fielddefs
    own = types_of(channel)
    if channel.type_name not in own and channel.type_name not in known:
        raise LogError(
            f"Type {channel.type_name} of topic {channel.topic} is not defined in the log and is no standard type."
        )
    if channel.type_name not in own:
        return _standard_store(channel.encoding)
    store = get_typestore(Stores.EMPTY)
    try:
        store.register({**{name: known[name] for name in _NEEDED_WITH}, **own})
    except (TypesysError, ValueError, LookupError, AssertionError, SyntaxError) as error:
        raise LogError(f"The definition of {channel.type_name} in the log cannot be used: {error}.") from error
    return store
