"""ROS 1 bags (version 2.0), read by `rosbags` through a file that refuses lengths beyond its end."""

import bz2
import struct
from collections.abc import Callable
from pathlib import Path
from typing import cast

import lz4.frame  # type: ignore[import-untyped]  # the package carries no annotations
from rosbags.interfaces.typing import RPath
from rosbags.rosbag1 import Reader
from rosbags.rosbag1.reader import ReaderError, decompressors

from ..errors import LogError
from ..result import Finding
from .bounded_file import CHUNK_LIMIT_BYTES, BoundedFile
from .channel import Channel, Collector, Keep, Scan

MAGIC = b"#ROSBAG V"
_FOREIGN = (
    ReaderError,
    AssertionError,
    ValueError,
    struct.error,
    RuntimeError,
    OverflowError,
    MemoryError,
    EOFError,
    LookupError,
    OSError,
)


class _BoundedPath:
    """The part of a path that the reader asks for."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def exists(self) -> bool:
        return self._path.exists()

    def open(self, _mode: str) -> BoundedFile:
        return BoundedFile(self._path)

    def __str__(self) -> str:
        return self._path.name


def scan_ros1_bag(path: Path, keep: Callable[[Channel], Keep]) -> Scan:
    """Read every message of a ROS 1 bag once, as far as `keep` asks; raise LogError if anything is damaged."""
    collector = Collector(keep)
    try:
        with Reader(cast(RPath, _BoundedPath(path))) as reader:
            _limit_chunks(reader)
            _check_counts(reader, path.name)
            buffers = {
                connection.id: collector.buffer(
                    Channel(
                        topic=connection.topic,
                        type_name=connection.msgtype,
                        encoding="ros1",
                        definition=connection.msgdef.data,
                    )
                )
                for connection in reader.connections
            }
            for connection, log_ns, data in reader.messages():
                buffers[connection.id].add(log_ns, data)
    except _FOREIGN as error:
        reason = str(error).rstrip(".") or type(error).__name__
        raise LogError(f"{path.name} is damaged: {reason}. Record again or run `rosbag reindex`.") from error
    return collector.finish(path, "ros1 bag", (_NO_CRC,))


_NO_CRC = Finding(
    code="crc-absent",
    severity="info",
    message="A ROS 1 bag carries no checksums (CRC): a flipped bit in the file would not be noticed.",
    advice="Record MCAP with chunk CRCs where that is possible.",
)


def _bounded_bz2(data: bytes) -> bytes:
    return _checked(bz2.BZ2Decompressor().decompress(data, max_length=CHUNK_LIMIT_BYTES + 1))


def _bounded_lz4(data: bytes) -> bytes:
    return _checked(lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=CHUNK_LIMIT_BYTES + 1))


def _checked(data: bytes) -> bytes:
    if len(data) > CHUNK_LIMIT_BYTES:
        raise LogError(f"A chunk of the bag unpacks to more than {CHUNK_LIMIT_BYTES} bytes, which is not believable.")
    return data


def _limit_chunks(reader: Reader) -> None:
    bounded = {decompressors["bz2"]: _bounded_bz2, decompressors["lz4"]: _bounded_lz4}
    for position, chunk in reader.chunks.items():
        reader.chunks[position] = chunk._replace(decompressor=bounded.get(chunk.decompressor, chunk.decompressor))


def _check_counts(reader: Reader, name: str) -> None:
    told = sum(sum(info.connection_counts.values()) for info in reader.chunk_infos)
    held = sum(len(index) for index in reader.indexes.values())
    if told != held:
        raise LogError(f"{name} is damaged: its chunks count {told} messages, its index holds {held}.")
