"""Damaged, altered and hostile MCAP files: each gives the same signals as the sound one or an error, never others."""

import random
import struct
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import zstandard
from mcap.data_stream import RecordBuilder
from mcap.records import Channel, Chunk, DataEnd, Footer, Header, McapRecord, Message, Schema
from mcap.writer import CompressionType, IndexType
from mcap.writer import Writer as PlainWriter

from identification.errors import LogError
from identification.logs import inspect_log, read_recording
from identification.logs.mcap_file import MAGIC
from identification.recording import PoseSignal, Recording, WrenchSignal
from tests.identification.logs.log_builder import Options, complete, write_mcap

FLIPS = 400


def same(first: Recording, second: Recording) -> bool:
    if first.command is None or second.command is None:
        return False
    return (
        np.array_equal(first.wrench.stamp_ns, second.wrench.stamp_ns)
        and np.array_equal(first.wrench.force_n, second.wrench.force_n)
        and np.array_equal(first.wrench.torque_n_m, second.wrench.torque_n_m)
        and all(
            np.array_equal(one.stamp_ns, other.stamp_ns)
            and np.array_equal(one.position_m, other.position_m)
            and np.array_equal(one.quaternion_xyzw, other.quaternion_xyzw)
            for one, other in ((first.pose, second.pose), (first.command, second.command))
        )
    )


@pytest.mark.parametrize("compression", list(CompressionType))
def test_every_compression_gives_the_samples_that_were_written(tmp_path: Path, compression: CompressionType) -> None:
    streams = complete()
    recording = read_recording(write_mcap(tmp_path / "run.mcap", streams, Options(compression=compression)))
    assert recording.command is not None
    signals: tuple[WrenchSignal | PoseSignal, ...] = (recording.wrench, recording.pose, recording.command)
    for signal, stream in zip(signals, streams, strict=True):
        assert signal.topic == stream.topic
        assert signal.frame_id == stream.frame_id
        assert np.array_equal(signal.stamp_ns, stream.stamp_ns)
    assert np.array_equal(recording.wrench.force_n, streams[0].values[:, :3])
    assert np.array_equal(recording.wrench.torque_n_m, streams[0].values[:, 3:])
    assert np.array_equal(recording.pose.position_m, streams[1].values[:, :3])
    # Normalising a quaternion of norm 1 within rounding changes it by a few units in the last place.
    assert np.allclose(recording.pose.quaternion_xyzw, streams[1].values[:, 3:], rtol=0, atol=1e-15)


@pytest.mark.parametrize("compression", [CompressionType.NONE, CompressionType.LZ4, CompressionType.ZSTD])
def test_no_flipped_bit_changes_a_sample_in_silence(tmp_path: Path, compression: CompressionType) -> None:
    path = write_mcap(tmp_path / "run.mcap", complete(), Options(compression=compression))
    sound, data = read_recording(path), path.read_bytes()
    chooser = random.Random(20240607)
    positions = [chooser.randrange(8 * len(data)) for _ in range(FLIPS)]
    # The frame around the chunks is where no checksum reaches: take all of its start and many bits of its end.
    positions += range(8 * 60)
    positions += [8 * (len(data) - 1 - chooser.randrange(1500)) + chooser.randrange(8) for _ in range(FLIPS)]
    wrong = [bit for bit in positions if not _refused_or_same(tmp_path / "flip.mcap", data, bit, sound)]
    assert wrong == []


def test_no_flipped_bit_in_the_frame_of_a_record_changes_a_sample(tmp_path: Path) -> None:
    path = write_mcap(tmp_path / "run.mcap", complete())
    sound, data = read_recording(path), path.read_bytes()
    # One record of each kind; 46 bytes are the longest frame, that of a chunk: length, times, sizes, CRC, compression.
    starts = {opcode: offset for offset, opcode in _top_records(data)}.values()
    bits = [8 * byte + bit for start in starts for byte in range(start, min(start + 46, len(data))) for bit in (1, 6)]
    wrong = [bit for bit in bits if not _refused_or_same(tmp_path / "flip.mcap", data, bit, sound)]
    assert wrong == []


def test_every_truncation_is_refused_with_file_and_byte(tmp_path: Path) -> None:
    data = write_mcap(tmp_path / "run.mcap", complete()).read_bytes()
    cut = tmp_path / "cut.mcap"
    for size in [*range(1, 200, 7), *range(200, len(data), len(data) // 150), *range(len(data) - 60, len(data))]:
        cut.write_bytes(data[:size])
        with pytest.raises(LogError, match=r"cut\.mcap") as caught:
            read_recording(cut)
        assert size < len(MAGIC) or "byte" in str(caught.value)


def test_bytes_after_the_end_are_refused(tmp_path: Path) -> None:
    path = write_mcap(tmp_path / "run.mcap", complete())
    path.write_bytes(path.read_bytes() * 2)
    with pytest.raises(LogError, match="follow the end"):
        read_recording(path)


def test_absent_checksums_are_told_not_refused(tmp_path: Path) -> None:
    path = write_mcap(tmp_path / "run.mcap", complete(), Options(enable_crcs=False))
    assert "crc-absent" in [finding.code for finding in inspect_log(path).findings]
    assert read_recording(path).wrench.stamp_ns.size == 200
    protected = write_mcap(tmp_path / "protected.mcap", complete())
    assert "crc-absent" not in [finding.code for finding in inspect_log(protected).findings]


@pytest.mark.parametrize("chunked", [True, False])
@pytest.mark.parametrize("data_crc", [True, False])
@pytest.mark.parametrize("summary", [True, False])
def test_files_without_summary_chunks_or_indexes_are_read(
    tmp_path: Path, chunked: bool, data_crc: bool, summary: bool
) -> None:
    path = tmp_path / "bare.mcap"
    with path.open("wb") as file:
        writer = PlainWriter(
            file,
            use_chunking=chunked,
            enable_data_crcs=data_crc,
            use_statistics=summary,
            repeat_channels=summary,
            repeat_schemas=summary,
            use_summary_offsets=summary,
            index_types=IndexType.ALL if summary else IndexType.NONE,
        )
        writer.start()
        schema = writer.register_schema("pkg.Thing", "protobuf", b"")
        channel = writer.register_channel("/thing", "protobuf", schema)
        for number in range(10):
            writer.add_message(channel, log_time=number, publish_time=0, data=bytes(number))
        writer.finish()
    told = inspect_log(path)
    assert [(c.topic, c.type, c.count, c.roles) for c in told.channels] == [("/thing", "pkg.Thing", 10, ())]
    assert ("crc-absent" in [finding.code for finding in told.findings]) == (not chunked and not data_crc)


def test_channels_that_share_topic_and_type_are_one_and_others_are_not(tmp_path: Path) -> None:
    path = tmp_path / "shared.mcap"
    with path.open("wb") as file:
        writer = PlainWriter(file)
        writer.start()
        ids = [writer.register_schema(name, "protobuf", b"") for name in ("pkg.A", "pkg.B")]
        channels = [writer.register_channel("/same", "protobuf", ids[which]) for which in (0, 0, 1)]
        for number, channel in enumerate([*channels, channels[0]]):
            writer.add_message(channel, log_time=number, publish_time=0, data=b"x")
        writer.finish()
    assert [(c.type, c.count) for c in inspect_log(path).channels] == [("pkg.A", 3), ("pkg.B", 1)]


def written(builder: RecordBuilder) -> bytes:
    return bytes(builder.end())


def file_of(*records: McapRecord | bytes) -> bytes:
    """Assemble a file from records and bare bytes, without a summary."""
    builder = RecordBuilder()
    for record in records:
        if isinstance(record, bytes):
            builder.write(record)
        else:
            record.write(builder)
    return MAGIC + written(builder) + MAGIC


def chunk(content: bytes, **changes: object) -> Chunk:
    told: dict[str, object] = {
        "compression": "zstd",
        "data": zstandard.compress(content),
        "message_start_time": 0,
        "message_end_time": 0,
        "uncompressed_crc": zlib.crc32(content),
        "uncompressed_size": len(content),
        **changes,
    }
    return Chunk(**told)  # type: ignore[arg-type]


def inner(*records: McapRecord) -> bytes:
    builder = RecordBuilder()
    for record in records:
        record.write(builder)
    return written(builder)


HEAD, TAIL = Header("ros2", "by hand"), (DataEnd(0), Footer(0, 0, 0))
SCHEMA = Schema(id=1, name="pkg/msg/A", encoding="ros2msg", data=b"uint8 a")
CHANNEL = Channel(id=1, topic="/a", message_encoding="cdr", metadata={}, schema_id=1)
MESSAGE = Message(channel_id=1, log_time=5, data=b"\0\1\0\0\7", publish_time=5, sequence=0)
GOOD = inner(SCHEMA, CHANNEL, MESSAGE)
HUGE = 2**40


@pytest.mark.parametrize(
    ("content", "complaint"),
    [
        ((HEAD, chunk(bytes(2**28 + 1)), *TAIL), "more than the 268435456"),
        ((HEAD, chunk(GOOD, uncompressed_size=HUGE), *TAIL), "more than the 268435456"),
        ((HEAD, chunk(GOOD, data=zstandard.compress(bytes(2**26))), *TAIL), "compressed content another size"),
        ((HEAD, chunk(GOOD, uncompressed_size=len(GOOD) - 1, compression="", data=GOOD), *TAIL), "it says"),
        ((HEAD, chunk(GOOD, compression="zst"), *TAIL), "not one of zstd, lz4 or none"),
        ((HEAD, chunk(GOOD, compression="lz4"), *TAIL), "damaged before byte"),
        ((HEAD, chunk(GOOD, data=b"no zstd"), *TAIL), "damaged before byte"),
        ((HEAD, chunk(GOOD, uncompressed_crc=1), *TAIL), "CRC of a chunk"),
        ((HEAD, chunk(GOOD[:-1]), *TAIL), "does not fit into its chunk"),
        ((HEAD, chunk(bytes(2**20)), *TAIL), "kind 0"),
        ((HEAD, chunk(inner(MESSAGE)), *TAIL), "channel 1, which is not defined"),
        ((HEAD, chunk(inner(CHANNEL)), *TAIL), "schema 1, which is not defined"),
        ((HEAD, chunk(inner(SCHEMA, CHANNEL) + struct.pack("<BQ21x", 5, 21)), *TAIL), "too short"),
        ((HEAD, SCHEMA, Schema(id=1, name="pkg/msg/B", encoding="ros2msg", data=b""), *TAIL), "defined twice"),
        ((HEAD, struct.pack("<BQ", 6, HUGE), *TAIL), "exceeds limit"),
        ((HEAD, SCHEMA, CHANNEL, struct.pack("<BQ", 5, 3) + b"abc", *TAIL), "truncated or damaged at byte"),
        ((HEAD, SCHEMA, Footer(0, 0, 0)), "ends the data section is missing"),
        ((HEAD, SCHEMA, DataEnd(77), Footer(0, 0, 0)), "crc validation failed in DataEnd"),
        ((HEAD, SCHEMA, DataEnd(0), Footer(0, 0, 99)), "CRC of the summary"),
        ((HEAD, SCHEMA, DataEnd(0), Footer(HUGE, 0, 99)), "summary should start"),
    ],
)
def test_files_assembled_to_mislead_are_refused(
    tmp_path: Path, content: tuple[McapRecord | bytes, ...], complaint: str
) -> None:
    path = tmp_path / "made.mcap"
    path.write_bytes(file_of(*content))
    with pytest.raises(LogError, match=complaint) as caught:
        inspect_log(path)
    assert "made.mcap" in str(caught.value)


def test_the_same_file_without_the_fault_is_read(tmp_path: Path) -> None:
    path = tmp_path / "made.mcap"
    path.write_bytes(file_of(HEAD, chunk(GOOD), *TAIL))
    assert [(c.topic, c.count) for c in inspect_log(path).channels] == [("/a", 1)]


def test_a_chunk_hidden_behind_another_record_kind_is_noticed_by_the_counts(tmp_path: Path) -> None:
    path = write_mcap(tmp_path / "run.mcap", complete())
    data = bytearray(path.read_bytes())
    chunks = [offset for offset, opcode in _top_records(bytes(data)) if opcode == 0x06]
    data[chunks[len(chunks) // 2]] = 0x86
    path.write_bytes(data)
    with pytest.raises(LogError, match="its summary counts"):
        read_recording(path)


def _top_records(data: bytes) -> list[tuple[int, int]]:
    """Return offset and kind of every record outside chunks."""
    found, offset = [], len(MAGIC)
    while offset < len(data) - len(MAGIC):
        opcode, length = struct.unpack_from("<BQ", data, offset)
        found.append((offset, opcode))
        offset += 9 + length
    return found


def _refused_or_same(path: Path, data: bytes, bit: int, sound: Recording) -> bool:
    damaged = bytearray(data)
    damaged[bit // 8] ^= 1 << bit % 8
    path.write_bytes(damaged)
    try:
        return same(read_recording(path), sound)
    except LogError:
        return True


Reader = Callable[[Path], object]


@pytest.mark.parametrize("read", [inspect_log, read_recording])
def test_what_is_no_log_is_refused(tmp_path: Path, read: Reader) -> None:
    directory = tmp_path / "rosbag2_2024"
    directory.mkdir()
    (directory / "part_0.mcap").write_bytes(b"")
    cases = {
        "empty.mcap": (b"", "is empty"),
        "text.mcap": (b"time,fx,fy\n0,1,2\n", "is not a log: it starts with the bytes 74 69 6d 65"),
        "old.db3": (b"SQLite format 3\0" + bytes(100), "convert it with `ros2 bag convert`"),
        "magic.mcap": (MAGIC, "truncated or damaged at byte 8"),
    }
    for name, (content, complaint) in cases.items():
        (tmp_path / name).write_bytes(content)
        with pytest.raises(LogError, match=complaint) as caught:
            read(tmp_path / name)
        assert name in str(caught.value)
    with pytest.raises(LogError, match=r"rosbag2_2024 is a directory; .* part_0\.mcap"):
        read(directory)
    with pytest.raises(LogError, match="No such file"):
        read(tmp_path / "absent.mcap")
    with pytest.raises(LogError, match="not a regular file"):
        read(Path("/dev/zero"))
