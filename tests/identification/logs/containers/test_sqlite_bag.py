"""SQLite logs of rosbag2: written by hand in every schema, by rosbags and by rosbag2 itself; damaged ones refused."""

import sqlite3
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
import zstandard
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from identification.errors import LogError
from identification.logs.containers import sqlite_bag, zstd
from identification.logs.containers.sqlite_bag import SqliteBagContainer
from tests.identification.logs.containers.database import TEXTS, change, write_db3
from tests.identification.logs.containers.stored import (
    START_NS,
    TYPES,
    Stored,
    channels_of,
    codes,
    read_all,
    reported,
    several,
    write_folder,
)


@pytest.mark.parametrize("version", [1, 2, 3, 4])
@pytest.mark.parametrize("salvage", [False, True])
def test_every_schema_gives_the_messages_that_were_written(tmp_path: Path, version: int, salvage: bool) -> None:
    messages = several()
    path = write_db3(tmp_path / "run.db3", messages, version)
    before = path.read_bytes()
    assert read_all(SqliteBagContainer(path, salvage=salvage)) == reported(messages)
    with SqliteBagContainer(path, salvage=salvage) as container:
        survey = container.survey()
        assert {held.channel.topic: (held.count, held.first_message) for held in survey.held} == {
            topic: (len(each), each[0][1]) for topic, each in reported(messages).items()
        }
        assert {held.channel.topic: held.channel.type_name for held in survey.held} == TYPES
        assert {(held.channel.encoding, held.channel.schema_encoding) for held in survey.held} == {
            ("cdr", "ros2msg" if version >= 4 else "")
        }
        if version >= 4:
            assert {held.channel.topic: held.channel.schema.decode() for held in survey.held} == TEXTS
        assert (survey.start_ns, survey.end_ns) == (messages[0].log_ns, messages[-1].log_ns)
        assert codes(container) == ["crc-absent"]
        assert container.lost() == ()
    assert path.read_bytes() == before
    assert [each.name for each in tmp_path.iterdir()] == ["run.db3"]


@settings(max_examples=30, suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None)
@given(
    content=st.lists(
        st.tuples(st.sampled_from(sorted(TYPES)), st.integers(-(2**63), 2**63 - 1), st.binary(max_size=2000)),
        max_size=40,
    )
)
def test_any_messages_are_read_as_written(tmp_path: Path, content: list[tuple[str, int, bytes]]) -> None:
    messages = [Stored(topic=topic, log_ns=log_ns, data=data) for topic, log_ns, data in content]
    path = tmp_path / "any.db3"
    path.unlink(missing_ok=True)
    write_db3(path, messages)
    assert read_all(SqliteBagContainer(path)) == reported(messages)
    assert read_all(SqliteBagContainer(path, salvage=True)) == reported(messages)


def test_what_rosbags_wrote_is_read(tmp_path: Path) -> None:
    messages = several()
    write_folder(tmp_path / "bag", messages)
    assert read_all(SqliteBagContainer(tmp_path / "bag" / "bag.db3")) == reported(messages)


def test_a_recorded_file_is_read_as_it_stands(shared_data: Path) -> None:
    path = shared_data / "rosbag2_fixtures" / "talker.db3"
    with closing(sqlite3.connect(f"file:{path}?mode=ro&immutable=1", uri=True)) as base:
        expected = base.execute(
            "SELECT name, timestamp, data FROM messages JOIN topics ON topic_id = topics.id ORDER BY messages.id"
        ).fetchall()
    messages = [Stored(topic=topic, log_ns=log_ns, data=data) for topic, log_ns, data in expected]
    found = read_all(SqliteBagContainer(path))
    assert found == reported(messages)
    assert {topic: len(each) for topic, each in found.items()} == {"/rosout": 10, "/topic": 10}
    with SqliteBagContainer(path) as container:
        assert channels_of(container)["/topic"].schema == b"string data"


def test_only_wanted_topics_are_handed_on(tmp_path: Path) -> None:
    messages = several()
    found = read_all(SqliteBagContainer(write_db3(tmp_path / "run.db3", messages)), "/pose")
    assert found == {"/pose": reported(messages)["/pose"]}


def test_topics_of_one_name_and_type_are_one_channel(tmp_path: Path) -> None:
    path = write_db3(
        tmp_path / "run.db3", [Stored(topic="/ft", log_ns=START_NS + i, data=bytes([i])) for i in range(9)], 1
    )
    change(
        path,
        "INSERT INTO topics SELECT 7, name, type, serialization_format FROM topics",
        "UPDATE messages SET topic_id = 7 WHERE id % 2 = 0",
    )
    assert read_all(SqliteBagContainer(path)) == {"/ft": [(START_NS + i, bytes([i])) for i in range(9)]}


def test_a_definition_is_found_by_type_where_the_digests_do_not_show(tmp_path: Path) -> None:
    path = change(write_db3(tmp_path / "run.db3", several()), "UPDATE topics SET type_description_hash = ''")
    with SqliteBagContainer(path) as container:
        assert {each.topic: each.schema.decode() for each in channels_of(container).values()} == TEXTS
    change(path, "UPDATE message_definitions SET encoding = 'unknown'")
    with SqliteBagContainer(path) as container:
        assert {(each.schema_encoding, each.schema) for each in channels_of(container).values()} == {("", b"")}


def test_messages_compressed_one_by_one_are_unpacked(tmp_path: Path) -> None:
    messages = several(60)
    for compressor in (zstandard.ZstdCompressor(), zstandard.ZstdCompressor(write_content_size=False)):
        path = tmp_path / "packed.db3"
        path.unlink(missing_ok=True)
        packed = [Stored(topic=m.topic, log_ns=m.log_ns, data=compressor.compress(m.data)) for m in messages]
        write_db3(path, packed)
        container = SqliteBagContainer(path)
        assert read_all(container) == reported(messages)
        first = {held.channel.topic: held.first_message for held in container.survey().held}
        assert first == {topic: each[0][1] for topic, each in reported(messages).items()}


def test_compressed_messages_that_are_damaged_or_bombs_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(zstd, "CHUNK_LIMIT_BYTES", 100_000)
    good = Stored(topic="/ft", log_ns=START_NS, data=zstandard.compress(b"good"))
    streaming = zstandard.ZstdCompressor(write_content_size=False)
    bad = {
        "cut": (zstandard.compress(b"x" * 100 + bytes(range(100)))[:-9], "cannot be unpacked"),
        "cut stream": (streaming.compress(bytes(range(200)))[:-9], "breaks off"),
        "bomb": (zstandard.compress(bytes(10**6)), "more than the 100000 bytes"),
        "hidden bomb": (streaming.compress(bytes(10**8)), "more than the 100000 bytes"),
        "plain": (b"\0\1\0\0plain", "cannot be unpacked"),
    }
    for name, (data, complaint) in bad.items():
        path = write_db3(tmp_path / f"{name}.db3", [good, Stored(topic="/ft", log_ns=START_NS + 1, data=data), good])
        with pytest.raises(LogError, match=complaint):
            read_all(SqliteBagContainer(path))
        container = SqliteBagContainer(path, salvage=True)
        assert read_all(container) == {"/ft": [(START_NS, b"good"), (START_NS, b"good")]}
        assert container.lost()


def test_truncated_files_are_refused_and_salvaged_up_to_it(tmp_path: Path) -> None:
    messages = several(1500)
    path = write_db3(tmp_path / "run.db3", messages, page_bytes=4096)
    data, sound = path.read_bytes(), reported(messages)
    for size in [*range(16, 4500, 997), *range(4500, len(data), len(data) // 40)]:
        path.write_bytes(data[:size])
        with pytest.raises(LogError, match=r"^run\.db3 is .*(--salvage.*\.recover|name the \.db3)"):
            read_all(SqliteBagContainer(path))
        try:
            container = SqliteBagContainer(path, salvage=True)
        except LogError:
            # The tables that tell the topics and the root of the messages stand in the first ten pages.
            assert size < 45_000
            continue
        found = read_all(container)
        assert all(each == sound[topic][: len(each)] for topic, each in found.items())
        # A message takes about 180 bytes, which fills pages of 4096 bytes well enough for one in 400.
        assert sum(map(len, found.values())) >= min((size - 45_000) // 400, 1400)
        assert container.lost()


@pytest.mark.parametrize(
    ("page_bytes", "size", "count"),
    [(512, 0, 900), (512, 60, 900), (512, 5000, 99), (4096, 60, 2000), (4096, 5000, 99), (65536, 60, 4000)],
)
def test_a_page_that_cannot_be_read_costs_that_page_alone(
    tmp_path: Path, page_bytes: int, size: int, count: int
) -> None:
    """Also with records that go on in other pages."""
    messages = [Stored(topic="/ft", log_ns=START_NS + i, data=bytes([i % 200]) * (size + i % 3)) for i in range(count)]
    path = write_db3(tmp_path / "run.db3", messages, page_bytes=page_bytes)
    sound, data = reported(messages)["/ft"], path.read_bytes()
    # The tables of topics and definitions stand in the first pages, and overflow pages start with 0.
    leaves = [page for page in range(8, len(data) // page_bytes) if data[page * page_bytes] == 13]
    for page in (leaves[len(leaves) // 2], leaves[-1]):
        at = page * page_bytes
        path.write_bytes(data[:at] + bytes(page_bytes) + data[at + page_bytes :])
        with pytest.raises(LogError, match=r"run\.db3 is damaged"):
            read_all(SqliteBagContainer(path))
        container = SqliteBagContainer(path, salvage=True)
        found = read_all(container).get("/ft", [])
        assert [message for message in sound if message in found] == found
        # At least 17 bytes are needed for each message in a page.
        assert len(sound) - len(found) <= page_bytes // 17
        assert container.lost()


def test_where_the_root_of_the_messages_is_lost_the_user_is_sent_to_recover(tmp_path: Path) -> None:
    path = write_db3(tmp_path / "run.db3", several())
    with closing(sqlite3.connect(path)) as base:
        (root,) = base.execute("SELECT rootpage FROM sqlite_master WHERE name = 'messages'").fetchone()
    data = path.read_bytes()
    path.write_bytes(data[: (root - 1) * 512] + bytes(512) + data[root * 512 :])
    with pytest.raises(LogError, match=r"damaged.*`sqlite3 run\.db3 \.recover`"):
        read_all(SqliteBagContainer(path))
    container = SqliteBagContainer(path, salvage=True)
    assert read_all(container) == {}
    assert "`sqlite3 run.db3 .recover` may find more" in container.lost()[0]
    assert "what followed message 0, if anything, is missing" in "; ".join(container.lost())


def test_a_damaged_rowid_does_not_cost_what_follows(tmp_path: Path) -> None:
    messages = [Stored(topic="/ft", log_ns=START_NS + i, data=bytes([i % 200]) * 60) for i in range(1000)]
    path = write_db3(tmp_path / "run.db3", messages)
    data = bytearray(path.read_bytes())
    # The record of message 500: its size, the rowid in two bytes, then its header of 5 bytes with the type 12 + 2 * 60.
    at = data.index(bytes([500 >> 7 | 0x80, 500 & 0x7F, 6]))
    data[at] ^= 0x40
    path.write_bytes(data)
    with pytest.raises(LogError, match=r"run\.db3 is damaged.*--salvage.*\.recover"):
        read_all(SqliteBagContainer(path))
    container = SqliteBagContainer(path, salvage=True)
    assert read_all(container) == reported(messages)
    assert "Rowid 8692 out of order" in container.lost()[0]


def test_flipped_bits_raise_nothing_else(tmp_path: Path) -> None:
    path = write_db3(tmp_path / "run.db3", several(120))
    data, refused = path.read_bytes(), 0
    chooser = np.random.default_rng(5)
    for place in [*range(0, 112, 2), *chooser.integers(100, len(data), 250)]:
        damaged = bytearray(data)
        damaged[place] ^= 1 << int(chooser.integers(8))
        path.write_bytes(damaged)
        for salvage in (False, True):
            try:
                read_all(SqliteBagContainer(path, salvage=salvage))
            except LogError as error:
                refused += 1 - salvage
                assert "\n" not in str(error)  # noqa: PT017 - most flips are not refused
    assert refused > 40


@pytest.mark.parametrize(
    ("statements", "complaint"),
    [
        (["DROP TABLE topics"], "no rosbag2 log: its table `topics` lacks id, name, serialization_format, type"),
        (["DROP TABLE messages"], "its table `messages` lacks data, timestamp, topic_id"),
        (["ALTER TABLE messages RENAME COLUMN data TO content"], "its table `messages` lacks data"),
        (["DROP TABLE topics", "CREATE VIEW topics AS SELECT 1 id, 'a' name, 'b' type, 'cdr' serialization_format"],
         "its table `topics` lacks"),
        (["UPDATE topics SET serialization_format = 'protobuf'"], "serialized as 'protobuf'"),
        (["UPDATE topics SET name = x'ff'"], "not defined by texts"),
        (["UPDATE messages SET topic_id = 99 WHERE id = 7"], "1 messages of topic 99, which is not defined"),
        (["UPDATE messages SET data = 'text' WHERE id = 7"], "one without time or bytes"),
        (["UPDATE messages SET timestamp = 'noon' WHERE id = 7"], "one without time or bytes|which is not defined"),
        (["UPDATE messages SET timestamp = 1.5 WHERE id = 7"], "one without time or bytes|which is not defined"),
    ],
)  # fmt: skip
def test_what_is_no_log_is_refused(tmp_path: Path, statements: list[str], complaint: str) -> None:
    path = change(write_db3(tmp_path / "run.db3", several(50), 1), *statements)
    with pytest.raises(LogError, match=complaint):
        read_all(SqliteBagContainer(path))


def test_salvage_leaves_out_the_message_that_is_none(tmp_path: Path) -> None:
    messages = several(50)
    path = change(write_db3(tmp_path / "run.db3", messages, 1), "UPDATE messages SET data = 'text' WHERE id = 7")
    container = SqliteBagContainer(path, salvage=True)
    assert read_all(container) == reported([*messages[:6], *messages[7:]])
    assert "1 messages have no defined topic, no time or no bytes" in container.lost()[0]


def test_a_file_that_was_not_closed_is_refused(tmp_path: Path) -> None:
    """A recorder that keeps a write-ahead log and dies leaves its last messages beside the file."""
    messages = several(50)
    path = write_db3(tmp_path / "run.db3", messages, 1)
    with closing(sqlite3.connect(path)) as base:
        base.execute("PRAGMA journal_mode=WAL")
        base.execute("INSERT INTO messages(topic_id, timestamp, data) VALUES(1, 5, x'00')")
        base.commit()
        with pytest.raises(LogError, match=r"run\.db3-wal beside it holds what is not yet in it.*wal_checkpoint"):
            SqliteBagContainer(path)
        assert read_all(SqliteBagContainer(path, salvage=True)) == reported(messages)
    hot = tmp_path / "run.db3-journal"
    hot.write_bytes(bytes.fromhex("d9d505f920a163d7") + bytes(504))
    with pytest.raises(LogError, match=r"run\.db3-journal beside it"):
        SqliteBagContainer(path)
    hot.write_bytes(bytes(512))
    SqliteBagContainer(path).close()


def test_a_message_beyond_the_limit_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write_db3(tmp_path / "run.db3", [Stored(topic="/ft", log_ns=START_NS, data=bytes(20_000))])
    monkeypatch.setattr(sqlite_bag, "CHUNK_LIMIT_BYTES", 10_000)
    with pytest.raises(LogError, match="too big"):
        read_all(SqliteBagContainer(path))


def test_a_path_may_hold_any_character(tmp_path: Path) -> None:
    messages = several(20)
    path = write_db3(tmp_path / "a?mode=rw#%41 ü.db3", messages)
    assert read_all(SqliteBagContainer(path)) == reported(messages)


def test_batches_are_neither_small_nor_large(tmp_path: Path) -> None:
    messages = [Stored(topic="/ft", log_ns=START_NS + i, data=bytes(5000)) for i in range(3000)]
    with SqliteBagContainer(write_db3(tmp_path / "run.db3", messages, page_bytes=4096)) as container:
        sizes = [batch.data.size for _, batch in container.read(channels_of(container).values(), lambda batch: batch)]
    assert sum(sizes) == 15_000_000
    # 2000 rows are fetched at once.
    assert max(sizes) <= 2 * 2**20 + 2000 * 5000
    assert len(sizes) <= 8
