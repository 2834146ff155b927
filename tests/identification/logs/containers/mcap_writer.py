"""MCAP files byte by byte, from the format's specification and nothing else."""

import struct
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import lz4.frame  # type: ignore[import-untyped]  # the package carries no annotations
import zstandard

MAGIC = b"\x89MCAP0\r\n"
(HEADER, FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, MESSAGE_INDEX, CHUNK_INDEX, ATTACHMENT, ATTACHMENT_INDEX,
 STATISTICS, METADATA, METADATA_INDEX, SUMMARY_OFFSET, DATA_END) = range(1, 16)  # fmt: skip


def text(value: str) -> bytes:
    data = value.encode()
    return struct.pack("<I", len(data)) + data


def record(kind: int, body: bytes) -> bytes:
    return struct.pack("<BQ", kind, len(body)) + body


def header(profile: str = "", library: str = "") -> bytes:
    return text(profile) + text(library)


def schema(number: int, name: str, encoding: str, data: bytes) -> bytes:
    return struct.pack("<H", number) + text(name) + text(encoding) + struct.pack("<I", len(data)) + data


def channel(number: int, schema_id: int, topic: str, encoding: str, metadata: Mapping[str, str] | None = None) -> bytes:
    pairs = b"".join(text(key) + text(value) for key, value in (metadata or {}).items())
    return struct.pack("<HH", number, schema_id) + text(topic) + text(encoding) + struct.pack("<I", len(pairs)) + pairs


def message(channel_id: int, log_ns: int, data: bytes, sequence: int = 0) -> bytes:
    return struct.pack("<HIQQ", channel_id, sequence, log_ns, log_ns) + data


def pack(data: bytes, compression: str) -> bytes:
    if compression == "zstd":
        return zstandard.compress(data)
    return bytes(lz4.frame.compress(data)) if compression == "lz4" else data


def chunk(data: bytes, span_ns: tuple[int, int], compression: str = "", crc: int | None = None) -> bytes:
    packed = pack(data, compression)
    check = zlib.crc32(data) if crc is None else crc
    return (
        struct.pack("<QQQI", *span_ns, len(data), check) + text(compression) + struct.pack("<Q", len(packed)) + packed
    )


def message_index(channel_id: int, entries: Sequence[tuple[int, int]]) -> bytes:
    pairs = b"".join(struct.pack("<QQ", *entry) for entry in entries)
    return struct.pack("<HI", channel_id, len(pairs)) + pairs


def chunk_index(
    span_ns: tuple[int, int],
    place: tuple[int, int],
    offsets: Mapping[int, int],
    index_bytes: int,
    compression: str,
    sizes: tuple[int, int],
) -> bytes:
    pairs = b"".join(struct.pack("<HQ", *item) for item in offsets.items())
    return (
        struct.pack("<QQQQI", *span_ns, *place, len(pairs))
        + pairs
        + struct.pack("<Q", index_bytes)
        + text(compression)
        + struct.pack("<QQ", *sizes)
    )


def statistics(
    counts: Mapping[int, int], *, schemas: int, channels: int, chunks: int, span_ns: tuple[int, int]
) -> bytes:
    pairs = b"".join(struct.pack("<HQ", *item) for item in counts.items())
    return (
        struct.pack("<QHIIIIQQI", sum(counts.values()), schemas, channels, 0, 0, chunks, *span_ns, len(pairs)) + pairs
    )


@dataclass(frozen=True, kw_only=True)
class Sent:
    """A message as it is sent to the file."""

    channel_id: int
    log_ns: int
    data: bytes
    sequence: int = 0


@dataclass(frozen=True, kw_only=True)
class Style:
    """How a file is laid out; the names of the conformance suite's features stand behind each."""

    chunked: bool = True  # ch
    message_index: bool = True  # mx
    statistics: bool = True  # st
    repeat_schemas: bool = True  # rsh
    repeat_channels: bool = True  # rch
    chunk_index: bool = True  # chx
    summary_offsets: bool = True  # sum
    padding: bytes = b""  # pad
    compression: str = ""
    chunk_crc: bool = True
    data_crc: bool = False
    summary_crc: bool = True
    messages_per_chunk: int = 10**9
    define_in_every_chunk: bool = False


@dataclass
class Writer:
    """Write a file of the given style; `chunks` are the offsets of its chunk records."""

    style: Style
    schemas: Mapping[int, bytes]
    channels: Mapping[int, bytes]
    file: bytearray = field(default_factory=lambda: bytearray(MAGIC))
    chunks: list[int] = field(default_factory=list)
    _indexes: list[bytes] = field(default_factory=list)

    def record(self, kind: int, body: bytes) -> bytes:
        """Return a record of the top with the style's padding, where its content tells its own length."""
        return record(kind, body if kind in (MESSAGE, CHUNK) else body + self.style.padding)

    def write(self, messages: Sequence[Sent]) -> bytes:
        style = self.style
        defined = [(SCHEMA, body) for body in self.schemas.values()]
        defined += [(CHANNEL, body) for body in self.channels.values()]
        self.file += self.record(HEADER, header())
        if style.chunked:
            definitions = b"".join(record(*each) for each in defined)
            for first in range(0, max(1, len(messages)), style.messages_per_chunk):
                inside = definitions if first == 0 or style.define_in_every_chunk else b""
                self._add_chunk(inside, messages[first : first + style.messages_per_chunk])
        else:
            self.file += b"".join(self.record(*each) for each in defined)
            self.file += b"".join(self.record(MESSAGE, self._body(sent)) for sent in messages)
        self.file += self.record(DATA_END, struct.pack("<I", zlib.crc32(self.file) if style.data_crc else 0))
        self._add_summary(messages)
        return bytes(self.file)

    @staticmethod
    def _body(sent: Sent) -> bytes:
        return message(sent.channel_id, sent.log_ns, sent.data, sent.sequence)

    def _add_chunk(self, definitions: bytes, messages: Sequence[Sent]) -> None:
        content, places = bytearray(definitions), dict[int, list[tuple[int, int]]]()
        for sent in messages:
            places.setdefault(sent.channel_id, []).append((sent.log_ns, len(content)))
            content += record(MESSAGE, self._body(sent))
        times = [sent.log_ns for sent in messages]
        span = (min(times, default=0), max(times, default=0))
        body = chunk(bytes(content), span, self.style.compression, None if self.style.chunk_crc else 0)
        start = len(self.file)
        self.chunks.append(start)
        self.file += self.record(CHUNK, body)
        end, offsets = len(self.file), {}
        if self.style.message_index:
            for channel_id, entries in places.items():
                offsets[channel_id] = len(self.file)
                self.file += self.record(MESSAGE_INDEX, message_index(channel_id, entries))
        sizes = (len(pack(bytes(content), self.style.compression)), len(content))
        self._indexes.append(
            chunk_index(span, (start, end - start), offsets, len(self.file) - end, self.style.compression, sizes)
        )

    def _add_summary(self, messages: Sequence[Sent]) -> None:
        style, start = self.style, len(self.file)
        counts: dict[int, int] = {}
        for sent in messages:
            counts[sent.channel_id] = counts.get(sent.channel_id, 0) + 1
        times = [sent.log_ns for sent in messages]
        reported = statistics(
            counts,
            schemas=len(self.schemas),
            channels=len(self.channels),
            chunks=len(self.chunks),
            span_ns=(min(times, default=0), max(times, default=0)),
        )
        groups = (
            (SCHEMA, list(self.schemas.values()) if style.repeat_schemas else []),
            (CHANNEL, list(self.channels.values()) if style.repeat_channels else []),
            (STATISTICS, [reported] if style.statistics else []),
            (CHUNK_INDEX, self._indexes if style.chunk_index else []),
        )
        offsets = bytearray()
        for kind, bodies in groups:
            group_start = len(self.file)
            self.file += b"".join(self.record(kind, body) for body in bodies)
            if bodies:
                place = struct.pack("<BQQ", kind, group_start, len(self.file) - group_start)
                offsets += self.record(SUMMARY_OFFSET, place)
        offset_start = len(self.file)
        if style.summary_offsets:
            self.file += offsets
        empty = len(self.file) == start
        has_offsets = style.summary_offsets and len(offsets) > 0
        footer = struct.pack("<QQ", 0 if empty else start, offset_start if has_offsets else 0)
        head = struct.pack("<BQ", FOOTER, len(footer) + 4)
        crc = zlib.crc32(bytes(self.file[start:]) + head + footer) if style.summary_crc else 0
        self.file += head + footer + struct.pack("<I", crc) + MAGIC
