"""Open one log file by its first bytes."""

import stat
from pathlib import Path

from ...errors import LogError
from . import ros1_bag, sqlite_bag
from .channel import Container
from .mcap_file import McapContainer
from .ros1_bag import Ros1BagContainer
from .sqlite_bag import SqliteBagContainer
from .zstd_file import ZstdFileContainer
from .batches import ZSTD_MAGIC

MCAP_MAGIC = b"\x89MCAP0\r\n"
_HEAD_BYTES = 4096
_TABLE_ENDINGS = (".csv", ".tsv", ".txt")
_TEXT_CONTROLS = frozenset(range(32)) - {9, 10, 13}
_FOREIGN = (
    (b"PK\x03\x04", "a ZIP archive", "unpack it and name the log inside"),
    (b"PK\x05\x06", "an empty ZIP archive", "name a log file"),
    (b"\x1f\x8b", "compressed with gzip", "unpack it with `gzip -d` and name the log inside"),
    (b"BZh", "compressed with bzip2", "unpack it with `bzip2 -d` and name the log inside"),
    (b"\xfd7zXZ\x00", "compressed with xz", "unpack it with `xz -d` and name the log inside"),
    (b"\x04\x22\x4d\x18", "compressed with lz4", "unpack it with `lz4 -d` and name the log inside"),
    (b"7z\xbc\xaf\x27\x1c", "a 7-Zip archive", "unpack it and name the log inside"),
    (b"\x89HDF", "an HDF5 file", "export it as CSV or Parquet"),
    (b"MATLAB 5.0", "a MATLAB file", "export it as CSV or Parquet"),
    (b"#ROSBAG V1", "a ROS 1 bag of version 1", "convert it with `rosbag fix`"),
)


def open_file(path: Path, *, salvage: bool = False) -> Container:
    """Open a log file of any known kind; raise LogError if it is none or damaged."""
    head = head_of(path)
    if head.startswith(MCAP_MAGIC):
        return McapContainer(path, salvage=salvage)
    if head.startswith(ros1_bag.MAGIC):
        return Ros1BagContainer(path, salvage=salvage)
    if head.startswith(sqlite_bag.MAGIC):
        return SqliteBagContainer(path, salvage=salvage)
    if head.startswith(ZSTD_MAGIC):
        return ZstdFileContainer(path, lambda inner: _open_unpacked(inner, salvage=salvage), salvage=salvage)
    raise LogError(_what_else(path, head))


def _open_unpacked(path: Path, *, salvage: bool) -> Container:
    if head_of(path).startswith(ZSTD_MAGIC):
        raise LogError(f"{path.name} is compressed with zstd twice; unpack it by hand with `zstd -d`.")
    return open_file(path, salvage=salvage)


def is_table(path: Path) -> bool:
    """Tell whether a file is a table (Parquet by its first bytes, CSV by its name and because it is text)."""
    head = head_of(path)
    return head.startswith(b"PAR1") or (path.suffix.lower() in _TABLE_ENDINGS and _is_text(head))


def head_of(path: Path) -> bytes:
    """Return the first bytes of a file; raise LogError if it cannot be read or is no regular file."""
    try:
        if not stat.S_ISREG(path.stat().st_mode):
            raise LogError(f"{path.name or path} is not a regular file; name a log file on disk.")
        with path.open("rb") as file:
            return file.read(_HEAD_BYTES)
    except OSError as error:
        raise LogError(f"{path} cannot be read: {error.strerror or error}; name an existing log file.") from error
    except ValueError as error:
        raise LogError(f"{str(path)!r} is not a file name: {error}; name an existing log file.") from error


def _is_text(head: bytes) -> bool:
    if head.startswith((b"\xff\xfe", b"\xfe\xff")):
        return True
    try:
        text = head.decode()
    except UnicodeDecodeError as error:
        # The last character may be cut; other bytes beyond ASCII are text in an older encoding.
        text = head[: error.start].decode() + head[error.start :].decode("latin-1")
    return bool(head) and not any(ord(character) in _TEXT_CONTROLS for character in text)


def _what_else(path: Path, head: bytes) -> str:
    name = path.name
    if not head:
        return f"{name} is empty (0 bytes); record again and stop the recorder before copying the file."
    if is_table(path):
        return (
            f"{name} is a table: its columns have no types that tell what they mean; "
            "map them in cell.yaml and name it with --cell."
        )
    for magic, what, advice in _FOREIGN:
        if head.startswith(magic):
            return f"{name} is {what}, no log that can be read; {advice}."
    known = "an MCAP file, a ROS 1 bag, a .db3 file or folder of rosbag2, CSV (.csv, .tsv, .txt) or Parquet"
    if head.startswith((MCAP_MAGIC[: len(head)], ros1_bag.MAGIC[: len(head)])):
        return f"{name} is truncated within its first {len(head)} bytes; record again."
    if _is_text(head):
        return f"{name} is text (it starts with {head[:20].decode('latin-1')!r}), not a log; name {known}."
    return f"{name} is not a log: it starts with the bytes {head[:8].hex(' ')}; name {known}."
