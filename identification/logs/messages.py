"""Decode messages: headers and rows of doubles by array views, other layouts one by one through `rosbags`.

A message is a header and then `width` doubles. CDR: 4 bytes of encapsulation (the second says the byte order), stamp as
int32 s and uint32 ns, frame name as uint32 length with its final zero and the characters, doubles aligned to 8 counted
from byte 4. ROS 1: uint32 sequence, stamp as uint32 s and ns, frame name without a zero, no alignment, little endian.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import reduce

import numpy as np
from numpy.typing import NDArray
from rosbags.serde import SerdeError

from ..errors import LogError
from ..recording import FloatArray, StampArray
from .channel import ByteArray, RawChannel
from .definitions import is_standard, store_for

_FIXED = 16
WRENCH_FIELDS = tuple(f"wrench.{part}.{axis}" for part in ("force", "torque") for axis in "xyz")
POSE_FIELDS = tuple(f"pose.{name}" for name in ("position.x", "position.y", "position.z")) + tuple(
    f"pose.orientation.{axis}" for axis in "xyzw"
)


@dataclass(frozen=True, kw_only=True)
class Headers:
    """Header stamps (n,) in ns as the sender wrote them, and the different frame names that occur."""

    stamp_ns: StampArray
    frame_ids: tuple[str, ...]


@dataclass(frozen=True, kw_only=True)
class _Group:
    """Messages of equal size, byte order (`<` or `>`) and frame name length: `rows` (k, size)."""

    index: NDArray[np.intp]
    rows: ByteArray
    order: str
    frame_bytes: int


def decode_headers(raw: RawChannel) -> Headers:
    """Decode the header of every message; raise LogError where one is no header."""
    stamp_ns = np.zeros(raw.count, dtype=np.int64)
    frames: set[str] = set()
    second_type = "u4" if raw.channel.encoding == "ros1" else "i4"
    for group in _groups(raw):
        seconds = _column(group, 4, second_type).astype(np.int64)
        nanoseconds = _column(group, 8, "u4").astype(np.int64)
        if bool(np.any(nanoseconds >= 10**9)):
            raise LogError(f"Topic {raw.channel.topic} holds a header stamp with {nanoseconds.max()} ns in a second.")
        stamp_ns[group.index] = seconds * 10**9 + nanoseconds
        frames |= _frame_names(raw, group)
    return Headers(stamp_ns=stamp_ns, frame_ids=tuple(sorted(frames)))


def decode_values(raw: RawChannel, fields: tuple[str, ...]) -> FloatArray:
    """Decode the doubles after the header, (n, len(fields)), in the order of `fields`.

    Raises LogError when the messages do not have the size of their type or the log's definition lacks a field.
    """
    if not is_standard(raw.channel):
        return _decode_by_name(raw, fields)
    values = np.zeros((raw.count, len(fields)))
    for group in _groups(raw):
        start = _FIXED + group.frame_bytes
        slack = 0
        if raw.channel.encoding == "cdr":
            start = 4 + -(-(start - 4) // 8) * 8
            slack = 3
        end = start + 8 * len(fields)
        size = group.rows.shape[1]
        if not end <= size <= end + slack:
            raise LogError(
                f"Topic {raw.channel.topic} holds messages of {size} bytes, {raw.channel.type_name} takes {end}; "
                "its type in the log is wrong or the messages are damaged."
            )
        block = np.ascontiguousarray(group.rows[:, start:end])
        values[group.index] = block.view(group.order + "f8")
    return values


def decode_objects(raw: RawChannel, step: int = 1) -> Iterator[object]:
    """Decode every `step`-th message one by one with the definition in the log; raise LogError on damage."""
    store = store_for(raw.channel)
    decode = store.deserialize_ros1 if raw.channel.encoding == "ros1" else store.deserialize_cdr
    ends = np.cumsum(raw.sizes)
    for index in range(0, raw.count, step):
        message = raw.payload[ends[index] - raw.sizes[index] : ends[index]].tobytes()
        try:
            yield decode(message, raw.channel.type_name)
        except (SerdeError, LookupError, ValueError, AssertionError, MemoryError) as error:
            raise LogError(
                f"Message {index + 1} of topic {raw.channel.topic} is no {raw.channel.type_name}: {error}."
            ) from error


def _decode_by_name(raw: RawChannel, fields: tuple[str, ...]) -> FloatArray:
    paths = [field.split(".") for field in fields]
    try:
        rows = [[float(reduce(getattr, path, message)) for path in paths] for message in decode_objects(raw)]  # type: ignore[arg-type]
    except (AttributeError, TypeError) as error:
        raise LogError(
            f"Type {raw.channel.type_name} as the log defines it for topic {raw.channel.topic} "
            f"lacks a number among {', '.join(fields)}: {error}."
        ) from error
    return np.array(rows, dtype=np.float64).reshape(raw.count, len(fields))


def _groups(raw: RawChannel) -> Iterator[_Group]:
    starts = np.cumsum(raw.sizes) - raw.sizes
    order = np.argsort(raw.sizes, kind="stable")
    for index in np.split(order, np.flatnonzero(np.diff(raw.sizes[order])) + 1):
        if not index.size:
            continue
        size = int(raw.sizes[index[0]])
        if size < _FIXED:
            raise LogError(
                f"Message {index.min() + 1} of topic {raw.channel.topic} has {size} bytes, a header takes {_FIXED}."
            )
        if index.size == raw.count:
            rows = raw.payload.reshape(raw.count, size)
        else:
            rows = raw.payload[starts[index][:, None] + np.arange(size)]
        yield from _by_frame(raw, index, rows)


def _by_frame(raw: RawChannel, index: NDArray[np.intp], rows: ByteArray) -> Iterator[_Group]:
    little = np.ones(len(rows), dtype=bool)
    if raw.channel.encoding == "cdr":
        if bool(np.any(rows[:, 0] != 0)) or bool(np.any(rows[:, 1] > 1)):
            raise LogError(
                f"Topic {raw.channel.topic} holds messages whose encapsulation is not plain CDR (00 00 or 00 01); "
                "record with an RMW that writes plain CDR."
            )
        little = rows[:, 1] == 1
    block = np.ascontiguousarray(rows[:, 12:16])
    lengths = np.where(little, block.view("<u4")[:, 0], block.view(">u4")[:, 0]).astype(np.int64)
    keys = lengths * 2 + little
    for key in np.unique(keys):
        chosen = keys == key
        yield _Group(
            index=index[chosen],
            rows=rows if bool(np.all(chosen)) else rows[chosen],
            order="<" if key % 2 else ">",
            frame_bytes=int(key // 2),
        )


def _column(group: _Group, start: int, kind: str) -> NDArray[np.integer]:
    return np.ascontiguousarray(group.rows[:, start : start + 4]).view(group.order + kind)[:, 0]


def _frame_names(raw: RawChannel, group: _Group) -> set[str]:
    available = group.rows.shape[1] - _FIXED
    kept = min(group.frame_bytes, available)
    text = group.rows[:, _FIXED : _FIXED + kept]
    different = text[:1] if bool(np.all(text == text[:1])) else np.unique(text, axis=0)
    try:
        return {row.tobytes().rstrip(b"\x00").decode() for row in different}
    except UnicodeDecodeError as error:
        raise LogError(f"Topic {raw.channel.topic} holds a header whose frame name is no text: {error}.") from error
