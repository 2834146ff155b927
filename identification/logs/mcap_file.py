"""MCAP: framing by the `mcap` library with CRC validation on, and the checks that it leaves out.

The library checks the CRC of the data section and, when it unpacks a chunk itself, of the chunk. It does not check the
summary's CRC, whether the summary's counts agree with the data, or how far a chunk unpacks. A record whose kind was
altered is skipped by it in silence, so the counts matter.
"""

import struct
import zlib
from collections import Counter
from collections.abc import Callable
from io import BytesIO
from pathlib import Path
from typing import IO, cast

import lz4.frame  # type: ignore[import-untyped]  # the package carries no annotations
import zstandard
from mcap import records
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.stream_reader import StreamReader
from rosbags.typesys.msg import normalize_msgtype

from ..errors import LogError
from ..result import Finding
from .bounded_file import CHUNK_LIMIT_BYTES, BoundedFile
from .channel import Buffer, Channel, Collector, Keep, Scan

MAGIC = b"\x89MCAP0\r\n"
_RECORD = struct.Struct("<BQ")
_MESSAGE = struct.Struct("<HIQQ")
_FOOTER_BYTES = 29
_FOREIGN = (
    McapError,
    ValueError,
    struct.error,
    RuntimeError,
    OverflowError,
    MemoryError,
    LookupError,
    zstandard.ZstdError,
)


def scan_mcap(path: Path, keep: Callable[[Channel], Keep]) -> Scan:
    """Read every message of an MCAP file once, as far as `keep` asks; raise LogError if anything is damaged."""
    with BoundedFile(path) as file:
        try:
            return _Scanner(file, keep).run(path)
        except _FOREIGN as error:
            reason = str(error) or type(error).__name__
            raise LogError(
                f"{path.name} is damaged before byte {file.tell()}: {reason}; record again or run `mcap recover`."
            ) from error


class _Scanner:
    def __init__(self, file: BoundedFile, keep: Callable[[Channel], Keep]) -> None:
        self._file = file
        self._collector = Collector(keep)
        self._schemas: dict[int, records.Schema] = {}
        self._channels: dict[int, records.Channel] = {}
        self._buffers: dict[int, Buffer] = {}
        self._counts: Counter[int] = Counter()
        self._chunks = 0
        self._unprotected = 0
        self._data_end: records.DataEnd | None = None
        self._statistics: records.Statistics | None = None
        self._footer: records.Footer | None = None

    def run(self, path: Path) -> Scan:
        stream = cast(IO[bytes], self._file)
        reader = StreamReader(stream, emit_chunks=True, validate_crcs=True, record_size_limit=self._file.size)
        for record in reader.records:
            if isinstance(record, records.Chunk):
                self._add_chunk(record)
            elif isinstance(record, records.Message):
                self._unprotected += 1
                self._add_message(record.channel_id, record.log_time, record.data)
            elif isinstance(record, records.DataEnd):
                self._data_end = record
            elif isinstance(record, records.Statistics):
                self._statistics = record
            elif isinstance(record, records.Footer):
                self._footer = record
            elif self._data_end is None:
                self._add_definition(record)
        self._check_end()
        return self._collector.finish(path, "mcap", self._findings())

    def _fail(self, reason: str) -> LogError:
        return LogError(
            f"{self._file.name} is damaged before byte {self._file.tell()}: {reason}; "
            "record again or run `mcap recover`."
        )

    def _add_definition(self, record: records.McapRecord) -> None:
        if isinstance(record, records.Schema):
            known_schema = self._schemas.setdefault(record.id, record)
            if known_schema != record:
                raise self._fail(f"schema {record.id} is defined twice, differently")
        elif isinstance(record, records.Channel):
            known = self._channels.setdefault(record.id, record)
            if known != record:
                raise self._fail(f"channel {record.id} is defined twice, differently")
            if record.id not in self._buffers:
                self._buffers[record.id] = self._collector.buffer(self._channel(record))

    def _channel(self, record: records.Channel) -> Channel:
        if record.schema_id == 0:
            return Channel(topic=record.topic, type_name="", encoding=record.message_encoding, definition="")
        if record.schema_id not in self._schemas:
            raise self._fail(f"channel {record.topic} names schema {record.schema_id}, which is not defined")
        schema = self._schemas[record.schema_id]
        is_ros = schema.encoding in ("ros2msg", "ros1msg", "ros2idl")
        return Channel(
            topic=record.topic,
            type_name=normalize_msgtype(schema.name) if is_ros else schema.name,
            encoding=record.message_encoding,
            definition=schema.data.decode() if schema.encoding in ("ros2msg", "ros1msg") else "",
        )

    def _add_message(self, channel_id: int, log_ns: int, data: bytes | memoryview) -> None:
        buffer = self._buffers.get(channel_id)
        if buffer is None:
            raise self._fail(f"a message names channel {channel_id}, which is not defined")
        self._counts[channel_id] += 1
        buffer.add(log_ns, data)

    def _add_chunk(self, chunk: records.Chunk) -> None:
        self._chunks += 1
        data = self._unpack(chunk)
        before = self._counts.total()
        self._add_chunk_records(memoryview(data))
        if chunk.uncompressed_crc == 0:
            self._unprotected += self._counts.total() - before
        elif zlib.crc32(data) != chunk.uncompressed_crc:
            raise self._fail("the CRC of a chunk does not agree with its content")

    def _unpack(self, chunk: records.Chunk) -> bytes:
        declared = chunk.uncompressed_size
        if declared > CHUNK_LIMIT_BYTES:
            raise self._fail(f"a chunk unpacks to {declared} bytes, more than the {CHUNK_LIMIT_BYTES} that are allowed")
        if chunk.compression == "zstd":
            if zstandard.frame_content_size(chunk.data) not in (-1, declared):
                raise self._fail(f"a chunk says {declared} bytes, its compressed content another size")
            data = zstandard.decompress(chunk.data, max_output_size=declared) if declared else b""
        elif chunk.compression == "lz4":
            data = lz4.frame.LZ4FrameDecompressor().decompress(chunk.data, max_length=declared + 1)
        elif chunk.compression == "":
            data = chunk.data
        else:
            raise self._fail(f"compression {chunk.compression!r} is not one of zstd, lz4 or none")
        if len(data) != declared:
            raise self._fail(f"a chunk unpacks to {len(data)} bytes, it says {declared}")
        return data

    def _add_chunk_records(self, data: memoryview) -> None:
        position, size = 0, len(data)
        while position < size:
            opcode, length = _RECORD.unpack_from(data, position)
            body = position + _RECORD.size
            position = body + length
            if position > size or opcode == 0:
                raise self._fail(f"a record of kind {opcode} and {length} bytes does not fit into its chunk")
            if opcode == Opcode.MESSAGE:
                if length < _MESSAGE.size:
                    raise self._fail(f"a message record of {length} bytes is too short")
                channel_id, _, log_ns, _ = _MESSAGE.unpack_from(data, body)
                self._add_message(channel_id, log_ns, data[body + _MESSAGE.size : position])
            elif opcode == Opcode.SCHEMA:
                self._add_definition(records.Schema.read(ReadDataStream(BytesIO(data[body:position]))))
            elif opcode == Opcode.CHANNEL:
                self._add_definition(records.Channel.read(ReadDataStream(BytesIO(data[body:position]))))

    def _check_end(self) -> None:
        if self._data_end is None or self._footer is None:
            raise self._fail("the record that ends the data section is missing")
        end = self._file.tell()
        if end != self._file.size:
            raise self._fail(f"{self._file.size - end} bytes follow the end of the log")
        if self._footer.summary_crc and self._summary_crc(self._footer, end) != self._footer.summary_crc:
            raise self._fail("the CRC of the summary does not agree with its content")
        told = self._statistics
        if told is None:
            return
        counts = {key: count for key, count in told.channel_message_counts.items() if count}
        if (told.message_count, told.chunk_count) != (self._counts.total(), self._chunks) or (
            counts and counts != self._counts
        ):
            raise self._fail(
                f"its summary counts {told.message_count} messages in {told.chunk_count} chunks, "
                f"the data hold {self._counts.total()} in {self._chunks}"
            )

    def _summary_crc(self, footer: records.Footer, end: int) -> int:
        footer_start = end - len(MAGIC) - _FOOTER_BYTES
        start, stop = footer.summary_start or footer_start, footer_start + _FOOTER_BYTES - 4
        if start > footer_start:
            raise self._fail(f"the summary should start at byte {start}")
        self._file.seek(start)
        crc = 0
        while start < stop:
            piece = self._file.read(min(2**20, stop - start))
            crc = zlib.crc32(piece, crc)
            start += len(piece)
        return crc

    def _findings(self) -> tuple[Finding, ...]:
        protected = self._data_end is not None and self._data_end.data_section_crc != 0
        if protected or not self._unprotected:
            return ()
        return (
            Finding(
                code="crc-absent",
                severity="info",
                message=f"{self._unprotected} of {self._counts.total()} messages carry no checksum (CRC): "
                "a flipped bit in the file would not be noticed.",
                advice="Let the recorder write chunk CRCs (rosbag2: storage option `noChunkCRC: false`).",
            ),
        )
