"""The registry of log formats: a path is opened by the first format whose first bytes or folder content it has."""

import hashlib
import stat
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from contextlib import suppress
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from threading import Thread
from typing import Protocol

from ...errors import LogError
from . import ros1_bag, sqlite_bag
from .channel import Container
from .mcap_file import McapContainer
from .mcap_layout import MAGIC as MCAP_MAGIC
from .mcap_salvage import SalvagedMcap
from .rosbag2_folder import Rosbag2FolderContainer
from .zstd import ZSTD_MAGIC, ZstdFileContainer

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


class Opener(Protocol):
    """Open a file or folder; raise LogError where it is damaged, with `salvage` leave out what is."""

    def __call__(self, path: Path, *, salvage: bool) -> Container:
        """Open a path."""
        ...


@dataclass(frozen=True, kw_only=True)
class LogFormat:
    """A format of files, which start with the bytes `magic`, or of folders, for which `is_folder` returns True.

    `name` lists the format in messages. Files that end with `ending` can be parts of a recording in a folder; without
    an ending the format has no parts.
    """

    name: str
    open: Opener
    magic: bytes = b""
    ending: str = ""
    is_folder: Callable[[Path], bool] | None = None


def _open_mcap(path: Path, *, salvage: bool = False) -> Container:
    return SalvagedMcap(path) if salvage else McapContainer(path)


def _open_zstd(path: Path, *, salvage: bool) -> Container:
    def open_inner(inner: Path) -> Container:
        if head_of(inner).startswith(ZSTD_MAGIC):
            raise LogError(f"{inner.name} is compressed with zstd twice; unpack it by hand with `zstd -d`.")
        return open_file(inner, salvage=salvage)

    return ZstdFileContainer(path, open_inner, salvage=salvage)


def _open_folder(path: Path, *, salvage: bool) -> Container:
    endings = tuple(each.ending for each in FORMATS if each.ending)
    return Rosbag2FolderContainer(path, open_file, endings, salvage=salvage)


FORMATS = [
    LogFormat(name="an MCAP file", magic=MCAP_MAGIC, ending=".mcap", open=_open_mcap),
    LogFormat(name="a ROS 1 bag", magic=ros1_bag.MAGIC, ending=".bag", open=ros1_bag.Ros1BagContainer),
    LogFormat(name="a .db3 file", magic=sqlite_bag.MAGIC, ending=".db3", open=sqlite_bag.SqliteBagContainer),
    LogFormat(name="one of these packed with zstd", magic=ZSTD_MAGIC, open=_open_zstd),
    LogFormat(name="a folder of rosbag2", is_folder=Path.is_dir, open=_open_folder),
]
"""All formats; to add one, write a file with its `Container` and its import and entry here."""


def open_container(path: Path, *, salvage: bool = False) -> Container:
    """Open a log file or folder; with `salvage` damage is left out and reported as a finding.

    Raises LogError: it is of no known format, a table (which needs a cell.yaml), missing, or damaged.
    """
    if not is_folder(path):
        return open_file(path, salvage=salvage)
    for each in FORMATS:
        if each.is_folder is not None and each.is_folder(path):
            return each.open(path, salvage=salvage)
    raise LogError(f"{path.name or path} is a folder of no known format; name a log file in it.")


def open_file(path: Path, *, salvage: bool = False) -> Container:
    """Open a log file of any known format; raise LogError if it is none or damaged."""
    head = head_of(path)
    for each in FORMATS:
        if each.magic and head.startswith(each.magic):
            return each.open(path, salvage=salvage)
    raise LogError(_what_else(path, head))


def is_table(path: Path) -> bool:
    """Return whether a file is a table (Parquet by its first bytes, CSV by its name and because it is text)."""
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


def is_folder(path: Path) -> bool:
    """Return whether a path names a folder; raise LogError where it is no path at all."""
    try:
        return path.is_dir()
    except OSError as error:
        raise LogError(f"{path} cannot be read: {error.strerror or error}; name an existing log.") from error
    except ValueError as error:
        raise LogError(f"{str(path)!r} is not a file name: {error}; name an existing log.") from error


def sha256_of(path: Path) -> str:
    """Return the SHA-256 of a log in hexadecimal.

    Of a folder it is that of the lines `digest  name` of the files directly in it, in order of their names, as
    `sha256sum * | sha256sum` prints it in the folder (with LC_ALL=C).
    """
    try:
        if not is_folder(path):
            return _digest(path)
        names = sorted(entry.name for entry in path.iterdir() if entry.is_file() and not entry.name.startswith("."))
        lines = "".join(f"{_digest(path / name)}  {name}\n" for name in names)
        return hashlib.sha256(lines.encode("utf-8", "surrogateescape")).hexdigest()
    except OSError as error:
        raise LogError(f"{path} cannot be read: {error.strerror or error}; name an existing log.") from error


def _digest(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def digests(paths: Sequence[Path]) -> dict[str, str]:
    """Return the SHA-256 in hexadecimal of each log; of a folder that of its files' names and digests."""
    try:
        return {str(path): _digest_in_state(path, *_state(path)).result() for path in paths}
    except LogError:
        # Where it could not be read it may be by the next time, with no other state.
        _digest_in_state.cache_clear()
        raise


def begin_digests(paths: Sequence[Path]) -> None:
    """Begin what `digests` returns, in a thread beside whatever is done until then."""
    for path in paths:
        # Of a path that cannot be read, who reads it says so.
        with suppress(OSError):
            _digest_in_state(path, *_state(path))


def _state(path: Path) -> tuple[int, int]:
    """Return size and time of the last change, of a folder those of all that is in it."""
    states = [each.stat() for each in ([path, *path.iterdir()] if path.is_dir() else [path])]
    return sum(each.st_size for each in states), max(each.st_mtime_ns for each in states)


@lru_cache(maxsize=64)
def _digest_in_state(path: Path, size: int, changed_ns: int) -> Future[str]:
    """Return what will be the SHA-256 of a log; one that is read in many windows is not digested for each."""
    del size, changed_ns
    found: Future[str] = Future()

    def digest() -> None:
        try:
            found.set_result(sha256_of(path))
        except BaseException as error:  # noqa: BLE001 - raised again in the thread that asks
            found.set_exception(error)

    # Nothing waits for it where reading fails, and it lets go of the interpreter's lock.
    Thread(target=digest, name="sha256", daemon=True).start()
    return found


def _what_else(path: Path, head: bytes) -> str:
    name = path.name
    if not head:
        return f"{name} is empty (0 bytes); record again and stop the recorder before copying the file."
    if is_table(path):
        return (
            f"{name} is a table: its columns have no types that say what they mean; "
            "map them in cell.yaml and name it with --cell."
        )
    for magic, what, advice in _FOREIGN:
        if head.startswith(magic):
            return f"{name} is {what}, no log that can be read; {advice}."
    names = ", ".join(each.name for each in FORMATS)
    known = f"{names}, CSV ({', '.join(_TABLE_ENDINGS)}) or Parquet"
    if any(each.magic.startswith(head) for each in FORMATS):
        return f"{name} is truncated within its first {len(head)} bytes; record again."
    if _is_text(head):
        return f"{name} is text (it starts with {head[:20].decode('latin-1')!r}), not a log; name {known}."
    return f"{name} is not a log: it starts with the bytes {head[:8].hex(' ')}; name {known}."
