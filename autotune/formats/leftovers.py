"""Temporary files beside a target, named so that a later run knows and sweeps its own that were left by a kill."""

import os
import platform
import re
import secrets
import shutil
import time
from contextlib import suppress
from functools import cache
from hashlib import sha256
from pathlib import Path

_NAME = re.compile(r"\.autotune-(?P<where>[0-9a-f]{8})-(?P<process>[0-9]+)-(?P<mark>[0-9a-f]{16})\.(?P<end>tmp|old)")
# Nothing is written for so long: what is older was left, whichever machine or container it came from.
_SURELY_LEFT_S = 86400.0


def temporary_beside(target: Path) -> tuple[Path, Path]:
    """Return two names beside `target`: for what takes its place, and for where the former one is moved aside."""
    stem = f".autotune-{_where()}-{os.getpid()}-{secrets.token_hex(8)}"
    return target.parent / f"{stem}.tmp", target.parent / f"{stem}.old"


def sweep_leftovers(folder: Path) -> None:
    """Delete what killed runs of this user left in `folder`, and nothing of which that is not certain.

    That is what bears a name of `temporary_beside` and either is of a process of this machine, boot and process
    namespace that has ended, or a day old. A former folder that was moved aside stays as long as the one that was to
    take its place stands beside it: a kill between the two steps leaves the former one there only.
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
    return name["where"] == _where() and not _is_running(int(name["process"]))


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
    """Return what tells machine, boot and process namespace apart: only inside one does a process number mean one."""
    told = [platform.node()]
    with suppress(OSError):
        told.append(Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii"))
    with suppress(OSError):
        told.append(str(Path("/proc/self/ns/pid").readlink()))
    return sha256("\n".join(told).encode()).hexdigest()[:8]
