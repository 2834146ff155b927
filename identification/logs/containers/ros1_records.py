"""The records of a ROS 1 bag: headers of `name=value` fields, and a compiled walk over the messages of a chunk.

A record is a uint32 length, its header, a uint32 length, its data; a header is a row of fields, each a uint32 length
and `name=value`. All numbers are little endian.
"""

import struct
from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from problems.compiled import compiled

from ...signals.recording import StampArray
from .channel import ByteArray

_PIECE = 16_384
_HEADER_LIMIT = 2**20
_OP, _CONN, _TIME_S, _TIME_NS, _AT, _START, _SIZE, _NEXT = range(8)
_COLUMNS = 8


class Op(IntEnum):
    """Kinds of records."""

    MESSAGE = 2
    BAG_HEADER = 3
    INDEX = 4
    CHUNK = 5
    CHUNK_INFO = 6
    CONNECTION = 7


@dataclass(frozen=True, kw_only=True)
class Walk:
    """The records found in a chunk in order: kind (message or connection), connection, time, and where the data lie.

    `offsets` is where a record starts, `starts` where its data do, both counted from the start of the chunk;
    `broken_at` is that of the first place that holds no record, or -1.
    """

    ops: StampArray
    connections: StampArray
    log_ns: StampArray
    offsets: StampArray
    starts: StampArray
    sizes: StampArray
    broken_at: int


def parse_header(data: bytes) -> dict[str, bytes]:
    """Split a header into its fields; raise ValueError where it is none."""
    fields: dict[str, bytes] = {}
    position = 0
    while position < len(data):
        if position + 4 > len(data):
            raise ValueError("a header field is cut off")
        (size,) = struct.unpack_from("<I", data, position)
        position += 4
        name, separator, value = data[position : position + size].partition(b"=")
        if position + size > len(data) or not separator:
            raise ValueError("a header field is damaged")
        key = name.decode("ascii")
        if key in fields:
            raise ValueError(f"the header field {key} stands twice")
        fields[key] = value
        position += size
    return fields


def walk_chunk(data: bytes, *, resume: bool) -> Walk:
    """Find all messages and connections of an unpacked chunk.

    With `resume` the walk goes on at the next sound record behind a place that holds none.
    """
    array = np.frombuffer(data, dtype=np.uint8)
    rows: list[NDArray[np.int64]] = []
    position, broken_at = 0, -1
    while position < array.size:
        piece = np.empty((_PIECE, _COLUMNS), dtype=np.int64)
        count, position, is_sound = _walk(array, position, piece)
        rows.append(piece[:count])
        if not is_sound:
            broken_at = position if broken_at < 0 else broken_at
            position = _find(array, position + 1) if resume else array.size
    table = np.concatenate(rows) if rows else np.empty((0, _COLUMNS), dtype=np.int64)
    return Walk(
        ops=table[:, _OP],
        connections=table[:, _CONN],
        log_ns=table[:, _TIME_S] * 10**9 + table[:, _TIME_NS],
        offsets=table[:, _AT],
        starts=table[:, _START],
        sizes=table[:, _SIZE],
        broken_at=broken_at,
    )


def copy_messages(data: bytes, starts: StampArray, sizes: StampArray) -> ByteArray:
    """Copy pieces of a buffer one behind the other."""
    packed = np.empty(int(sizes.sum()), dtype=np.uint8)
    _copy(np.frombuffer(data, dtype=np.uint8), starts, sizes, packed)
    return packed


# `parse_header` for the two kinds of records in a chunk; the helpers stand in this file because the disk cache of a
# compiled function asks after the age of this file alone.


@compiled
def _uint32(data: ByteArray, at: int) -> int:
    low = np.int64(data[at]) | np.int64(data[at + 1]) << 8
    return int(low | np.int64(data[at + 2]) << 16 | np.int64(data[at + 3]) << 24)


@compiled
def _is_name(data: ByteArray, at: int, a: int, b: int, c: int, d: int) -> bool:
    return bool(data[at] == a and data[at + 1] == b and data[at + 2] == c and data[at + 3] == d and data[at + 4] == 61)


@compiled
def _record(data: ByteArray, at: int, row: NDArray[np.int64]) -> bool:
    """Parse the record at an offset into `row`; tell whether a message or a connection stands there."""
    size = data.size
    if at + 8 > size:
        return False
    header = _uint32(data, at)
    if header < 8 or header > _HEADER_LIMIT or at + 8 + header > size:
        return False
    position, end = at + 4, at + 4 + header
    row[_OP], row[_CONN], row[_TIME_S], row[_TIME_NS] = -1, -1, -1, 0
    while position < end:
        if position + 4 > end:
            return False
        length = _uint32(data, position)
        position += 4
        if length < 2 or position + length > end:
            return False
        if length == 4 and data[position] == 111 and data[position + 1] == 112 and data[position + 2] == 61:
            row[_OP] = data[position + 3]
        elif length == 9 and _is_name(data, position, 99, 111, 110, 110):
            row[_CONN] = _uint32(data, position + 5)
        elif length == 13 and _is_name(data, position, 116, 105, 109, 101):
            row[_TIME_S] = _uint32(data, position + 5)
            row[_TIME_NS] = _uint32(data, position + 9)
        position += length
    row[_AT] = at
    row[_START] = end + 4
    row[_SIZE] = _uint32(data, end)
    row[_NEXT] = row[_START] + row[_SIZE]
    is_message = row[_OP] == 2 and row[_TIME_S] >= 0 and row[_TIME_NS] < 1_000_000_000
    return bool(row[_NEXT] <= size and row[_CONN] >= 0 and (is_message or row[_OP] == 7))


@compiled
def _walk(data: ByteArray, at: int, rows: NDArray[np.int64]) -> tuple[int, int, bool]:
    """Fill `rows` from an offset on; return how many, where the next record starts, and whether all were sound."""
    count = 0
    while at < data.size and count < len(rows):
        if not _record(data, at, rows[count]):
            return count, at, False
        at = int(rows[count, _NEXT])
        count += 1
    return count, at, True


@compiled
def _find(data: ByteArray, at: int) -> int:
    """Return the offset of the next sound record, or the end."""
    row = np.empty(_COLUMNS, dtype=np.int64)
    while at < data.size:
        if _record(data, at, row):
            return at
        at += 1
    return int(data.size)


@compiled
def _copy(data: ByteArray, starts: StampArray, sizes: StampArray, packed: ByteArray) -> None:
    at = 0
    for i in range(starts.size):
        packed[at : at + sizes[i]] = data[starts[i] : starts[i] + sizes[i]]
        at += sizes[i]
