"""Open the database that processes share state in, a SQLite file or PostgreSQL, and name its failures."""

import sqlite3
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from sqlalchemy import event
from sqlalchemy.engine import URL, Engine, make_url
from sqlalchemy.exc import SQLAlchemyError

from autotune.errors import UsageError
from problems.errors import AutotuneError, require_extra

_BACKENDS = ("sqlite", "postgresql")
_SQLITE_TIMEOUT_S = 60  # how long it waits for another process to finish writing
_CONNECT_TIMEOUT_S = 10
_KEPT = "What is finished is kept; the same command goes on from there."


def database_address(url: str | None, beside: Path) -> URL:
    """Return the address that `--storage` names, or that of the SQLite file `beside`.

    Raises UsageError for what is neither SQLite nor PostgreSQL, MissingExtraError without PostgreSQL's driver.
    """
    try:
        address = URL.create("sqlite", database=str(beside)) if url is None else make_url(url)
    except SQLAlchemyError as error:
        # The text is not repeated: whatever it is, it may hold a password.
        raise UsageError("--storage is no URL; an example is sqlite:///state.db.") from error
    if address.get_backend_name() not in _BACKENDS:
        raise UsageError(
            "--storage must be SQLite (sqlite:///FILE) or PostgreSQL (postgresql+psycopg://USER@HOST/NAME), found "
            f"{address.drivername}://."
        )
    if is_sqlite(address) and address.database in {None, "", ":memory:"}:
        raise UsageError(
            "--storage names no file, and what is kept in memory is lost; an example is sqlite:///state.db."
        )
    if address.drivername == "postgresql":
        address = address.set(drivername="postgresql+psycopg")
    if address.drivername == "postgresql+psycopg":
        require_extra("--storage postgresql+psycopg://", "psycopg", "postgresql")
    return address


def is_sqlite(address: URL) -> bool:
    """Return whether an address is that of a SQLite file."""
    return address.get_backend_name() == "sqlite"


def connect_arguments(address: URL) -> dict[str, Any]:
    """Return what SQLAlchemy's `connect_args` are: how long is waited."""
    return {"timeout": _SQLITE_TIMEOUT_S} if is_sqlite(address) else {"connect_timeout": _CONNECT_TIMEOUT_S}


def write_ahead(engine: Engine) -> None:
    """Let SQLite write ahead: a run or a trial is several commits, each of which would otherwise wait for the disk.

    A killed process loses nothing, and a power failure at most what came last, not the file. Connections that are open
    already stay as they are. A file system that cannot share memory between processes goes without.
    """
    if is_sqlite(engine.url):
        event.listen(engine, "connect", _write_ahead)


def _write_ahead(connection: Any, _record: object) -> None:
    with suppress(sqlite3.Error):
        connection.execute("PRAGMA journal_mode=WAL").close()
    connection.execute("PRAGMA synchronous=NORMAL").close()


@contextmanager
def named_opening(what: str, address: URL) -> Iterator[None]:
    """Raise UsageError, which hides the password, where the block cannot open the storage of `what` ("study")."""
    try:
        yield
    except AutotuneError:
        raise
    except Exception as error:
        # Every driver has errors of its own.
        raise UsageError(
            f"The {what}'s storage {address.render_as_string(hide_password=True)} cannot be used: {_reason(error)}."
        ) from error


@contextmanager
def named_failures(what: str, *others: type[Exception]) -> Iterator[None]:
    """Raise UsageError where the storage of `what` ("study") fails in the block, as `others` or SQLAlchemy say it."""
    errors: tuple[type[Exception], ...] = (SQLAlchemyError, *others)
    try:
        yield
    except errors as error:
        raise UsageError(f"The {what}'s storage failed: {_reason(error)}. {_KEPT}") from error


def _reason(error: Exception) -> str:
    """Return the first line of what the driver says, which says what is wrong."""
    return next(iter(str(error.__cause__ or error).splitlines()), repr(error)).rstrip(".")
