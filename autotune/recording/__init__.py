"""Record a log as docs/recording.md asks: a recorder for any control loop, and the program of a first log.

Needs `mcap` when the file is written, and no other library.
"""

from .first_log import FirstLog, FirstLogCommand
from .plain_admittance import PlainAdmittance
from .recorder import Recorder

__all__ = ["FirstLog", "FirstLogCommand", "PlainAdmittance", "Recorder"]
