"""Open the chunks of an MCAP file (read, unpack, check), in two threads, and count the messages in them."""

import threading
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import TypeVar

import lz4.frame  # type: ignore[import-untyped]  # the package carries no annotations
import numpy as np
import zstandard
from zlib_ng import zlib_ng

from .channel import CHUNK_LIMIT_BYTES, ByteArray
from .file_bytes import FileBytes
from .mcap_kernel import Counting, Tally
from .mcap_layout import Layout
from .mcap_records import FRAME, FRAME_BYTES, KNOWN, Damage, Definition, Definitions, Kind, Piece


@dataclass(frozen=True, kw_only=True)
class Opened:
    """A piece in memory: its records fill `data`, which is valid until the same thread opens the next piece.

    `definitions` are those that were not known; `has_strangers` tells of records whose kind the format does not name.
    """

    piece: Piece
    data: ByteArray
    tally: Tally
    definitions: tuple[Definition, ...]
    has_strangers: bool


class _Space(threading.local):
    """Buffers that a thread uses again for every piece."""

    def __init__(self) -> None:
        self.packed = np.empty(0, dtype=np.uint8)
        self.unpacked = np.empty(0, dtype=np.uint8)
        self.counting = Counting()
        self.zstd = zstandard.ZstdDecompressor()


class Opener:
    """Open pieces of one file, in any thread."""

    def __init__(self, file: FileBytes, definitions: Definitions) -> None:
        self._file, self._definitions = file, definitions
        self._space = _Space()

    def open(self, piece: Piece) -> Opened:
        """Read and check one piece; raise Damage when anything about it is wrong."""
        if piece.declared > CHUNK_LIMIT_BYTES:
            what = f"a chunk unpacks to {piece.declared}" if piece.is_chunk else f"a message has {piece.declared}"
            raise Damage(piece.start, f"{what} bytes, more than the {CHUNK_LIMIT_BYTES} that are allowed")
        data = self.unpack(piece)
        if data.size != piece.declared:
            raise Damage(piece.start, f"a chunk unpacks to {_amount(data, piece)}, it says {piece.declared}")
        if piece.crc and zlib_ng.crc32(data.data) != piece.crc:
            raise Damage(piece.start, "the CRC of a chunk does not agree with its content")
        tally = self._space.counting.count(data)
        _check(piece, tally)
        definitions, has_strangers = self._others(piece, data, tally)
        return Opened(piece=piece, data=data, tally=tally, definitions=definitions, has_strangers=has_strangers)

    def unpack(self, piece: Piece) -> ByteArray:
        """Return the content of a piece, of one byte too many where it goes on beyond what is declared."""
        space = self._space
        space.packed = _at_least(space.packed, piece.stored)
        packed = space.packed[: piece.stored]
        self._file.read_into(piece.body, packed.data)
        try:
            if piece.compression == "zstd":
                return self._unzstd(piece, packed)
            if piece.compression == "lz4":
                return np.frombuffer(_unlz4(packed, piece.declared), dtype=np.uint8)
        except (zstandard.ZstdError, RuntimeError, ValueError, MemoryError, EOFError) as error:
            raise Damage(piece.start, f"a chunk cannot be unpacked ({error})") from error
        return packed

    def _unzstd(self, piece: Piece, packed: ByteArray) -> ByteArray:
        space, size = self._space, piece.declared + 1
        space.unpacked = _at_least(space.unpacked, size)
        target, done = space.unpacked.data[:size], 0
        with space.zstd.stream_reader(packed.data, read_across_frames=True) as reader:
            while done < size and (count := reader.readinto(target[done:])):
                done += count
        return space.unpacked[:done]

    def _others(self, piece: Piece, data: ByteArray, tally: Tally) -> tuple[tuple[Definition, ...], bool]:
        found: list[Definition] = []
        has_strangers = False
        for position in tally.others:
            kind, length = FRAME.unpack_from(data.data, position)
            if kind in (Kind.SCHEMA, Kind.CHANNEL):
                body = data[position + FRAME_BYTES : position + FRAME_BYTES + length].tobytes()
                if self._definitions.is_new(kind, body):
                    found.append((kind, body, piece.start))
            elif kind in KNOWN:
                raise Damage(piece.start, f"a record of kind {kind} stands in a chunk")
            else:
                has_strangers = True
        return tuple(found), has_strangers


def _check(piece: Piece, tally: Tally) -> None:
    """Compare what a piece holds with what was told of it."""
    if tally.fault:
        raise Damage(piece.start, tally.fault)
    total = sum(tally.counts.values())
    if piece.counts is not None and {key: count for key, count in piece.counts.items() if count} != tally.counts:
        raise Damage(piece.start, f"a chunk holds {total} messages, its index has {sum(piece.counts.values())}")
    if total and piece.has_span and not piece.start_ns <= tally.start_ns <= tally.end_ns <= piece.end_ns:
        raise Damage(piece.start, "a chunk holds messages from before or after the times that it tells")


def _amount(data: ByteArray, piece: Piece) -> str:
    return f"{data.size} bytes" if data.size < piece.declared else f"more than {piece.declared} bytes"


def _unlz4(packed: ByteArray, declared: int) -> bytes:
    rest: memoryview | bytes = packed.data
    parts: list[bytes] = []
    room = declared + 1
    while len(rest) and room > 0:
        unpacker = lz4.frame.LZ4FrameDecompressor()
        parts.append(unpacker.decompress(rest, max_length=room))
        room -= len(parts[-1])
        if not unpacker.eof:
            break
        rest = unpacker.unused_data or b""
    return parts[0] if len(parts) == 1 else b"".join(parts)


def _at_least(buffer: ByteArray, size: int) -> ByteArray:
    return buffer if buffer.size >= size else np.empty(size + size // 8, dtype=np.uint8)


Item = TypeVar("Item")
Result = TypeVar("Result")

THREADS = 2
AHEAD = 4
"""Results that may wait: enough that no thread is idle, few enough that they weigh nothing."""


def map_in_order(work: Callable[[Item], Result], items: Iterable[Item]) -> Iterator[Result]:
    """Yield `work(item)` for every item in order; an error is raised when its turn comes."""
    pending: deque[Future[Result]] = deque()
    with ThreadPoolExecutor(THREADS) as pool:
        try:
            for item in items:
                pending.append(pool.submit(work, item))
                if len(pending) == AHEAD:
                    yield pending.popleft().result()
            while pending:
                yield pending.popleft().result()
        finally:
            for future in pending:
                future.cancel()


def total_counts(pieces: Iterable[Piece]) -> Counter[int]:
    """Return the messages per channel id of all pieces together, as far as they are known."""
    total: Counter[int] = Counter()
    for piece in pieces:
        total.update(piece.counts or {})
    return +total


def complete(layout: Layout, file: FileBytes, opener: Opener) -> Layout:
    """Return the layout with the counts of all pieces known and all their channels defined.

    Raises Damage where the summary, the indexes and the messages contradict each other.
    """
    known = _from_indexes(layout) or _count(layout, opener)
    _check_statistics(known)
    for piece in known.pieces:
        for channel_id in piece.counts or {}:
            if not layout.definitions.has_all((channel_id,)):
                raise Damage(piece.start, f"a message names channel {channel_id}, which is not defined")
    if layout.data_crc and not is_protected(layout) and file.crc32(0, layout.data_stop) != layout.data_crc:
        raise Damage(layout.data_stop, "the CRC of the data section does not agree with its content")
    return known


def is_protected(layout: Layout) -> bool:
    """Tell whether all that matters has a CRC of its own, so that the one of the whole data section is not needed."""
    return bool(layout.pieces) and layout.summary_crc != 0 and all(piece.crc for piece in layout.pieces)


def counted(opened: Opened) -> Piece:
    """Return the piece with what has been counted in it."""
    tally = opened.tally
    return replace(opened.piece, counts=tally.counts, start_ns=tally.start_ns, end_ns=tally.end_ns)


def without_data(opened: Opened) -> Opened:
    """Return what is known of an opened piece, without its content, which the next piece takes the place of."""
    return replace(opened, data=np.empty(0, dtype=np.uint8))


def _from_indexes(layout: Layout) -> Layout | None:
    """Take the counts from the indexes if the statistics confirm them; messages outside of chunks were counted."""
    total = total_counts(layout.pieces)
    told = layout.statistics
    if not layout.definitions.has_all(total):
        return None
    if told is None:
        return None if any(piece.is_chunk for piece in layout.pieces) or layout.has_strangers else layout
    if told.message_count != total.total() or not all(_has_times(piece, layout) for piece in layout.pieces):
        return None
    return replace(layout, pieces=tuple(replace(piece, counts=piece.counts or {}) for piece in layout.pieces))


def _has_times(piece: Piece, layout: Layout) -> bool:
    """Tell whether the recording times of a piece are known: counted, or told by the chunk and by its index."""
    return not piece.is_chunk or not piece.counts or (piece.has_span and bool(layout.chunk_indexes))


def _count(layout: Layout, opener: Opener) -> Layout:
    pieces: list[Piece] = []
    has_strangers = layout.has_strangers
    for opened in map_in_order(lambda piece: without_data(opener.open(piece)), layout.pieces):
        for definition in opened.definitions:
            layout.definitions.add(*definition)
        has_strangers |= opened.has_strangers
        pieces.append(counted(opened))
    if has_strangers and layout.statistics is None:
        raise Damage(0, "it holds records of unknown kinds, and no count tells whether they were messages")
    return replace(layout, pieces=tuple(pieces))


def _check_statistics(layout: Layout) -> None:
    told = layout.statistics
    if told is None:
        return
    total = total_counts(layout.pieces)
    chunks = sum(piece.is_chunk for piece in layout.pieces)
    per_channel = {key: count for key, count in told.channel_message_counts.items() if count}
    are_others = bool(per_channel) and per_channel != total
    if (told.message_count, told.chunk_count) != (total.total(), chunks) or are_others:
        raise Damage(
            layout.data_stop,
            f"its summary counts {told.message_count} messages in {told.chunk_count} chunks, "
            f"the data hold {total.total()} in {chunks}{', of other channels' if are_others else ''}",
        )
