"""An SQLite database that is only ever read, and whose content is not believed."""

import sqlite3
from collections.abc import Collection, Iterator
from pathlib import Path
from urllib.parse import quote

from ...errors import LogError
from .channel import CHUNK_LIMIT_BYTES

MAGIC = b"SQLite format 3\x00"
Row = tuple[object, ...]
_FETCHED = 2000
_FOREIGN = (sqlite3.Error, ValueError, OverflowError, MemoryError)
_HOT_JOURNAL = bytes.fromhex("d9d505f920a163d7")
_WAL_HEADER_BYTES = 32


class SqliteFile:
    """A database opened without any right to change it; with `salvage` even where it is cut."""

    def __init__(self, path: Path, *, salvage: bool) -> None:
        self.name = path.name
        self._salvage = salvage
        if not salvage:
            _check_closed(path)
        try:
            self._connection = sqlite3.connect(
                f"file:{quote(str(path.absolute()))}?mode=ro&immutable=1", uri=True, check_same_thread=False
            )
        except sqlite3.Error as error:
            raise self.refusal(error) from error
        self._connection.text_factory = _text
        self._connection.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, CHUNK_LIMIT_BYTES)
        self.all("PRAGMA trusted_schema=OFF")
        if salvage:
            # Lets SQLite accept a file that is shorter than its header says; nothing can be written anyway.
            self.all("PRAGMA writable_schema=ON")

    def refusal(self, error: Exception | str) -> LogError:
        """Make the error that the user sees of one of SQLite."""
        advice = "record again" if self._salvage else "read what is sound of it with --salvage, or record again"
        return LogError(f"{self.name} is damaged or no SQLite log ({error}); {advice}.")

    def all(self, query: str, values: Row = ()) -> list[Row]:
        """Return all rows of a query; raise LogError where they cannot be read."""
        try:
            return self._connection.execute(query, values).fetchall()
        except _FOREIGN as error:
            raise self.refusal(error) from error

    def columns(self, table: str) -> tuple[str, ...]:
        """Return the columns of a plain table, none where it is missing or something else (a view, virtual)."""
        kinds = self.all("SELECT type, rootpage FROM sqlite_master WHERE name = ?", (table,))
        if not any(kind == "table" and page for kind, page in kinds):
            return ()
        return tuple(str(row[1]) for row in self.all(f"PRAGMA table_info({table})"))

    def fault(self) -> str:
        """Say where the pages of the database do not fit together, nothing where they do."""
        try:
            told = self._connection.execute("PRAGMA quick_check(1)").fetchall()
        except _FOREIGN as error:
            return str(error)
        return "" if told == [("ok",)] else " ".join(str(told[0][0]).split()) if told else "it cannot be checked"

    def messages(self, topics: Collection[int] | None) -> Iterator[list[Row]]:
        """Yield the rows (rowid, topic_id, timestamp, data) of some topics, or of all, in order of recording."""
        chosen = "" if topics is None else f"WHERE topic_id IN ({','.join(str(topic) for topic in topics)})"
        query = f"SELECT rowid, topic_id, timestamp, data FROM messages {chosen} ORDER BY rowid"
        try:
            cursor = self._connection.execute(query)
            while rows := cursor.fetchmany(_FETCHED):
                yield rows
        except _FOREIGN as error:
            raise self.refusal(error) from error

    def close(self) -> None:
        """Close the database."""
        self._connection.close()


def _check_closed(path: Path) -> None:
    """Raise LogError where SQLite has left messages or changes in a file beside the database."""
    for ending, what in (("-wal", "PRAGMA wal_checkpoint(TRUNCATE)"), ("-journal", "PRAGMA integrity_check")):
        beside = path.with_name(path.name + ending)
        try:
            with beside.open("rb") as file:
                head = file.read(_WAL_HEADER_BYTES + 1)
        except OSError:
            continue
        if head.startswith(_HOT_JOURNAL) if ending == "-journal" else len(head) > _WAL_HEADER_BYTES:
            raise LogError(
                f"{path.name} was not closed: {beside.name} beside it holds what is not yet in it; "
                f'run `sqlite3 {path.name} "{what}"`, or read it without that with --salvage.'
            )


def _text(data: bytes) -> str:
    return data.decode("utf-8", "replace")
