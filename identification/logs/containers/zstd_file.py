"""Log files that were compressed as a whole (`.mcap.zstd`, `.db3.zstd`): unpacked among the temporary files."""

import shutil
import tempfile
from collections.abc import Callable, Collection, Iterator
from pathlib import Path
from typing import TypeVar

import zstandard

from ...errors import LogError
from ...result import Finding
from .channel import Batch, Channel, Container, Survey, salvaged

T = TypeVar("T")
_FEED_BYTES = 2**14
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
        return Survey(
            container=f"{inner.container}, zstd file",
            held=inner.held,
            start_ns=inner.start_ns,
            end_ns=inner.end_ns,
            findings=(*inner.findings, *salvaged(self._name, self._lost)),
        )

    def read(self, wanted: Collection[Channel], handle: Callable[[Batch], T]) -> Iterator[tuple[Channel, T]]:
        """Read the unpacked file; see `Container.read`."""
        return self._inner.read(wanted, handle)

    def findings(self) -> tuple[Finding, ...]:
        """Report what the last `read` left out."""
        return (*self._inner.findings(), *salvaged(self._name, self._lost))

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
