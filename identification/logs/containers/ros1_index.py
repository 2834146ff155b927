"""Where the connections and chunks of a ROS 1 bag are: told by its index, or found by walking over the whole file."""

import struct
from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path

from rosbags.typesys.msg import normalize_msgtype

from .channel import Channel
from .ros1_records import Op, parse_header

MAGIC = b"#ROSBAG V2.0\n"
_HEADER_LIMIT = 2**20
_SEARCH_BYTES = 2**20
_CHUNK_MARK = b"\x04\x00\x00\x00op=\x05"
_CHUNK_HEADER_BYTES = 128


class Damage(Exception):  # noqa: N818 - a place in the file, which the container refuses or works around
    """A place that cannot be read, and why."""

    def __init__(self, offset: int, reason: str) -> None:
        super().__init__(reason)
        self.offset, self.reason = offset, reason


@dataclass(frozen=True, kw_only=True)
class Record:
    """A record at a byte offset: its header fields and where its data lie."""

    offset: int
    fields: dict[str, bytes]
    data_at: int
    data_bytes: int

    @property
    def end(self) -> int:
        """Return the offset behind the record."""
        return self.data_at + self.data_bytes

    @property
    def op(self) -> int:
        """Return the kind, -1 where none is told."""
        value = self.fields.get("op", b"")
        return value[0] if len(value) == 1 else -1

    def number(self, name: str, size: int = 4) -> int:
        """Return an unsigned number of the header; raise Damage where it is missing."""
        value = self.fields.get(name)
        if value is None or len(value) != size:
            raise Damage(self.offset, f"the record's field `{name}` is missing or has another size than {size} bytes")
        return int.from_bytes(value, "little")

    def expect(self, op: Op) -> "Record":
        """Return the record itself; raise Damage where it is of another kind."""
        if self.op != op:
            raise Damage(self.offset, f"a record of kind {op} ({op.name.lower()}) should stand here, found {self.op}")
        return self


@dataclass(frozen=True, kw_only=True)
class ChunkPlace:
    """A chunk: its record, how much of its data the file holds, and what the index tells of it.

    That are the messages per connection and their time span; all empty where the file was walked over.
    """

    record: Record
    data_bytes: int
    counts: dict[int, int] = field(default_factory=dict)
    start_ns: int = 0
    end_ns: int = 0


@dataclass(frozen=True, kw_only=True)
class Layout:
    """What the file holds at its top level; `damage` is empty unless the file was walked over."""

    connections: dict[int, Channel]
    chunks: list[ChunkPlace]
    damage: list[Damage] = field(default_factory=list)


class BagFile:
    """A bag on disk, read by offset."""

    def __init__(self, path: Path) -> None:
        self._file = path.open("rb")
        self.size = path.stat().st_size

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def bytes_at(self, offset: int, size: int) -> bytes:
        """Read bytes; raise Damage where the file has fewer."""
        if not 0 <= size <= self.size - offset:
            raise Damage(offset, f"{size} bytes should follow, the file has {max(self.size - offset, 0)}")
        self._file.seek(offset)
        data = self._file.read(size)
        if len(data) != size:
            raise Damage(offset, f"{size} bytes should follow, {len(data)} could be read")
        return data

    def record_at(self, offset: int) -> Record:
        """Read the header of a record; its data may lie beyond the end of the file."""
        (header_bytes,) = struct.unpack("<I", self.bytes_at(offset, 4))
        if header_bytes > _HEADER_LIMIT:
            raise Damage(offset, f"a record header of {header_bytes} bytes is not believable")
        data = self.bytes_at(offset + 4, header_bytes + 4)
        try:
            fields = parse_header(data[:-4])
        except ValueError as error:
            raise Damage(offset, str(error)) from error
        (data_bytes,) = struct.unpack("<I", data[-4:])
        return Record(offset=offset, fields=fields, data_at=offset + 8 + header_bytes, data_bytes=data_bytes)

    def data_of(self, record: Record) -> bytes:
        """Read the data of a record; raise Damage where the file ends before."""
        return self.bytes_at(record.data_at, record.data_bytes)

    def find_chunk(self, offset: int) -> int:
        """Return the offset of the next chunk record, or the end of the file."""
        while offset < self.size:
            block = self.bytes_at(offset, min(_SEARCH_BYTES, self.size - offset))
            at = -1
            while (at := block.find(_CHUNK_MARK, at + 1)) >= 0:
                for start in range(at - 4, max(at - _CHUNK_HEADER_BYTES, -1), -1):
                    if self._is_chunk(block[start : start + _CHUNK_HEADER_BYTES]):
                        return offset + start
            offset += max(len(block) - _CHUNK_HEADER_BYTES, 1) if offset + len(block) < self.size else len(block)
        return self.size

    @staticmethod
    def _is_chunk(data: bytes) -> bool:
        header_bytes = int.from_bytes(data[:4], "little")
        if not 8 <= header_bytes <= len(data) - 8:
            return False
        try:
            fields = parse_header(data[4 : 4 + header_bytes])
        except ValueError:
            return False
        return fields.get("op") == b"\x05" and "compression" in fields and "size" in fields


def cut_off(file: BagFile, record: Record) -> Damage:
    """Describe a record whose data reach beyond the end of the file."""
    return Damage(record.offset, f"{record.data_bytes} bytes should follow, the file has {file.size - record.data_at}")


def read_index(file: BagFile) -> Layout:
    """Read the index at the end of the file; raise Damage where it is missing or does not fit the file."""
    head = file.record_at(len(MAGIC)).expect(Op.BAG_HEADER)
    if head.fields.get("encryptor", b""):
        raise Damage(head.offset, f"the bag is encrypted ({head.fields['encryptor']!r}), which is not supported")
    offset = head.number("index_pos", 8)
    if offset == 0:
        raise Damage(head.offset, "the bag is not indexed (index_pos 0): its recorder was not stopped properly")
    if not head.end <= offset <= file.size:
        raise Damage(head.offset, f"the index should start at byte {offset}, the file has {file.size}")
    connections: dict[int, Channel] = {}
    for _ in range(head.number("conn_count")):
        record = file.record_at(offset).expect(Op.CONNECTION)
        add_connection(connections, record.number("conn"), record.offset, file.data_of(record), record.fields)
        offset = record.end
    chunks: list[ChunkPlace] = []
    for _ in range(head.number("chunk_count")):
        record = file.record_at(offset).expect(Op.CHUNK_INFO)
        chunks.append(_chunk_place(file, record, connections))
        offset = record.end
    if offset != file.size:
        raise Damage(offset, f"{file.size - offset} bytes follow the end of the index")
    chunks.sort(key=lambda chunk: chunk.record.offset)
    for before, after in pairwise(chunks):
        if before.record.end > after.record.offset:
            raise Damage(after.record.offset, "two chunks of the index overlap")
    return Layout(connections=connections, chunks=chunks)


def _chunk_place(file: BagFile, info: Record, connections: dict[int, Channel]) -> ChunkPlace:
    if info.number("ver") != 1:
        raise Damage(info.offset, f"chunk information of version {info.number('ver')} is not known")
    data = file.data_of(info)
    if len(data) != 8 * info.number("count"):
        raise Damage(info.offset, f"a chunk should tell {info.number('count')} connections, found {len(data)} bytes")
    pairs = list(struct.iter_unpack("<II", data))
    counts = dict(pairs)
    if len(counts) != len(pairs) or not counts.keys() <= connections.keys():
        raise Damage(info.offset, "the index counts messages of a connection twice or of one that is not defined")
    chunk = file.record_at(info.number("chunk_pos", 8)).expect(Op.CHUNK)
    if chunk.end > file.size:
        raise cut_off(file, chunk)
    return ChunkPlace(
        record=chunk,
        data_bytes=chunk.data_bytes,
        counts=counts,
        start_ns=_time(info, "start_time") if counts else 0,
        end_ns=_time(info, "end_time") if counts else 0,
    )


def _time(record: Record, name: str) -> int:
    value = record.number(name, 8)
    return (value & 0xFFFFFFFF) * 10**9 + (value >> 32)


def add_connection(known: dict[int, Channel], number: int, offset: int, data: bytes, header: dict[str, bytes]) -> None:
    """Add the connection that a record defines; raise Damage where it is none or differs from a known one."""
    try:
        fields = parse_header(data)
        channel = Channel(
            topic=_topic(header["topic"].decode()),
            type_name=normalize_msgtype(fields["type"].decode()),
            encoding="ros1",
            schema_encoding="ros1msg",
            schema=fields["message_definition"],
        )
    except (ValueError, LookupError) as error:
        raise Damage(offset, f"connection {number} is not defined properly ({error})") from error
    if known.setdefault(number, channel) != channel:
        raise Damage(offset, f"connection {number} is defined twice, differently")


def _topic(name: str) -> str:
    return ("/" if name.startswith("/") else "") + "/".join(part for part in name.split("/") if part)


def walk_file(file: BagFile) -> Layout:
    """Find connections and chunks without the index, from the start, and go on behind every damaged place."""
    connections: dict[int, Channel] = {}
    chunks: list[ChunkPlace] = []
    damage: list[Damage] = []
    for item in _walk(file):
        if isinstance(item, Damage):
            damage.append(item)
        elif item.op == Op.CHUNK:
            chunks.append(ChunkPlace(record=item, data_bytes=item.data_bytes))
        elif item.op == Op.CONNECTION:
            try:
                add_connection(connections, item.number("conn"), item.offset, file.data_of(item), item.fields)
            except Damage as error:
                damage.append(error)
    limited = [_limited(file, chunks, index) for index in range(len(chunks))]
    return Layout(connections=connections, chunks=limited, damage=damage)


def _limited(file: BagFile, chunks: list[ChunkPlace], index: int) -> ChunkPlace:
    record = chunks[index].record
    end = chunks[index + 1].record.offset if index + 1 < len(chunks) else file.size
    return ChunkPlace(record=record, data_bytes=min(record.data_bytes, end - record.data_at))


def _walk(file: BagFile) -> Iterator[Record | Damage]:
    offset, search_from = len(MAGIC), len(MAGIC) + 1
    while offset < file.size:
        try:
            record = file.record_at(offset)
            if record.op not in tuple(Op):
                raise Damage(offset, f"a record of unknown kind {record.op}")
            if record.op == Op.CHUNK:
                # A chunk whose length is wrong leads past chunks that are sound: look for them inside it.
                search_from = record.data_at
                yield record
            if record.end > file.size:
                raise cut_off(file, record)
            if record.op != Op.CHUNK:
                yield record
            offset = record.end
        except Damage as error:
            yield error
            offset = file.find_chunk(search_from)
            search_from = max(search_from, offset + 1)
