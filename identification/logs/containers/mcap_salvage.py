"""Read what is left of a damaged MCAP file.

The records are walked as in a sound file. Where one is damaged, the next place is searched that proves itself sound: a
chunk that the summary lists or whose CRC agrees, or several messages in a row where the file has no chunks. The
summary, if it is sound, defines channels that are lost otherwise.
"""

from collections.abc import Callable, Collection, Sequence
from dataclasses import replace

import numpy as np
from mcap.opcode import Opcode

from ..threads import map_in_order
from .channel import CHUNK_LIMIT_BYTES, ByteArray, Damage, FileBytes, recorded_text
from .mcap_file import ChunkReader, McapContainer, is_protected, total_counts, without_data
from .mcap_kernel import FRAME, FRAME_BYTES, Chunk, RecordCounter, find_chunk, find_messages
from .mcap_layout import (
    CHUNK_HEAD_BYTES,
    KNOWN,
    MAGIC,
    Definitions,
    Layout,
    Walker,
    message_chunk,
    parse_chunk,
    read_summary,
)

_WINDOW_BYTES = 4 * 2**20
_OVERLAP_BYTES = 2**18
_IDS = 2**16
_SPARE_BYTES = 64
"""A record with more bytes than this behind its content has a damaged length."""
_START_BYTES = FRAME_BYTES + 2
_LONGEST = 2**32


class SalvagedMcap(McapContainer):
    """What is left of an MCAP file."""

    def lost(self) -> tuple[str, ...]:
        """Name what is left out."""
        return (*self._known[0].lost, *super().lost())

    @staticmethod
    def _walk(file: FileBytes) -> Layout:
        layout = salvage_layout(file)
        if layout.lost:
            return layout
        try:
            # What costs no message, such as a damaged index or another log behind this one, is not passed over.
            checked = McapContainer._walk(file)  # noqa: SLF001 - of its own base
        except Damage as damage:
            return replace(layout, lost=(f"at byte {damage.offset}: {damage.reason}",))
        return replace(
            layout, lost=tuple(f"at byte {chunk.start}: {chunk.fault}" for chunk in checked.chunks if chunk.fault)
        )

    def _usable(self, definitions: Definitions) -> frozenset[int]:
        return definitions.usable


def next_chunk(file: FileBytes, opener: ChunkReader, begin: int, stop: int) -> int | None:
    """Return where the first chunk record starts at or after `begin` that unpacks and agrees with its CRC, if any."""
    while True:
        found = _search(file, find_chunk, begin, stop)
        if found is None or _is_sound(file, opener, found):
            return found
        begin = found + 1


def _is_sound(file: FileBytes, opener: ChunkReader, start: int) -> bool:
    try:
        opener.open(_chunk_at(file, start))
    except Damage:
        return False
    return True


def _chunk_at(file: FileBytes, start: int) -> Chunk:
    head = file.read(start, FRAME_BYTES + CHUNK_HEAD_BYTES)
    _, length = FRAME.unpack_from(head)
    chunk = parse_chunk(head[FRAME_BYTES:], start, start + FRAME_BYTES + length)
    if chunk.stop > file.size:
        raise Damage(start, "a chunk does not fit into the file")
    return chunk


def next_messages(file: FileBytes, channel_ids: Collection[int], begin: int, stop: int) -> int | None:
    """Return where the first message of a known channel starts after which other records follow, if any."""
    is_known = np.zeros(_IDS, dtype=np.uint8)
    is_known[list(channel_ids)] = 1
    return _search(file, lambda data, start, end: find_messages(data, start, end, is_known), begin, stop)


def _search(file: FileBytes, find: Callable[[ByteArray, int, int], int], begin: int, stop: int) -> int | None:
    while begin < stop:
        data = np.frombuffer(file.read(begin, min(_WINDOW_BYTES, stop - begin)), dtype=np.uint8)
        found = find(data, 0, data.size)
        if found >= 0:
            return begin + found
        if begin + data.size >= stop:
            break
        begin += data.size - _OVERLAP_BYTES
    return None


def cut_chunk(file: FileBytes, start: int) -> Chunk | None:
    """Return the whole messages of a chunk without compression whose end is beyond that of the file, if it is that."""
    head = file.read(start, FRAME_BYTES + CHUNK_HEAD_BYTES)
    if len(head) < FRAME_BYTES + CHUNK_HEAD_BYTES or head[0] != Opcode.CHUNK:
        return None
    _, length = FRAME.unpack_from(head)
    try:
        chunk = parse_chunk(head[FRAME_BYTES:], start, start + FRAME_BYTES + length)
    except Damage:
        return None
    if chunk.compression or chunk.declared > CHUNK_LIMIT_BYTES or chunk.body + chunk.stored <= file.size:
        return None
    data = np.frombuffer(file.read(chunk.body, chunk.stored), dtype=np.uint8)
    record_counts = RecordCounter().count(data)
    if not record_counts.stop:
        return None
    whole = RecordCounter().count(data[: record_counts.stop])
    return replace(message_chunk(chunk.body, chunk.body + record_counts.stop, whole), start=start)


def start_of_last(file: FileBytes, chunk: Chunk) -> tuple[int, ByteArray]:
    """Return where the last message starts in a chunk outside of chunks, and the bytes before it."""
    data = np.frombuffer(file.read(chunk.start, chunk.stop - chunk.start), dtype=np.uint8)
    position = last = 0
    while position < data.size:
        last = position
        position += FRAME_BYTES + FRAME.unpack_from(data.data, position)[1]
    return chunk.start + last, data[:last]


def salvage_layout(file: FileBytes) -> Layout:
    """Return the layout of what is left, with the counts of its chunks."""
    walker = _Salvager(file)
    layout = walker.salvage()
    chunks: list[Chunk] = []
    for chunk, opened in map_in_order(lambda chunk: (chunk, walker.try_open(chunk)), layout.chunks):
        try:
            if isinstance(opened, Damage):
                raise opened
            for definition in opened.definitions:
                layout.definitions.add(*definition)
            chunks.append(opened)
        except Damage as damage:
            walker.lose(chunk.start, chunk.stop, damage.reason, chunk)
    return replace(layout, chunks=tuple(chunks), lost=walker.describe_lost(layout, chunks))


class _Salvager(Walker):
    def __init__(self, file: FileBytes) -> None:
        super().__init__(file)
        self._lost: list[tuple[int, str]] = []
        self._stop = file.size
        self._take_summary()
        self.opener = ChunkReader(file, self.definitions)

    def salvage(self) -> Layout:
        """Return the layout of what can be found."""
        try:
            offset = self.walk_start()
            self._check_length(len(MAGIC), offset)
        except Damage as damage:
            offset = self._skip(0, damage.reason)
        while offset < self._stop and self.data_end is None:
            offset = self._walk(offset)
        return self.layout()

    def try_open(self, chunk: Chunk) -> Chunk | Damage:
        """Open a chunk or return what is wrong; where its CRC agrees, a damaged index does not matter."""
        try:
            return without_data(self.opener.open(replace(chunk, counts=None) if chunk.crc else chunk))
        except Damage as damage:
            return damage

    def lose(self, start: int, stop: int, reason: str, chunk: Chunk | None = None) -> None:
        """Note that the bytes from `start` to `stop` are left out."""
        spans = [
            (index.message_start_time, index.message_end_time)
            for index in self.chunk_indexes
            if start <= index.chunk_start_offset < stop
        ]
        if not spans and chunk is not None and chunk.has_span:
            spans = [(chunk.start_ns, chunk.end_ns)]
        starts = [index.message_start_time for index in self.chunk_indexes] or [
            each.start_ns for each in self.chunks if each.has_span
        ]
        first_ns = min(starts, default=min(spans)[0] if spans else 0)
        when = f", {recorded_text(min(spans)[0], max(end for _, end in spans), first_ns)}" if spans else ""
        counts = None if chunk is None else chunk.counts
        many = f", {sum(counts.values())} messages" if counts else ""
        self._lost.append((start, f"bytes {start} to {stop} left out{when}{many} ({reason})"))

    def describe_lost(self, layout: Layout, chunks: Sequence[Chunk]) -> tuple[str, ...]:
        """Return what is left out, in order of place, and how many messages of how many that is."""
        missing_parts = [text for _, text in sorted(self._lost)]
        total = total_counts(chunks)
        orphaned = sum(total[channel_id] for channel_id in total.keys() - self.definitions.usable)
        if orphaned:
            missing_parts.append(f"{orphaned} messages of channels whose definition is lost")
        if self.statistics is not None and self.statistics.message_count != total.total() - orphaned:
            missing = self.statistics.message_count - total.total() + orphaned
            missing_parts.insert(0, f"altogether {missing} of {self.statistics.message_count} messages left out")
        bare = layout.data_crc and not missing_parts and not is_protected(layout)
        if bare and self.file.crc32(0, layout.data_stop) != layout.data_crc:
            missing_parts.append(
                "nothing that can be located, but the CRC of the data section does not agree with its content"
            )
        return tuple(missing_parts)

    def _walk(self, offset: int) -> int:
        count = len(self.chunks)
        try:
            stop = self.walk_data(offset)
            self._check_length(offset, stop)
        except Damage as damage:
            del self.chunks[count:]
            return self._skip(offset, damage.reason)
        return stop

    def _check_length(self, offset: int, stop: int) -> None:
        """Refuse a record that reaches too far: in a damaged file such a one hides what follows."""
        if self.chunks and self.chunks[-1].start == offset:
            chunk = self.chunks[-1]
            if chunk.is_chunk and chunk.stop - chunk.body - chunk.stored > _SPARE_BYTES:
                raise Damage(offset, f"a chunk record is longer than its content of {chunk.stored} bytes")
        elif stop < self._stop and self.data_end is None and self._kind(stop) not in KNOWN:
            raise Damage(offset, "no record follows where its length points to")

    def _skip(self, offset: int, reason: str) -> int:
        """Leave out what is damaged at an offset; return where the next sound part starts."""
        begin = self._drop_suspect(offset)
        found = self._find_next(begin + 1)
        if found is None:
            found = self._stop
            rest = cut_chunk(self.file, begin)
            if rest is not None:
                self.chunks.append(rest)
                begin = rest.stop
        self.lose(begin, found, reason)
        return found

    def _find_next(self, begin: int) -> int | None:
        if self.chunk_indexes:
            return min(
                (i.chunk_start_offset for i in self.chunk_indexes if i.chunk_start_offset >= begin), default=None
            )
        found = next_chunk(self.file, self.opener, begin, self._stop)
        if found is None and not any(chunk.is_chunk for chunk in self.chunks) and self._kind(begin - 1) != Opcode.CHUNK:
            found = next_messages(self.file, self.definitions.ids, begin, self._stop)
        return found

    def _kind(self, offset: int) -> int:
        return self.peek(offset, 1)[0] if offset < self.file.size else 0

    def _drop_suspect(self, offset: int) -> int:
        """Drop the message before the damage if its length may be what is damaged; return where the damage begins."""
        last = self.chunks[-1] if self.chunks else None
        if last is None or last.is_chunk or last.stop != offset or self._starts_record(offset):
            return offset
        del self.chunks[-1]
        begin, data = start_of_last(self.file, last)
        if begin > last.start:
            self.chunks.append(message_chunk(last.start, begin, RecordCounter().count(data)))
        return begin

    def _starts_record(self, offset: int) -> bool:
        """Return whether a record may start at an offset, though cut or of damaged length."""
        head = self.peek(offset, _START_BYTES)
        if len(head) < _START_BYTES:
            return not head or head[0] in KNOWN
        kind, length = FRAME.unpack_from(head)
        if kind == Opcode.MESSAGE:
            return int.from_bytes(head[FRAME_BYTES:_START_BYTES], "little") in self.definitions.ids
        return kind in KNOWN and length < _LONGEST

    def _take_summary(self) -> None:
        """Take in the summary if the file still ends with a sound one."""
        try:
            probe, start = read_summary(self.file)
        except Damage as damage:
            cut = self.file.size >= len(MAGIC) and self.peek(self.file.size - len(MAGIC), len(MAGIC)) != MAGIC
            lost = (
                "the end was cut off, with all that was recorded after the last message that is left; " if cut else ""
            )
            self._lost.append((self.file.size, f"{lost}no sound summary at the end: {damage.reason}"))
            return
        self.definitions, self.chunk_indexes, self._stop = probe.definitions, probe.chunk_indexes, start
        self.statistics, self.summary_crc = probe.statistics, probe.summary_crc
