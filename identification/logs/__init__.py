"""Reading robot logs: what they hold (`inspect_log`) and the channels that identification needs (`read_recording`)."""

from .inspect import ChannelSummary, LogSummary, inspect_log
from .read import read_recording
from .roles import Role

__all__ = ["ChannelSummary", "LogSummary", "Role", "inspect_log", "read_recording"]
