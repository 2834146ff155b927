"""Who wants to know that kernels are being compiled; imports nothing that takes time."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager

_listeners: list[Callable[[], None]] = []
_watchers: list[Callable[[], None]] = []


def on_compilation(listener: Callable[[], None]) -> None:
    """Have `listener` called once, in the place of an earlier one, when several kernels must be compiled."""
    _listeners[:] = [listener]


@contextmanager
def each_compilation(watcher: Callable[[], None]) -> Iterator[None]:
    """Have `watcher` called whenever a kernel begins to be compiled, in the block."""
    _watchers.append(watcher)
    try:
        yield
    finally:
        _watchers.remove(watcher)


def compilation_began() -> None:
    """Call the watchers."""
    for watcher in _watchers:
        watcher()


def many_compilations() -> None:
    """Call the listener, for the last time."""
    while _listeners:
        _listeners.pop()()
