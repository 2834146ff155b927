"""The records of an MCAP file: their kinds, their content, and the schemas and channels that they define."""

import struct
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from enum import IntEnum
from io import BytesIO
from typing import TypeVar

from mcap import records
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from rosbags.typesys.msg import normalize_msgtype

from .channel import Channel, Damage

MAGIC = b"\x89MCAP0\r\n"
FRAME = struct.Struct("<BQ")
"""Every record: its kind and the number of bytes that follow."""
FRAME_BYTES = FRAME.size
FOOTER_BYTES = 20
_CHUNK = struct.Struct("<QQQII")
_LENGTH = struct.Struct("<Q")
_INDEX = struct.Struct("<HI")
INDEX_HEAD_BYTES = _INDEX.size
CHUNK_HEAD_BYTES = _CHUNK.size + 16 + _LENGTH.size
"""Enough for the head of a chunk record whose compression has a name of up to 16 bytes."""
Record = TypeVar("Record")
Definition = tuple[int, bytes, int]
"""Kind, content and offset of a record that defines a schema or a channel."""


class Kind(IntEnum):
    """Kinds of records that the format names."""

    HEADER = 0x01
    FOOTER = 0x02
    SCHEMA = 0x03
    CHANNEL = 0x04
    MESSAGE = 0x05
    CHUNK = 0x06
    MESSAGE_INDEX = 0x07
    CHUNK_INDEX = 0x08
    ATTACHMENT = 0x09
    ATTACHMENT_INDEX = 0x0A
    STATISTICS = 0x0B
    METADATA = 0x0C
    METADATA_INDEX = 0x0D
    SUMMARY_OFFSET = 0x0E
    DATA_END = 0x0F


IN_DATA = frozenset(
    {Kind.SCHEMA, Kind.CHANNEL, Kind.MESSAGE, Kind.CHUNK, Kind.MESSAGE_INDEX, Kind.ATTACHMENT, Kind.METADATA}
)
IN_SUMMARY = frozenset(
    {
        Kind.SCHEMA,
        Kind.CHANNEL,
        Kind.STATISTICS,
        Kind.CHUNK_INDEX,
        Kind.ATTACHMENT_INDEX,
        Kind.METADATA_INDEX,
        Kind.SUMMARY_OFFSET,
    }
)
KNOWN = frozenset(Kind)


@dataclass(frozen=True, kw_only=True)
class Chunk:
    """Bytes of the data section that are read at once: a chunk record, or messages outside of them.

    `start` and `stop` are the offsets of the whole records, `body` and `stored` where the packed content begins and
    its size, `declared` the size that it unpacks to. `counts` are the messages per channel id where something counts
    them (`None`: nothing does). `start_ns` and `end_ns` span its messages on the recording clock.
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

    @property
    def has_span(self) -> bool:
        """Return whether the recording times are known; writers that do not care leave zeros."""
        return self.end_ns != 0


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
        compression=name.decode(),
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


def parse_schema(body: bytes, offset: int) -> records.Schema:
    """Parse a schema record."""
    schema: records.Schema = parse(records.Schema.read, body, offset)
    return schema


def parse_channel(body: bytes, offset: int) -> records.Channel:
    """Parse a channel record."""
    channel: records.Channel = parse(records.Channel.read, body, offset)
    return channel


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
        if kind == Kind.SCHEMA:
            schema = parse_schema(body, offset)
            if schema.id == 0:
                raise Damage(offset, "a schema has the id 0, which means none")
            if self._schemas.setdefault(schema.id, schema) != schema:
                raise Damage(offset, f"schema {schema.id} is defined twice, differently")
        else:
            channel = parse_channel(body, offset)
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
