"""Write stamped wrenches, poses and texts as a ROS 2 MCAP; the official library writes the file's structure."""

import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from typing import IO

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
# What a message begins with: CDR of little-endian numbers. Alignment counts from behind it.
_ENCAPSULATION = bytes((0, 1, 0, 0))


class StampedKind(Enum):
    """What a channel holds: name of the entry, definition of the message, and how many numbers a row has."""

    WRENCH = ("wrench", _WRENCH_STAMPED, 6)
    POSE = ("pose", _POSE_STAMPED, 7)

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
        return self.value[2]


@dataclass(frozen=True, kw_only=True)
class StampedChannel:
    """One topic: stamps [ns] in rising order, of each a row: force and torque, or position and quaternion x y z w."""

    topic: str
    frame_id: str
    kind: StampedKind
    stamps_ns: Sequence[int]
    row: Callable[[int], Sequence[float]]

    def messages(self) -> Callable[[int], bytes]:
        """Return the function that encodes the i-th message: header, then the row, whose numbers are aligned to 8."""
        name = _string(self.frame_id)
        head = struct.Struct("<iI")
        row = struct.Struct(f"<{self.kind.width}d")
        between = name + bytes(-(head.size + len(name)) % 8)

        def encoded(i: int) -> bytes:
            stamp = divmod(self.stamps_ns[i], 10**9)
            return b"".join((_ENCAPSULATION, head.pack(*stamp), between, row.pack(*self.row(i))))

        return encoded


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

    def messages(self) -> Callable[[int], bytes]:
        """Return the function that encodes the i-th message; a line of a log bears the name of this program."""
        return self._text if self.kind is TextKind.STRING else self._line

    def _text(self, i: int) -> bytes:
        return _ENCAPSULATION + _string(self.texts[i])

    def _line(self, i: int) -> bytes:
        body = struct.pack("<iIB", *divmod(self.stamps_ns[i], 10**9), _LOG_INFO)
        for text in ("autotune", self.texts[i], "", ""):
            body = _aligned(body) + _string(text)
        return _ENCAPSULATION + _aligned(body) + struct.pack("<I", 0)


def _string(text: str) -> bytes:
    """Return the length, the text and the zero that ends it."""
    data = text.encode() + b"\0"
    return struct.pack("<I", len(data)) + data


def _aligned(body: bytes) -> bytes:
    """Return a message's content, filled up to where a length or a number of 4 bytes may begin."""
    return body + bytes(-len(body) % 4)


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
    from mcap.well_known import MessageEncoding, SchemaEncoding  # noqa: PLC0415 - not while the loop runs
    from mcap.writer import Writer  # noqa: PLC0415

    writer = Writer(stream)
    writer.start(profile="ros2")
    kinds: dict[StampedKind | TextKind, None] = dict.fromkeys(channel.kind for channel in channels)
    schemas = {
        kind: writer.register_schema(kind.type_name, SchemaEncoding.ROS2, kind.definition.encode()) for kind in kinds
    }
    numbers = [
        writer.register_channel(channel.topic, MessageEncoding.CDR, schemas[channel.kind]) for channel in channels
    ]
    encoders = [channel.messages() for channel in channels]
    order = sorted((stamp, c, i) for c, channel in enumerate(channels) for i, stamp in enumerate(channel.stamps_ns))
    since = 0
    for sequence, (stamp, c, i) in enumerate(order):
        writer.add_message(numbers[c], stamp, encoders[c](i), stamp, sequence)
        since += 1
        if progress is not None and since == 5000:
            progress(since)
            since = 0
    if progress is not None:
        progress(since)
    writer.finish()
