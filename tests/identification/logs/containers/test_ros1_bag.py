"""ROS 1 bags: the messages that another library wrote or reads, and nothing else when they are damaged."""

import bz2
import struct
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from rosbags.rosbag1 import Reader, Writer

from identification.errors import LogError
from identification.logs.containers import ros1_chunk
from identification.logs.containers.ros1_bag import Ros1BagContainer
from tests.identification.logs.containers.stored import (
    ROS1,
    START_NS,
    TYPES,
    Stored,
    Told,
    channels_of,
    codes,
    read_all,
    reported,
    several,
    write_bag,
)

FORMATS = [None, Writer.CompressionFormat.BZ2, Writer.CompressionFormat.LZ4]
CHUNK, INDEX, CONNECTION, INFO, MESSAGE = 5, 4, 7, 6, 2


def record(op: int, data: bytes = b"", **fields: bytes) -> bytes:
    """One record of the format, byte by byte."""
    pairs = [b"op=" + bytes([op]), *(name.encode() + b"=" + value for name, value in fields.items())]
    header = b"".join(struct.pack("<I", len(pair)) + pair for pair in pairs)
    return struct.pack("<I", len(header)) + header + struct.pack("<I", len(data)) + data


def u32(number: int) -> bytes:
    return struct.pack("<I", number)


def time_of(log_ns: int) -> bytes:
    return struct.pack("<II", log_ns // 10**9, log_ns % 10**9)


def connection(number: int, topic: bytes = b"/a") -> bytes:
    pairs = [b"type=std_msgs/String", b"md5sum=0", b"message_definition=string data"]
    content = b"".join(u32(len(pair)) + pair for pair in pairs)
    return record(CONNECTION, content, conn=u32(number), topic=topic)


def message(number: int, log_ns: int, data: bytes) -> bytes:
    return record(MESSAGE, data, conn=u32(number), time=time_of(log_ns))


def bag_of(
    content: bytes,
    entries: list[tuple[int, int]],
    *,
    packed: bytes | None = None,
    head: dict[str, bytes] | None = None,
    **changes: bytes,
) -> bytes:
    """A bag of one chunk and one connection, whose messages stand at `entries` (time, offset)."""
    fields = {"compression": b"none", "size": u32(len(content)), **changes}
    chunk = record(CHUNK, content if packed is None else packed, **fields)
    index = record(
        INDEX, b"".join(time_of(t) + u32(at) for t, at in entries), ver=u32(1), conn=u32(0), count=u32(len(entries))
    )
    position = 13 + len(record(3, index_pos=bytes(8), conn_count=u32(1), chunk_count=u32(1)))
    header = {
        "index_pos": struct.pack("<Q", position + len(chunk) + len(index)),
        "conn_count": u32(1),
        "chunk_count": u32(1),
        **(head or {}),
    }
    times = [t for t, _ in entries] or [0]
    info = record(
        INFO,
        u32(0) + u32(len(entries)),
        ver=u32(1),
        chunk_pos=struct.pack("<Q", position),
        start_time=time_of(min(times)),
        end_time=time_of(max(times)),
        count=u32(1),
    )
    return b"#ROSBAG V2.0\n" + record(3, **header) + chunk + index + connection(0) + info


def by_rosbags(path: Path) -> Told:
    found: Told = {}
    with Reader(path) as reader:
        for each, log_ns, data in reader.messages():
            found.setdefault(each.topic, []).append((log_ns, data))
    return found


def records_of(data: bytes) -> list[tuple[int, int, int, int]]:
    """Kind, offset, offset of the data and end of every record of a sound bag."""
    found, at = [], 13
    while at < len(data):
        (header,) = struct.unpack_from("<I", data, at)
        (size,) = struct.unpack_from("<I", data, at + 4 + header)
        kind = data[data.index(b"op=", at) + 3]
        found.append((kind, at, at + 8 + header, at + 8 + header + size))
        at += 8 + header + size
    return found


@pytest.mark.parametrize("compression", FORMATS)
@pytest.mark.parametrize("salvage", [False, True])
def test_a_bag_gives_the_messages_that_were_written(
    tmp_path: Path, compression: Writer.CompressionFormat | None, salvage: bool
) -> None:
    messages = several()
    path = write_bag(tmp_path / "run.bag", messages, compression)
    assert read_all(Ros1BagContainer(path, salvage=salvage)) == reported(messages)
    with Ros1BagContainer(path, salvage=salvage) as container:
        survey = container.survey()
        assert {held.channel.topic: (held.count, held.first_message) for held in survey.held} == {
            topic: (len(each), each[0][1]) for topic, each in reported(messages).items()
        }
        assert {held.channel.topic: held.channel.type_name for held in survey.held} == TYPES
        assert all(
            held.channel.schema == ROS1.generate_msgdef(held.channel.type_name)[0].encode()
            and held.channel.encoding == "ros1"
            and held.channel.schema_encoding == "ros1msg"
            for held in survey.held
        )
        assert (survey.start_ns, survey.end_ns) == (messages[0].log_ns, messages[-1].log_ns)
        assert codes(container) == ["crc-absent"]
        assert container.lost() == ()


@settings(max_examples=40, suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None)
@given(
    content=st.lists(
        st.tuples(st.sampled_from(sorted(TYPES)), st.integers(0, 2**32 * 10**9 - 1), st.binary(max_size=40)),
        max_size=30,
    ),
    chunk_bytes=st.integers(1, 600),
    compression=st.sampled_from(FORMATS),
)
def test_any_bag_is_read_as_written_with_and_without_its_index(
    tmp_path: Path,
    content: list[tuple[str, int, bytes]],
    chunk_bytes: int,
    compression: Writer.CompressionFormat | None,
) -> None:
    messages = [Stored(topic=topic, log_ns=log_ns, data=data) for topic, log_ns, data in content]
    path = tmp_path / "any.bag"
    path.unlink(missing_ok=True)
    write_bag(path, messages, compression, chunk_bytes)
    assert read_all(Ros1BagContainer(path)) == reported(messages)
    assert read_all(Ros1BagContainer(path, salvage=True)) == reported(messages)


def test_only_wanted_channels_are_handed_on_and_chunks_without_them_are_not_read(tmp_path: Path) -> None:
    messages = [
        Stored(topic=topic, log_ns=START_NS + i, data=bytes(500)) for topic in ("/ft", "/pose") for i in range(40)
    ]
    path = write_bag(tmp_path / "run.bag", messages, Writer.CompressionFormat.BZ2)
    data = bytearray(path.read_bytes())
    for _, _, start, end in [each for each in records_of(bytes(data)) if each[0] == CHUNK][-4:]:
        data[start:end] = bytes(end - start)
    path.write_bytes(data)
    with Ros1BagContainer(path) as container:
        ft, pose = (channels_of(container)[topic] for topic in ("/ft", "/pose"))
        read = [log_ns for _, times in container.read([ft], lambda batch: batch.log_ns.tolist()) for log_ns in times]
        assert read == [START_NS + i for i in range(40)]
        assert container.lost() == ()
        assert len(list(container.read([pose], lambda batch: batch))) < 4
        assert all("bz2 data cannot be unpacked" in place for place in container.lost())
        assert len(container.lost()) == 4


def test_publishers_of_one_topic_are_one_channel_in_the_order_of_the_file(tmp_path: Path) -> None:
    path = tmp_path / "run.bag"
    with Writer(path) as bag:
        ids = [bag.add_connection("/ft", TYPES["/ft"], typestore=ROS1, callerid=name) for name in ("/a", "/b")]
        for index in range(20):
            bag.write(ids[index % 2], START_NS + index, bytes([index]))
    assert read_all(Ros1BagContainer(path)) == {"/ft": [(START_NS + i, bytes([i])) for i in range(20)]}


def test_an_empty_bag_holds_no_channel(tmp_path: Path) -> None:
    with Ros1BagContainer(write_bag(tmp_path / "run.bag", [])) as container:
        survey = container.survey()
        assert (survey.held, survey.start_ns, survey.end_ns) == ((), 0, 0)
        assert list(container.read([], lambda batch: batch)) == []


def test_every_truncation_is_refused_and_salvaged_up_to_it(tmp_path: Path) -> None:
    messages = several()
    for compression in FORMATS:
        path = write_bag(tmp_path / f"{compression}.bag", messages, compression)
        data = path.read_bytes()
        chunks = [(at, end) for kind, at, _, end in records_of(data) if kind == CHUNK]
        sound = reported(messages)
        for size in [*range(13, 200, 17), *range(200, len(data), len(data) // 25)]:
            path.write_bytes(data[:size])
            with pytest.raises(
                LogError, match=rf"^{compression}\.bag is damaged at byte \d+: .*`rosbag reindex`.*--salvage"
            ):
                Ros1BagContainer(path)
            container = Ros1BagContainer(path, salvage=True)
            found = read_all(container)
            assert all(each == sound[topic][: len(each)] for topic, each in found.items())
            whole = sum(end <= size for _, end in chunks)
            # A chunk of 4000 bytes holds 10 to 40 of these messages.
            assert sum(map(len, found.values())) >= min(10 * whole, len(messages))
            assert codes(container) == ["crc-absent"]
            assert container.lost()


@pytest.mark.parametrize("compression", FORMATS)
def test_a_damaged_chunk_costs_that_chunk_alone(tmp_path: Path, compression: Writer.CompressionFormat | None) -> None:
    messages = several()
    path = write_bag(tmp_path / "run.bag", messages, compression)
    sound, data = reported(messages), bytearray(path.read_bytes())
    chunks = [(at, start, end) for kind, at, start, end in records_of(bytes(data)) if kind == CHUNK]
    at, start, end = chunks[len(chunks) // 2]
    data[start:end] = bytes(end - start)
    path.write_bytes(data)
    container = Ros1BagContainer(path, salvage=True)
    found = read_all(container)
    assert read_all(beside := Ros1BagContainer(path)) == found
    assert [place.partition(": ")[0] for place in beside.lost()] == [f"at byte {at}"]
    lost = [m for topic, each in sound.items() for m in each if m not in found.get(topic, [])]
    times = [log_ns for log_ns, _ in lost]
    assert {topic: [m for m in each if m[0] not in times] for topic, each in sound.items()} == found
    assert 10 < len(lost) < 45
    # What is lost lies together: 800 µs apart.
    assert max(times) - min(times) == 800_000 * (len(times) - 1)
    assert f"at byte {at}: " in container.lost()[0]


@pytest.mark.parametrize("place", [0, 1, -1])
def test_a_damaged_chunk_is_left_out_and_named(tmp_path: Path, place: int) -> None:
    messages = several()
    path = write_bag(tmp_path / "run.bag", messages, Writer.CompressionFormat.LZ4)
    sound, data = reported(messages), bytearray(path.read_bytes())
    at, start, end = [(at, start, end) for kind, at, start, end in records_of(bytes(data)) if kind == CHUNK][place]
    data[start:end] = bytes(end - start)
    path.write_bytes(data)
    container = Ros1BagContainer(path)
    found = read_all(container)
    lost = sum(map(len, sound.values())) - sum(map(len, found.values()))
    assert 2 < lost < 60
    assert all(set(each) <= set(sound[topic]) for topic, each in found.items())
    (said,) = container.lost()
    assert said.startswith(f"at byte {at}: ")
    assert said.endswith(f" s after the log's start, {lost} of {sum(map(len, sound.values()))} messages)")


def test_a_message_with_a_wrong_length_costs_that_message(tmp_path: Path) -> None:
    content = [message(0, START_NS + i, bytes([i]) * 50) for i in range(9)]
    offsets = np.cumsum([0, *map(len, content)]).tolist()
    data = bytearray(b"".join(content))
    data[offsets[4] + len(content[4]) - 51] = 0x7F
    path = tmp_path / "run.bag"
    path.write_bytes(bag_of(bytes(data), [(START_NS + i, offsets[i]) for i in range(9)]))
    with pytest.raises(LogError, match=f"holds no record at byte {offsets[4]} of its"):
        read_all(Ros1BagContainer(path))
    assert read_all(Ros1BagContainer(path, salvage=True)) == {
        "/a": [(START_NS + i, bytes([i]) * 50) for i in range(9) if i != 4]
    }


@pytest.mark.parametrize("compression", FORMATS)
def test_a_bag_that_was_not_closed_is_refused_and_salvaged_whole(
    tmp_path: Path, compression: Writer.CompressionFormat | None
) -> None:
    messages = several()
    path = write_bag(tmp_path / "run.bag", messages, compression)
    data = bytearray(path.read_bytes())
    where = data.index(b"index_pos=") + len(b"index_pos=")
    (index_pos,) = struct.unpack_from("<Q", data, where)
    data[where : where + 8] = bytes(8)
    path.write_bytes(data[:index_pos])
    with pytest.raises(LogError, match=r"not indexed \(index_pos 0\)"):
        Ros1BagContainer(path)
    container = Ros1BagContainer(path, salvage=True)
    assert read_all(container) == reported(messages)
    assert "the bag is not indexed" in container.lost()[0]


def test_a_chunk_whose_length_leads_past_others_does_not_cost_them(tmp_path: Path) -> None:
    messages = several()
    path = write_bag(tmp_path / "run.bag", messages)
    data = bytearray(path.read_bytes())
    chunks = [(start, end) for kind, _, start, end in records_of(bytes(data)) if kind == CHUNK]
    for length in (2**32 - 1, chunks[4][1] - chunks[1][0] + 5):
        data[chunks[1][0] - 4 : chunks[1][0]] = u32(length)
        path.write_bytes(data)
        with pytest.raises(LogError, match="at byte"):
            read_all(Ros1BagContainer(path))
        container = Ros1BagContainer(path, salvage=True)
        assert read_all(container) == reported(messages)
        assert container.lost()


@pytest.mark.parametrize("compression", FORMATS)
def test_flipped_bits_raise_nothing_else(tmp_path: Path, compression: Writer.CompressionFormat | None) -> None:
    path = write_bag(tmp_path / "run.bag", several(150), compression, chunk_bytes=2000)
    data, refused = path.read_bytes(), 0
    chooser = np.random.default_rng(7)
    places = [*range(13, 120, 4), *chooser.integers(4000, len(data), 60), *range(len(data) - 900, len(data), 12)]
    for place in places:
        damaged = bytearray(data)
        damaged[place] ^= 1 << int(chooser.integers(8))
        path.write_bytes(damaged)
        try:
            read_all(Ros1BagContainer(path))
        except LogError:
            refused += 1
        read_all(Ros1BagContainer(path, salvage=True))
    assert refused > 40


def test_no_flipped_bit_in_the_frame_of_a_message_goes_unnoticed(tmp_path: Path) -> None:
    """The format has no checksum, but what it tells twice must agree: connection, time and place."""
    content = message(0, START_NS, b"first") + message(0, START_NS + 1, b"second")
    first = len(message(0, START_NS, b"first"))
    data = bag_of(content, [(START_NS, 0), (START_NS + 1, first)])
    path = tmp_path / "run.bag"
    path.write_bytes(data)
    assert read_all(Ros1BagContainer(path)) == {"/a": [(START_NS, b"first"), (START_NS + 1, b"second")]}
    start = data.index(content)
    for place in [*range(start, start + first - 5), *range(start + first, start + len(content) - 6)]:
        for bit in range(8):
            damaged = bytearray(data)
            damaged[place] ^= 1 << bit
            path.write_bytes(damaged)
            with pytest.raises(LogError, match="at byte"):
                read_all(Ros1BagContainer(path))


def test_an_index_may_point_at_the_connection_before_its_message(tmp_path: Path) -> None:
    content = connection(0) + message(0, START_NS, b"x")
    path = tmp_path / "run.bag"
    path.write_bytes(bag_of(content, [(START_NS, 0)]))
    assert read_all(Ros1BagContainer(path)) == by_rosbags(path) == {"/a": [(START_NS, b"x")]}


ONE = message(0, START_NS, b"data")
SOUND = bag_of(ONE, [(START_NS, 0)])
HUGE = u32(2**30)


@pytest.mark.parametrize(
    ("data", "complaint"),
    [
        (bag_of(ONE, [(START_NS, 0)], head={"index_pos": struct.pack("<Q", 2**60)}), "the index should start at byte"),
        (bag_of(ONE, [(START_NS, 0)], head={"index_pos": struct.pack("<Q", 14)}), "Header could not be read"),
        (bag_of(ONE, [(START_NS, 0)], head={"conn_count": u32(2)}), "Record of type 'CHUNK_INFO' is unexpected"),
        (bag_of(ONE, [(START_NS, 0)], head={"chunk_count": u32(2)}), "Header could not be read"),
        (bag_of(ONE, [(START_NS, 0)], head={"chunk_count": u32(0)}), "bytes follow the end of the index"),
        (bag_of(ONE, [(START_NS, 0)], head={"conn_count": b"1"}), "Could not read uint32 field 'conn_count'"),
        (bag_of(ONE, [(START_NS, 0)], head={"encryptor": b"rosbag/AesCbcEncryptor"}), "is encrypted"),
        (bag_of(ONE, [(START_NS, 0)], compression=b"zstd"), "not one of none, bz2 or lz4"),
        (bag_of(ONE, [(START_NS, 0)], size=HUGE), "more than the 268435456 that are allowed"),
        (bag_of(ONE, [(START_NS, 0)], size=u32(3)), "should unpack to 3 bytes"),
        (bag_of(ONE, [(START_NS, 0)], compression=b"bz2"), "bz2 data cannot be unpacked"),
        (bag_of(ONE, [(START_NS, 0)], compression=b"lz4"), "lz4 data cannot be unpacked"),
        (bag_of(ONE, [(START_NS, 0)], compression=b"bz2", packed=bz2.compress(ONE)[:-6]), "bz2 data break off"),
        (bag_of(ONE, [(START_NS, 0)], compression=b"bz2", packed=bz2.compress(bytes(10**7))), "or more"),
        (bag_of(ONE, [(START_NS, 1)]), "index of connection 0 does not agree"),
        (bag_of(ONE, [(START_NS + 1, 0)]), "index of connection 0 does not agree"),
        (bag_of(ONE, [(START_NS, 0), (START_NS, 0)]), "holds 1 messages, the index counts 2"),
        (bag_of(ONE + ONE, [(START_NS, 0)]), "holds 2 messages, the index counts 1"),
        (bag_of(ONE + ONE, [(START_NS, 0), (START_NS, 0)]), "does not agree"),
        (bag_of(message(3, START_NS, b"data"), [(START_NS, 0)]), "or others"),
        (bag_of(connection(0, b"/b") + ONE, [(START_NS, 0)]), "connection 0 is defined twice, differently"),
        (bag_of(record(9), [(START_NS, 0)]), "holds no record at byte 0"),
        (bag_of(ONE.replace(time_of(START_NS), u32(5) + u32(10**9)), [(START_NS, 0)]), "holds no record at byte 0"),
        (b"#ROSBAG V1.2\n" + SOUND[13:], "must start with the line"),
        (SOUND.replace(b"\x0f\0\0\0conn_count", b"\x0f\0\0\x7fconn_count"), "Declared field size is too large"),
        (SOUND[:13] + u32(2**31) + SOUND[17:], "Header could not be read"),
    ],
)
def test_bags_assembled_to_mislead_are_refused(tmp_path: Path, data: bytes, complaint: str) -> None:
    path = tmp_path / "made.bag"
    path.write_bytes(data)
    with pytest.raises(LogError, match=complaint) as caught:
        read_all(Ros1BagContainer(path))
    assert str(caught.value).startswith("made.bag is damaged at byte ")


def test_the_same_bag_without_the_fault_is_read(tmp_path: Path) -> None:
    path = tmp_path / "made.bag"
    path.write_bytes(SOUND)
    assert read_all(Ros1BagContainer(path)) == by_rosbags(path) == {"/a": [(START_NS, b"data")]}


def test_unpacking_stops_at_what_the_chunk_declares(tmp_path: Path) -> None:
    path = tmp_path / "bomb.bag"
    path.write_bytes(bag_of(ONE, [(START_NS, 0)], compression=b"bz2", packed=bz2.compress(bytes(10**8))))
    tracemalloc.start()
    with pytest.raises(LogError, match="should unpack to"):
        read_all(Ros1BagContainer(path))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    # The decompressor's own block is 900 kB, of which it keeps four bytes for each.
    assert peak < 6 * 10**6


def test_the_limit_holds_for_what_is_read_and_what_is_unpacked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write_bag(tmp_path / "run.bag", several(100), chunk_bytes=100_000)
    monkeypatch.setattr(ros1_chunk, "CHUNK_LIMIT_BYTES", 10_000)
    with pytest.raises(LogError, match="more than the 10000 that are allowed"):
        read_all(Ros1BagContainer(path))
    assert read_all(Ros1BagContainer(path, salvage=True)) == {}


@pytest.mark.parametrize("name", ["single_mode_middle.bag", "yellow_table_1.bag"])
def test_recorded_bags_are_read_as_rosbags_reads_them(shared_data: Path, name: str) -> None:
    path = shared_data / "nj60" / name
    expected = by_rosbags(path)
    for salvage in (False, True):
        container = Ros1BagContainer(path, salvage=salvage)
        found = read_all(container)
        # The library sorts by time, a container keeps the order of the file.
        assert {topic: sorted(each) for topic, each in found.items()} == {
            topic: sorted(each) for topic, each in expected.items()
        }
        survey = container.survey()
        times = [log_ns for each in expected.values() for log_ns, _ in each]
        assert (survey.start_ns, survey.end_ns) == (min(times), max(times))
        assert {held.channel.topic: held.count for held in survey.held} == {
            topic: len(each) for topic, each in expected.items()
        }
