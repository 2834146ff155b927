"""The layout of an MCAP file: walk its top records without unpacking chunks, and check its frame."""

import struct
from collections import Counter
from dataclasses import dataclass, replace

import numpy as np
from mcap import records

from .channel import CHUNK_LIMIT_BYTES, ByteArray, Damage
from .file_bytes import FileBytes
from .mcap_kernel import MESSAGE_HEAD_BYTES, RecordCounter, RecordCounts, skim
from .mcap_records import (
    CHUNK_HEAD_BYTES,
    FOOTER_BYTES,
    FRAME,
    FRAME_BYTES,
    IN_DATA,
    IN_SUMMARY,
    INDEX_HEAD_BYTES,
    KNOWN,
    MAGIC,
    Chunk,
    Definitions,
    Kind,
    parse,
    parse_chunk,
    parse_index_head,
)

WINDOW_BYTES = 2**20
_PEEK_BYTES = 4096
_MESSAGE = struct.Struct("<BQHIQ")


@dataclass(frozen=True, kw_only=True)
class Layout:
    """The chunks of a file and what its other records hold.

    `data_stop` is where the data section ends, `data_crc` and `summary_crc` are 0 where absent; `has_unknown_kinds`
    says that there are records whose kind the format does not name; `lost` are the parts that a salvage leaves out.
    """

    chunks: tuple[Chunk, ...]
    definitions: Definitions
    statistics: records.Statistics | None
    chunk_indexes: tuple[records.ChunkIndex, ...]
    data_stop: int
    data_crc: int
    summary_crc: int
    has_unknown_kinds: bool
    lost: tuple[str, ...] = ()


class Walker:
    """Walk the top records of a file once; anything wrong raises Damage."""

    def __init__(self, file: FileBytes) -> None:
        self.file = file
        self.definitions = Definitions()
        self.chunks: list[Chunk] = []
        self.indexed: dict[int, Counter[int]] = {}
        self.statistics: records.Statistics | None = None
        self.chunk_indexes: list[records.ChunkIndex] = []
        self.data_stop = file.size
        self.data_end: records.DataEnd | None = None
        self.summary_crc = 0
        self.has_unknown_kinds = False
        self._peeked, self._peeked_at = b"", 0
        self._window: ByteArray = np.empty(0, dtype=np.uint8)
        self._counter = RecordCounter()
        self._footer_start = 0

    def walk(self) -> Layout:
        """Return the layout of a file that is whole."""
        offset = self.walk_start()
        while self.data_end is None:
            offset = self.walk_data(offset)
        summary_start, footer = offset, None
        while footer is None:
            offset, footer = self.walk_summary(offset)
        self._check_end(footer, summary_start, offset)
        return self.layout()

    def layout(self, lost: tuple[str, ...] = ()) -> Layout:
        """Return what has been found."""
        return Layout(
            chunks=tuple(replace(c, counts=self.indexed.get(c.start, c.counts)) for c in self.chunks),
            definitions=self.definitions,
            statistics=self.statistics,
            chunk_indexes=tuple(self.chunk_indexes),
            data_stop=self.data_stop,
            data_crc=0 if self.data_end is None else self.data_end.data_section_crc,
            summary_crc=self.summary_crc,
            has_unknown_kinds=self.has_unknown_kinds,
            lost=lost,
        )

    def peek(self, offset: int, length: int) -> bytes:
        """Return up to `length` bytes from an offset, of which it reads more at once than are asked for."""
        inside = offset - self._peeked_at
        if not 0 <= inside <= len(self._peeked) - length:
            self._peeked, self._peeked_at = self.file.read(offset, max(length, _PEEK_BYTES)), offset
            inside = 0
        return self._peeked[inside : inside + length]

    def frame(self, offset: int) -> tuple[int, int]:
        """Return kind and length of the record at an offset."""
        left = self.file.size - offset - FRAME_BYTES
        if left < 0:
            raise Damage(offset, f"the file ends after {self.file.size} bytes without the records that end a log")
        kind, length = FRAME.unpack(self.peek(offset, FRAME_BYTES))
        if length > left:
            raise Damage(offset, f"a record of kind {kind} says {length} bytes should follow, the file has {left}")
        return kind, length

    def walk_start(self) -> int:
        """Check magic and header; return where the header ends."""
        if self.peek(0, len(MAGIC)) != MAGIC:
            raise Damage(0, f"an MCAP file starts with the bytes {MAGIC.hex(' ')}")
        kind, length = self.frame(len(MAGIC))
        if kind != Kind.HEADER:
            raise Damage(len(MAGIC), f"the header should be here, a record of kind {kind} does")
        parse(records.Header.read, self.body(len(MAGIC), length), len(MAGIC))
        return len(MAGIC) + FRAME_BYTES + length

    def body(self, offset: int, length: int) -> bytes:
        """Return the content of a record that is parsed as a whole."""
        if length > CHUNK_LIMIT_BYTES:
            raise Damage(offset, f"a record has {length} bytes, more than the {CHUNK_LIMIT_BYTES} that are allowed")
        return self.peek(offset + FRAME_BYTES, length)

    def walk_data(self, offset: int) -> int:
        """Take in the record of the data section at an offset, or several messages; return where they end."""
        kind, length = self.frame(offset)
        if kind == Kind.MESSAGE:
            return self._walk_messages(offset, length)
        stop = offset + FRAME_BYTES + length
        if kind == Kind.CHUNK:
            self.chunks.append(parse_chunk(self.peek(offset + FRAME_BYTES, CHUNK_HEAD_BYTES), offset, stop))
        elif kind == Kind.MESSAGE_INDEX:
            self._add_index(offset, length)
        elif kind in (Kind.SCHEMA, Kind.CHANNEL):
            self.definitions.add(kind, self.body(offset, length), offset)
        elif kind == Kind.DATA_END:
            self.data_end, self.data_stop = parse(records.DataEnd.read, self.body(offset, length), offset), offset
        elif kind in KNOWN and kind not in IN_DATA:
            raise Damage(offset, f"a record of kind {kind} is in the data section")
        elif kind not in KNOWN:
            self._add_unknown(kind, offset)
        return stop

    def _add_unknown(self, kind: int, offset: int) -> None:
        if kind == 0:
            raise Damage(offset, "a record is of kind 0")
        self.has_unknown_kinds = True

    def _add_index(self, offset: int, length: int) -> None:
        channel_id, count = parse_index_head(self.peek(offset + FRAME_BYTES, INDEX_HEAD_BYTES), length, offset)
        if not self.chunks or not self.chunks[-1].is_chunk:
            raise Damage(offset, "a message index follows no chunk")
        self.indexed.setdefault(self.chunks[-1].start, Counter())[channel_id] += count

    def _walk_messages(self, offset: int, length: int) -> int:
        if length < MESSAGE_HEAD_BYTES:
            raise Damage(offset, f"a message record of {length} bytes is too short")
        size = min(WINDOW_BYTES, self.file.size - offset)
        if not self._window.size:
            self._window = np.empty(WINDOW_BYTES, dtype=np.uint8)
        window = self._window[:size]
        self.file.read_into(offset, window.data)
        stop = offset + skim(window, 0, size)
        record_counts = self._counter.count(window[: stop - offset])
        if stop == offset:
            stop, record_counts = offset + FRAME_BYTES + length, _alone(window)
        if record_counts.fault:
            raise Damage(offset, record_counts.fault)
        self.chunks.append(message_chunk(offset, stop, record_counts))
        return stop

    def walk_summary(self, offset: int) -> tuple[int, records.Footer | None]:
        """Take in the record of the summary at an offset; return where it ends, and the footer if it is that."""
        kind, length = self.frame(offset)
        footer = None
        if kind in (Kind.SCHEMA, Kind.CHANNEL):
            self.definitions.add(kind, self.body(offset, length), offset)
        elif kind == Kind.STATISTICS:
            self.statistics = parse(records.Statistics.read, self.body(offset, length), offset)
        elif kind == Kind.CHUNK_INDEX:
            self.chunk_indexes.append(parse(records.ChunkIndex.read, self.body(offset, length), offset))
        elif kind == Kind.FOOTER:
            self._footer_start = offset
            footer = parse(records.Footer.read, self.body(offset, length), offset)
        elif kind in KNOWN and kind not in IN_SUMMARY:
            raise Damage(offset, f"a record of kind {kind} is in the summary")
        return offset + FRAME_BYTES + length, footer

    def _check_end(self, footer: records.Footer, summary_start: int, end: int) -> None:
        if self.peek(end, len(MAGIC)) != MAGIC:
            raise Damage(end, f"the file should end with the bytes {MAGIC.hex(' ')}")
        after = self.file.size - end - len(MAGIC)
        if after:
            raise Damage(end + len(MAGIC), f"{after} bytes follow the end of the log")
        self.check_summary(footer, summary_start)
        if self.chunk_indexes:
            self._check_indexes()

    def _check_indexes(self) -> None:
        """Compare place and times of the chunks with what the summary, which mostly has a CRC, lists."""
        found = {(chunk.start, chunk.start_ns, chunk.end_ns) for chunk in self.chunks if chunk.is_chunk}
        listed = {(i.chunk_start_offset, i.message_start_time, i.message_end_time) for i in self.chunk_indexes}
        if listed != found:
            raise Damage(
                min(listed ^ found)[0],
                f"the summary lists {len(listed)} chunks, the data hold {len(found)}, and not these",
            )

    def check_summary(self, footer: records.Footer, summary_start: int) -> None:
        """Check place and CRC of the summary that was walked last."""
        is_empty = summary_start == self._footer_start
        if footer.summary_start != summary_start and not (is_empty and footer.summary_start == 0):
            raise Damage(summary_start, f"the summary starts here, its footer says at byte {footer.summary_start}")
        self.summary_crc = footer.summary_crc
        stop = self._footer_start + FRAME_BYTES + FOOTER_BYTES - 4
        if footer.summary_crc and footer.summary_crc != self.file.crc32(summary_start, stop):
            raise Damage(summary_start, "the CRC of the summary does not agree with its content")


def message_chunk(start: int, stop: int, record_counts: RecordCounts) -> Chunk:
    """Return the chunk of the messages outside of chunks at bytes `start` to `stop`."""
    return Chunk(
        start=start,
        stop=stop,
        body=start,
        stored=stop - start,
        declared=stop - start,
        is_chunk=False,
        compression="",
        crc=0,
        start_ns=record_counts.start_ns,
        end_ns=record_counts.end_ns,
        counts=record_counts.counts,
    )


def _alone(head: ByteArray) -> RecordCounts:
    """Count a message that is longer than the window, of which only the head is there."""
    _, _, channel_id, _, log_ns = _MESSAGE.unpack_from(head.data)
    fault = "a message has a recording time of 2^63 ns or more" if log_ns >= 2**63 else ""
    return RecordCounts(counts={channel_id: 1}, start_ns=log_ns, end_ns=log_ns, others=(), stop=0, fault=fault)
