"""Find out what kind of log a path is, by first bytes or folder content, and open it."""

import hashlib
from pathlib import Path

from ...errors import LogError
from .channel import Container
from .rosbag2_folder import Rosbag2FolderContainer
from .single_file import is_table, open_file

__all__ = ["is_table", "open_container", "sha256_of"]


def open_container(path: Path, *, salvage: bool = False) -> Container:
    """Open a log file or folder; with `salvage` damage is left out and told as a finding.

    Raises LogError: it is none of the known formats, a table (which needs a cell.yaml), missing, or damaged.
    """
    if is_folder(path):
        return Rosbag2FolderContainer(path, salvage=salvage)
    return open_file(path, salvage=salvage)


def is_folder(path: Path) -> bool:
    """Tell whether a path names a folder; raise LogError where it is no path at all."""
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
