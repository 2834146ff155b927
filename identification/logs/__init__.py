"""Reading robot logs: what they hold (`inspect_log`) and the channels that identification needs (`read_recording`)."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .inspect import inspect_log
    from .read import read_checked_recording, read_recording
    from .roles.registry import Role
    from .summary import ChannelSummary, LogSummary

__all__ = ["ChannelSummary", "LogSummary", "Role", "inspect_log", "read_checked_recording", "read_recording"]

_HOMES = {
    "ChannelSummary": "summary",
    "LogSummary": "summary",
    "Role": "roles.registry",
    "inspect_log": "inspect",
    "read_checked_recording": "read",
    "read_recording": "read",
}


def __getattr__(name: str) -> Any:
    """Import what is asked for only then: a cell's description is read without the readers of logs."""
    if name not in _HOMES:
        raise AttributeError(f"module {__name__} has no attribute {name}")
    return getattr(import_module(f".{_HOMES[name]}", __name__), name)
