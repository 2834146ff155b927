"""A terminal for tests: a pair of pseudo-terminal ends, what is written to the one is read from the other."""

import fcntl
import os
import pty
import re
import struct
import sys
import termios
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager

import pytest

# What would otherwise come from whoever runs the tests.
SAID_BY_USERS = ("NO_COLOR", "FORCE_COLOR", "CLICOLOR", "CLICOLOR_FORCE", "COLUMNS", "LINES", "TTY_COMPATIBLE")
_ESCAPE = re.compile(r"\x1b\[[0-9;?]*[A-Za-z]")


class Seen:
    """What a terminal was sent; complete after its block."""

    def __init__(self) -> None:
        self.raw = ""

    @property
    def text(self) -> str:
        """Return what stays on the screen: without escape sequences and without the bars, which are wiped."""
        reported = self.raw[self.raw.rfind("\x1b[2K") + 4 :] if "\x1b[2K" in self.raw else self.raw
        return _ESCAPE.sub("", reported).replace("\r\n", "\n")


def set_width(descriptor: int, columns: int) -> None:
    fcntl.ioctl(descriptor, termios.TIOCSWINSZ, struct.pack("HHHH", 50, columns, 0, 0))


def read_all(descriptor: int) -> bytes:
    """Read until the other end is closed."""
    found = b""
    while True:
        try:
            part = os.read(descriptor, 65536)
        except OSError:  # Linux says so when the other end is closed
            part = b""
        if not part:
            return found
        found += part


@contextmanager
def terminal(
    columns: int = 100, encoding: str = "utf-8", environment: Mapping[str, str] | None = None
) -> Iterator[Seen]:
    """Let standard output and standard error be a terminal of `columns` while the block runs."""
    seen, (ours, theirs) = Seen(), pty.openpty()
    set_width(theirs, columns)
    parts: list[bytes] = []
    # The kernel holds a few kilobytes only, so somebody must read meanwhile.
    reader = threading.Thread(target=lambda: parts.append(read_all(ours)))
    reader.start()
    with pytest.MonkeyPatch.context() as patch:
        for name in SAID_BY_USERS:
            patch.delenv(name, raising=False)
        for name, value in {"TERM": "xterm-256color", **(environment or {})}.items():
            patch.setenv(name, value)
        with open(theirs, "w", encoding=encoding, errors="replace", buffering=1) as stream:  # noqa: PTH123 - a number
            patch.setattr(sys, "stdout", stream)
            patch.setattr(sys, "stderr", stream)
            yield seen
            stream.flush()
    reader.join(timeout=60.0)
    os.close(ours)
    seen.raw = b"".join(parts).decode(encoding, errors="replace")
