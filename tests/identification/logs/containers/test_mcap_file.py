"""MCAP files of every style that recorders write, from bytes that are put together here and by the MCAP library."""

import itertools
import struct
import tracemalloc
import zlib
from dataclasses import replace
from pathlib import Path

import lz4.frame  # type: ignore[import-untyped]  # the package carries no annotations
import numpy as np
import pytest
import zstandard
from mcap.writer import CompressionType, IndexType
from mcap.writer import Writer as LibraryWriter

from identification.errors import LogError
from identification.logs.containers.channel import Channel
from identification.logs.containers.mcap_file import McapContainer
from identification.logs.messages.decode import Wanted
from tests.identification.logs.containers import mcap_writer as raw
from tests.identification.logs.containers.mcap_reading import (
    CHANNELS,
    SCHEMAS,
    START_NS,
    channels_of,
    expected,
    messages_of,
    read_all,
    some_messages,
    write_style,
)
from tests.identification.logs.containers.mcap_writer import Sent, Style, Writer
from tests.identification.logs.messages.message_builder import read_series

COMPRESSIONS = ("", "zstd", "lz4")


@pytest.mark.parametrize("compression", COMPRESSIONS)
@pytest.mark.parametrize("per_chunk", [1, 7, 1000])
def test_messages_come_in_file_order_whatever_the_compression(tmp_path: Path, compression: str, per_chunk: int) -> None:
    messages = some_messages()
    path = tmp_path / "run.mcap"
    write_style(path, messages, Style(compression=compression, messages_per_chunk=per_chunk))

    contents = read_all(path)

    assert contents.messages == expected(messages)
    assert contents.survey.container == "mcap"
    message = {held.channel.topic: (held.count, held.first_message) for held in contents.survey.held}
    assert message == {topic: (len(each), each[0][1]) for topic, each in expected(messages).items()}
    assert contents.survey.start_ns == min(sent.log_ns for sent in messages)
    assert contents.survey.end_ns == max(sent.log_ns for sent in messages)
    assert contents.survey.findings == ()


def test_every_mixture_of_indexes_and_summary_is_read(tmp_path: Path) -> None:
    messages = some_messages(25)
    path = tmp_path / "run.mcap"
    for flags in itertools.product([False, True], repeat=7):
        chunked, message_index, statistics, repeat, chunk_index, data_crc, in_every = flags
        style = Style(
            chunked=chunked,
            message_index=message_index,
            statistics=statistics,
            repeat_channels=repeat,
            repeat_schemas=repeat,
            chunk_index=chunk_index,
            data_crc=data_crc,
            define_in_every_chunk=in_every,
            messages_per_chunk=10,
            compression="zstd",
        )
        write_style(path, messages, style)
        contents = read_all(path)
        assert contents.messages == expected(messages), style
        codes = {finding.code for finding in contents.survey.findings}
        assert ("crc-absent" in codes) == (not chunked and not data_crc), style
        assert ("summary-absent" in codes) == (not statistics), style


def test_what_rosbag2_writes_by_default_is_read_and_its_missing_checksums_are_reported(tmp_path: Path) -> None:
    messages = some_messages()
    default = Style(chunk_crc=False, messages_per_chunk=10)
    fast = Style(chunked=False, summary_crc=False, message_index=False, chunk_index=False)
    for style in (default, fast, replace(default, compression="zstd")):
        path = tmp_path / "run.mcap"
        write_style(path, messages, style)
        contents = read_all(path)
        assert contents.messages == expected(messages)
        assert [finding.code for finding in contents.survey.findings] == ["crc-absent"]
        assert "60 of 60 messages carry no checksum" in contents.survey.findings[0].message
        assert contents.survey.findings[0].severity == "info"


@pytest.mark.parametrize("compression", list(CompressionType))
@pytest.mark.parametrize("chunked", [True, False])
def test_files_of_the_mcap_library_are_read(tmp_path: Path, compression: CompressionType, chunked: bool) -> None:
    path = tmp_path / "library.mcap"
    with path.open("wb") as file:
        writer = LibraryWriter(
            file, chunk_size=500, compression=compression, use_chunking=chunked, index_types=IndexType.ALL
        )
        writer.start("ros2")
        number = writer.register_schema("geometry_msgs/msg/Wrench", "ros2msg", b"float64 x")
        channel = writer.register_channel("/w", "cdr", number)
        for index in range(100):
            writer.add_message(channel, log_time=START_NS + index, publish_time=0, data=bytes([index]))
            if index % 20 == 0:
                writer.add_attachment(index, index, "photo.jpg", "image/jpeg", bytes(2000))
                writer.add_metadata("note", {"key": "value"})
        writer.finish()

    contents = read_all(path)

    assert contents.messages == {"/w": [(START_NS + index, bytes([index])) for index in range(100)]}
    assert contents.survey.held[0].channel == Channel(
        topic="/w",
        type_name="geometry_msgs/msg/Wrench",
        encoding="cdr",
        schema_encoding="ros2msg",
        schema=b"float64 x",
    )


def test_names_of_ros_types_are_written_alike_and_others_are_left(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    schemas = {1: raw.schema(1, "geometry_msgs/Wrench", "ros1msg", b""), 2: raw.schema(2, "a/B", "jsonschema", b"{}")}
    channels = {1: raw.channel(1, 1, "/w", "ros1"), 2: raw.channel(2, 2, "/j", "json")}
    path.write_bytes(Writer(Style(), schemas, channels).write([Sent(channel_id=1, log_ns=5, data=b"")]))
    assert [channel.type_name for channel in channels_of(path)] == ["a/B", "geometry_msgs/msg/Wrench"]


def test_channels_that_say_the_same_are_one_and_keep_file_order(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    schemas = {1: raw.schema(1, "pkg/msg/A", "ros2msg", b""), 2: raw.schema(2, "pkg/msg/B", "ros2msg", b"")}
    channels = {
        1: raw.channel(1, 1, "/same", "cdr"),
        9: raw.channel(9, 1, "/same", "cdr", {"publisher": "second"}),
        4: raw.channel(4, 2, "/same", "cdr"),
    }
    messages = [Sent(channel_id=id_, log_ns=log, data=bytes([log])) for log, id_ in enumerate([1, 9, 4, 9, 1, 9], 1)]
    for per_chunk in (2, 100):
        path.write_bytes(Writer(Style(messages_per_chunk=per_chunk), schemas, channels).write(messages))
        with McapContainer(path) as container:
            held = container.survey().held
            assert [(each.channel.type_name, each.count) for each in held] == [("pkg/msg/A", 5), ("pkg/msg/B", 1)]
            found = [m for _, part in container.read([held[0].channel], messages_of) for m in part]
            assert found == [(log, bytes([log])) for log in (1, 2, 4, 5, 6)]


@pytest.mark.parametrize("packer", [zstandard.compress, lz4.frame.compress])
def test_a_chunk_of_several_frames_is_unpacked_whole(tmp_path: Path, packer: object) -> None:
    assert callable(packer)
    name = "zstd" if packer is zstandard.compress else "lz4"
    content = b"".join(
        [
            raw.record(raw.SCHEMA, SCHEMAS[1]),
            raw.record(raw.CHANNEL, CHANNELS[1]),
            *(raw.record(raw.MESSAGE, raw.message(1, log, bytes([log]))) for log in range(1, 50)),
        ]
    )
    packed = packer(content[:100]) + packer(b"") + packer(content[100:])
    body = struct.pack("<QQQI", 1, 49, len(content), zlib.crc32(content)) + raw.text(name)
    body += struct.pack("<Q", len(packed)) + packed
    path = tmp_path / "frames.mcap"
    path.write_bytes(file_of(raw.record(raw.CHUNK, body)))
    assert read_all(path).messages == {"/a": [(log, bytes([log])) for log in range(1, 50)]}


def file_of(*records: bytes) -> bytes:
    return (
        raw.MAGIC
        + raw.record(raw.HEADER, raw.header())
        + b"".join(records)
        + raw.record(raw.DATA_END, bytes(4))
        + raw.record(raw.FOOTER, bytes(20))
        + raw.MAGIC
    )


def test_only_what_is_wanted_is_read(tmp_path: Path) -> None:
    """A chunk without wanted channels may hold anything: it is not even unpacked."""
    messages = [Sent(channel_id=1 + (index // 10) % 2, log_ns=index, data=bytes(20)) for index in range(1, 100)]
    path = tmp_path / "run.mcap"
    writer = write_style(path, messages, Style(compression="zstd", messages_per_chunk=5))
    data = bytearray(path.read_bytes())
    second = writer.chunks[2]  # messages 11 to 15 are all of the second channel
    data[second + 70] ^= 0xFF
    path.write_bytes(data)
    topic_a = [channel for channel in channels_of_index(path) if channel.topic == "/a"]
    with McapContainer(path) as container:
        found = [m for _, part in container.read(topic_a, messages_of) for m in part]
        assert found == expected(messages)["/a"]
    (finding,) = read_all(path).findings
    assert finding.message.startswith(f"run.mcap is damaged: bytes {second} to ")


def channels_of_index(path: Path) -> list[Channel]:
    """Return the channels without opening the damaged chunk for its first message."""
    with McapContainer(path) as container:
        return list(container._ids)


def test_channels_that_the_file_does_not_have_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    write_style(path, some_messages(), Style())
    other = Channel(topic="/nowhere", type_name="T", encoding="cdr", schema_encoding="", schema=b"")
    with (
        McapContainer(path) as container,
        pytest.raises(LogError, match=r"Topic /nowhere of type T is not in run\.mcap"),
    ):
        list(container.read([other], messages_of))


def test_an_error_while_handling_a_batch_comes_out_in_order(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    write_style(path, some_messages(200), Style(messages_per_chunk=5))
    with McapContainer(path) as container:
        channel = container.survey().held[0].channel
        done: list[int] = []
        limit = START_NS + 100_000

        def handle(batch: object) -> int:
            last = int(getattr(batch, "log_ns")[-1])  # noqa: B009 - the batch is typed by the container
            if last > limit:
                raise LogError(f"at {last}")
            return last

        with pytest.raises(LogError, match="at ") as caught:
            done.extend(last for _, last in container.read([channel], handle))
        assert done
        assert int(str(caught.value).removeprefix("at ")) <= limit + 12_000


def test_reading_may_be_given_up_halfway_and_begun_again(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    messages = some_messages(300)
    write_style(path, messages, Style(messages_per_chunk=5))
    with McapContainer(path) as container:
        channels = [held.channel for held in container.survey().held]
        for _ in container.read(channels, messages_of):
            break
        again: dict[str, list[tuple[int, bytes]]] = {channel.topic: [] for channel in channels}
        for channel, part in container.read(channels, messages_of):
            again[channel.topic] += part
        assert again == expected(messages)


def test_messages_larger_than_the_window_are_read(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    sizes = [10, 2**20 - 31, 2**20 - 30, 2**20, 3 * 2**20, 5]
    messages = [Sent(channel_id=1, log_ns=index + 1, data=bytes([index]) * size) for index, size in enumerate(sizes)]
    write_style(path, messages, Style(chunked=False))
    assert read_all(path).messages["/a"] == [(sent.log_ns, sent.data) for sent in messages]


def test_memory_stays_below_three_times_what_is_returned_whatever_else_is_in_the_file(tmp_path: Path) -> None:
    """A camera of 60 MB beside 8 MB of wanted numbers: neither it nor the file is ever in memory."""
    path = tmp_path / "camera.mcap"
    schemas = {1: raw.schema(1, "geometry_msgs/msg/Vector3", "ros2msg", b"float64 x\nfloat64 y\nfloat64 z\n")}
    channels = {1: raw.channel(1, 1, "/v", "cdr"), 2: raw.channel(2, 0, "/camera", "jpeg")}
    vector = b"\0\1\0\0" + np.arange(3.0).tobytes()
    messages = [
        Sent(channel_id=2, log_ns=index, data=bytes(500_000))
        if index % 2000 == 0
        else Sent(channel_id=1, log_ns=index, data=vector)
        for index in range(1, 240_000)
    ]
    path.write_bytes(Writer(Style(messages_per_chunk=4000, compression="lz4"), schemas, channels).write(messages))
    del messages
    wanted = Wanted(fields=("x", "y", "z"), header="")
    with McapContainer(path) as container:
        channel = next(held.channel for held in container.survey().held if held.channel.topic == "/v")
        read_series(container, {channel: wanted})  # compiles what is not compiled yet
        tracemalloc.start()
        series = read_series(container, {channel: wanted})[channel]
        _, peak = tracemalloc.get_traced_memory()
        tracemalloc.stop()
    returned = series.values.nbytes + series.log_ns.nbytes
    assert returned > 7_000_000
    assert peak < 3 * returned
