"""Zstd around logs: files compressed as a whole (`.mcap.zstd`, `.db3.zstd`), and messages compressed one by one."""

import shutil
import tempfile
from collections.abc import Callable, Collection, Iterator
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

import numpy as np
import zstandard

from ...errors import LogError
from .channel import CHUNK_LIMIT_BYTES, Batch, Channel, Container, Survey, pack

T = TypeVar("T")
ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
"""How a zstd frame starts; no CDR message does (its first byte is 0)."""
_BATCH_LIMIT_BYTES = 4 * CHUNK_LIMIT_BYTES
_FEED_BYTES, _MESSAGE_FEED_BYTES = 2**14, 256
_LARGEST_RATIO = 100
_ALWAYS_ALLOWED_BYTES = 2**26
_SPARE_BYTES = 2**28


class ZstdFileContainer(Container):
    """What `open_inner` makes of the unpacked file, which lives as long as the container."""

    def __init__(self, path: Path, open_inner: Callable[[Path], Container], *, salvage: bool = False) -> None:
        self._lost: list[str] = []
        self._folder = tempfile.TemporaryDirectory(prefix="autotune-")
        self._name = path.name
        inner = Path(self._folder.name) / (path.name.removesuffix(".zstd").removesuffix(".zst") or "log")
        try:
            self._unpack(path, inner, salvage=salvage)
            self._inner = open_inner(inner)
        except BaseException:
            self._folder.cleanup()
            raise

    def survey(self) -> Survey:
        """Return what the unpacked file holds."""
        inner = self._inner.survey()
        return replace(inner, container=f"{inner.container}, zstd file")

    def read(self, wanted: Collection[Channel], handle: Callable[[Batch], T]) -> Iterator[tuple[Channel, T]]:
        """Read the unpacked file; see `Container.read`."""
        self._inner.recorded_ns = self.recorded_ns
        return self._inner.read(wanted, handle)

    def lost(self) -> tuple[str, ...]:
        """Name the damaged places that were left out so far."""
        return (*self._inner.lost(), *self._lost)

    def close(self) -> None:
        """Close and remove the unpacked file."""
        self._inner.close()
        self._folder.cleanup()

    def _unpack(self, path: Path, inner: Path, *, salvage: bool) -> None:
        """Unpack a file; raise LogError where it is damaged or too large, with `salvage` keep what comes before."""
        free = max(shutil.disk_usage(self._folder.name).free - _SPARE_BYTES, 0)
        allowed = _ALWAYS_ALLOWED_BYTES + _LARGEST_RATIO * path.stat().st_size
        written = 0
        try:
            with inner.open("wb") as file:
                for data in _frames(path):
                    written += len(data)
                    if written > free:
                        raise LogError(
                            f"{self._name} unpacks to more than the {free} bytes that temporary files may take; "
                            "free some space, or unpack it by hand with `zstd -d`."
                        )
                    if written > allowed:
                        raise LogError(
                            f"{self._name} unpacks to more than {allowed} bytes, over {_LARGEST_RATIO} times its size, "
                            "which no recording does; if it is one, unpack it by hand with `zstd -d`."
                        )
                    file.write(data)
        except zstandard.ZstdError as error:
            reason = f"its zstd data cannot be unpacked behind {written} bytes ({error})"
            if not salvage:
                raise LogError(
                    f"{self._name} is damaged: {reason}; read what is sound of it with --salvage, or record again."
                ) from error
            self._lost.append(reason)
        except OSError as error:
            raise LogError(f"{self._name} cannot be unpacked: {error.strerror or error}; unpack it by hand.") from error


def _frames(path: Path) -> Iterator[bytes]:
    """Yield the unpacked bytes of all frames of a file; raise ZstdError where it is damaged or breaks off."""
    unpacker = zstandard.ZstdDecompressor().decompressobj()
    is_begun = False
    with path.open("rb") as file:
        while feed := file.read(_FEED_BYTES):
            while feed:
                yield unpacker.decompress(feed)
                is_begun, feed = not unpacker.eof, unpacker.unused_data if unpacker.eof else b""
                if unpacker.eof:
                    unpacker = zstandard.ZstdDecompressor().decompressobj()
    if is_begun:
        raise zstandard.ZstdError("it breaks off")


def unpack_message(data: bytes, topic: str) -> bytes:
    """Unpack one message; raise LogError where it is not zstd or larger than `CHUNK_LIMIT_BYTES`."""
    try:
        size = zstandard.frame_content_size(data)
        if size > CHUNK_LIMIT_BYTES:
            raise _too_large(topic)
        if size < 0:
            return _unpack_unknown(data, topic)
        return zstandard.ZstdDecompressor().decompress(data, max_output_size=max(size, 1))
    except zstandard.ZstdError as error:
        raise LogError(
            f"A message of topic {topic} cannot be unpacked (zstd: {error}); the log is damaged, record again."
        ) from error


def _unpack_unknown(data: bytes, topic: str) -> bytes:
    """Unpack a frame of unknown size, in pieces so small that a bomb is noticed early."""
    unpacker = zstandard.ZstdDecompressor().decompressobj()
    pieces: list[bytes] = []
    left = CHUNK_LIMIT_BYTES
    for at in range(0, len(data), _MESSAGE_FEED_BYTES):
        pieces.append(unpacker.decompress(data[at : at + _MESSAGE_FEED_BYTES]))
        left -= len(pieces[-1])
        if left < 0:
            raise _too_large(topic)
    if not unpacker.eof:
        raise LogError(f"A compressed message of topic {topic} breaks off; the log is damaged, record again.")
    return b"".join(pieces)


def unpack_messages(batch: Batch, lost: list[str] | None = None) -> Batch:
    """Unpack every message of a batch; those that cannot be are noted in `lost`, without it LogError is raised."""
    kept: list[int] = []
    messages: list[bytes] = []
    left = _BATCH_LIMIT_BYTES
    for index, (start, size) in enumerate(zip(batch.starts, batch.sizes, strict=True)):
        try:
            messages.append(unpack_message(batch.data[start : start + size].tobytes(), batch.channel.topic))
        except LogError as error:
            if lost is None:
                raise
            lost.append(str(error).rstrip("."))
            continue
        kept.append(index)
        left -= len(messages[-1])
        if left < 0:
            raise _too_large(batch.channel.topic)
    sizes, data = pack(messages)
    log_ns = batch.log_ns[np.array(kept, dtype=np.intp)]
    return replace(batch, log_ns=log_ns, data=data, starts=np.cumsum(sizes) - sizes, sizes=sizes)


def _too_large(topic: str) -> LogError:
    return LogError(
        f"The compressed messages of topic {topic} unpack to more than the {CHUNK_LIMIT_BYTES} bytes "
        "that are allowed; the log is damaged."
    )
