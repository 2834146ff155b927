"""Write a file so that the name is never that of half a file.

Temporary files lie beside the target, named so that a later run knows and sweeps its own that a kill left there.
"""

import ctypes
import os
import platform
import re
import secrets
import shutil
import sys
import time
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from functools import cache
from hashlib import sha256
from pathlib import Path

from autotune.errors import UsageError

from .kinds import check_replaceable, kind_of

_PROCESS = re.compile(r"(?P<where>[0-9a-f]{8})-(?P<process>[0-9]+)-(?P<mark>[0-9a-f]{16})")
_NAME = re.compile(rf"\.autotune-(?P<of>{_PROCESS.pattern})\.(?P<end>tmp|old)")
# Nothing is written for so long: what is older was left, whichever machine or container it came from.
_SURELY_LEFT_S = 86400.0


def temporary_beside(target: Path) -> tuple[Path, Path]:
    """Return two names beside `target`: for what takes its place, and for where the former one is moved aside."""
    stem = f".autotune-{name_of_process()}"
    return target.parent / f"{stem}.tmp", target.parent / f"{stem}.old"


def sweep_leftovers(folder: Path) -> None:
    """Delete what killed runs of this user left in `folder`, and nothing of which that is not certain.

    That is what bears a name of `temporary_beside` and either is of a process of this machine, boot and process
    namespace that has ended, or a day old. A former folder that was moved aside stays as long as the one that was to
    take its place lies beside it: a kill between the two steps leaves the former one there only.
    """
    with suppress(OSError):
        found = {entry.name: entry for entry in os.scandir(folder) if _NAME.fullmatch(entry.name)}
        for name, entry in found.items():
            other = name[:-3] + ("old" if name.endswith("tmp") else "tmp")
            if other not in found and _is_left(entry):
                _delete(entry)


def _is_left(entry: "os.DirEntry[str]") -> bool:
    name = _NAME.fullmatch(entry.name)
    if name is None or entry.is_symlink():
        return False
    about = entry.stat(follow_symlinks=False)
    if hasattr(os, "geteuid") and about.st_uid != os.geteuid():
        return False
    if time.time() - about.st_mtime > _SURELY_LEFT_S:
        return True
    return has_ended(name["of"])


def name_of_process() -> str:
    """Return a new name of this process, in which `has_ended` finds it."""
    return f"{_where()}-{os.getpid()}-{secrets.token_hex(8)}"


def is_of_this_machine(name: str) -> bool:
    """Return whether a process that named itself so is of this machine, boot and process namespace."""
    return name.startswith(f"{_where()}-")


def has_ended(name: str) -> bool:
    """Return whether the process that named itself so has certainly ended; of another machine's nothing is certain."""
    found = _PROCESS.fullmatch(name)
    return found is not None and is_of_this_machine(name) and not _is_running(int(found["process"]))


def _delete(entry: "os.DirEntry[str]") -> None:
    if entry.is_dir(follow_symlinks=False):
        shutil.rmtree(entry.path, ignore_errors=True)
    else:
        with suppress(OSError):
            Path(entry.path).unlink()


def _is_running(process: int) -> bool:
    if os.name != "posix":
        return True  # there, asking with a signal would end it
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except (OSError, OverflowError):
        return True
    return True


@cache
def _where() -> str:
    """Return what distinguishes machine, boot and process namespace: only inside one does a process number mean one."""
    names = [platform.node()]
    with suppress(OSError):
        names.append(Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii"))
    with suppress(OSError):
        names.append(str(Path("/proc/self/ns/pid").readlink()))
    return sha256("\n".join(names).encode()).hexdigest()[:8]


_HERE, _EXCHANGE = -100, 2  # AT_FDCWD and RENAME_EXCHANGE of Linux


def exchange(one: Path, other: Path) -> bool:
    """Exchange what is under two names, so that neither is ever free; False, and nothing done, where it cannot be.

    Linux 3.15 and its local file systems can (renameat2).
    """
    call = _renameat2()
    return call is not None and call(_HERE, os.fsencode(one), _HERE, os.fsencode(other), _EXCHANGE) == 0


@cache
def _renameat2() -> Callable[..., int] | None:
    if sys.platform != "linux":
        return None
    try:
        call = ctypes.CDLL(None, use_errno=True).renameat2
    except (OSError, AttributeError):
        return None
    call.argtypes = (ctypes.c_int, ctypes.c_char_p, ctypes.c_int, ctypes.c_char_p, ctypes.c_uint)
    call.restype = ctypes.c_int
    return call


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
    With `kind` it may be none but one of that kind (`is_own` as in `autotune.formats.kinds.check_replaceable`).
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
        check_replaceable(path, kind, option=option, is_own=is_own)
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
    """Write texts by file name, which may name folders too, into the folder `path`, in place of what was there.

    They go to a temporary folder beside it, are flushed to the disk, and trade places with what was there in one
    step where the system can; elsewhere what was there is moved aside before, deleted after, and comes back if the
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
                (temporary / name).parent.mkdir(parents=True, exist_ok=True)
                _write_new(temporary / name, text.encode())
            for folder in {(temporary / name).parent for name in files} | {temporary}:
                _sync_directory(folder)
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
    """Let `new` take the name `target` in two steps; what was there is `former` then, and back if that fails."""
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
        _write_new(temporary, data)
        temporary.replace(target)
    except BaseException:
        with suppress(OSError):
            temporary.unlink()
        raise
    _sync_directory(target.parent)


def _write_new(path: Path, data: bytes) -> None:
    with os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o666), "wb") as stream:
        stream.write(data)
        stream.flush()
        os.fsync(stream.fileno())


def _sync_directory(directory: Path) -> None:
    """Make the new name durable where the system lets a directory be opened; elsewhere the rename must do."""
    with suppress(OSError):
        descriptor = os.open(directory, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
