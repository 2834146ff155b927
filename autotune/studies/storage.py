"""Open the storage of a study, a SQLite file or a PostgreSQL database, and name its failures.

Only this module and `study` import Optuna, which takes half a second.
"""

import itertools
import time
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import optuna
from optuna.storages import RDBStorage, RetryHeartbeatStaleTrialCallback
from sqlalchemy import event
from sqlalchemy.engine import URL, make_url
from sqlalchemy.exc import DBAPIError, SQLAlchemyError

from autotune.errors import UsageError

Storage = RDBStorage

HEARTBEAT_S = 10
_BACKENDS = ("sqlite", "postgresql")
_GRACE_BEATS = 3
_RETRIES = 3
# Two workers that meet a new storage both create its tables; the slower one finds them a moment later.
_OPENINGS, _OPENING_PAUSE_S = 5, 0.5
_SQLITE_TIMEOUT_S = 60


def open_storage(url: str | None, beside: Path, *, heartbeat_s: int = HEARTBEAT_S) -> Storage:
    """Open the storage of a study: `url` (SQLite or PostgreSQL), or the SQLite file `beside`.

    A running trial has a heartbeat every `heartbeat_s` seconds; one whose worker misses three of them is tried again,
    three times at most. Raises UsageError for another kind of storage and for one that cannot be opened; the message
    hides the password.
    """
    try:
        address = URL.create("sqlite", database=str(beside)) if url is None else make_url(url)
    except SQLAlchemyError as error:
        # The text is not repeated: whatever it is, it may hold a password.
        raise UsageError("--storage is no URL; an example is sqlite:///study.db.") from error
    if address.get_backend_name() not in _BACKENDS:
        raise UsageError(
            "--storage must be SQLite (sqlite:///FILE) or PostgreSQL (postgresql+psycopg://USER@HOST/NAME), found "
            f"{address.drivername}://."
        )
    try:
        return _opened(address, heartbeat_s)
    except Exception as error:
        # Every driver has errors of its own, whose first line says what is wrong.
        reason = next(iter(str(error.__cause__ or error).splitlines()), repr(error)).rstrip(".")
        raise UsageError(
            f"The study's storage {address.render_as_string(hide_password=True)} cannot be used: {reason}."
        ) from error


def close_storage(storage: Storage) -> None:
    """Close the connections of a storage; it opens new ones when it is used again."""
    storage.remove_session()
    storage.engine.dispose()


def _opened(address: URL, heartbeat_s: int) -> Storage:
    is_file = address.get_backend_name() == "sqlite"
    for opening in itertools.count(1):
        try:
            with quiet_optuna():
                storage = RDBStorage(
                    address.render_as_string(hide_password=False),
                    engine_kwargs={"connect_args": {"timeout": _SQLITE_TIMEOUT_S}} if is_file else None,
                    heartbeat_interval=heartbeat_s,
                    grace_period=_GRACE_BEATS * heartbeat_s,
                    heartbeat_stale_trial_callback=RetryHeartbeatStaleTrialCallback(max_retry=_RETRIES),
                )
            if is_file:
                event.listen(storage.engine, "connect", _write_ahead)
                storage.engine.dispose()  # what is open already was opened without
            return storage
        except (DBAPIError, optuna.exceptions.StorageInternalError):
            if opening == _OPENINGS:
                raise
            time.sleep(_OPENING_PAUSE_S)
    raise AssertionError("unreachable")


def _write_ahead(connection: Any, _record: object) -> None:
    """Let SQLite write ahead: a trial is 25 commits, each of which would otherwise wait for the disk.

    A killed process loses nothing and a power failure at most the last trials, not the file.
    """
    cursor = connection.cursor()
    cursor.execute("PRAGMA journal_mode=WAL")
    cursor.execute("PRAGMA synchronous=NORMAL")
    cursor.close()


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


@contextmanager
def named_failures() -> Iterator[None]:
    """Raise UsageError where a storage fails in the middle of a study."""
    try:
        yield
    except (SQLAlchemyError, optuna.exceptions.StorageInternalError) as error:
        reason = next(iter(str(error.__cause__ or error).splitlines()), repr(error)).rstrip(".")
        raise UsageError(
            f"The study's storage failed: {reason}. What is finished is kept; the same command goes on from there."
        ) from error
