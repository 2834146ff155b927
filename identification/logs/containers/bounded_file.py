"""A file that never promises more bytes than it has."""

import os
from pathlib import Path
from types import TracebackType

from ...errors import LogError

CHUNK_LIMIT_BYTES = 256 * 2**20
"""Largest size a compressed chunk may unpack to; recorders use a few MiB."""


class BoundedFile:
    """Read a file so that a length written in it beyond its end is refused before memory is asked for."""

    def __init__(self, path: Path) -> None:
        self.name = path.name
        self._file = path.open("rb")
        self.size = os.fstat(self._file.fileno()).st_size

    def read(self, length: int) -> bytes:
        """Read exactly `length` bytes; raise LogError with the byte offset when the file has fewer."""
        offset = self._file.tell()
        if not 0 <= length <= self.size - offset:
            raise LogError(
                f"{self.name} is truncated or damaged at byte {offset}: {length} bytes should follow, "
                f"the file has {self.size - offset}; record again or repair it (`mcap recover`, `rosbag reindex`)."
            )
        return self._file.read(length)

    def readline(self) -> bytes:
        """Read a first line of at most 64 bytes."""
        return self._file.readline(64)

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        """Move to an offset."""
        return self._file.seek(offset, whence)

    def tell(self) -> int:
        """Return the offset of the next byte."""
        return self._file.tell()

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def __enter__(self) -> "BoundedFile":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
