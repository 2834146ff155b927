"""A ten-minute log written fast: the bytes of whole chunks by numpy, the frame of the file by the MCAP library."""

import struct
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

import lz4.frame  # type: ignore[import-untyped]  # the package carries no annotations
import numpy as np
import zstandard
from mcap import records
from mcap.data_stream import RecordBuilder
from numpy.typing import NDArray
from rosbags.typesys import Stores, get_typestore

RATE_HZ = 1250
START_NS = 1_700_000_000_000_000_000
CHUNK_BYTES = 768 * 1024
MAGIC = b"\x89MCAP0\r\n"
TOPICS = {
    "/ft/wrench": ("geometry_msgs/msg/WrenchStamped", 6, b"ft_sensor\0\0\0", 10),
    "/robot/pose": ("geometry_msgs/msg/PoseStamped", 7, b"base_link\0\0\0", 10),
    "/robot/twist": ("geometry_msgs/msg/TwistStamped", 6, b"base_link\0\0\0", 10),
}


def pack(data: bytes, compression: str) -> bytes:
    """Pack a chunk as the recorders do."""
    if compression == "zstd":
        return zstandard.compress(data, 3)
    return bytes(lz4.frame.compress(data)) if compression == "lz4" else data


def tick_type() -> np.dtype[np.void]:
    """Return the layout of one message of each topic, as they stand in a chunk."""
    fields: list[tuple[str, object]] = []
    for channel_id, (_, width, frame, _) in enumerate(TOPICS.values(), 1):
        size = 22 + 4 + 12 + len(frame) + 8 * width
        if (12 + len(frame)) % 8:
            raise ValueError("choose frame names that leave the doubles aligned")
        one = [
            ("op", "u1"), ("length", "<u8"), ("channel", "<u2"), ("sequence", "<u4"), ("log_ns", "<u8"),
            ("publish_ns", "<u8"), ("encapsulation", "u1", 4), ("sec", "<i4"), ("nanosec", "<u4"),
            ("name_bytes", "<u4"), ("name", f"S{len(frame)}"), ("values", "<f8", width),
        ]  # fmt: skip
        fields.append((f"m{channel_id}", np.dtype(one)))
        assert np.dtype(one).itemsize == 9 + size
    return np.dtype(fields)


def write_log(path: Path, compression: str, duration_s: float) -> Path:
    """Write wrench, pose and twist at 1250 Hz with chunk CRCs, indexes, statistics and a summary."""
    store = get_typestore(Stores.ROS2_HUMBLE)
    ids = range(1, len(TOPICS) + 1)
    schemas = [
        records.Schema(id=i, name=name, encoding="ros2msg", data=store.generate_msgdef(name, ros_version=2)[0].encode())
        for i, (name, *_) in zip(ids, TOPICS.values(), strict=True)
    ]
    channels = [
        records.Channel(id=i, topic=topic, message_encoding="cdr", metadata={}, schema_id=i)
        for i, topic in zip(ids, TOPICS, strict=True)
    ]
    indexes: list[records.ChunkIndex] = []
    with path.open("wb") as file:
        file.write(MAGIC + written(records.Header("ros2", "benchmark"), *schemas, *channels))
        count = 0
        for ticks in chunks_of_ticks(duration_s):
            indexes.append(_write_chunk(file, ticks, compression))
            count += ticks.size
        file.write(written(records.DataEnd(0)))
        start = file.tell()
        end_ns = indexes[-1].message_end_time
        statistics = records.Statistics(
            attachment_count=0,
            channel_count=len(ids),
            channel_message_counts=dict.fromkeys(ids, count),
            chunk_count=len(indexes),
            message_count=count * len(ids),
            message_end_time=end_ns,
            message_start_time=START_NS,
            metadata_count=0,
            schema_count=len(ids),
        )
        summary = written(*schemas, *channels, statistics, *indexes)
        footer = written(records.Footer(start, 0, 0))[:-4]
        file.write(summary + footer + zlib.crc32(summary + footer).to_bytes(4, "little") + MAGIC)
    return path


def _write_chunk(file: BinaryIO, ticks: NDArray[np.void], compression: str) -> records.ChunkIndex:
    data = ticks.tobytes()
    packed = pack(data, compression)
    start_ns, end_ns = int(ticks["m1"]["log_ns"][0]), int(ticks[f"m{len(TOPICS)}"]["log_ns"][-1])
    chunk = records.Chunk(
        compression=compression,
        data=packed,
        message_end_time=end_ns,
        message_start_time=start_ns,
        uncompressed_crc=zlib.crc32(data),
        uncompressed_size=len(data),
    )
    start = file.tell()
    file.write(written(chunk))
    end = file.tell()
    offsets = {}
    for place, (channel_id, field) in enumerate(enumerate(ticks.dtype.names or (), 1)):
        offsets[channel_id] = file.tell()
        entries = np.empty((ticks.size, 2), dtype="<u8")
        entries[:, 0] = ticks[field]["log_ns"]
        entries[:, 1] = np.arange(ticks.size) * ticks.dtype.itemsize + _offset_of(ticks.dtype, place)
        body = struct.pack("<HI", channel_id, entries.nbytes) + entries.tobytes()
        file.write(struct.pack("<BQ", 7, len(body)) + body)
    return records.ChunkIndex(
        chunk_length=end - start,
        chunk_start_offset=start,
        compression=compression,
        compressed_size=len(packed),
        message_end_time=end_ns,
        message_index_length=file.tell() - end,
        message_index_offsets=offsets,
        message_start_time=start_ns,
        uncompressed_size=len(data),
    )


def _offset_of(kind: np.dtype[np.void], place: int) -> int:
    assert kind.fields is not None
    assert kind.names is not None
    return int(kind.fields[kind.names[place]][1])


def chunks_of_ticks(duration_s: float) -> Iterator[NDArray[np.void]]:
    """Yield the content of one chunk after the other: slow motion, contact forces and noise of a 16-bit sensor."""
    kind = tick_type()
    total, per_chunk = round(duration_s * RATE_HZ), CHUNK_BYTES // kind.itemsize
    noise = np.random.default_rng(1)
    for first in range(0, total, per_chunk):
        number = np.arange(first, min(first + per_chunk, total))
        ticks = np.zeros(number.size, dtype=kind)
        stamp_ns = START_NS + number * (10**9 // RATE_HZ)
        for place, (field, (_, width, frame, name_bytes)) in enumerate(
            zip(kind.names or (), TOPICS.values(), strict=True)
        ):
            part = ticks[field]
            part["op"], part["length"], part["channel"] = 5, part.dtype.itemsize - 9, place + 1
            part["sequence"], part["encapsulation"][:, 1] = number, 1
            part["log_ns"] = part["publish_ns"] = stamp_ns + 100_000 * place
            part["sec"], part["nanosec"] = stamp_ns // 10**9, stamp_ns % 10**9
            part["name_bytes"], part["name"] = name_bytes, frame
            phase = number[:, None] / RATE_HZ * (0.2 + 0.1 * np.arange(width))
            part["values"] = np.round((np.sin(phase) + 1e-3 * noise.normal(size=(number.size, width))) * 2**14) / 2**14
        yield ticks


def written(*content: records.McapRecord) -> bytes:
    """Return records as they stand in a file."""
    builder = RecordBuilder()
    for record in content:
        record.write(builder)
    return bytes(builder.end())
