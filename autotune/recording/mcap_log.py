"""Write stamped wrenches, poses and texts as a ROS 2 MCAP through the official writer library."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from typing import IO, Any

from autotune.formats.atomic import sweep_leftovers, temporary_beside

_HEADER = """std_msgs/Header header
{body}
================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
================================================================================
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
"""
_VECTOR = "float64 x\nfloat64 y\nfloat64 z\n"
_SEPARATOR = "=" * 80
_WRENCH_STAMPED = _HEADER.format(body="geometry_msgs/Wrench wrench") + (
    f"{_SEPARATOR}\nMSG: geometry_msgs/Wrench\ngeometry_msgs/Vector3 force\ngeometry_msgs/Vector3 torque\n"
    f"{_SEPARATOR}\nMSG: geometry_msgs/Vector3\n{_VECTOR}"
)
_POSE_STAMPED = _HEADER.format(body="geometry_msgs/Pose pose") + (
    f"{_SEPARATOR}\nMSG: geometry_msgs/Pose\ngeometry_msgs/Point position\ngeometry_msgs/Quaternion orientation\n"
    f"{_SEPARATOR}\nMSG: geometry_msgs/Point\n{_VECTOR}"
    f"{_SEPARATOR}\nMSG: geometry_msgs/Quaternion\n{_VECTOR}float64 w\n"
)
_STRING = "string data\n"
_LOG = """builtin_interfaces/Time stamp
uint8 level
string name
string msg
string file
string function
uint32 line
================================================================================
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
"""
_LOG_INFO = 20


class StampedKind(Enum):
    """What a channel holds: name of the entry, definition of the message, and the parts of a row."""

    WRENCH = ("wrench", _WRENCH_STAMPED, (("force", "xyz"), ("torque", "xyz")))
    POSE = ("pose", _POSE_STAMPED, (("position", "xyz"), ("orientation", "xyzw")))

    @property
    def type_name(self) -> str:
        """The message's type, as in `geometry_msgs/msg/WrenchStamped`."""
        return f"geometry_msgs/msg/{self.value[0].capitalize()}Stamped"

    @property
    def definition(self) -> str:
        """The definition of the message."""
        return self.value[1]

    @property
    def width(self) -> int:
        """How many numbers a row has."""
        return sum(len(components) for _, components in self.value[2])

    def body(self, row: Sequence[float]) -> dict[str, Any]:
        """Return the entry of a message that holds a row."""
        parts, at = {}, 0
        for part, components in self.value[2]:
            parts[part] = dict(zip(components, row[at : at + len(components)], strict=True))
            at += len(components)
        return parts


@dataclass(frozen=True, kw_only=True)
class StampedChannel:
    """One topic: stamps [ns] in rising order, of each a row: force and torque, or position and quaternion x y z w."""

    topic: str
    frame_id: str
    kind: StampedKind
    stamps_ns: Sequence[int]
    row: Callable[[int], Sequence[float]]

    def message(self, i: int) -> dict[str, Any]:
        """Return the i-th message."""
        stamp = {"sec": self.stamps_ns[i] // 10**9, "nanosec": self.stamps_ns[i] % 10**9}
        header = {"stamp": stamp, "frame_id": self.frame_id}
        return {"header": header, self.kind.value[0]: self.kind.body(self.row(i))}


class TextKind(Enum):
    """What a channel of texts holds: type of the message and its definition."""

    STRING = ("std_msgs/msg/String", _STRING)
    LOG = ("rcl_interfaces/msg/Log", _LOG)

    @property
    def type_name(self) -> str:
        """The message's type."""
        return self.value[0]

    @property
    def definition(self) -> str:
        """The definition of the message."""
        return self.value[1]


@dataclass(frozen=True, kw_only=True)
class TextChannel:
    """One topic of texts, each from its stamp [ns] on; the stamps rise."""

    topic: str
    kind: TextKind
    stamps_ns: Sequence[int]
    texts: Sequence[str]

    def message(self, i: int) -> dict[str, Any]:
        """Return the i-th message; a line of a log has its stamp and bears the name of this program."""
        if self.kind is TextKind.STRING:
            return {"data": self.texts[i]}
        stamp = {"sec": self.stamps_ns[i] // 10**9, "nanosec": self.stamps_ns[i] % 10**9}
        where = {"file": "", "function": "", "line": 0}
        return {"stamp": stamp, "level": _LOG_INFO, "name": "autotune", "msg": self.texts[i], **where}


def write_channels(
    channels: Sequence[StampedChannel | TextChannel], path: Path, *, progress: Callable[[int], None] | None = None
) -> None:
    """Write channels as zstd-compressed CDR in the order of their stamps, whole or not at all.

    `progress` receives the number of messages written since the last call. Log and publish time equal the stamp.
    """
    sweep_leftovers(path.parent)
    partial, _ = temporary_beside(path)
    try:
        with partial.open("wb") as stream:
            _write(stream, channels, progress)
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)


def _write(
    stream: IO[bytes], channels: Sequence[StampedChannel | TextChannel], progress: Callable[[int], None] | None
) -> None:
    from mcap_ros2.writer import Writer  # noqa: PLC0415 - not while the loop runs

    writer = Writer(stream)
    kinds: dict[StampedKind | TextKind, None] = dict.fromkeys(channel.kind for channel in channels)
    registered = {kind: writer.register_msgdef(kind.type_name, kind.definition) for kind in kinds}
    order = sorted((stamp, c, i) for c, channel in enumerate(channels) for i, stamp in enumerate(channel.stamps_ns))
    since = 0
    for sequence, (stamp, c, i) in enumerate(order):
        channel = channels[c]
        writer.write_message(
            topic=channel.topic,
            schema=registered[channel.kind],
            message=channel.message(i),
            log_time=stamp,
            publish_time=stamp,
            sequence=sequence,
        )
        since += 1
        if progress is not None and since == 5000:
            progress(since)
            since = 0
    if progress is not None:
        progress(since)
    writer.finish()
