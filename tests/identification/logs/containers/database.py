"""SQLite logs by hand, in every version of rosbag2's schema."""

import sqlite3
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path

from tests.identification.logs.containers.stored import TYPES, Stored

_MESSAGES = (
    "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER NOT NULL, timestamp INTEGER NOT NULL, "
    "data BLOB NOT NULL)"
)
_TOPICS = {
    1: "id INTEGER PRIMARY KEY, name TEXT NOT NULL, type TEXT NOT NULL, serialization_format TEXT NOT NULL",
    2: "offered_qos_profiles TEXT NOT NULL",
    4: "type_description_hash TEXT NOT NULL",
}
TEXTS = {topic: f"string definition_of_{topic[1:]}" for topic in TYPES}


def write_db3(path: Path, messages: Sequence[Stored], version: int = 4, *, page_bytes: int = 512) -> Path:
    """Write a .db3 file as rosbag2 of a version does; small pages make many of them."""
    topics = list(dict.fromkeys(message.topic for message in messages)) or list(TYPES)
    columns = ", ".join(text for since, text in _TOPICS.items() if since <= version)
    with closing(sqlite3.connect(path)) as base, base:
        base.execute(f"PRAGMA page_size={page_bytes}")
        base.execute(f"CREATE TABLE topics({columns})")
        base.execute(_MESSAGES)
        base.execute("CREATE INDEX timestamp_idx ON messages (timestamp ASC)")
        for number, topic in enumerate(topics, start=1):
            row = (number, topic, TYPES[topic], "cdr", *[""] * (version >= 2), *[f"hash of {topic}"] * (version >= 4))
            base.execute(f"INSERT INTO topics VALUES({','.join('?' * len(row))})", row)
        if version >= 3:
            base.execute("CREATE TABLE schema(schema_version INTEGER PRIMARY KEY, ros_distro TEXT NOT NULL)")
            base.execute("INSERT INTO schema VALUES(?, 'rolling')", (version,))
            base.execute("CREATE TABLE metadata(id INTEGER PRIMARY KEY, metadata_version INTEGER, metadata TEXT)")
        if version >= 4:
            base.execute(
                "CREATE TABLE message_definitions(id INTEGER PRIMARY KEY, topic_type TEXT NOT NULL, "
                "encoding TEXT NOT NULL, encoded_message_definition TEXT NOT NULL, type_description_hash TEXT NOT NULL)"
            )
            for topic in topics:
                base.execute(
                    "INSERT INTO message_definitions(topic_type, encoding, encoded_message_definition, "
                    "type_description_hash) VALUES(?, 'ros2msg', ?, ?)",
                    (TYPES[topic], TEXTS[topic], f"hash of {topic}"),
                )
        base.executemany(
            "INSERT INTO messages(topic_id, timestamp, data) VALUES(?, ?, ?)",
            [(1 + topics.index(message.topic), message.log_ns, message.data) for message in messages],
        )
    return path


def change(path: Path, *statements: str, values: Sequence[object] = ()) -> Path:
    """Run statements on a database; `values` belong to the last."""
    with closing(sqlite3.connect(path)) as base, base:
        for statement in statements:
            base.execute(statement, tuple(values) if statement == statements[-1] else ())
    return path
