"""MCAP: own framing, so that what is not wanted is neither read nor unpacked, and what is wanted is checked.

The top records are walked first, without the content of chunks. Chunks are then read, unpacked, checked and decoded in
two threads. Counts in the file's summary and indexes have to agree with the messages that are read.
"""

import threading
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import cached_property, partial
from itertools import groupby
from pathlib import Path

import lz4.frame  # type: ignore[import-untyped]  # the package carries no annotations
import numpy as np
import zstandard
from mcap.opcode import Opcode
from zlib_ng import zlib_ng

from ...errors import LogError
from ...result import Finding
from ..threads import map_in_order
from .channel import (
    CHUNK_LIMIT_BYTES,
    Batch,
    ByteArray,
    Channel,
    Container,
    Damage,
    FileBytes,
    Held,
    Survey,
    T,
    recorded_text,
    worked_out,
)
from .mcap_indexed import walk
from .mcap_kernel import FRAME, FRAME_BYTES, Chunk, Definition, RecordCounter, RecordCounts, Selection
from .mcap_layout import KNOWN, Definitions, Layout


class _Space(threading.local):
    """Buffers that a thread uses again for every chunk."""

    def __init__(self) -> None:
        self.packed = np.empty(0, dtype=np.uint8)
        self.unpacked = np.empty(0, dtype=np.uint8)
        self.counter = RecordCounter()
        self.zstd = zstandard.ZstdDecompressor()


class ChunkReader:
    """Open chunks of one file, in any thread."""

    def __init__(self, file: FileBytes, definitions: Definitions) -> None:
        self._file, self._definitions = file, definitions
        self._space = _Space()

    def open(self, chunk: Chunk) -> Chunk:
        """Return a chunk with its content, counted and checked; raise Damage when anything about it is wrong."""
        if chunk.fault:
            raise Damage(chunk.start, chunk.fault)
        if chunk.declared > CHUNK_LIMIT_BYTES:
            what = f"a chunk unpacks to {chunk.declared}" if chunk.is_chunk else f"a message has {chunk.declared}"
            raise Damage(chunk.start, f"{what} bytes, more than the {CHUNK_LIMIT_BYTES} that are allowed")
        data = self.unpack(chunk)
        if data.size != chunk.declared:
            size = f"{data.size}" if data.size < chunk.declared else f"more than {chunk.declared}"
            raise Damage(chunk.start, f"a chunk unpacks to {size} bytes, it says {chunk.declared}")
        if chunk.crc and zlib_ng.crc32(data.data) != chunk.crc:
            raise Damage(chunk.start, "the CRC of a chunk does not agree with its content")
        record_counts = self._space.counter.count(data)
        _check(chunk, record_counts)
        definitions, has_unknown_kinds = self._others(chunk, data, record_counts)
        return replace(
            chunk,
            counts=record_counts.counts,
            start_ns=record_counts.start_ns,
            end_ns=record_counts.end_ns,
            data=data,
            definitions=definitions,
            has_unknown_kinds=has_unknown_kinds,
        )

    def unpack(self, chunk: Chunk) -> ByteArray:
        """Return the content of a chunk, of one byte too many where it goes on beyond what is declared."""
        space = self._space
        space.packed = _at_least(space.packed, chunk.stored)
        packed = space.packed[: chunk.stored]
        self._file.read_into(chunk.body, packed.data)
        try:
            if chunk.compression == "zstd":
                return self._unzstd(chunk, packed)
            if chunk.compression == "lz4":
                return np.frombuffer(_unlz4(packed, chunk.declared), dtype=np.uint8)
        except (zstandard.ZstdError, RuntimeError, ValueError, MemoryError, EOFError) as error:
            raise Damage(chunk.start, f"a chunk cannot be unpacked ({error})") from error
        return packed

    def _unzstd(self, chunk: Chunk, packed: ByteArray) -> ByteArray:
        space, size = self._space, chunk.declared + 1
        space.unpacked = _at_least(space.unpacked, size)
        target, done = space.unpacked.data[:size], 0
        with space.zstd.stream_reader(packed.data, read_across_frames=True) as reader:
            while done < size and (count := reader.readinto(target[done:])):
                done += count
        return space.unpacked[:done]

    def _others(
        self, chunk: Chunk, data: ByteArray, record_counts: RecordCounts
    ) -> tuple[tuple[Definition, ...], bool]:
        found: list[Definition] = []
        has_unknown_kinds = False
        for position in record_counts.others:
            kind, length = FRAME.unpack_from(data.data, position)
            if kind in (Opcode.SCHEMA, Opcode.CHANNEL):
                body = data[position + FRAME_BYTES : position + FRAME_BYTES + length].tobytes()
                if self._definitions.is_new(kind, body):
                    found.append((kind, body, chunk.start))
            elif kind in KNOWN:
                raise Damage(chunk.start, f"a record of kind {kind} is in a chunk")
            else:
                has_unknown_kinds = True
        return tuple(found), has_unknown_kinds


def _check(chunk: Chunk, record_counts: RecordCounts) -> None:
    """Compare what a chunk holds with what its index says."""
    if record_counts.fault:
        raise Damage(chunk.start, record_counts.fault)
    total = sum(record_counts.counts.values())
    if (
        chunk.counts is not None
        and {key: count for key, count in chunk.counts.items() if count} != record_counts.counts
    ):
        raise Damage(chunk.start, f"a chunk holds {total} messages, its index has {sum(chunk.counts.values())}")
    if (
        total
        and chunk.has_span
        and not chunk.start_ns <= record_counts.start_ns <= record_counts.end_ns <= chunk.end_ns
    ):
        raise Damage(chunk.start, "a chunk holds messages from before or after the times that it names")


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


def total_counts(chunks: Iterable[Chunk]) -> Counter[int]:
    """Return the messages per channel id of all chunks together, as far as they are known."""
    total: Counter[int] = Counter()
    for chunk in chunks:
        total.update(chunk.counts or {})
    return +total


def complete(layout: Layout, file: FileBytes, opener: ChunkReader) -> Layout:
    """Return the layout with the counts of all chunks known and all their channels defined.

    Raises Damage where the summary, the indexes and the messages contradict each other.
    """
    known = _from_indexes(layout) or _count(layout, opener)
    _check_statistics(known)
    for chunk in known.chunks:
        for channel_id in chunk.counts or {}:
            if not layout.definitions.has_all((channel_id,)):
                raise Damage(chunk.start, f"a message names channel {channel_id}, which is not defined")
    if layout.data_crc and not is_protected(layout) and file.crc32(0, layout.data_stop) != layout.data_crc:
        raise Damage(layout.data_stop, "the CRC of the data section does not agree with its content")
    return known


def is_protected(layout: Layout) -> bool:
    """Return whether all that matters has a CRC of its own, so that the one of the whole data section is not needed."""
    return bool(layout.chunks) and layout.summary_crc != 0 and all(chunk.crc or chunk.fault for chunk in layout.chunks)


def without_data(opened: Chunk) -> Chunk:
    """Return what is known of an opened chunk, without its content, which the next chunk takes the place of."""
    return replace(opened, data=None)


def _from_indexes(layout: Layout) -> Layout | None:
    """Take the counts from the indexes if the statistics confirm them; messages outside of chunks were counted."""
    total = total_counts(layout.chunks)
    statistics = layout.statistics
    if not layout.definitions.has_all(total):
        return None
    if statistics is None:
        return None if any(chunk.is_chunk for chunk in layout.chunks) or layout.has_unknown_kinds else layout
    if statistics.message_count != total.total() or not all(_has_times(chunk, layout) for chunk in layout.chunks):
        return None
    chunks = (chunk if chunk.counts is not None else replace(chunk, counts={}) for chunk in layout.chunks)
    return replace(layout, chunks=tuple(chunks))


def _has_times(chunk: Chunk, layout: Layout) -> bool:
    """Return whether the recording times of a chunk are known: counted, or given by the chunk and by its index."""
    return not chunk.is_chunk or not chunk.counts or (chunk.has_span and layout.indexed_ns is not None)


def _count(layout: Layout, opener: ChunkReader) -> Layout:
    chunks: list[Chunk] = []
    has_unknown_kinds = layout.has_unknown_kinds
    for opened in map_in_order(lambda chunk: without_data(opener.open(chunk)), layout.chunks):
        for definition in opened.definitions:
            layout.definitions.add(*definition)
        has_unknown_kinds |= opened.has_unknown_kinds
        chunks.append(opened)
    if has_unknown_kinds and layout.statistics is None:
        raise Damage(0, "it holds records of unknown kinds, and no count says whether they were messages")
    return replace(layout, chunks=tuple(chunks))


def _check_statistics(layout: Layout) -> None:
    statistics = layout.statistics
    if statistics is None:
        return
    total = total_counts(layout.chunks)
    chunks = sum(chunk.is_chunk for chunk in layout.chunks)
    per_channel = {key: count for key, count in statistics.channel_message_counts.items() if count}
    are_others = bool(per_channel) and per_channel != total
    if (statistics.message_count, statistics.chunk_count) != (total.total(), chunks) or are_others:
        raise Damage(
            layout.data_stop,
            f"its summary counts {statistics.message_count} messages in {statistics.chunk_count} chunks, "
            f"the data hold {total.total()} in {chunks}{', of other channels' if are_others else ''}",
        )


def file_findings(layout: Layout) -> tuple[Finding, ...]:
    """Report messages without a checksum, and a file without a summary."""
    found = []
    total = sum(sum((chunk.counts or {}).values()) for chunk in layout.chunks)
    bare = sum(sum((chunk.counts or {}).values()) for chunk in layout.chunks if not (chunk.crc or chunk.fault))
    if bare and not layout.data_crc:
        found.append(
            Finding.info(
                "crc-absent",
                f"{bare} of {total} messages carry no checksum (CRC): a flipped bit in the file would not be noticed.",
                "Let the recorder write chunk CRCs (rosbag2: storage option `noChunkCRC: false`).",
            )
        )
    if layout.statistics is None:
        found.append(
            Finding.info(
                "summary-absent",
                f"The file has no summary that would confirm that all its {total} messages are there.",
                "Let the recorder write a summary (rosbag2: storage option `noSummary: false`).",
            )
        )
    return tuple(found)


class McapContainer(Container):
    """An MCAP file.

    A chunk whose content is damaged is left out and reported where indexes and summary say what it held.
    """

    def __init__(self, path: Path) -> None:
        self._file = FileBytes(path)
        self._lost: dict[int, str] = {}

    def lost(self) -> tuple[str, ...]:
        """Name the damaged chunks that were left out so far."""
        if not self._lost:
            return ()
        chunks, (first_ns, _) = self._known[0].chunks, self._known[0].span_ns
        total = total_counts(chunks).total()
        return tuple(
            f"bytes {group[0].start} to {group[-1].stop} left out, "
            f"{recorded_text(min(c.start_ns for c in group), max(c.end_ns for c in group), first_ns)}, "
            f"{total_counts(group).total()} of {total} messages "
            f"({', '.join(dict.fromkeys(self._lost[chunk.start] for chunk in group))})"
            for is_lost, group in ((key, [*each]) for key, each in groupby(chunks, lambda c: c.start in self._lost))
            if is_lost
        )

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def survey(self) -> Survey:
        """Return what the file holds, from its indexes where they are complete, else by counter."""
        with self._refusing():
            return self._survey

    def read(self, wanted: Collection[Channel], handle: Callable[[Batch], T]) -> Iterator[tuple[Channel, T]]:
        """Read the wanted channels; see `Container`."""
        with self._refusing():
            yield from self._read(tuple(dict.fromkeys(wanted)), handle)

    @contextmanager
    def _refusing(self) -> Iterator[None]:
        try:
            yield
        except Damage as damage:
            raise LogError(
                f"{self._file.name} is truncated or damaged at byte {damage.offset}: {damage.reason}; "
                "record again, or read what is left with `--salvage`."
            ) from damage

    @cached_property
    def _known(self) -> tuple[Layout, ChunkReader]:
        layout = worked_out(self._walk, self._file)
        return layout, ChunkReader(self._file, layout.definitions)

    @staticmethod
    def _walk(file: FileBytes) -> Layout:
        layout = walk(file)
        return complete(layout, file, ChunkReader(file, layout.definitions))

    @cached_property
    def _ids(self) -> dict[Channel, list[int]]:
        """The ids of each channel: those that say the same are one."""
        definitions = self._known[0].definitions
        ids: dict[Channel, list[int]] = {}
        for channel_id in sorted(self._usable(definitions)):
            ids.setdefault(definitions.channel(channel_id), []).append(channel_id)
        return ids

    def _usable(self, definitions: Definitions) -> frozenset[int]:
        return definitions.ids

    @cached_property
    def _survey(self) -> Survey:
        layout, _ = self._known
        total = total_counts(layout.chunks)
        first = self._first_messages()
        start_ns, end_ns = layout.span_ns
        return Survey(
            container="mcap",
            held=tuple(
                Held(channel=channel, count=sum(total[i] for i in ids), first_message=first.get(channel, b""))
                for channel, ids in sorted(self._ids.items(), key=lambda item: (item[0].topic, item[0].type_name))
            ),
            start_ns=start_ns,
            end_ns=end_ns,
            findings=file_findings(layout),
        )

    def _first_messages(self) -> dict[Channel, bytes]:
        layout, opener = self._known
        missing, found = dict(self._ids), {}
        for chunk in layout.chunks:
            here = [channel for channel, ids in missing.items() if any((chunk.counts or {}).get(i) for i in ids)]
            opened = self._opened(opener, chunk) if here else chunk
            if opened.data is not None:
                selection = Selection({channel: missing.pop(channel) for channel in here})
                for batch in selection.batches(opened):
                    begin = int(batch.starts[0])
                    found[batch.channel] = batch.data[begin : begin + int(batch.sizes[0])].tobytes()
        if self._lost and not found:
            raise Damage(*next(iter(self._lost.items())))
        return found

    def _read(self, wanted: tuple[Channel, ...], handle: Callable[[Batch], T]) -> Iterator[tuple[Channel, T]]:
        layout, opener = self._known
        for channel in wanted:
            if channel not in self._ids:
                raise LogError(f"Topic {channel.topic} of type {channel.type_name} is not in {self._file.name}.")
        selection = Selection({channel: self._ids[channel] for channel in wanted})

        def work(chunk: Chunk) -> tuple[tuple[Definition, ...], list[tuple[Channel, T]]]:
            opened = self._opened(opener, chunk)
            return opened.definitions, [(batch.channel, handle(batch)) for batch in self._batches(selection, opened)]

        chunks = (chunk for chunk in layout.chunks if selection.is_in(chunk))
        asked = (chunk for chunk in chunks if self.may_want(chunk.start_ns, chunk.end_ns))
        for definitions, results in map_in_order(work, asked):
            for definition in definitions:
                layout.definitions.add(*definition)
            yield from results

    def _opened(self, opener: ChunkReader, chunk: Chunk) -> Chunk:
        """Return a chunk with its content, or without where that is damaged."""
        if chunk.start in self._lost:
            return chunk
        try:
            return opener.open(chunk)
        except Damage as damage:
            self._lost[chunk.start] = damage.reason
            return chunk

    def _batches(self, selection: Selection, opened: Chunk) -> Iterator[Batch]:
        # What a CRC agrees with is as it was recorded.
        can_leave_out = opened.is_chunk and not opened.crc
        leave_out = partial(self._lost.setdefault, opened.start) if can_leave_out else None
        return (replace(batch, leave_out=leave_out) for batch in selection.batches(opened))
