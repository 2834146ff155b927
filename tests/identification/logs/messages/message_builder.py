"""Random messages of any type, serialised by rosbags, and containers that hold them in memory."""

from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from identification.logs.containers.channel import Batch, Channel, Container, Held, Survey, T
from identification.logs.gather import gather
from identification.logs.messages.decode import Series, Wanted
from identification.logs.messages.objects import build_decoder

ADMITTANCE = "control_msgs/msg/AdmittanceControllerState"
MIXED = "test_msgs/msg/Mixed"
NESTED = "test_msgs/msg/Nested"
_ADMITTANCE_TEXT = """
std_msgs/Float64MultiArray mass
std_msgs/Float64MultiArray damping
std_msgs/Float64MultiArray stiffness
geometry_msgs/Quaternion rot_base_control
geometry_msgs/TransformStamped ref_trans_base_ft
std_msgs/Int8MultiArray selected_axes
std_msgs/String ft_sensor_frame
geometry_msgs/WrenchStamped wrench_base
sensor_msgs/JointState joint_state_error
"""
_MIXED_TEXT = """
bool flag
std_msgs/Header header
int8 a
uint64 b
uint8 c
int16 d
float32 e
string note
int64 f
uint16[3] g
float64 h
string[] names
float32[] i
uint32 j
test_msgs/Nested[2] pair
test_msgs/Nested[] several
int32[<=4] k
bool[] l
"""
_NESTED_TEXT = """
uint8 kind
string[2] labels
float64[] data
geometry_msgs/Point[] points
int16 last
"""

Encoding = Literal["little", "big", "ros1"]
ENCODINGS: tuple[Encoding, ...] = ("little", "big", "ros1")


def _store(base: Stores) -> Typestore:
    store = get_typestore(base)
    for name, text in ((NESTED, _NESTED_TEXT), (MIXED, _MIXED_TEXT), (ADMITTANCE, _ADMITTANCE_TEXT)):
        store.register(get_types_from_msg(text, name))
    if "tf2_msgs/msg/TFMessage" not in store.fielddefs:
        store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", "tf2_msgs/msg/TFMessage"))
    return store


ROS2, ROS1 = _store(Stores.ROS2_HUMBLE), _store(Stores.ROS1_NOETIC)


def store_of(encoding: Encoding) -> Typestore:
    return ROS1 if encoding == "ros1" else ROS2


def channel_of(type_name: str, encoding: Encoding, topic: str = "/topic") -> Channel:
    version = 1 if encoding == "ros1" else 2
    return Channel(
        topic=topic,
        type_name=type_name,
        encoding="ros1" if encoding == "ros1" else "cdr",
        schema_encoding=f"ros{version}msg",
        schema=store_of(encoding).generate_msgdef(type_name, ros_version=version)[0].encode(),
    )


def serialise(message: object, type_name: str, encoding: Encoding) -> bytes:
    if encoding == "ros1":
        return bytes(ROS1.serialize_ros1(message, type_name))
    return bytes(ROS2.serialize_cdr(message, type_name, little_endian=encoding == "little"))


def deserialise(data: bytes, type_name: str, encoding: Encoding) -> Any:
    store = store_of(encoding)
    return (store.deserialize_ros1 if encoding == "ros1" else store.deserialize_cdr)(data, type_name)


class RandomMessages:
    """Draw messages whose doubles are any bits at all and whose strings and sequences have any small length."""

    def __init__(self, seed: int, encoding: Encoding, entries: int | None = None) -> None:
        self._random = np.random.default_rng(seed)
        self._store, self._entries = store_of(encoding), entries

    def message(self, type_name: str) -> Any:
        fields = self._store.fielddefs[type_name][1]
        values = {name: self._value(description) for name, description in fields}
        if type_name == "builtin_interfaces/msg/Time":
            values["nanosec"] = int(self._random.integers(0, 10**9))
        return self._store.types[type_name](**values)

    def _value(self, description: Any) -> Any:
        kind, inside = description
        if kind == Nodetype.NAME:
            return self.message(inside)
        if kind == Nodetype.BASE:
            return self._text() if inside[0] == "string" else self._numbers(inside[0], 1)[0].item()
        inner, limit = inside
        few = self._entries if self._entries is not None else int(self._random.integers(0, 5))
        count = limit if kind == Nodetype.ARRAY else few
        if inner[0] == Nodetype.BASE and inner[1][0] != "string":
            return self._numbers(inner[1][0], count)
        return [self._value(inner) for _ in range(count)]

    def _text(self) -> str:
        length = int(self._random.integers(0, 12))
        return "".join(self._random.choice(list("ab/_0é漢"), size=length))

    def _numbers(self, name: str, count: int) -> Any:
        if name == "bool":
            return self._random.integers(0, 2, count).astype(bool)
        dtype = np.dtype({"byte": "i1", "char": "u1"}.get(name, name))
        return np.frombuffer(self._random.bytes(count * dtype.itemsize), dtype=dtype)


def number_paths(store: Typestore, type_name: str, entries: int) -> Iterator[str]:
    """Yield the path of every number in a type, of sequences of numbers the first `entries`, of others none."""
    for name, description in store.fielddefs[type_name][1]:
        yield from (f"{name}{rest}" for rest in _paths_below(store, description, entries))


def _paths_below(store: Typestore, description: Any, entries: int) -> Iterator[str]:
    kind, inside = description
    if kind == Nodetype.NAME:
        yield from (f".{path}" for path in number_paths(store, inside, entries))
    elif kind == Nodetype.BASE:
        if inside[0] != "string":
            yield ""
    else:
        inner, limit = inside
        if kind == Nodetype.ARRAY or inner[0] == Nodetype.BASE:
            for index in range(limit if kind == Nodetype.ARRAY else entries):
                yield from (f"[{index}]{rest}" for rest in _paths_below(store, inner, entries))


def batch_of(channel: Channel, messages: Sequence[bytes], gap: bytes = b"\xa5\xa5\xa5") -> Batch:
    """Put messages into a batch, with bytes of no meaning before, between and behind them."""
    data, starts = bytearray(gap), []
    for message in messages:
        starts.append(len(data))
        data += message + gap
    return Batch(
        channel=channel,
        log_ns=np.arange(len(messages), dtype=np.int64),
        data=np.frombuffer(bytes(data), dtype=np.uint8),
        starts=np.array(starts, dtype=np.int64),
        sizes=np.array([len(message) for message in messages], dtype=np.int64),
    )


@dataclass(frozen=True)
class MemoryContainer(Container):
    """A container of batches that are there already."""

    batches: tuple[Batch, ...]

    def survey(self) -> Survey:
        counts = Counter[Channel]()
        for batch in self.batches:
            counts[batch.channel] += batch.count
        held = tuple(Held(channel=channel, count=count, first_message=b"") for channel, count in counts.items())
        return Survey(container="memory", held=held, start_ns=0, end_ns=0, findings=())

    def read(self, wanted: Collection[Channel], handle: Callable[[Batch], T]) -> Iterator[tuple[Channel, T]]:
        for batch in self.batches:
            if batch.channel in wanted:
                yield batch.channel, handle(batch)


def read_series(container: Container, wanted: Mapping[Channel, Wanted]) -> dict[Channel, Series]:
    """Read channels of a container as an opened log does."""
    return gather(container, {channel: build_decoder(channel, each) for channel, each in wanted.items()}, wanted)
