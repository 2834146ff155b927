"""The records of an MCAP file and its layout: walk its top records without unpacking chunks, and check its frame."""

import struct
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from io import BytesIO
from sys import intern
from typing import TypeVar

import numpy as np
from mcap import records
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from rosbags.typesys.msg import normalize_msgtype

from .channel import CHUNK_LIMIT_BYTES, ByteArray, Channel, Damage, FileBytes
from .mcap_kernel import FRAME, FRAME_BYTES, MESSAGE_HEAD_BYTES, Chunk, RecordCounter, RecordCounts, skim

MAGIC = b"\x89MCAP0\r\n"
FOOTER_BYTES = 20
WINDOW_BYTES = 2**20
_PEEK_BYTES = 4096
_MESSAGE = struct.Struct("<BQHIQ")
_CHUNK = struct.Struct("<QQQII")
_LENGTH = struct.Struct("<Q")
_INDEX = struct.Struct("<HI")
INDEX_HEAD_BYTES = _INDEX.size
CHUNK_HEAD_BYTES = _CHUNK.size + 16 + _LENGTH.size
"""Enough for the head of a chunk record whose compression has a name of up to 16 bytes."""
Record = TypeVar("Record")


IN_DATA = frozenset(
    {
        Opcode.SCHEMA,
        Opcode.CHANNEL,
        Opcode.MESSAGE,
        Opcode.CHUNK,
        Opcode.MESSAGE_INDEX,
        Opcode.ATTACHMENT,
        Opcode.METADATA,
    }
)
IN_SUMMARY = frozenset(
    {
        Opcode.SCHEMA,
        Opcode.CHANNEL,
        Opcode.STATISTICS,
        Opcode.CHUNK_INDEX,
        Opcode.ATTACHMENT_INDEX,
        Opcode.METADATA_INDEX,
        Opcode.SUMMARY_OFFSET,
    }
)
KNOWN = frozenset(Opcode)


def parse(read: Callable[[ReadDataStream], Record], body: bytes, offset: int) -> Record:
    """Parse the content of a record; raise Damage with its `offset` in the file when it ends too early."""
    try:
        return read(ReadDataStream(BytesIO(body)))
    except (McapError, ValueError, struct.error, OverflowError, MemoryError) as error:
        raise Damage(offset, f"a record has no proper content ({str(error) or type(error).__name__})") from error


def parse_chunk(head: bytes, start: int, stop: int) -> Chunk:
    """Parse the head of the chunk record at bytes `start` to `stop` of the file."""
    inside = stop - start - FRAME_BYTES
    if inside < _CHUNK.size + _LENGTH.size:
        raise Damage(start, f"a chunk record of {inside} bytes is too short")
    start_ns, end_ns, declared, crc, name_bytes = _CHUNK.unpack_from(head)
    if name_bytes > 16:
        raise Damage(start, f"a chunk names a compression of {name_bytes} bytes; zstd, lz4 or none are known")
    name = head[_CHUNK.size : _CHUNK.size + name_bytes]
    if name not in (b"", b"zstd", b"lz4"):
        raise Damage(start, f"compression {name.decode(errors='replace')!r} is not one of zstd, lz4 or none")
    (stored,) = _LENGTH.unpack_from(head, _CHUNK.size + name_bytes)
    used = _CHUNK.size + name_bytes + _LENGTH.size
    if stored > inside - used:
        raise Damage(start, f"a chunk of {stored} bytes does not fit into its record of {inside} bytes")
    return Chunk(
        start=start,
        stop=stop,
        body=start + FRAME_BYTES + used,
        stored=stored,
        declared=declared,
        is_chunk=True,
        compression=intern(name.decode()),
        crc=crc,
        start_ns=start_ns,
        end_ns=end_ns,
        counts=None,
    )


def parse_index_head(head: bytes, length: int, offset: int) -> tuple[int, int]:
    """Return channel id and number of messages of a message index record with `length` bytes of content."""
    if length < _INDEX.size:
        raise Damage(offset, f"a message index record of {length} bytes is too short")
    channel_id, size = _INDEX.unpack_from(head)
    if size % 16 or size > length - _INDEX.size:
        raise Damage(offset, f"a message index of {size} bytes does not fit into its record of {length} bytes")
    return channel_id, size // 16


class Definitions:
    """Gather definitions; one that is repeated must say the same."""

    def __init__(self) -> None:
        self._seen: set[tuple[int, bytes]] = set()
        self._schemas: dict[int, records.Schema] = {}
        self._channels: dict[int, tuple[records.Channel, int]] = {}
        self._built: dict[int, Channel] = {}

    def is_new(self, kind: int, body: bytes) -> bool:
        """Return whether a definition has to be added."""
        return (kind, body) not in self._seen

    def add(self, kind: int, body: bytes, offset: int) -> None:
        """Add a definition; raise Damage when it contradicts an earlier one."""
        if (kind, body) in self._seen:
            return
        if kind == Opcode.SCHEMA:
            schema: records.Schema = parse(records.Schema.read, body, offset)
            if schema.id == 0:
                raise Damage(offset, "a schema has the id 0, which means none")
            if self._schemas.setdefault(schema.id, schema) != schema:
                raise Damage(offset, f"schema {schema.id} is defined twice, differently")
        else:
            channel: records.Channel = parse(records.Channel.read, body, offset)
            if self._channels.setdefault(channel.id, (channel, offset))[0] != channel:
                raise Damage(offset, f"channel {channel.id} is defined twice, differently")
        self._seen.add((kind, body))

    @property
    def ids(self) -> frozenset[int]:
        """Return the ids of all channels."""
        return frozenset(self._channels)

    @property
    def usable(self) -> frozenset[int]:
        """Return the ids of the channels whose schemas are defined."""
        return frozenset(channel_id for channel_id in self._channels if self.has_all((channel_id,)))

    def has_all(self, channel_ids: Iterable[int]) -> bool:
        """Return whether these channels and their schemas are defined."""
        return all(
            channel_id in self._channels and self._channels[channel_id][0].schema_id in {0, *self._schemas}
            for channel_id in channel_ids
        )

    def channel(self, channel_id: int) -> Channel:
        """Return the channel of an id; raise Damage when its schema is nowhere defined."""
        found = self._built.get(channel_id)
        if found is None:
            found = self._built[channel_id] = self._build(*self._channels[channel_id])
        return found

    def _build(self, record: records.Channel, offset: int) -> Channel:
        if record.schema_id == 0:
            return Channel(
                topic=record.topic, type_name="", encoding=record.message_encoding, schema_encoding="", schema=b""
            )
        schema = self._schemas.get(record.schema_id)
        if schema is None:
            raise Damage(offset, f"channel {record.topic} names schema {record.schema_id}, which is not defined")
        is_ros = schema.encoding in ("ros2msg", "ros1msg", "ros2idl")
        return Channel(
            topic=record.topic,
            type_name=normalize_msgtype(schema.name) if is_ros else schema.name,
            encoding=record.message_encoding,
            schema_encoding=schema.encoding,
            schema=bytes(schema.data),
        )


@dataclass(frozen=True, kw_only=True)
class Layout:
    """The chunks of a file and what its other records hold.

    `data_stop` is where the data section ends, `data_crc` and `summary_crc` are 0 where absent; `has_unknown_kinds`
    says that there are records whose kind the format does not name; `lost` are the parts that a salvage leaves out.
    `indexed_ns` is from when to when the summary's index says that messages were recorded, None without an index.
    """

    chunks: tuple[Chunk, ...]
    definitions: Definitions
    statistics: records.Statistics | None
    indexed_ns: tuple[int, int] | None
    data_stop: int
    data_crc: int
    summary_crc: int
    has_unknown_kinds: bool
    lost: tuple[str, ...] = ()

    @property
    def span_ns(self) -> tuple[int, int]:
        """Return from when to when messages were recorded, those of lost chunks that the summary lists too."""
        spans = [(chunk.start_ns, chunk.end_ns) for chunk in self.chunks if chunk.counts]
        spans += [self.indexed_ns] if self.indexed_ns and self.indexed_ns[1] else []
        return min((start for start, _ in spans), default=0), max((end for _, end in spans), default=0)


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
        timed = [index for index in self.chunk_indexes if index.message_end_time]
        first_ns = min((index.message_start_time for index in timed), default=0)
        last_ns = max((index.message_end_time for index in timed), default=0)
        return Layout(
            chunks=tuple(self._counted_chunks()),
            definitions=self.definitions,
            statistics=self.statistics,
            indexed_ns=(first_ns, last_ns) if self.chunk_indexes else None,
            data_stop=self.data_stop,
            data_crc=0 if self.data_end is None else self.data_end.data_section_crc,
            summary_crc=self.summary_crc,
            has_unknown_kinds=self.has_unknown_kinds,
            lost=lost,
        )

    def _counted_chunks(self) -> Iterator[Chunk]:
        """Yield the chunks with the counts of their indexes; a day of log has tens of thousands, mostly alike."""
        known: dict[frozenset[tuple[int, int]], Mapping[int, int]] = {}
        for chunk in self.chunks:
            found = self.indexed.pop(chunk.start, None)
            if found is None:
                yield chunk
            else:
                yield replace(chunk, counts=known.setdefault(frozenset(found.items()), found))

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
        if kind != Opcode.HEADER:
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
        if kind == Opcode.MESSAGE:
            return self._walk_messages(offset, length)
        stop = offset + FRAME_BYTES + length
        if kind == Opcode.CHUNK:
            self.chunks.append(parse_chunk(self.peek(offset + FRAME_BYTES, CHUNK_HEAD_BYTES), offset, stop))
        elif kind == Opcode.MESSAGE_INDEX:
            self._add_index(offset, length)
        elif kind in (Opcode.SCHEMA, Opcode.CHANNEL):
            self.definitions.add(kind, self.body(offset, length), offset)
        elif kind == Opcode.DATA_END:
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
        if kind in (Opcode.SCHEMA, Opcode.CHANNEL):
            self.definitions.add(kind, self.body(offset, length), offset)
        elif kind == Opcode.STATISTICS:
            self.statistics = parse(records.Statistics.read, self.body(offset, length), offset)
        elif kind == Opcode.CHUNK_INDEX:
            self.chunk_indexes.append(parse(records.ChunkIndex.read, self.body(offset, length), offset))
        elif kind == Opcode.FOOTER:
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
                f"the summary lists {len(listed)} chunks, the data hold {len(found)} of other places, times or sizes",
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


def read_summary(file: FileBytes) -> tuple[Walker, int]:
    """Return what the summary holds that a file ends with, and where it starts; raise Damage where it is not sound."""
    walker, footer_start = Walker(file), file.size - len(MAGIC) - FRAME_BYTES - FOOTER_BYTES
    if footer_start < len(MAGIC) or walker.peek(file.size - len(MAGIC), len(MAGIC)) != MAGIC:
        raise Damage(file.size, "the file does not end as a log does")
    if walker.frame(footer_start)[0] != Opcode.FOOTER:
        raise Damage(footer_start, "no footer is before the end")
    _, footer = walker.walk_summary(footer_start)
    start = offset = footer_start if footer is None or not footer.summary_start else footer.summary_start
    footer = None
    while footer is None:
        offset, footer = walker.walk_summary(offset)
    walker.check_summary(footer, start)
    return walker, start


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
