"""What is left of damaged MCAP files: all of it, nothing else, and what is lost is told."""

import random
import struct
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import pytest

from identification.errors import LogError
from tests.identification.logs.containers import mcap_writer as raw
from tests.identification.logs.containers.mcap_reading import (
    CHANNELS,
    SCHEMAS,
    Contents,
    Message,
    expected,
    read_all,
    some_messages,
    write_style,
)
from tests.identification.logs.containers.mcap_writer import MAGIC, Sent, Style, Writer

PER_CHUNK = 20
CHUNKED = Style(messages_per_chunk=PER_CHUNK, compression="zstd", define_in_every_chunk=True)
BARE = replace(
    CHUNKED, message_index=False, statistics=False, chunk_index=False, repeat_channels=False, repeat_schemas=False
)
UNCHUNKED = Style(chunked=False)


def without_chunks(messages: Sequence[Sent], lost: Sequence[int]) -> dict[str, list[Message]]:
    return expected([sent for number, sent in enumerate(messages) if number // PER_CHUNK not in lost])


def reported(contents: Contents) -> str:
    assert [(finding.code, finding.severity) for finding in contents.findings] == [("salvaged", "warning")]
    return contents.findings[0].message


def damage(path: Path, writer: Writer, chunk: int, place: int, value: bytes) -> None:
    """Overwrite bytes of a chunk record; negative places count from its end."""
    data = bytearray(path.read_bytes())
    start = writer.chunks[chunk]
    (length,) = struct.unpack_from("<Q", data, start + 1)
    at = start + place if place >= 0 else start + 9 + length + place
    data[at : at + len(value)] = value
    path.write_bytes(data)


@pytest.mark.parametrize("style", [CHUNKED, BARE, replace(CHUNKED, compression="lz4"), replace(BARE, compression="")])
@pytest.mark.parametrize(
    ("place", "value"),
    [
        (-9, b"\xff\xff\xff"),  # content
        (60, b"\xff\xff\xff"),  # content
        (1, struct.pack("<Q", 2**63)),  # length beyond everything
        (1, struct.pack("<Q", 2**20)),  # length beyond the file
        (1, struct.pack("<Q", 1500)),  # length inside the file
        (1, struct.pack("<Q", 5)),  # length too small
        (0, b"\0"),  # kind
        (0, b"\x02"),  # kind
        (25, struct.pack("<Q", 2**40)),  # size unpacked
        (33, b"\1\2\3\4"),  # CRC
        (37, struct.pack("<I", 77)),  # name of the compression
    ],
)
def test_a_damaged_chunk_in_the_middle_costs_that_chunk_alone(
    tmp_path: Path, style: Style, place: int, value: bytes
) -> None:
    messages, path = some_messages(200), tmp_path / "run.mcap"
    writer = write_style(path, messages, style)
    damage(path, writer, 4, place, value)

    # The summary lists where the chunk is whose head is damaged.
    if style.statistics:
        beside = read_all(path)
        assert beside.messages == without_chunks(messages, [4])
        assert f"damaged: bytes {writer.chunks[4]} to" in reported(beside)
        assert "20 of 200 messages (" in reported(beside)
    else:
        with pytest.raises(LogError, match="--salvage"):
            read_all(path)
    contents = read_all(path, salvage=True)

    assert contents.messages == without_chunks(messages, [4])
    message = reported(contents)
    assert f"bytes {writer.chunks[4]} to" in message
    if style.statistics:
        assert "altogether 20 of 200 messages" in message
    if style.chunk_index:
        times = [1e-9 * (sent.log_ns - messages[0].log_ns) for sent in messages[4 * PER_CHUNK : 5 * PER_CHUNK]]
        assert f"recorded {min(times):.3f} to {max(times):.3f} s after the log's start" in message


def test_what_looks_like_a_chunk_but_is_damaged_too_does_not_end_the_search(tmp_path: Path) -> None:
    messages, path = some_messages(200), tmp_path / "run.mcap"
    writer = write_style(path, messages, BARE)
    damage(path, writer, 3, 1, struct.pack("<Q", 2**63))
    damage(path, writer, 4, -9, b"\xff\xff")
    assert read_all(path, salvage=True).messages == without_chunks(messages, [3, 4])


def test_no_message_is_taken_out_of_a_damaged_chunk_that_is_not_cut(tmp_path: Path) -> None:
    """Without compression its messages could be found, but nothing says which of them are damaged."""
    content = b"".join(raw.record(raw.MESSAGE, raw.message(1, log, bytes(30))) for log in range(1, 20))
    defined = raw.record(raw.SCHEMA, SCHEMAS[1]) + raw.record(raw.CHANNEL, CHANNELS[1])
    chunk = bytearray(raw.record(raw.CHUNK, raw.chunk(content, (1, 19))))
    chunk[1:9] = struct.pack("<Q", 2**63)
    end = raw.record(raw.DATA_END, bytes(4)) + raw.record(raw.FOOTER, bytes(20)) + MAGIC
    path = tmp_path / "run.mcap"
    path.write_bytes(MAGIC + raw.record(raw.HEADER, raw.header()) + defined + chunk + end)
    contents = read_all(path, salvage=True)
    assert contents.messages == {"/a": []}
    assert "a record of kind 6 says 9223372036854775808 bytes should follow" in reported(contents)


def test_what_is_lost_is_counted_where_the_index_shows(tmp_path: Path) -> None:
    messages, path = some_messages(200), tmp_path / "run.mcap"
    writer = write_style(path, messages, CHUNKED)
    damage(path, writer, 4, -9, b"\xff\xff")
    damage(path, writer, 6, -9, b"\xff\xff")
    contents = read_all(path, salvage=True)
    assert contents.messages == without_chunks(messages, [4, 6])
    assert reported(contents).count("20 messages (") == 2
    assert "altogether 40 of 200 messages" in reported(contents)


@pytest.mark.parametrize("style", [CHUNKED, BARE, replace(BARE, compression=""), UNCHUNKED])
def test_a_cut_file_gives_everything_before_the_cut(tmp_path: Path, style: Style) -> None:
    messages, path, cut = some_messages(100), tmp_path / "run.mcap", tmp_path / "cut.mcap"
    writer = write_style(path, messages, style)
    data = path.read_bytes()
    stops = ends_of_messages(data, writer, messages, style)
    for size in sorted(random.Random(1).sample(range(60, len(data)), 60)):
        cut.write_bytes(data[:size])
        contents = read_all(cut, salvage=True)
        count = sum(stop <= size for stop in stops)
        every = {topic: found for topic, found in expected(messages[:count]).items() if found}
        assert {topic: found for topic, found in contents.messages.items() if found} == every
        assert "truncated" in reported(contents) or "end" in reported(contents)


def ends_of_messages(data: bytes, writer: Writer, messages: Sequence[Sent], style: Style) -> list[int]:
    """Return from which size of the file on each message can be had."""
    stops: list[int] = []
    if style.chunked and style.compression:
        for start in writer.chunks:
            (length,) = struct.unpack_from("<Q", data, start + 1)
            stops += [start + 9 + length] * PER_CHUNK
        return stops[: len(messages)]
    for sent in messages:
        body = raw.record(raw.MESSAGE, raw.message(sent.channel_id, sent.log_ns, sent.data, sent.sequence))
        stops.append(data.index(body, stops[-1] if stops else 0) + len(body))
    return stops


def test_a_file_without_its_end_has_lost_nothing_but_that(tmp_path: Path) -> None:
    messages, path = some_messages(100), tmp_path / "run.mcap"
    for style in (CHUNKED, UNCHUNKED):
        data = write_style(path, messages, style).file
        path.write_bytes(data[: data.index(raw.record(raw.DATA_END, bytes(4)))])
        contents = read_all(path, salvage=True)
        assert contents.messages == expected(messages)
        assert "no sound summary at the end" in reported(contents)
        assert "the end was cut off, with all that was recorded after" in reported(contents)


@pytest.mark.parametrize("value", [struct.pack("<Q", 2**63), struct.pack("<Q", 70), struct.pack("<Q", 24)])
def test_a_damaged_message_outside_of_chunks_costs_that_message_and_few_beside_it(tmp_path: Path, value: bytes) -> None:
    messages, path = some_messages(100), tmp_path / "run.mcap"
    data = bytearray(write_style(path, messages, UNCHUNKED).file)
    victim = messages[50]
    body = raw.record(raw.MESSAGE, raw.message(victim.channel_id, victim.log_ns, victim.data, victim.sequence))
    at = bytes(data).index(body)
    data[at + 1 : at + 9] = value
    path.write_bytes(data)

    contents = read_all(path, salvage=True)

    found, every = contents.messages, expected(messages)
    kept = {log_ns for each in found.values() for log_ns, _ in each}
    lost = [number for number, sent in enumerate(messages) if sent.log_ns not in kept]
    assert 50 in lost
    assert set(lost) <= {50, 51, 52}
    assert all(message in every[topic] for topic, each in found.items() for message in each)
    assert f"altogether {len(lost)} of 100 messages" in reported(contents)


def test_a_damaged_index_costs_no_message(tmp_path: Path) -> None:
    messages, path = some_messages(200), tmp_path / "run.mcap"
    for style in (CHUNKED, replace(BARE, message_index=True)):
        writer = write_style(path, messages, style)
        for value in (struct.pack("<Q", 2**63), struct.pack("<Q", 3), struct.pack("<Q", 400)):
            data = bytearray(writer.file)
            start = writer.chunks[4]
            (length,) = struct.unpack_from("<Q", data, start + 1)
            data[start + 9 + length + 1 : start + 9 + length + 9] = value
            path.write_bytes(data)
            contents = read_all(path, salvage=True)
            assert contents.messages == expected(messages)
            assert "bytes" in reported(contents)


def test_damaged_chunks_that_follow_each_other_are_one_place(tmp_path: Path) -> None:
    messages, path = some_messages(200), tmp_path / "run.mcap"
    writer = write_style(path, messages, CHUNKED)
    for chunk in (2, 5, 6, 7):
        damage(path, writer, chunk, 60, b"\xff\xff\xff")
    beside = read_all(path)
    assert beside.messages == without_chunks(messages, [2, 5, 6, 7])
    said = reported(beside)
    assert said.count("bytes ") == 2
    assert f"bytes {writer.chunks[2]} to " in said
    assert f"bytes {writer.chunks[5]} to " in said
    assert "60 of 200 messages" in said


@pytest.mark.parametrize("what", ["another log behind it", "time of a chunk", "channel of an index"])
def test_damage_that_costs_no_message_is_said_too(tmp_path: Path, what: str) -> None:
    messages, path = some_messages(200), tmp_path / "run.mcap"
    writer = write_style(path, messages, CHUNKED)
    data = bytearray(path.read_bytes())
    start = writer.chunks[4]
    (length,) = struct.unpack_from("<Q", data, start + 1)
    if what == "another log behind it":
        data = data * 2
    else:
        # The recorded time in the head of the chunk, or the channel of the first index behind it.
        data[start + (9 if what == "time of a chunk" else 9 + length + 9)] ^= 0x10
    path.write_bytes(data)
    if what == "time of a chunk":
        beside = read_all(path)
        assert beside.messages == without_chunks(messages, [4])
        place = f"{start}: {reported(beside).rpartition('(')[2].partition(')')[0]}"
    else:
        with pytest.raises(LogError, match="--salvage") as refused:
            read_all(path)
        place = str(refused.value).partition(" at byte ")[2].partition(";")[0]
    contents = read_all(path, salvage=True)
    assert contents.messages == expected(messages)
    assert f"run.mcap is damaged: at byte {place}." in reported(contents)


def test_channels_that_only_the_damaged_chunk_defines_are_reported(tmp_path: Path) -> None:
    messages, path = some_messages(100), tmp_path / "run.mcap"
    once = replace(BARE, define_in_every_chunk=False, compression="")
    writer = write_style(path, messages, once)
    damage(path, writer, 0, -9, b"\xff\xff")
    contents = read_all(path, salvage=True)
    assert contents.messages == {}
    assert "80 messages of channels whose definition is lost" in reported(contents)

    writer = write_style(path, messages, replace(once, repeat_channels=True, repeat_schemas=True))
    damage(path, writer, 0, -9, b"\xff\xff")
    assert read_all(path, salvage=True).messages == without_chunks(messages, [0])


def test_a_damaged_start_or_end_of_the_file_costs_no_message(tmp_path: Path) -> None:
    messages, path = some_messages(100), tmp_path / "run.mcap"
    for style in (CHUNKED, BARE, UNCHUNKED):
        data = bytes(write_style(path, messages, style).file)
        footer = data.rindex(struct.pack("<BQ", raw.FOOTER, 20))
        for at in (len(MAGIC) + 1, footer + 1, footer + 9, footer + 25, len(data) - 3):
            if style is UNCHUNKED and at < footer:
                continue
            path.write_bytes(data[:at] + b"\xff" + data[at + 1 :])
            contents = read_all(path, salvage=True)
            assert contents.messages == expected(messages), (style, at)


def test_no_flipped_bit_gives_a_message_that_was_not_written(tmp_path: Path) -> None:
    """With checksums: whatever is salvaged was written, and where something is missing it is told."""
    messages, path = some_messages(100), tmp_path / "run.mcap"
    data, every = write_style(path, messages, replace(CHUNKED, compression="")).file, expected(messages)
    chooser = random.Random(7)
    for _ in range(150):
        bit = chooser.randrange(8 * len(data))
        flipped = bytearray(data)
        flipped[bit // 8] ^= 1 << bit % 8
        path.write_bytes(flipped)
        contents = read_all(path, salvage=True)
        assert all(each == [m for m in every[topic] if m in each] for topic, each in contents.messages.items())
        assert contents.findings or contents.messages == every


def test_a_sound_file_is_read_alike_and_nothing_is_reported(tmp_path: Path) -> None:
    messages, path = some_messages(100), tmp_path / "run.mcap"
    for style in (CHUNKED, BARE, UNCHUNKED, replace(UNCHUNKED, data_crc=True)):
        write_style(path, messages, style)
        contents = read_all(path, salvage=True)
        assert contents.messages == expected(messages)
        assert contents.findings == ()


def test_a_flipped_bit_that_only_the_crc_of_the_data_section_sees_is_reported(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    data = bytearray(write_style(path, some_messages(50), replace(UNCHUNKED, data_crc=True)).file)
    at = data.index(some_messages(50)[20].data)
    data[at] ^= 1
    path.write_bytes(data)
    assert "CRC of the data section" in reported(read_all(path, salvage=True))


def test_a_file_of_random_bytes_holds_nothing(tmp_path: Path) -> None:
    path = tmp_path / "noise.mcap"
    for seed in range(5):
        path.write_bytes(MAGIC + random.Random(seed).randbytes(3000))
        contents = read_all(path, salvage=True)
        assert contents.messages == {}
        assert "bytes" in reported(contents)
