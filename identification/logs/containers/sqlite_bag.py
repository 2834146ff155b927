"""SQLite files (.db3) of rosbag2, in every version of its schema, opened without any right to change them."""

import shutil
import sqlite3
from collections.abc import Callable, Collection, Iterator
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TypeVar, cast
from urllib.parse import quote

import numpy as np

from ...errors import LogError
from ...result import Finding
from .channel import CHUNK_LIMIT_BYTES, Batch, Channel, Container, Held, Survey, pack
from .zstd import ZSTD_MAGIC, unpack_message, unpack_messages

T = TypeVar("T")
Row = tuple[object, ...]
MAGIC = b"SQLite format 3\x00"
_NEEDED = {
    "topics": {"id", "name", "type", "serialization_format"},
    "messages": {"topic_id", "timestamp", "data"},
}
_DEFINED = {"topic_type", "encoding", "encoded_message_definition", "type_description_hash"}
_ROWS = "SELECT rowid, topic_id, timestamp, data FROM messages"
_FETCHED = 2000
_KNOWN_SCHEMAS = ("ros2msg", "ros2idl")
_FOREIGN = (sqlite3.Error, ValueError, OverflowError, MemoryError)
_HOT_JOURNAL = bytes.fromhex("d9d505f920a163d7")
_WAL_HEADER_BYTES = 32

NO_CRC = Finding.info(
    "crc-absent",
    "An SQLite log carries no checksums (CRC): a flipped bit in a message would not be noticed.",
    "Record MCAP with chunk CRCs (rosbag2: storage option `noChunkCRC: false`).",
)


class SqliteFile:
    """A database opened without any right to change it; with `salvage` even where it is cut."""

    def __init__(self, path: Path, *, salvage: bool) -> None:
        self.name = path.name
        self._salvage = salvage
        self._copies = ExitStack()
        if not salvage:
            _check_closed(path)
        try:
            path = _whole_pages(path, self._copies) if salvage else path
            self._connection = sqlite3.connect(
                f"file:{quote(str(path.absolute()))}?mode=ro&immutable=1", uri=True, check_same_thread=False
            )
        except (sqlite3.Error, OSError) as error:
            raise self.refusal(error) from error
        self._connection.text_factory = lambda data: data.decode("utf-8", "replace")
        self._connection.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, CHUNK_LIMIT_BYTES)
        self.all("PRAGMA trusted_schema=OFF")
        if salvage:
            # Lets SQLite accept a file that is shorter than its header says; nothing can be written anyway.
            self.all("PRAGMA writable_schema=ON")

    def refusal(self, error: Exception | str) -> LogError:
        """Make the error that the user sees of one of SQLite."""
        salvage = "" if self._salvage else "read what is sound of it with --salvage, "
        return LogError(
            f"{self.name} is damaged or no SQLite log ({error}); {salvage}"
            f"recover it with `sqlite3 {self.name} .recover`, or record again."
        )

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
            found = self._connection.execute("PRAGMA quick_check(1)").fetchall()
        except _FOREIGN as error:
            return str(error)
        return "" if found == [("ok",)] else " ".join(str(found[0][0]).split()) if found else "it cannot be checked"

    def messages(self, topics: Collection[int]) -> Iterator[list[Row]]:
        """Yield the rows (rowid, topic_id, timestamp, data) of some topics in order of recording."""
        query = f"{_ROWS} WHERE topic_id IN ({','.join(map(str, topics))}) ORDER BY rowid"
        try:
            cursor = self._connection.execute(query)
            while rows := cursor.fetchmany(_FETCHED):
                yield rows
        except _FOREIGN as error:
            raise self.refusal(error) from error

    def readable_messages(self, lost: list[str]) -> Iterator[Row]:
        """Yield the rows before the first damaged page and behind the last one; note in `lost` what is between."""
        last, after = 0, None
        try:
            for row in self._connection.execute(f"{_ROWS} ORDER BY rowid"):
                last = cast(int, row[0])
                yield row
        except _FOREIGN:
            with suppress(*_FOREIGN):
                for row in self._connection.execute(f"{_ROWS} WHERE rowid > {last} ORDER BY rowid DESC"):
                    after = cast(int, row[0])
            if after is None:
                lost.append(f"what followed message {last}, if anything, is missing")
                return
            lost.append(f"messages {last + 1} to {after - 1} are missing")
            with suppress(*_FOREIGN):
                yield from self._connection.execute(f"{_ROWS} WHERE rowid >= {after} ORDER BY rowid")

    def close(self) -> None:
        """Close the database."""
        self._connection.close()
        self._copies.close()


def _whole_pages(path: Path, copies: ExitStack) -> Path:
    """Return the file, or a temporary copy without a last page that was cut: SQLite would take its rest for zeros."""
    with path.open("rb") as file:
        page_bytes = int.from_bytes(file.read(18)[16:], "big")
        page_bytes = 65_536 if page_bytes == 1 else max(page_bytes, 1)
        left = path.stat().st_size // page_bytes * page_bytes
        if left in (0, path.stat().st_size):
            return path
        copy = Path(copies.enter_context(TemporaryDirectory(prefix="autotune-"))) / path.name
        file.seek(0)
        with copy.open("wb") as target:
            shutil.copyfileobj(file, target)
            target.truncate(left)
    return copy


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


@dataclass
class _Counted:
    """What was seen of a topic."""

    count: int = 0
    first_message: bytes = b""
    log_ns: list[int] = field(default_factory=list)

    def add(self, count: int, first_message: bytes, *log_ns: int) -> None:
        """Add messages with their first and last time."""
        self.first_message = self.first_message if self.count else first_message
        self.count += count
        times = (*self.log_ns, *log_ns)
        self.log_ns = [min(times), max(times)] if times else []


class SqliteBagContainer(Container):
    """A .db3 file of rosbag2, opened without any right to change it; messages come in the order of their ids."""

    def __init__(self, path: Path, *, salvage: bool = False) -> None:
        self._name, self._salvage = path.name, salvage
        self._survey: Survey | None = None
        self._lost: list[str] = []
        self._is_checked = False
        self._file = SqliteFile(path, salvage=salvage)
        try:
            self._topics = self._read_topics()
        except BaseException:
            self.close()
            raise

    def survey(self) -> Survey:
        """Count the messages; raise LogError where the database is damaged."""
        if self._survey is None:
            self._check()
            held = {channel: _Counted() for channel in self._topics.values()}
            (self._count_readable if self._salvage else self._count)(held)
            times = [log_ns for seen in held.values() for log_ns in seen.log_ns]
            self._survey = Survey(
                container="rosbag2 sqlite3",
                held=tuple(
                    Held(channel=channel, count=seen.count, first_message=self._plain(channel, seen.first_message))
                    for channel, seen in sorted(held.items(), key=lambda item: (item[0].topic, item[0].type_name))
                ),
                start_ns=min(times, default=0),
                end_ns=max(times, default=0),
                findings=(NO_CRC,),
            )
        return self._survey

    def read(self, wanted: Collection[Channel], handle: Callable[[Batch], T]) -> Iterator[tuple[Channel, T]]:
        """Read the wanted channels once; see `Container.read`."""
        topics = {topic: channel for topic, channel in self._topics.items() if channel in set(wanted)}
        for channel in topics.values():
            if channel.encoding != "cdr":
                raise LogError(
                    f"Topic {channel.topic} of {self._name} is serialized as {channel.encoding!r}; "
                    "record with the format `cdr`."
                )
        if self._salvage:
            self.survey()
        self._check()
        for batch in (
            batch for rows in (self._rows(topics) if topics else ()) for batch in self._batches(rows, topics)
        ):
            unpacked = self._unpacked(batch)
            if unpacked.count:
                yield unpacked.channel, handle(unpacked)

    def lost(self) -> tuple[str, ...]:
        """Name the damaged places that were left out so far."""
        return tuple(dict.fromkeys(self._lost))

    def close(self) -> None:
        """Close the database."""
        self._file.close()

    def _read_topics(self) -> dict[int, Channel]:
        for table, needed in _NEEDED.items():
            missing = needed.difference(self._file.columns(table))
            if missing:
                raise LogError(
                    f"{self._name} is an SQLite file but no rosbag2 log: its table `{table}` "
                    f"lacks {', '.join(sorted(missing))}; name the .db3 file of a recording."
                )
        defined: dict[tuple[str, str], tuple[str, bytes]] = {}
        if set(self._file.columns("message_definitions")) >= _DEFINED:
            names = ("topic_type", "type_description_hash", "encoding", "encoded_message_definition")
            for row in self._file.all(f"SELECT {', '.join(names)} FROM message_definitions ORDER BY id"):
                type_name, digest, encoding, text = map(str, row)
                if encoding in _KNOWN_SCHEMAS:
                    for key in ((type_name, digest), (type_name, "")):
                        defined.setdefault(key, (encoding, text.encode()))
        digest_column = "type_description_hash" if "type_description_hash" in self._file.columns("topics") else "''"
        query = f"SELECT id, name, type, serialization_format, {digest_column} FROM topics ORDER BY id"
        topics: dict[int, Channel] = {}
        for number, *texts in self._file.all(query):
            if not isinstance(number, int) or not all(isinstance(text, str) for text in texts):
                raise self._file.refusal(ValueError(f"topic {number!r} is not defined by texts"))
            name, type_name, encoding, digest = cast(list[str], texts)
            # A definition may lack the digest that the topic has, or the other way round.
            schema = defined.get((type_name, digest)) or defined.get((type_name, "")) or ("", b"")
            topics[number] = Channel(
                topic=name, type_name=type_name, encoding=encoding, schema_encoding=schema[0], schema=schema[1]
            )
        return topics

    def _check(self) -> None:
        """Look once whether the pages fit together; raise LogError where not, with `salvage` note it."""
        if self._is_checked:
            return
        fault = self._file.fault()
        if fault and not self._salvage:
            raise self._file.refusal(fault)
        self._is_checked = True
        if fault:
            self._lost.append(f"{fault} (`sqlite3 {self._name} .recover` may find more)")

    def _count(self, held: dict[Channel, _Counted]) -> None:
        for row in self._file.all(
            "SELECT topic_id, count(*), min(rowid), min(timestamp), max(timestamp) FROM messages GROUP BY topic_id"
        ):
            topic, count, first, start_ns, end_ns = row
            if not (isinstance(start_ns, int) and isinstance(end_ns, int) and topic in self._topics):
                raise self._file.refusal(ValueError(f"{count} messages of topic {topic!r}, which is not defined"))
            data = self._file.all("SELECT data FROM messages WHERE rowid = ?", (first,))[0][0]
            if not isinstance(data, bytes):
                raise self._file.refusal(ValueError(f"message {first} is no bytes"))
            held[self._topics[topic]].add(cast(int, count), data, start_ns, end_ns)

    def _count_readable(self, held: dict[Channel, _Counted]) -> None:
        wrong = 0
        for _, topic, log_ns, data in self._file.readable_messages(self._lost):
            if isinstance(log_ns, int) and isinstance(data, bytes) and topic in self._topics:
                held[self._topics[topic]].add(1, data, log_ns)
            else:
                wrong += 1
        if wrong:
            self._lost.append(f"{wrong} messages have no defined topic, no time or no bytes")

    def _rows(self, topics: Collection[int]) -> Iterator[list[Row]]:
        if not self._salvage:
            yield from self._file.messages(topics)
            return
        sound = (
            row
            for row in self._file.readable_messages([])
            if row[1] in topics and isinstance(row[2], int) and isinstance(row[3], bytes)
        )
        while rows := list(islice(sound, _FETCHED)):
            yield rows

    def _batches(self, rows: list[Row], topics: dict[int, Channel]) -> Iterator[Batch]:
        numbers, topic_ids, log_ns, data = zip(*rows, strict=True)
        if set(map(type, log_ns)) != {int} or set(map(type, data)) != {bytes}:
            raise self._file.refusal(
                ValueError(f"messages {numbers[0]} to {numbers[-1]} hold one without time or bytes")
            )
        times = np.array(log_ns, dtype=np.int64)
        owners = np.array(topic_ids, dtype=np.int64)
        for channel in dict.fromkeys(topics.values()):
            own = [topic for topic, each in topics.items() if each == channel]
            chosen = np.flatnonzero(np.isin(owners, own))
            if chosen.size:
                sizes, packed = pack([data[index] for index in chosen.tolist()])
                starts = np.cumsum(sizes) - sizes
                yield Batch(channel=channel, log_ns=times[chosen], data=packed, starts=starts, sizes=sizes)

    def _plain(self, channel: Channel, message: bytes) -> bytes:
        if not _is_packed(channel, message):
            return message
        try:
            return unpack_message(message, channel.topic)
        except LogError:
            if not self._salvage:
                raise
            return b""

    def _unpacked(self, batch: Batch) -> Batch:
        start, size = int(batch.starts[0]), int(batch.sizes[0])
        if not _is_packed(batch.channel, batch.data[start : start + min(size, 8)].tobytes()):
            return batch
        return unpack_messages(batch, self._lost if self._salvage else None)


def _is_packed(channel: Channel, first: bytes) -> bool:
    return channel.encoding == "cdr" and first.startswith(ZSTD_MAGIC)
