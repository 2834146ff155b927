"""SHA-256 of logs, kept beside the state of a campaign: of hosts that share an archive one reads each log for it."""

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple, Protocol

from sqlalchemy import BigInteger, Column, Connection, MetaData, Table, Text, select
from sqlalchemy.dialects import postgresql, sqlite

from identification.logs.containers.formats import sha256_of

from .work import digest_of

# A file that changed later than this before it was read may change again without its times showing it.
_RESTED_NS = 2_000_000_000

FILES = Table(
    "autotune_files",
    MetaData(),
    Column("path", Text, primary_key=True),
    Column("size", BigInteger, nullable=False),
    Column("modified_ns", BigInteger, nullable=False),
    Column("changed_ns", BigInteger, nullable=False),
    Column("sha256", Text, nullable=False),
)


class Transactions(Protocol):
    """Does work in one transaction, all of which may be done twice."""

    def __call__(self, work: Callable[[Connection], Any]) -> Any:
        """Return what the work returns."""


class _Seen(NamedTuple):
    """What a look at a file shows; `changed_ns` is also of its name and its times, which a tool may set back."""

    size: int
    modified_ns: int
    changed_ns: int


class Checksums:
    """The SHA-256 of files, each of which is read again only when its size or one of its times is another one."""

    def __init__(self, transact: Transactions, *, is_sqlite: bool) -> None:
        self._transact, self._insert = transact, sqlite.insert if is_sqlite else postgresql.insert

    def find(self, path: Path) -> str:
        """Return the SHA-256 of a file, or of the names and digests of all that is in a folder."""
        return digest_of(path, self._find)

    def _find(self, path: Path) -> str:
        known, seen = str(path.resolve()), _look_at(path)
        row = self._transact(lambda connection: connection.execute(select(FILES).where(FILES.c.path == known)).first())
        if row is not None and seen == _Seen(row.size, row.modified_ns, row.changed_ns):
            return str(row.sha256)
        began_ns = time.time_ns()
        found = sha256_of(path)
        if seen == _look_at(path) and began_ns - max(seen.modified_ns, seen.changed_ns) > _RESTED_NS:
            values = {**seen._asdict(), "sha256": found}
            change = self._insert(FILES).values(path=known, **values)
            self._transact(
                lambda connection: connection.execute(change.on_conflict_do_update(FILES.primary_key, set_=values))
            )
        return found


def _look_at(path: Path) -> _Seen:
    state = path.stat()
    return _Seen(state.st_size, state.st_mtime_ns, state.st_ctime_ns)
