"""Who wants to know that kernels are being compiled; imports nothing that takes time."""

from collections.abc import Callable

_listeners: list[Callable[[], None]] = []


def on_compilation(listener: Callable[[], None]) -> None:
    """Have `listener` called once, in the place of an earlier one, when several kernels must be compiled."""
    _listeners[:] = [listener]


def many_compilations() -> None:
    """Call the listener, for the last time."""
    while _listeners:
        _listeners.pop()()
