"""The one file that the pages may write, and only until the server ends."""

import threading
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from autotune.errors import AutotuneError, CertificateError, UsageError
from autotune.formats.canonical import short
from autotune.formats.controller import read_controller, write_controller
from autotune.formats.controller_record import Controller


class SaveInterruptedError(AutotuneError):
    """The server ended before the controller was written, so it is not written."""


@dataclass(frozen=True, kw_only=True)
class Written:
    """What was written: the short form of its checksum, and what it replaced, "" where there was no file."""

    checksum: str
    replaced: str


class Target:
    """A file, what stands in it, and whether it still may be written.

    Several pages may save at once, each in a thread of its own: one writes at a time, and none after `end`.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.is_cut_short = False
        self._lock = threading.Lock()
        self._has_ended = False
        self._under_way = 0

    def standing(self) -> str:
        """Say in a few words which file stands there now; "" for none."""
        if not self.path.is_file():
            return ""
        try:
            found = read_controller(self.path, allow_unvalidated=True)
        except (CertificateError, UsageError):
            return "a file that is no whole controller"
        return f"the controller of checksum {short(found.checksum)}"

    def save(self, make: Callable[[Callable[[float], None]], Controller], expected: str | None = None) -> Written:
        """Write the controller that `make` returns, which is given a `progress` that stops it once the server ends.

        Raises SaveInterruptedError after `end`; UsageError where the file cannot be written, or where other than
        `expected` (words of `standing`) stands there by now; what `make` raises. Nothing is written then.
        """
        with self._lock:
            self._under_way += 1
        try:
            controller = make(self._progress)
        except BaseException:
            with self._lock:
                self._under_way -= 1
            raise
        # Under the lock, so that `end` comes before the whole of this or after it.
        with self._lock:
            self._under_way -= 1
            self._progress(0.0)
            standing = self.standing()
            if expected is not None and standing != expected:
                raise UsageError(
                    f"{self.path} has changed meanwhile: it was {expected or 'not there'}, now it is "
                    f"{standing or 'not there'}. Save again to write it all the same."
                )
            return Written(checksum=short(write_controller(self.path, controller)), replaced=standing)

    def end(self) -> None:
        """Let nothing be written from now on; `is_cut_short` then tells whether something would have been."""
        with self._lock:
            if not self._has_ended:
                self._has_ended, self.is_cut_short = True, self._under_way > 0

    def _progress(self, _share: float) -> None:
        if self._has_ended:
            raise SaveInterruptedError(f"The server has ended, so {self.path} is not written.")
