"""SQLite files (.db3) of rosbag2, in every version of its schema."""

from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeVar, cast

import numpy as np

from ...errors import LogError
from ...result import Finding
from .channel import Batch, Channel, Held, Survey
from .channel import Closing
from .batches import Gatherer, pack
from .channel import salvaged
from .sqlite_file import Row, SqliteFile
from .sqlite_pages import SqlitePages
from .batches import ZSTD_MAGIC, unpack_message, unpack_messages

T = TypeVar("T")
_MESSAGE_COLUMNS = ("topic_id", "timestamp", "data")
_NEEDED = {
    "topics": {"id", "name", "type", "serialization_format"},
    "messages": {*_MESSAGE_COLUMNS},
}
_DEFINED = {"topic_type", "encoding", "encoded_message_definition", "type_description_hash"}
_GROUP = 1000
_KNOWN_SCHEMAS = ("ros2msg", "ros2idl")

NO_CRC = Finding(
    code="crc-absent",
    severity="info",
    message="An SQLite log carries no checksums (CRC): a flipped bit in a message would not be noticed.",
    advice="Record MCAP with chunk CRCs (rosbag2: storage option `noChunkCRC: false`).",
)


@dataclass
class _Tally:
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


class SqliteBagContainer(Closing):
    """A .db3 file of rosbag2, opened without any right to change it; messages come in the order of their ids."""

    def __init__(self, path: Path, *, salvage: bool = False) -> None:
        self._path, self._name, self._salvage = path, path.name, salvage
        self._pages: SqlitePages | None = None
        self._survey: Survey | None = None
        self._lost: list[str] = []
        self._is_checked = self._was_read = False
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
            tallies = self._salvaged_tallies() if self._salvage else self._tallies()
            held = {channel: _Tally() for channel in self._topics.values()}
            for topic, tally in tallies.items():
                held[self._topics[topic]].add(tally.count, tally.first_message, *tally.log_ns)
            times = [log_ns for tally in held.values() for log_ns in tally.log_ns]
            self._survey = Survey(
                container="rosbag2 sqlite3",
                held=tuple(
                    Held(channel=channel, count=tally.count, first_message=self._plain(channel, tally.first_message))
                    for channel, tally in sorted(held.items(), key=lambda item: (item[0].topic, item[0].type_name))
                ),
                start_ns=min(times, default=0),
                end_ns=max(times, default=0),
                findings=(NO_CRC, *salvaged(self._name, self._lost)),
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
        self._was_read = True
        gatherers = {channel: Gatherer(channel) for channel in topics.values()}
        for batch in self._all_batches(topics, gatherers):
            unpacked = self._unpacked(batch)
            if unpacked.count:
                yield unpacked.channel, handle(unpacked)

    def findings(self) -> tuple[Finding, ...]:
        """Tell what the last `read` had to leave out."""
        return salvaged(self._name, self._lost) if self._was_read else ()

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
            # A definition may stand there without the digest that the topic tells, or the other way round.
            schema = defined.get((type_name, digest)) or defined.get((type_name, "")) or ("", b"")
            topics[number] = Channel(
                topic=name, type_name=type_name, encoding=encoding, schema_encoding=schema[0], schema=schema[1]
            )
        return topics

    def _check(self) -> None:
        """Look once whether the pages fit together; raise LogError where not, with `salvage` go round them."""
        if self._is_checked:
            return
        fault = self._file.fault()
        if fault and not self._salvage:
            raise self._file.refusal(fault)
        self._is_checked = True
        if fault:
            self._lost.append(fault)
            columns = self._file.columns("messages")
            self._pages = SqlitePages(self._path, [columns.index(name) for name in _MESSAGE_COLUMNS])

    def _tallies(self) -> dict[int, _Tally]:
        tallies: dict[int, _Tally] = {}
        for row in self._file.all(
            "SELECT topic_id, count(*), min(rowid), min(timestamp), max(timestamp) FROM messages GROUP BY topic_id"
        ):
            topic, count, first, start_ns, end_ns = row
            if not (isinstance(start_ns, int) and isinstance(end_ns, int) and topic in self._topics):
                raise self._file.refusal(ValueError(f"{count} messages of topic {topic!r}, which is not defined"))
            data = self._file.all("SELECT data FROM messages WHERE rowid = ?", (first,))[0][0]
            if not isinstance(data, bytes):
                raise self._file.refusal(ValueError(f"message {first} is no bytes"))
            tallies[topic] = _Tally(count=cast(int, count), first_message=data, log_ns=[start_ns, end_ns])
        return tallies

    def _salvaged_tallies(self) -> dict[int, _Tally]:
        tallies: dict[int, _Tally] = {}
        wrong = 0
        for _, topic, log_ns, data in self._salvaged_rows(self._lost):
            if isinstance(log_ns, int) and isinstance(data, bytes) and topic in self._topics:
                tallies.setdefault(topic, _Tally()).add(1, data, log_ns)
            else:
                wrong += 1
        if wrong:
            self._lost.append(f"{wrong} messages have no defined topic, no time or no bytes")
        return tallies

    def _salvaged_rows(self, missing: list[str]) -> Iterator[Row]:
        if self._pages is not None:
            yield from self._pages.rows(missing)
        else:
            for rows in self._file.messages(None):
                yield from rows

    def _rows(self, topics: Collection[int]) -> Iterator[list[Row]]:
        if not self._salvage:
            yield from self._file.messages(topics)
            return
        group: list[Row] = []
        for row in self._salvaged_rows([]):
            _, topic, log_ns, data = row
            if topic in topics and isinstance(log_ns, int) and isinstance(data, bytes):
                group.append(row)
            if len(group) == _GROUP:
                yield group
                group = []
        if group:
            yield group

    def _all_batches(self, topics: dict[int, Channel], gatherers: dict[Channel, Gatherer]) -> Iterator[Batch]:
        for rows in self._rows(topics) if topics else ():
            yield from self._batches(rows, topics, gatherers)
        for gatherer in gatherers.values():
            yield from gatherer.flush()

    def _batches(
        self, rows: list[Row], topics: dict[int, Channel], gatherers: dict[Channel, Gatherer]
    ) -> Iterator[Batch]:
        numbers, topic_ids, log_ns, data = zip(*rows, strict=True)
        if set(map(type, log_ns)) != {int} or set(map(type, data)) != {bytes}:
            raise self._file.refusal(
                ValueError(f"messages {numbers[0]} to {numbers[-1]} hold one without time or bytes")
            )
        times = np.array(log_ns, dtype=np.int64)
        owners = np.array(topic_ids, dtype=np.int64)
        for channel, gatherer in gatherers.items():
            own = [topic for topic, each in topics.items() if each == channel]
            chosen = np.flatnonzero(np.isin(owners, own))
            if chosen.size:
                yield from gatherer.add(times[chosen], *pack([data[index] for index in chosen.tolist()]))

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
