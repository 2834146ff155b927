"""Find out what kind of log a file is, by its first bytes, and read it."""

import hashlib
import stat
from collections.abc import Callable
from pathlib import Path

from ..errors import LogError
from . import mcap_file, ros1_bag
from .channel import Channel, Keep, Scan

_SQLITE_MAGIC = b"SQLite format 3\x00"


def scan_log(path: Path, keep: Callable[[Channel], Keep]) -> Scan:
    """Read a log of any known container once; raise LogError if it is none or damaged."""
    head = _head(path)
    if head.startswith(mcap_file.MAGIC):
        return mcap_file.scan_mcap(path, keep)
    if head.startswith(ros1_bag.MAGIC):
        return ros1_bag.scan_ros1_bag(path, keep)
    if not head:
        raise LogError(f"{path.name} is empty (0 bytes); record again and stop the recorder before copying the file.")
    if head.startswith(_SQLITE_MAGIC):
        raise LogError(
            f"{path.name} is an SQLite log of rosbag2; MCAP and ROS 1 bags are read: "
            "convert it with `ros2 bag convert` to MCAP."
        )
    raise LogError(
        f"{path.name} is not a log: it starts with the bytes {head[:8].hex(' ')}, "
        f"an MCAP file with {mcap_file.MAGIC.hex(' ')}, a ROS 1 bag with `#ROSBAG V2.0`."
    )


def sha256_of(path: Path) -> str:
    """Return the SHA-256 of a file's bytes in hexadecimal."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _head(path: Path) -> bytes:
    try:
        mode = path.stat().st_mode
        if stat.S_ISDIR(mode):
            inside = sorted(entry.name for entry in path.iterdir() if entry.suffix in (".mcap", ".bag"))
            raise LogError(
                f"{path.name or path} is a directory; name one log file, of which it holds: "
                f"{', '.join(inside[:5]) or 'none'}."
            )
        if not stat.S_ISREG(mode):
            raise LogError(f"{path.name} is not a regular file; name a log file on disk.")
        with path.open("rb") as file:
            return file.read(16)
    except OSError as error:
        raise LogError(f"{path} cannot be read: {error.strerror}; name an existing log file.") from error
    except ValueError as error:
        raise LogError(f"{str(path)!r} is not a file name: {error}.") from error
