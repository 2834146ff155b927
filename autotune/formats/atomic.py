"""Write a file so that the name never stands for half of it."""

import os
import shutil
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from pathlib import Path

from autotune.errors import UsageError

from .exchange import exchange
from .leftovers import sweep_leftovers, temporary_beside
from .replaceable import check_kind, kind_of


def check_target(
    path: Path | str,
    sources: Iterable[Path | str] | None = None,
    *,
    kind: str | None = None,
    option: str = "-o",
    is_own: Callable[[Path], bool] | None = None,
) -> None:
    """Raise UsageError now if `write_atomic` could not write there later: worth asking before long work.

    With `sources`, what the work reads, the target may be none of them, nor a file that is not one of the tool's own.
    With `kind` it may be none but one of that kind (`is_own` as in `autotune.formats.replaceable.check_kind`).
    `option` is what names the target on the command line.
    """
    folder = Path(path).resolve().parent
    if not folder.is_dir():
        raise UsageError(f"{path} cannot be written: the folder {folder} does not exist.")
    if not os.access(folder, os.W_OK):
        raise UsageError(f"{path} cannot be written: the folder {folder} is not writable.")
    for source in sources or ():
        if os.path.realpath(source) == os.path.realpath(path):
            raise UsageError(
                f"{path} is what is read, and would be replaced by the result; name another file with {option}."
            )
    if kind is not None:
        check_kind(path, kind, option=option, is_own=is_own)
    elif sources is not None and kind_of(Path(path)) is None:
        raise UsageError(
            f"{path} exists and is no file of this tool, so it is not replaced; name another one with {option}."
        )


def write_atomic(path: Path | str, content: str | bytes) -> None:
    """Write `content` (text as UTF-8) under `path`: the old file stays whole until the new one is.

    The bytes go to a temporary file beside the target, are flushed to the disk, and take the name in one step.
    A symbolic link is followed; the mode is that of a new file under the umask. A device or pipe is written directly.
    Nothing is left behind on failure or interruption; what a kill left there is swept first.

    Raises UsageError: the target cannot be written.
    """
    data = content.encode() if isinstance(content, str) else content
    target = Path(os.path.realpath(path))
    try:
        if target.exists() and not target.is_file() and not target.is_dir():
            target.write_bytes(data)
        else:
            sweep_leftovers(target.parent)
            _replace(target, data)
    except OSError as error:
        raise UsageError(f"{path} cannot be written: {error.strerror or error}.") from error


def write_folder_atomic(path: Path | str, files: Mapping[str, str]) -> None:
    """Write texts by file name into the folder `path`, in place of the folder that stood there.

    They go to a temporary folder beside it, are flushed to the disk, and trade places with what stood there in one
    step where the system can; elsewhere what stood there is moved aside before, deleted after, and comes back if the
    step fails. So nobody ever sees half of the files under `path`. A symbolic link is followed. Nothing is left behind
    on failure or interruption; what a kill left there is swept first.

    Raises UsageError: the folder cannot be written.
    """
    target = Path(os.path.realpath(path))
    temporary, former = temporary_beside(target)
    try:
        sweep_leftovers(target.parent)
        try:
            temporary.mkdir()
            for name, text in files.items():
                _replace(temporary / name, text.encode())
            if not (target.exists() and exchange(temporary, target)):
                _move_aside(target, temporary, former)
        finally:
            # After the exchange it is the former folder, after a failure the new one.
            shutil.rmtree(temporary, ignore_errors=True)
    except OSError as error:
        raise UsageError(f"{path} cannot be written: {error.strerror or error}.") from error
    _sync_directory(target.parent)
    shutil.rmtree(former, ignore_errors=True)


def _move_aside(target: Path, new: Path, former: Path) -> None:
    """Let `new` take the name `target` in two steps; what stood there is `former` then, and back if that fails."""
    try:
        if target.exists():
            target.rename(former)
        new.rename(target)
    except BaseException:
        if former.exists() and not target.exists():
            former.rename(target)
        raise


def _replace(target: Path, data: bytes) -> None:
    temporary, _ = temporary_beside(target)
    try:
        with os.fdopen(os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o666), "wb") as stream:
            stream.write(data)
            stream.flush()
            os.fsync(stream.fileno())
        temporary.replace(target)
    except BaseException:
        with suppress(OSError):
            temporary.unlink()
        raise
    _sync_directory(target.parent)


def _sync_directory(directory: Path) -> None:
    """Make the new name durable where the system lets a directory be opened; elsewhere the rename must do."""
    with suppress(OSError):
        descriptor = os.open(directory, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
