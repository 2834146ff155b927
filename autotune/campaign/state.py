"""The state of a campaign: a table with a row for each run, which a process claims before it works on the run."""

import platform
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any, TypeVar

from sqlalchemy import (
    Column,
    Connection,
    DateTime,
    Engine,
    Executable,
    Integer,
    MetaData,
    Row,
    Table,
    Text,
    and_,
    create_engine,
    func,
    inspect,
    or_,
    select,
    update,
)
from sqlalchemy.dialects import postgresql, sqlite
from sqlalchemy.exc import DBAPIError, OperationalError

from autotune.database import connect_arguments, database_address, is_sqlite, named_failures, named_opening, write_ahead
from autotune.errors import UsageError
from autotune.formats.atomic import has_ended, is_of_this_machine, name_of_process

from .checksums import FILES, Checksums
from .manifest import STATE
from .work import RunOutcome, RunTask, parse_outcome

TRIED_AGAIN = ("killed", "unforeseen", "unreadable")
"""Refusals that are none of the log: the next campaign tries such a run again."""
_LEASE = timedelta(seconds=120)
_RENEWAL_S = 5.0
# A server that is started again is away for less; claims last longer than that.
_PATIENCE_S, _PAUSE_S = 60.0, 0.5
_ENDED: set[str] = set()  # owners in this process whose campaign is over
_Found = TypeVar("_Found")

_RUNS = Table(
    "autotune_runs",
    MetaData(),
    Column("folder", Text, primary_key=True),  # "." beside the file in it
    Column("cell", Text, primary_key=True),
    Column("run", Text, primary_key=True),
    Column("key", Text, nullable=False),
    Column("state", Text, nullable=False),  # waiting, running, done, refused, or one of TRIED_AGAIN
    Column("attempts", Integer, nullable=False),
    Column("owner", Text, nullable=False),
    Column("host", Text, nullable=False),
    Column("lease", DateTime(timezone=True)),
    Column("started", DateTime(timezone=True)),
    Column("ended", DateTime(timezone=True)),
    Column("result", Text),
)


@dataclass(frozen=True, kw_only=True)
class Sight:
    """What a look at the state shows of some tasks.

    `known` are those with a result, `free` those that may be claimed, `lost` the names of those of them that have a
    result whose files are not in the folder, `older` the free ones that have a result of other inputs, options or
    another version, with it, `unknown`, at the first look, those that nobody has begun yet, and `hosts` the machines
    that work on the others.
    """

    known: list[tuple[RunTask, RunOutcome]] = field(default_factory=list)
    free: list[RunTask] = field(default_factory=list)
    lost: list[str] = field(default_factory=list)
    older: list[tuple[RunTask, RunOutcome]] = field(default_factory=list)
    unknown: list[RunTask] = field(default_factory=list)
    hosts: set[str] = field(default_factory=set)


class CampaignState:
    """What is known of the runs of one folder, of its logs (`checksums`), and those runs that this process has claimed.

    A claim is one UPDATE that holds only while the row is as it was seen, so that of two processes one has it. It lasts
    for `_LEASE` by the database's clock unless it is renewed; a process of this machine that has ended has none.
    """

    def __init__(self, engine: Engine, folder: str) -> None:
        self._engine, self._folder, self._owner = engine, folder, name_of_process()
        self._is_sqlite = is_sqlite(engine.url)
        self.checksums = Checksums(self._done, is_sqlite=self._is_sqlite)
        self._seen: dict[str, Row[Any]] = {}
        self._failed: dict[str, int] | None = None
        self._held: dict[str, int] = {}
        self._renewed_s = time.monotonic()

    def look(self, tasks: Sequence[RunTask]) -> Sight:
        """Return what is known of the tasks that this process does not hold.

        A run of which the first look shows that it is to be tried again has no result until somebody tries it again.
        """
        now, sight = self._now(), Sight()
        shown = (_RUNS, (_RUNS.c.lease > now).label("is_held"), (_RUNS.c.ended > now - _LEASE).label("is_new"))
        question = select(*shown).where(_RUNS.c.folder == self._folder)
        self._seen = {_name(row): row for row in self._rows(question)}
        if new := [task for task in tasks if task.run.name not in self._seen]:
            self._enter(new)
            self._seen = {_name(row): row for row in self._rows(question)}
        if self._failed is None:
            self._failed = {name: row.attempts for name, row in self._seen.items() if row.state in TRIED_AGAIN}
            sight.unknown.extend(task for task in tasks if not self._seen[task.run.name].attempts)
        for task in tasks:
            if task.run.name not in self._held:
                self._sort(task, self._seen[task.run.name], sight)
        return sight

    def _sort(self, task: RunTask, row: Row[Any], sight: Sight) -> None:
        """Put a task where it belongs in what is seen."""
        outcome = parse_outcome(row.result) if row.key == task.key else None
        if row.state == "running" and row.is_held and not self._is_left(row):
            sight.hosts.add(row.host)
        elif outcome is None or (self._failed or {}).get(task.run.name) == row.attempts:
            older = None if row.key == task.key else parse_outcome(row.result)
            lacks_check = older is not None and older.own_key == task.own_key and older.has_files(task.folder)
            is_usable = older is not None and (lacks_check or older.has_identified(task))
            sight.free.append(replace(task, known=older) if is_usable else task)
            if older is not None and older.files and not lacks_check:
                sight.older.append((task, older))
        elif outcome.has_files(task.folder):
            sight.known.append((task, outcome))
        elif row.is_new and not is_of_this_machine(row.owner):
            sight.hosts.add(row.host)  # a shared file system may show them later
        else:
            sight.free.append(task)
            sight.lost.append(task.run.name)

    def _enter(self, tasks: Sequence[RunTask]) -> None:
        """Make a row for each run that has none."""
        insert = (sqlite.insert if self._is_sqlite else postgresql.insert)(_RUNS).on_conflict_do_nothing()
        new = {"folder": self._folder, "state": "waiting", "attempts": 0, "owner": "", "host": ""}
        self._changed(insert, [{**new, "cell": task.run.cell, "run": task.run.run, "key": task.key} for task in tasks])

    def claim(self, task: RunTask) -> bool:
        """Return whether this process may work on a task, as it was seen."""
        name = task.run.name
        if name in self._held:
            return True
        row, now = self._seen[name], self._now()
        held = [] if self._is_left(row) else [or_(_RUNS.c.state != "running", _RUNS.c.lease <= now)]
        values = {"key": task.key, "state": "running", "attempts": row.attempts + 1, "started": now, "ended": None}
        mine = {"owner": self._owner, "host": platform.node(), "lease": now + _LEASE, "result": None}
        as_seen = and_(_RUNS.c.attempts == row.attempts, _RUNS.c.state == row.state, *held)
        free = or_(as_seen, self._is_claimed(row.attempts + 1))
        if not self._changed(update(_RUNS).where(*self._of(task), free).values(**values, **mine)):
            return False
        self._held[name] = row.attempts + 1
        return True

    def finish(self, task: RunTask, outcome: RunOutcome) -> bool:
        """Keep what came of a claimed task; False where another process has taken it meanwhile."""
        attempt = self._held.pop(task.run.name)
        state = outcome.refused if outcome.refused in TRIED_AGAIN else "refused" if outcome.refused else "done"
        values = {"state": state, "lease": None, "ended": self._now(), "result": outcome.text()}
        mine = and_(_RUNS.c.attempts == attempt, _RUNS.c.owner == self._owner, _RUNS.c.state.in_(["running", state]))
        return bool(self._changed(update(_RUNS).where(*self._of(task), mine).values(**values)))

    def renew(self) -> bool:
        """Renew the claims if it is time to; return whether it was."""
        if time.monotonic() < self._renewed_s + _RENEWAL_S:
            return False
        self._renewed_s = time.monotonic()
        if self._held:
            self._changed(update(_RUNS).where(*self._mine()).values(lease=self._now() + _LEASE))
        return True

    def release(self) -> None:
        """Let others have what this process had claimed; where that fails, other machines have it after a while."""
        _ENDED.add(self._owner)
        with suppress(UsageError):
            if self._held:
                self._changed(update(_RUNS).where(*self._mine()).values(state="waiting", lease=None), patience_s=0.0)
        self._held.clear()

    def _is_left(self, row: Row[Any]) -> bool:
        """Return whether nobody works on a run that is claimed: its process has ended, or this one has given it up."""
        return row.owner == self._owner or row.owner in _ENDED or has_ended(row.owner)

    def _is_claimed(self, attempt: int) -> Any:
        """Return the condition that this process has a run by this attempt: the server's answer may have been lost."""
        return and_(_RUNS.c.attempts == attempt, _RUNS.c.owner == self._owner, _RUNS.c.state == "running")

    def _of(self, task: RunTask) -> tuple[Any, ...]:
        return (_RUNS.c.folder == self._folder, _RUNS.c.cell == task.run.cell, _RUNS.c.run == task.run.run)

    def _mine(self) -> tuple[Any, ...]:
        return (_RUNS.c.folder == self._folder, _RUNS.c.owner == self._owner, _RUNS.c.state == "running")

    def _now(self) -> Any:
        """Return the time of the server, which hosts have in common, or that of this machine."""
        return datetime.now(UTC) if self._is_sqlite else func.now()

    def _rows(self, question: Executable) -> Sequence[Row[Any]]:
        return self._done(lambda connection: connection.execute(question).all())

    def _changed(self, change: Executable, rows: Any = None, *, patience_s: float | None = None) -> int:
        return self._done(lambda connection: connection.execute(change, rows).rowcount, patience_s)

    def _done(self, work: Callable[[Connection], _Found], patience_s: float | None = None) -> _Found:
        """Return what `work` finds in one transaction, all of which may be done twice; a server may come back."""
        end = time.monotonic() + (_PATIENCE_S if patience_s is None else patience_s)
        while True:
            try:
                with named_failures("campaign"), self._engine.begin() as connection:
                    return work(connection)
            except UsageError as error:
                away = isinstance(error.__cause__, OperationalError) and not self._is_sqlite
                if not away or time.monotonic() > end:
                    raise
                time.sleep(_PAUSE_S)


@contextmanager
def open_state(storage: str | None, folder: Path) -> Iterator[CampaignState]:
    """Yield the state of the campaign in `folder`: in the database `storage`, or in a SQLite file in the folder.

    Raises UsageError for a storage, or a folder, that cannot be used.
    """
    address = database_address(storage, folder / STATE)
    if storage is None:
        _make(folder)
    with ExitStack() as stack:
        with named_opening("campaign", address):
            engine = create_engine(address, connect_args=connect_arguments(address), pool_pre_ping=True)
            stack.callback(engine.dispose)
            write_ahead(engine)
            _make_tables(engine)
        _make(folder)
        state = CampaignState(engine, "." if storage is None else str(folder.resolve()))
        stack.callback(state.release)
        yield state


def _name(row: Row[Any]) -> str:
    return f"{row.cell}/{row.run}"


def _make(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UsageError(f"{folder} cannot be made: {error.strerror or error}.") from error


def _make_tables(engine: Engine) -> None:
    """Make the tables where there are none; another process may do it at the same time."""
    for table in (_RUNS, FILES):
        try:
            table.create(engine, checkfirst=True)
        except DBAPIError:
            if not inspect(engine).has_table(table.name):
                raise
