"""One chunk of a ROS 1 bag: unpacked within limits, walked over, and held against its own index."""

import bz2
import struct
from collections import Counter
from collections.abc import Iterator

import lz4.frame  # type: ignore[import-untyped]  # the package carries no annotations
import numpy as np

from .bounded_file import CHUNK_LIMIT_BYTES
from .channel import Channel
from .ros1_index import BagFile, ChunkPlace, Damage, add_connection
from .ros1_records import Op, Walk, parse_header, walk_chunk

_FEED_BYTES = 2**16
_INDEX_ENTRY = np.dtype([("s", "<u4"), ("ns", "<u4"), ("offset", "<u4")])


def read_chunk(file: BagFile, place: ChunkPlace, connections: dict[int, Channel]) -> tuple[bytes, Walk]:
    """Unpack a chunk that the index names and find its messages; raise Damage unless all of it agrees."""
    data = _unpack(file, place)
    walk = walk_chunk(data, resume=False)
    for damage in (*_broken(place, data, walk), *_define(place, data, walk, connections)):
        raise damage
    _check_index(file, place, walk)
    return data, walk


def salvage_chunk(
    file: BagFile, place: ChunkPlace, connections: dict[int, Channel], lost: list[Damage]
) -> tuple[bytes, Walk]:
    """Unpack what can be unpacked of a chunk, find the sound messages in it and note in `lost` what is not."""
    try:
        data = _unpack(file, place)
    except Damage as damage:
        lost.append(damage)
        data = b""
    walk = walk_chunk(data, resume=True)
    lost.extend(_broken(place, data, walk))
    lost.extend(_define(place, data, walk, connections))
    return data, walk


def _broken(place: ChunkPlace, data: bytes, walk: Walk) -> Iterator[Damage]:
    if walk.broken_at >= 0:
        yield Damage(place.record.offset, f"the chunk here holds no record at byte {walk.broken_at} of its {len(data)}")


def _define(place: ChunkPlace, data: bytes, walk: Walk, connections: dict[int, Channel]) -> Iterator[Damage]:
    """Add the connections that stand in a chunk to those that are known."""
    for row in np.flatnonzero(walk.ops == Op.CONNECTION).tolist():
        start, at = int(walk.starts[row]), int(walk.offsets[row])
        (header_bytes,) = struct.unpack_from("<I", data, at)
        try:
            header = parse_header(data[at + 4 : at + 4 + header_bytes])
            definition = data[start : start + int(walk.sizes[row])]
            add_connection(connections, int(walk.connections[row]), place.record.offset, definition, header)
        except ValueError as error:
            yield Damage(place.record.offset, f"the chunk here holds a damaged connection ({error})")
        except Damage as damage:
            yield damage


def _unpack(file: BagFile, place: ChunkPlace) -> bytes:
    record = place.record
    declared, kind = record.number("size"), record.fields.get("compression", b"")
    if max(declared, place.data_bytes) > CHUNK_LIMIT_BYTES:
        raise Damage(
            record.offset,
            f"a chunk of {max(declared, place.data_bytes)} bytes is more than the {CHUNK_LIMIT_BYTES} that are allowed",
        )
    packed = file.bytes_at(record.data_at, place.data_bytes)
    is_whole = place.data_bytes == record.data_bytes
    if kind == b"none":
        data = packed
    elif kind in (b"bz2", b"lz4"):
        data = _decompress(kind.decode(), packed, declared, record.offset, keep_partial=not is_whole)
    else:
        raise Damage(record.offset, f"the chunk's compression {kind!r} is not one of none, bz2 or lz4")
    if is_whole and len(data) != declared:
        more = " or more" if len(data) > declared else ""
        raise Damage(record.offset, f"a chunk should unpack to {declared} bytes, its data give {len(data)}{more}")
    return data


def _decompress(kind: str, packed: bytes, declared: int, offset: int, *, keep_partial: bool) -> bytes:
    """Unpack at most one byte more than declared; `keep_partial` keeps what comes before the data break off."""
    unpacker = bz2.BZ2Decompressor() if kind == "bz2" else lz4.frame.LZ4FrameDecompressor()
    pieces: list[bytes] = []
    left, at = declared + 1, 0
    try:
        while left > 0 and not unpacker.eof and (at < len(packed) or not unpacker.needs_input):
            feed = b""
            if unpacker.needs_input:
                feed, at = packed[at : at + _FEED_BYTES], at + _FEED_BYTES
            pieces.append(unpacker.decompress(feed, max_length=left))
            left -= len(pieces[-1])
    except (OSError, RuntimeError, EOFError, ValueError, MemoryError) as error:
        if not keep_partial:
            raise Damage(offset, f"the chunk's {kind} data cannot be unpacked ({error})") from error
    if not keep_partial and left > 0 and not unpacker.eof:
        raise Damage(offset, f"the chunk's {kind} data break off")
    return b"".join(pieces)


def _check_index(file: BagFile, place: ChunkPlace, walk: Walk) -> None:
    """Raise Damage unless the index records behind a chunk name exactly its messages with their times."""
    told = {number: count for number, count in place.counts.items() if count}
    is_message = walk.ops == Op.MESSAGE
    held = Counter(walk.connections[is_message].tolist())
    if held != told:
        raise Damage(
            place.record.offset,
            f"the chunk here holds {held.total()} messages, the index counts {sum(told.values())} or others",
        )
    # An entry may point at the connection that stands before its message.
    rows = np.where(is_message, np.arange(walk.ops.size), walk.ops.size)
    message_from = np.minimum.accumulate(rows[::-1])[::-1]
    offset = place.record.end
    for _ in place.counts:
        record = file.record_at(offset).expect(Op.INDEX)
        number, data = record.number("conn"), file.data_of(record)
        if record.number("ver") != 1 or len(data) != _INDEX_ENTRY.itemsize * record.number("count"):
            raise Damage(offset, "the index of a chunk has an unknown version or another length than it says")
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
        offset = record.end
