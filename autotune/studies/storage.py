"""Open the storage of a study, a SQLite file or a PostgreSQL database, and name its failures.

Only this module and `study` import Optuna, which takes half a second.
"""

import itertools
import time
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import optuna
from optuna.storages import RDBStorage, RetryHeartbeatStaleTrialCallback
from sqlalchemy.engine import URL
from sqlalchemy.exc import DBAPIError

from autotune.database import connect_arguments, database_address, named_opening, write_ahead

Storage = RDBStorage

HEARTBEAT_S = 10
_GRACE_BEATS = 3
_RETRIES = 3
# Two workers that meet a new storage both create its tables; the slower one finds them a moment later.
_OPENINGS, _OPENING_PAUSE_S = 5, 0.5


def open_storage(url: str | None, beside: Path, *, heartbeat_s: int = HEARTBEAT_S) -> Storage:
    """Open the storage of a study: `url` (SQLite or PostgreSQL), or the SQLite file `beside`.

    A running trial has a heartbeat every `heartbeat_s` seconds; one whose worker misses three of them is tried again,
    three times at most. Raises UsageError for another kind of storage and for one that cannot be opened; the message
    hides the password.
    """
    address = database_address(url, beside)
    with named_opening("study", address):
        return _opened(address, heartbeat_s)


def close_storage(storage: Storage) -> None:
    """Close the connections of a storage; it opens new ones when it is used again."""
    storage.remove_session()
    storage.engine.dispose()


def _opened(address: URL, heartbeat_s: int) -> Storage:
    for opening in itertools.count(1):
        try:
            with quiet_optuna():
                storage = RDBStorage(
                    address.render_as_string(hide_password=False),
                    engine_kwargs={"connect_args": connect_arguments(address)},
                    heartbeat_interval=heartbeat_s,
                    grace_period=_GRACE_BEATS * heartbeat_s,
                    heartbeat_stale_trial_callback=RetryHeartbeatStaleTrialCallback(max_retry=_RETRIES),
                )
            write_ahead(storage.engine)
            storage.engine.dispose()  # what is open already was opened without
            return storage
        except (DBAPIError, optuna.exceptions.StorageInternalError):
            if opening == _OPENINGS:
                raise
            time.sleep(_OPENING_PAUSE_S)
    raise AssertionError("unreachable")


@contextmanager
def quiet_optuna() -> Iterator[None]:
    """Keep Optuna's progress lines and its notes on experimental parts (the heartbeat is one) off the terminal."""
    before = optuna.logging.get_verbosity()
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)
            # `study` runs its trials itself, their heartbeats included.
            warnings.filterwarnings("ignore", message="Heartbeat of storage", category=UserWarning)
            yield
    finally:
        optuna.logging.set_verbosity(before)
