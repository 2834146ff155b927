"""Chunks of records in memory, walked at machine speed and without the interpreter's lock."""

import struct
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from problems.compiled import inlined, unlocked

from ...signals.recording import StampArray
from .channel import Batch, ByteArray, Channel, u16, u32, u64

FINE, NO_FIT, SHORT_MESSAGE, BAD_TIME, FULL = range(5)
MESSAGE_HEAD_BYTES = 22
FRAME = struct.Struct("<BQ")
"""Every record: its kind and the number of bytes that follow."""
FRAME_BYTES = FRAME.size
_MESSAGE, _CHUNK = 5, 6
_CHUNK_FIXED = 40
_LAST_KIND = 15
_CHAIN = 4
_IDS = 2**16
_NEVER_NS = 2**63 - 1
# Entries of the span of stamps.
FIRST, LAST = 0, 1
Definition = tuple[int, bytes, int]
"""Opcode, content and offset of a record that defines a schema or a channel."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Chunk:
    """Bytes of the data section that are read at once: a chunk record, or messages outside of them.

    `start` and `stop` are the offsets of the whole records, `body` and `stored` where the packed content begins and
    its size, `declared` the size that it unpacks to. `counts` are the messages per channel id where something counts
    them (`None`: nothing does). `start_ns` and `end_ns` span its messages on the recording clock.

    Of a chunk that was opened, `data` is the content, valid until the same thread opens the next one, `definitions` are
    those in it that were not known, and `has_unknown_kinds` says whether it has records of kinds that the format does
    not name. `fault` says why its content cannot be read, empty where nothing is known against it.
    """

    start: int
    stop: int
    body: int
    stored: int
    declared: int
    is_chunk: bool
    compression: str
    crc: int
    start_ns: int
    end_ns: int
    counts: Mapping[int, int] | None
    data: ByteArray | None = None
    definitions: tuple[Definition, ...] = ()
    has_unknown_kinds: bool = False
    fault: str = ""

    @property
    def has_span(self) -> bool:
        """Return whether the recording times are known; writers that do not care leave zeros."""
        return self.end_ns != 0


@inlined
def _kind(data: ByteArray, at: int) -> int:
    return int(np.int64(data[np.uint64(at)]))


@unlocked
def count_records(
    data: ByteArray,
    start: int,
    end: int,
    counts: StampArray,
    ids: StampArray,
    span_ns: StampArray,
    others: StampArray,
) -> tuple[int, int, int, int]:
    """Count the messages per channel id and list the places of records of other kinds.

    Adds to `counts` (65536,), names in `ids` the channel ids that occur, widens `span_ns` (earliest and latest
    recording time) and fills `others`. Returns a code, the position up to which it came, how many others there are
    and how many ids.
    """
    position, other_count, id_count = start, 0, 0
    while position < end:
        if end - position < FRAME_BYTES or _kind(data, position) == 0:
            return NO_FIT, position, other_count, id_count
        length = u64(data, position + 1)
        if length < 0 or length > end - position - FRAME_BYTES:
            return NO_FIT, position, other_count, id_count
        if _kind(data, position) == _MESSAGE:
            if length < MESSAGE_HEAD_BYTES:
                return SHORT_MESSAGE, position, other_count, id_count
            channel = u16(data, position + 9)
            if counts[channel] == 0:
                ids[id_count] = channel
                id_count += 1
            counts[channel] += 1
            log_ns = u64(data, position + 15)
            if log_ns < 0:
                return BAD_TIME, position, other_count, id_count
            span_ns[FIRST] = min(span_ns[FIRST], log_ns)
            span_ns[LAST] = max(span_ns[LAST], log_ns)
        else:
            if other_count == others.size:
                return FULL, position, other_count, id_count
            others[other_count] = position
            other_count += 1
        position += FRAME_BYTES + length
    return FINE, position, other_count, id_count


@unlocked
def gather(
    data: ByteArray,
    start: int,
    end: int,
    slot_of: StampArray,
    next_row: StampArray,
    log_ns: StampArray,
    starts: StampArray,
    sizes: StampArray,
) -> None:
    """Write time, place and size of every message whose channel id has a slot to the next row of that slot.

    The records have been walked by `count_records` before.
    """
    position = start
    while position < end:
        length = u64(data, position + 1)
        if _kind(data, position) == _MESSAGE:
            slot = slot_of[u16(data, position + 9)]
            if slot >= 0:
                row = next_row[slot]
                next_row[slot] = row + 1
                log_ns[row] = u64(data, position + 15)
                starts[row] = position + FRAME_BYTES + MESSAGE_HEAD_BYTES
                sizes[row] = length - MESSAGE_HEAD_BYTES
        position += FRAME_BYTES + length


@unlocked
def skim(data: ByteArray, start: int, end: int) -> int:
    """Return the place of the first record that is no message or does not end before `end`."""
    position = start
    while end - position >= FRAME_BYTES and _kind(data, position) == _MESSAGE:
        length = u64(data, position + 1)
        if length < 0 or length > end - position - FRAME_BYTES:
            break
        position += FRAME_BYTES + length
    return position


@unlocked
def find_chunk(data: ByteArray, start: int, end: int) -> int:
    """Return the first position at which something looks like the head of a chunk record, or -1."""
    for position in range(start, end - FRAME_BYTES - _CHUNK_FIXED + 1):
        if _kind(data, position) != _CHUNK:
            continue
        name_bytes = u32(data, position + FRAME_BYTES + 28)
        if name_bytes not in (0, 3, 4) or position + FRAME_BYTES + _CHUNK_FIXED + name_bytes > end:
            continue
        length = u64(data, position + 1)
        stored = u64(data, position + FRAME_BYTES + 32 + name_bytes)
        spare = length - stored - _CHUNK_FIXED - name_bytes
        if stored >= 0 and 0 <= spare < 64:
            return position
    return -1


@unlocked
def find_messages(data: ByteArray, start: int, end: int, is_known: ByteArray) -> int:
    """Return the first position from which several records of sensible kind follow each other, or -1.

    The first is a message of a known channel, `is_known` (65536,); the last may end exactly at `end`.
    """
    for first in range(start, end - FRAME_BYTES - MESSAGE_HEAD_BYTES + 1):
        if _kind(data, first) != _MESSAGE:
            continue
        position, links = first, 0
        while links < _CHAIN and position < end:
            if end - position < FRAME_BYTES or not 0 < _kind(data, position) <= _LAST_KIND:
                break
            length = u64(data, position + 1)
            if length < 0 or length > end - position - FRAME_BYTES:
                break
            if _kind(data, position) == _MESSAGE and (
                length < MESSAGE_HEAD_BYTES or is_known[u16(data, position + 9)] == 0
            ):
                break
            position += FRAME_BYTES + length
            links += 1
        if links == _CHAIN or (links > 0 and position == end):
            return first
    return -1


@dataclass(frozen=True, kw_only=True)
class RecordCounts:
    """Messages per channel id, the recording times they span (0 and 0 without any), the places of other records.

    `fault` says what does not fit at `stop`, empty where all is well.
    """

    counts: Mapping[int, int]
    start_ns: int
    end_ns: int
    others: tuple[int, ...]
    stop: int
    fault: str


class RecordCounter:
    """Arrays that are used again for every count, by one thread."""

    def __init__(self) -> None:
        self._counts = np.zeros(_IDS, dtype=np.int64)
        self._ids = np.empty(_IDS, dtype=np.int64)
        self._others = np.empty(256, dtype=np.int64)
        self._span = np.empty(2, dtype=np.int64)

    def count(self, data: ByteArray) -> RecordCounts:
        """Count the records in `data`."""
        while True:
            self._span[:] = _NEVER_NS, -1
            code, stop, other_count, id_count = count_records(
                data, 0, data.size, self._counts, self._ids, self._span, self._others
            )
            ids = self._ids[:id_count]
            counts = dict(zip(ids.tolist(), self._counts[ids].tolist(), strict=True))
            self._counts[ids] = 0
            if code != FULL:
                break
            self._others = np.empty(2 * self._others.size, dtype=np.int64)
        return RecordCounts(
            counts=counts,
            start_ns=int(self._span[0]) if counts else 0,
            end_ns=int(self._span[1]) if counts else 0,
            others=tuple(self._others[:other_count].tolist()),
            stop=stop,
            fault="" if code == FINE else _fault(code, data, stop),
        )


def _fault(code: int, data: ByteArray, position: int) -> str:
    where = f"{position} bytes into it"
    if code == BAD_TIME:
        return f"a message has a recording time of 2^63 ns or more, {where}"
    if code != NO_FIT:
        return f"a message record is too short, {where}: it takes {MESSAGE_HEAD_BYTES} bytes"
    if data.size - position < FRAME_BYTES:
        return f"a record does not fit into its chunk, {where}"
    kind, length = FRAME.unpack_from(data.data, position)
    return f"a record of kind {kind} and {length} bytes does not fit into its chunk, {where}"


class Selection:
    """The channels that are wanted of a file, each with its ids."""

    def __init__(self, ids: Mapping[Channel, Collection[int]]) -> None:
        self._ids = ids
        self._slot_of: StampArray = np.full(_IDS, -1, dtype=np.int64)
        for slot, group in enumerate(ids.values()):
            self._slot_of[list(group)] = slot

    def is_in(self, chunk: Chunk) -> bool:
        """Return whether a chunk holds any of them."""
        return any(self._slot_of[channel_id] >= 0 for channel_id in chunk.counts or ())

    def batches(self, opened: Chunk) -> Iterator[Batch]:
        """Yield their messages in an opened chunk, a batch for each channel that has any."""
        counts, data = opened.counts or {}, opened.data
        if data is None:
            return
        sizes = [sum(counts.get(channel_id, 0) for channel_id in group) for group in self._ids.values()]
        stops: StampArray = np.cumsum(sizes, dtype=np.int64)
        next_row: StampArray = stops - np.array(sizes, dtype=np.int64)
        table: StampArray = np.empty((3, sum(sizes)), dtype=np.int64)
        log_ns, starts, lengths = table
        gather(data, 0, data.size, self._slot_of, next_row, log_ns, starts, lengths)
        for channel, size, stop in zip(self._ids, sizes, stops.tolist(), strict=True):
            if size:
                rows = slice(stop - size, stop)
                yield Batch(channel=channel, log_ns=log_ns[rows], data=data, starts=starts[rows], sizes=lengths[rows])
