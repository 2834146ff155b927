"""ROS 1 bags (version 2.0): rosbags reads the records of their index, a compiled walk the messages of each chunk.

Only chunks with wanted connections are unpacked, and the index is held against the messages that they contain.
"""

import io
import os
import struct
from collections import Counter
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TypeVar

import numpy as np
from rosbags.rosbag1 import Reader, ReaderError
from rosbags.rosbag1.reader import Header, RecordType, read_uint32

from ...errors import LogError
from ...result import Finding
from .channel import Batch, Channel, Container, Damage, Held, Survey, recorded_text
from .ros1_chunk import ChunkRecord, Walk, check_index, unpack_chunk, walk_chunk

T = TypeVar("T")
MAGIC = b"#ROSBAG V2.0\n"
_FOREIGN = (ReaderError, AssertionError, struct.error, ValueError, LookupError, OverflowError, MemoryError)
_INDEX_ENTRY_BYTES = 12

NO_CRC = Finding.info(
    "crc-absent",
    "A ROS 1 bag carries no checksums (CRC): a flipped bit in the file may go unnoticed.",
    "Record MCAP with chunk CRCs where that is possible.",
)


class BagFile(io.BufferedReader):
    """A file of which no more is read than it has, so that a damaged length asks for no memory."""

    def __init__(self, path: Path) -> None:
        super().__init__(io.FileIO(path))
        self.size = os.fstat(self.fileno()).st_size

    def read(self, size: int | None = -1) -> bytes:
        """Read up to `size` bytes."""
        left = max(self.size - self.tell(), 0)
        return super().read(left if size is None or size < 0 else min(size, left))

    def exactly(self, offset: int, size: int) -> bytes:
        """Read bytes at an offset; raise Damage where the file has fewer."""
        if not 0 <= size <= self.size - offset:
            raise Damage(offset, f"{size} bytes should follow, the file has {max(self.size - offset, 0)}")
        self.seek(offset)
        return self.read(size)


@contextmanager
def _at(file: BagFile, offset: int) -> Iterator[None]:
    """Start reading at an offset; raise Damage there for whatever rosbags cannot read."""
    if not 0 <= offset <= file.size:
        raise Damage(offset, f"a record should be here, the file has {file.size} bytes")
    try:
        file.seek(offset)
        yield
    except _FOREIGN as error:
        raise Damage(offset, " ".join(str(error).split()).rstrip(".") or "the record cannot be read") from error


class _Records(Reader):
    """The record parsers of rosbags, applied to one file or to an unpacked chunk."""

    def channel_at(self, file: io.BufferedIOBase, offset: int) -> tuple[int, Channel]:
        """Return a connection's number and channel."""
        file.seek(offset)
        self.bio = file  # type: ignore[assignment]  # any seekable file will do
        found = self.read_connection()
        return found.id, Channel(
            topic=found.topic,
            type_name=found.msgtype,
            encoding="ros1",
            schema_encoding="ros1msg",
            schema=found.msgdef.data.encode(),
        )


class Ros1BagContainer(Container):
    """A ROS 1 bag.

    A chunk that cannot be read is left out and reported where the index says what it held; with `salvage` what can be
    read of it is kept, and a missing index is replaced by a walk.
    """

    def __init__(self, path: Path, *, salvage: bool = False) -> None:
        self._name, self._salvage = path.name, salvage
        self._survey: Survey | None = None
        self._lost: list[Damage] = []
        self._left_out: dict[int, Damage] = {}
        self._connections: dict[int, Channel] = {}
        with self._refusing():
            self._file, self._records = BagFile(path), _Records(path)
        try:
            with self._refusing():
                self._chunks = self._read_layout()
        except BaseException:
            self.close()
            raise

    def survey(self) -> Survey:
        """Count the messages by the index, or with `salvage` those that can be read; raise LogError on damage."""
        if self._survey is None:
            with self._refusing():
                self._survey = self._walked_survey() if self._salvage else self._indexed_survey()
        return self._survey

    def read(self, wanted: Collection[Channel], handle: Callable[[Batch], T]) -> Iterator[tuple[Channel, T]]:
        """Read the wanted channels once; see `Container.read`."""
        self.survey()
        chosen = set(wanted)
        channels = {number: channel for number, channel in self._connections.items() if channel in chosen}
        with self._refusing():
            for record in self._chunks:
                is_asked = record.counts.keys() & channels.keys() and self.may_want(record.start_ns, record.end_ns)
                if self._salvage or is_asked:
                    for batch in self._batches(record, channels):
                        yield batch.channel, handle(batch)

    def lost(self) -> tuple[str, ...]:
        """Name the damaged places that were left out so far."""
        places = [f"at byte {item.offset}: {item.reason}" for item in self._lost]
        first_ns = min((record.start_ns for record in self._chunks if record.counts), default=0)
        total = sum(sum(record.counts.values()) for record in self._chunks)
        for record in self._chunks:
            if record.offset in self._left_out:
                reason, count = self._left_out[record.offset].reason, sum(record.counts.values())
                when = f", {recorded_text(record.start_ns, record.end_ns, first_ns)}, {count} of {total} messages"
                places.append(f"at byte {record.offset}: {reason} (left out{when if count else ''})")
        return tuple(places)

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    @contextmanager
    def _refusing(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            raise LogError(f"{self._name} cannot be read: {error.strerror or error}; copy the file again.") from error
        except Damage as damage:
            raise LogError(
                f"{self._name} is damaged at byte {damage.offset}: {damage.reason}; "
                "repair it with `rosbag reindex`, read what is sound of it with --salvage, or record again."
            ) from damage

    # Layout

    def _read_layout(self) -> list[ChunkRecord]:
        if self._file.exactly(0, min(len(MAGIC), self._file.size)) != MAGIC:
            raise Damage(0, "a ROS 1 bag must start with the line `#ROSBAG V2.0`")
        try:
            return self._indexed_chunks()
        except Damage as damage:
            if not self._salvage:
                raise
            self._lost.append(damage)
            return self._walked_chunks()

    def _indexed_chunks(self) -> list[ChunkRecord]:
        """Read the index at the end of the file; raise Damage where it is missing or does not fit the file."""
        file, start = self._file, len(MAGIC)
        with _at(file, start):
            head = Header.read(file, RecordType.BAGHEADER)
            index_at = head.get_uint64("index_pos")
            connection_count, chunk_count = head.get_uint32("conn_count"), head.get_uint32("chunk_count")
        if head.get("encryptor"):
            raise Damage(start, f"the bag is encrypted ({head['encryptor']!r}), which is not supported")
        if index_at == 0:
            raise Damage(start, "the bag is not indexed (index_pos 0): its recorder was not stopped properly")
        if not start < index_at <= file.size:
            raise Damage(start, f"the index should start at byte {index_at}, the file has {file.size}")
        offset = index_at
        for _ in range(connection_count):
            self._define(offset)
            offset = file.tell()
        infos = []
        for _ in range(chunk_count):
            with _at(file, offset):
                self._records.bio = file
                infos.append(self._records.read_chunk_info())
            if not infos[-1].connection_counts.keys() <= self._connections.keys():
                raise Damage(offset, "the index counts messages of a connection that is not defined")
            offset = file.tell()
        if offset != file.size:
            raise Damage(offset, f"{file.size - offset} bytes follow the end of the index")
        infos.sort(key=lambda info: info.pos)
        found = []
        for info, end in zip(infos, [*(info.pos for info in infos), index_at][1:], strict=True):
            counts = info.connection_counts
            start_ns, end_ns = (info.start_time, info.end_time - 1) if counts else (0, 0)
            if (record := self._chunk_record(info.pos, end)) is not None:
                found.append(replace(record, counts=counts, start_ns=start_ns, end_ns=end_ns))
        return found

    def _chunk_record(self, offset: int, end: int) -> ChunkRecord | None:
        """Read the head of a chunk that must stop before `end`; with `salvage` it is cut there, None without a head."""
        file = self._file
        try:
            with _at(file, offset):
                header = Header.read(file, RecordType.CHUNK)
                compression, declared = header.get_string("compression"), header.get_uint32("size")
                stored, data_at = read_uint32(file), file.tell()
            if stored > end - data_at and not self._salvage:
                raise Damage(offset, f"{stored} bytes should follow, {end - data_at} are left before what comes next")
        except Damage as damage:
            if not self._salvage:
                raise
            self._lost.append(damage)
            return None
        return ChunkRecord(
            offset=offset,
            compression=compression,
            declared=declared,
            data_at=data_at,
            stored=max(min(stored, end - data_at), 0),
            is_whole=stored <= end - data_at,
        )

    def _walked_chunks(self) -> list[ChunkRecord]:
        """Find chunks and connections record by record, up to the first place that cannot be read."""
        file, offset, found = self._file, len(MAGIC), []
        try:
            while offset < file.size:
                with _at(file, offset):
                    kind = Header.read(file).get_uint8("op")
                    end = read_uint32(file) + file.tell()
                if kind == RecordType.CHUNK and (record := self._chunk_record(offset, file.size)) is not None:
                    found.append(record)
                elif kind == RecordType.CONNECTION:
                    self._define(offset)
                elif kind not in tuple(RecordType):
                    raise Damage(offset, f"a record of unknown kind {kind}")
                if end > file.size:
                    raise Damage(offset, f"the record here should end at byte {end}, the file has {file.size}")
                offset = end
        except Damage as damage:
            self._lost.append(damage)
        return found

    def _define(self, offset: int, chunk: io.BytesIO | None = None, inside: int = 0) -> None:
        """Add the connection at an offset (in an unpacked chunk at `inside`); raise Damage where it contradicts."""
        with _at(self._file, offset):
            number, channel = self._records.channel_at(chunk or self._file, inside if chunk else offset)
        if self._connections.setdefault(number, channel) != channel:
            raise Damage(offset, f"connection {number} is defined twice, differently")

    # Chunks

    def _chunk(self, record: ChunkRecord, lost: list[Damage]) -> tuple[bytes, Walk]:
        """Unpack a chunk and find its messages; raise Damage, with `salvage` note in `lost` what cannot be read."""
        data, faults = b"", []
        try:
            data = unpack_chunk(record, self._file.exactly)
        except Damage as damage:
            faults.append(damage)
        walk = walk_chunk(data, resume=self._salvage)
        if walk.broken_at >= 0:
            reason = f"the chunk here holds no record at byte {walk.broken_at} of its {len(data)}"
            faults.append(Damage(record.offset, reason))
        for start in walk.offsets[walk.ops == RecordType.CONNECTION].tolist():
            try:
                self._define(record.offset, io.BytesIO(data), start)
            except Damage as damage:
                faults.append(damage)
        if faults and not self._salvage:
            raise faults[0]
        lost.extend(faults)
        if not self._salvage:
            check_index(self._index_of(record), record, walk)
        return data, walk

    def _sound_chunk(self, record: ChunkRecord) -> tuple[bytes, Walk] | None:
        """Return a chunk as `_chunk` does, None where it is damaged, which is noted."""
        if record.offset in self._left_out:
            return None
        try:
            return self._chunk(record, [])
        except Damage as damage:
            self._left_out[record.offset] = damage
            return None

    def _index_of(self, record: ChunkRecord) -> Iterator[tuple[int, int, bytes]]:
        """Yield offset, connection and entries of the index records behind a chunk."""
        file, offset = self._file, record.data_at + record.stored
        for _ in record.counts:
            with _at(file, offset):
                header = Header.read(file, RecordType.IDXDATA)
                version, count = header.get_uint32("ver"), header.get_uint32("count")
                size, data_at = read_uint32(file), file.tell()
                number = header.get_uint32("conn")
            if version != 1 or size != _INDEX_ENTRY_BYTES * count:
                raise Damage(offset, "the index of a chunk has an unknown version or another length than it says")
            yield offset, number, file.exactly(data_at, size)
            offset = data_at + size

    def _batches(self, record: ChunkRecord, channels: dict[int, Channel]) -> Iterator[Batch]:
        if (opened := self._sound_chunk(record)) is None:
            return
        data, walk = opened
        is_message = walk.ops == RecordType.MSGDATA
        here = np.unique(walk.connections[is_message]).tolist()
        for channel in {channels[number]: None for number in here if number in channels}:
            numbers = [number for number, each in channels.items() if each == channel]
            rows = is_message & np.isin(walk.connections, numbers)
            yield Batch(
                channel=channel,
                log_ns=walk.log_ns[rows],
                data=np.frombuffer(data, dtype=np.uint8),
                starts=walk.starts[rows],
                sizes=walk.sizes[rows],
                leave_out=partial(self._leave_out, record),
            )

    def _leave_out(self, record: ChunkRecord, reason: str) -> None:
        self._left_out.setdefault(record.offset, Damage(record.offset, reason))

    # Survey

    def _indexed_survey(self) -> Survey:
        counts: Counter[Channel] = Counter()
        first: dict[Channel, bytes] = {}
        for record in self._chunks:
            here = {self._connections[number]: count for number, count in record.counts.items() if count}
            for number, count in record.counts.items():
                counts[self._connections[number]] += count
            if here.keys() - first.keys() and (opened := self._sound_chunk(record)) is not None:
                self._note_first(*opened, first)
        if self._left_out and not first:
            raise next(iter(self._left_out.values()))
        filled = [record for record in self._chunks if record.counts]
        start_ns, end_ns = [record.start_ns for record in filled], [record.end_ns for record in filled]
        return self._survey_of(counts, first, min(start_ns, default=0), max(end_ns, default=0))

    def _walked_survey(self) -> Survey:
        counts: Counter[Channel] = Counter()
        first: dict[Channel, bytes] = {}
        times: list[int] = []
        for record in self._chunks:
            data, walk = self._chunk(record, self._lost)
            is_message = walk.ops == RecordType.MSGDATA
            for number, count in Counter(walk.connections[is_message].tolist()).items():
                if number in self._connections:
                    counts[self._connections[number]] += count
                else:
                    reason = f"{count} messages of connection {number}, whose definition is lost"
                    self._lost.append(Damage(record.offset, reason))
            if bool(np.any(is_message)):
                times += [int(walk.log_ns[is_message].min()), int(walk.log_ns[is_message].max())]
            self._note_first(data, walk, first)
        return self._survey_of(counts, first, min(times, default=0), max(times, default=0))

    def _survey_of(self, counts: Counter[Channel], first: dict[Channel, bytes], start_ns: int, end_ns: int) -> Survey:
        channels = sorted(set(self._connections.values()), key=lambda each: (each.topic, each.type_name, each.schema))
        return Survey(
            container="ros1 bag",
            held=tuple(Held(channel=each, count=counts[each], first_message=first.get(each, b"")) for each in channels),
            start_ns=start_ns,
            end_ns=end_ns,
            findings=(NO_CRC,),
        )

    def _note_first(self, data: bytes, walk: Walk, first: dict[Channel, bytes]) -> None:
        rows = np.flatnonzero(walk.ops == RecordType.MSGDATA)
        _, at = np.unique(walk.connections[rows], return_index=True)
        for row in rows[np.sort(at)].tolist():
            channel = self._connections.get(int(walk.connections[row]))
            if channel is not None and channel not in first:
                start = int(walk.starts[row])
                first[channel] = data[start : start + int(walk.sizes[row])]
