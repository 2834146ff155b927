"""One chunk of a ROS 1 bag: unpacked within limits, walked over by a compiled kernel, held against its own index.

A record is a uint32 length, its header, a uint32 length, its data; a header is a row of fields, each a uint32 length
and `name=value`. All numbers are little endian.
"""

import bz2
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field

import lz4.frame  # type: ignore[import-untyped]  # the package carries no annotations
import numpy as np
from numpy.typing import NDArray

from problems.compiled import compiled

from ...signals.recording import StampArray
from .channel import CHUNK_LIMIT_BYTES, ByteArray, Damage, u32

_FEED_BYTES = 2**16
_INDEX_ENTRY = np.dtype([("s", "<u4"), ("ns", "<u4"), ("offset", "<u4")])
_ROWS = 16_384
_HEADER_LIMIT = 2**20
_OP, _CONN, _TIME_S, _TIME_NS, _AT, _START, _SIZE, _NEXT = range(8)
_COLUMNS = 8
_MESSAGE = 2


@dataclass(frozen=True, kw_only=True)
class ChunkRecord:
    """The record of a chunk: its place, its compression, its declared unpacked size, and where its data lie.

    `stored` is how many bytes of its data there are; `is_whole` is False where that is fewer than the record says.
    Messages per connection and their time span are what the index says, nothing without one.
    """

    offset: int
    compression: str
    declared: int
    data_at: int
    stored: int
    is_whole: bool
    counts: Mapping[int, int] = field(default_factory=dict)
    start_ns: int = 0
    end_ns: int = 0


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


def unpack_chunk(record: ChunkRecord, read: Callable[[int, int], bytes]) -> bytes:
    """Unpack a chunk, `read` from offset and size; raise Damage unless they give what the record declares."""
    declared, most = record.declared, max(record.declared, record.stored)
    if most > CHUNK_LIMIT_BYTES:
        raise Damage(record.offset, f"a chunk of {most} bytes is more than the {CHUNK_LIMIT_BYTES} that are allowed")
    packed = read(record.data_at, record.stored)
    if record.compression == "none":
        data = packed
    elif record.compression in ("bz2", "lz4"):
        data = _decompress(record, packed)
    else:
        raise Damage(record.offset, f"the chunk's compression {record.compression!r} is not one of none, bz2 or lz4")
    if record.is_whole and len(data) != declared:
        more = " or more" if len(data) > declared else ""
        raise Damage(record.offset, f"a chunk should unpack to {declared} bytes, its data give {len(data)}{more}")
    return data


def _decompress(record: ChunkRecord, packed: bytes) -> bytes:
    """Unpack at most one byte more than declared; of data that break off keep what comes before."""
    kind = record.compression
    unpacker = bz2.BZ2Decompressor() if kind == "bz2" else lz4.frame.LZ4FrameDecompressor()
    pieces: list[bytes] = []
    left, at = record.declared + 1, 0
    try:
        while left > 0 and not unpacker.eof and (at < len(packed) or not unpacker.needs_input):
            feed = b""
            if unpacker.needs_input:
                feed, at = packed[at : at + _FEED_BYTES], at + _FEED_BYTES
            pieces.append(unpacker.decompress(feed, max_length=left))
            left -= len(pieces[-1])
    except (OSError, RuntimeError, EOFError, ValueError, MemoryError) as error:
        if record.is_whole:
            raise Damage(record.offset, f"the chunk's {kind} data cannot be unpacked ({error})") from error
    if record.is_whole and left > 0 and not unpacker.eof:
        raise Damage(record.offset, f"the chunk's {kind} data break off")
    return b"".join(pieces)


def check_index(index: Iterable[tuple[int, int, bytes]], record: ChunkRecord, walk: Walk) -> None:
    """Raise Damage unless the index names exactly the messages of a chunk, with their times.

    `index` has offset, connection and entries of each index record.
    """
    expected = {number: count for number, count in record.counts.items() if count}
    is_message = walk.ops == _MESSAGE
    held = Counter(walk.connections[is_message].tolist())
    if held != expected:
        raise Damage(
            record.offset,
            f"the chunk here holds {held.total()} messages, the index counts {sum(expected.values())} or others",
        )
    # An entry may point at the connection before its message.
    rows = np.where(is_message, np.arange(walk.ops.size), walk.ops.size)
    message_from = np.minimum.accumulate(rows[::-1])[::-1]
    for offset, number, data in index:
        entries = np.frombuffer(data, dtype=_INDEX_ENTRY)
        at = np.minimum(np.searchsorted(walk.offsets, entries["offset"]), walk.offsets.size - 1)
        found = np.flatnonzero(is_message & (walk.connections == number))
        chosen = message_from[at] if walk.offsets.size else at
        order = np.argsort(chosen, kind="stable")
        log_ns = entries["s"].astype(np.int64) * 10**9 + entries["ns"]
        if (
            not np.array_equal(chosen[order], found)
            or not np.array_equal(walk.offsets[at], entries["offset"])
            or not np.array_equal(log_ns[order], walk.log_ns[found])
        ):
            raise Damage(offset, f"the index of connection {number} does not agree with the chunk before it")


def walk_chunk(data: bytes, *, resume: bool) -> Walk:
    """Find all messages and connections of an unpacked chunk.

    With `resume` the walk goes on at the next sound record behind a place that holds none.
    """
    array = np.frombuffer(data, dtype=np.uint8)
    rows: list[NDArray[np.int64]] = []
    position, broken_at = 0, -1
    while position < array.size:
        piece = np.empty((_ROWS, _COLUMNS), dtype=np.int64)
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


@compiled
def _is_name(data: ByteArray, at: int, a: int, b: int, c: int, d: int) -> bool:
    return bool(data[at] == a and data[at + 1] == b and data[at + 2] == c and data[at + 3] == d and data[at + 4] == 61)


@compiled
def _record(data: ByteArray, at: int, row: NDArray[np.int64]) -> bool:
    """Parse the record at an offset into `row`; return whether it is a message or a connection."""
    size = data.size
    if at + 8 > size:
        return False
    header = u32(data, at)
    if header < 8 or header > _HEADER_LIMIT or at + 8 + header > size:
        return False
    position, end = at + 4, at + 4 + header
    row[_OP], row[_CONN], row[_TIME_S], row[_TIME_NS] = -1, -1, -1, 0
    while position < end:
        if position + 4 > end:
            return False
        length = u32(data, position)
        position += 4
        if length < 2 or position + length > end:
            return False
        if length == 4 and data[position] == 111 and data[position + 1] == 112 and data[position + 2] == 61:
            row[_OP] = data[position + 3]
        elif length == 9 and _is_name(data, position, 99, 111, 110, 110):
            row[_CONN] = u32(data, position + 5)
        elif length == 13 and _is_name(data, position, 116, 105, 109, 101):
            row[_TIME_S] = u32(data, position + 5)
            row[_TIME_NS] = u32(data, position + 9)
        position += length
    row[_AT] = at
    row[_START] = end + 4
    row[_SIZE] = u32(data, end)
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
