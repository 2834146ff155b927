"""A file that is read at given offsets, by several threads at once."""

import os
from pathlib import Path
from threading import Lock

from zlib_ng import zlib_ng

from ...errors import LogError

_CRC_BYTES = 2**20


class FileBytes:
    """Read bytes by offset; the size is that at the time of opening."""

    def __init__(self, path: Path) -> None:
        self.name = path.name
        try:
            self._file = path.open("rb", buffering=0)
        except OSError as error:
            raise LogError(f"{path} cannot be read: {error.strerror}; name an existing log file.") from error
        self._lock = Lock()
        self.size = os.fstat(self._file.fileno()).st_size

    def read(self, offset: int, length: int) -> bytes:
        """Read up to `length` bytes, fewer only at the end of the file."""
        wanted = max(0, min(length, self.size - offset))
        data = bytearray(wanted)
        self.read_into(offset, memoryview(data))
        return bytes(data)

    def read_into(self, offset: int, target: memoryview) -> None:
        """Fill `target` from an offset; raise LogError when the file has become shorter since it was opened."""
        done = 0
        while done < len(target):
            count = self._read_some(offset + done, target[done:])
            if not count:
                raise LogError(f"{self.name} has become shorter while it was read; close the recorder and read again.")
            done += count

    def crc32(self, start: int, stop: int) -> int:
        """Return the CRC-32 of the bytes from `start` to `stop`."""
        crc, buffer = 0, bytearray(min(_CRC_BYTES, max(0, stop - start)))
        while start < stop:
            part = memoryview(buffer)[: stop - start]
            self.read_into(start, part)
            crc = zlib_ng.crc32(part, crc)
            start += len(part)
        return crc

    def _read_some(self, offset: int, target: memoryview) -> int:
        if hasattr(os, "preadv"):
            return os.preadv(self._file.fileno(), [target], offset)
        with self._lock:
            self._file.seek(offset)
            return self._file.readinto(target) or 0

    def close(self) -> None:
        """Close the file."""
        self._file.close()
