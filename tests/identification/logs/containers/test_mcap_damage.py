"""Damaged, altered and hostile MCAP files.

Each gives the messages of the sound one, those beside a damaged chunk with a warning, or an error, never others.
"""

import itertools
import random
import re
import struct
import zlib
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
import zstandard

from identification.errors import LogError
from identification.logs.containers.mcap_file import McapContainer
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
from tests.identification.logs.containers.mcap_writer import MAGIC, Style

FLIPS = 200
HUGE = 2**63


def alike(first: Contents, second: Contents) -> bool:
    """Tell whether two files hold the same: channels, messages and times."""
    return first.messages == second.messages and count_alike(first, second)


def count_alike(first: Contents, second: Contents) -> bool:
    return [(held.channel, held.count) for held in first.survey.held] == [
        (held.channel, held.count) for held in second.survey.held
    ] and (first.survey.start_ns, first.survey.end_ns) == (second.survey.start_ns, second.survey.end_ns)


def refused_or_same(path: Path, data: bytes, bit: int, sound: Contents, per_chunk: int) -> bool:
    """Tell whether a file with a flipped bit is refused, gives the same, or says that it lacks one chunk."""
    damaged = bytearray(data)
    damaged[bit // 8] ^= 1 << bit % 8
    path.write_bytes(damaged)
    try:
        found = read_all(path)
    except LogError:
        return True
    if not found.findings:
        return alike(found, sound)
    (finding,) = found.findings
    lost = int(re.findall(r"(\d+) of \d+ messages", finding.message)[0])
    return count_alike(found, sound) and found.messages in lacking_one_chunk(sound, per_chunk, lost)


def lacking_one_chunk(sound: Contents, per_chunk: int, lost: int) -> list[dict[str, list[Message]]]:
    """Return what is left of a file when one chunk of so many messages is missing, for each of its chunks."""
    total = sum(map(len, sound.messages.values()))
    sent = some_messages(total)
    return [
        expected([each for number, each in enumerate(sent) if number // per_chunk != chunk])
        for chunk in range(-(-total // per_chunk))
        if min(per_chunk, total - chunk * per_chunk) == lost
    ]


@pytest.mark.parametrize("compression", ["", "zstd", "lz4"])
def test_no_flipped_bit_changes_anything_in_silence(tmp_path: Path, compression: str) -> None:
    path = tmp_path / "run.mcap"
    write_style(path, some_messages(150), Style(compression=compression, messages_per_chunk=40))
    sound, data = read_all(path), path.read_bytes()
    chooser = random.Random(20240607)
    bits = [chooser.randrange(8 * len(data)) for _ in range(FLIPS)]
    wrong = [bit for bit in bits if not refused_or_same(tmp_path / "flip.mcap", data, bit, sound, 40)]
    assert wrong == []


def record_starts(data: bytes) -> list[int]:
    """Return where the records of the top start, and where the closing magic does."""
    starts = [len(MAGIC)]
    while starts[-1] < len(data) - len(MAGIC):
        starts.append(starts[-1] + 9 + struct.unpack_from("<BQ", data, starts[-1])[1])
    return starts


def frame_bits(data: bytes) -> list[int]:
    """Return the bits of the first 46 bytes of every record of the top: there no chunk's CRC reaches."""
    starts = record_starts(data)
    return [
        8 * byte + bit
        for start, stop in itertools.pairwise(starts)
        for byte in range(start, min(start + 46, stop))
        for bit in range(8)
    ]


@pytest.mark.parametrize(
    ("style", "step"), [(Style(messages_per_chunk=20), 7), (Style(chunked=False, data_crc=True), 41)]
)
def test_no_flipped_bit_in_the_frame_of_the_file_changes_anything_in_silence(
    tmp_path: Path, style: Style, step: int
) -> None:
    path = tmp_path / "run.mcap"
    write_style(path, some_messages(50), style)
    sound, data = read_all(path), path.read_bytes()
    bits = [*range(0, 8 * 40, 3), *frame_bits(data)[::step], *range(8 * (len(data) - 60), 8 * len(data), 3)]
    wrong = [bit for bit in bits if not refused_or_same(tmp_path / "flip.mcap", data, bit, sound, 20)]
    assert wrong == []


@pytest.mark.parametrize("chunked", [True, False])
def test_every_truncation_is_refused_with_file_byte_and_advice(tmp_path: Path, chunked: bool) -> None:
    path, cut = tmp_path / "run.mcap", tmp_path / "cut.mcap"
    write_style(path, some_messages(12), Style(chunked=chunked, messages_per_chunk=5, compression="zstd"))
    data = path.read_bytes()
    edges = {start + step for start in record_starts(data) for step in (-1, 0, 1, 9)}
    for size in sorted({*range(0, len(data), 7), *(edge for edge in edges if 0 <= edge < len(data))}):
        cut.write_bytes(data[:size])
        with pytest.raises(LogError, match=r"cut\.mcap is truncated or damaged at byte \d+: .*--salvage"):
            read_all(cut)


def test_bytes_after_the_end_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    write_style(path, some_messages(), Style())
    path.write_bytes(path.read_bytes() + b"\0")
    with pytest.raises(LogError, match="1 bytes follow the end"):
        read_all(path)


def record(kind: int, body: bytes) -> bytes:
    return raw.record(kind, body)


SCHEMA, CHANNEL = record(raw.SCHEMA, SCHEMAS[1]), record(raw.CHANNEL, CHANNELS[1])
MESSAGE = record(raw.MESSAGE, raw.message(1, 5, b"\0\1\0\0\7"))
GOOD = SCHEMA + CHANNEL + MESSAGE
HEAD = record(raw.HEADER, raw.header())
END = record(raw.DATA_END, bytes(4))
TAIL = END + record(raw.FOOTER, bytes(20))


def chunk(content: bytes, **changes: object) -> bytes:
    """A chunk record of messages at 5 ns, of which anything may be told wrongly."""
    reported = {
        "name": "zstd", "data": zstandard.compress(content), "size": len(content), "crc": zlib.crc32(content),
        "start": 5, "end": 5, "stored": None, **changes,
    }  # fmt: skip
    data, stored = reported["data"], reported["stored"]
    assert isinstance(data, bytes)
    head = struct.pack("<QQQI", reported["start"], reported["end"], reported["size"], reported["crc"]) + raw.text(
        str(reported["name"])
    )
    return record(raw.CHUNK, head + struct.pack("<Q", len(data) if stored is None else stored) + data)


def index(channel_id: int, count: int) -> bytes:
    return record(raw.MESSAGE_INDEX, raw.message_index(channel_id, [(5, 0)] * count))


def summary(data: bytes, body: bytes, start: int | None = None, crc: int = 0) -> bytes:
    place = len(MAGIC) + len(data) if start is None else start
    return data + body + record(raw.FOOTER, struct.pack("<QQI", place, 0, crc)) + MAGIC


def statistics(messages: int, chunks: int, channel_id: int = 1) -> bytes:
    message = raw.statistics({channel_id: messages}, schemas=1, channels=1, chunks=chunks, span_ns=(5, 5))
    return record(raw.STATISTICS, message)


CASES: dict[str, tuple[bytes, str]] = {
    "nothing": (b"", "the file ends after 16 bytes without"),
    "no header": (GOOD + TAIL + MAGIC, "the header should be here, a record of kind 3 does"),
    "bomb declared": (HEAD + chunk(bytes(2**28 + 1)) + TAIL, "more than the 268435456 that are allowed"),
    "huge chunk": (HEAD + chunk(GOOD, size=HUGE) + TAIL, "more than the 268435456 that are allowed"),
    "bomb not declared": (HEAD + chunk(GOOD, data=zstandard.compress(bytes(2**26))) + TAIL, "unpacks to more than"),
    "lz4 bomb": (HEAD + chunk(GOOD, name="lz4", data=raw.pack(bytes(2**26), "lz4")) + TAIL, "unpacks to more than"),
    "too small": (HEAD + chunk(GOOD, size=len(GOOD) + 1) + TAIL, f"unpacks to {len(GOOD)} bytes"),
    "not packed": (HEAD + chunk(GOOD, name="", data=GOOD, size=len(GOOD) - 1) + TAIL, "it says"),
    "compression": (HEAD + chunk(GOOD, name="zst") + TAIL, "compression 'zst' is not one of zstd, lz4 or none"),
    "long name": (HEAD + chunk(GOOD, name="z" * 99) + TAIL, "names a compression of 99 bytes"),
    "no lz4": (HEAD + chunk(GOOD, name="lz4") + TAIL, "cannot be unpacked"),
    "no zstd": (HEAD + chunk(GOOD, data=b"no zstd") + TAIL, "cannot be unpacked"),
    "cut zstd": (HEAD + chunk(GOOD, data=zstandard.compress(GOOD)[:-3]) + TAIL, "unpacks to|cannot be unpacked"),
    "rest behind zstd": (HEAD + chunk(GOOD, data=zstandard.compress(GOOD) + b"rest") + TAIL, "cannot be unpacked"),
    "chunk CRC": (HEAD + chunk(GOOD, crc=1) + TAIL, "CRC of a chunk does not agree"),
    "cut record": (HEAD + chunk(GOOD[:-1]) + TAIL, "does not fit into its chunk"),
    "cut frame": (HEAD + chunk(GOOD + b"\5\0") + TAIL, "does not fit into its chunk"),
    "long record": (HEAD + chunk(GOOD + struct.pack("<BQ", 5, HUGE)) + TAIL, f"and {HUGE} bytes does not fit"),
    "zeros": (HEAD + chunk(bytes(2**10)) + TAIL, "kind 0"),
    "no channel": (HEAD + chunk(MESSAGE) + TAIL, "channel 1, which is not defined"),
    "no schema": (HEAD + chunk(CHANNEL + MESSAGE) + TAIL, "channel 1, which is not defined|schema 1, which is not"),
    "short message": (HEAD + chunk(SCHEMA + CHANNEL + record(5, bytes(21))) + TAIL, "too short"),
    "late message": (HEAD + chunk(GOOD + record(5, raw.message(1, HUGE, b""))) + TAIL, r"2\^63 ns or more"),
    "outside times": (HEAD + chunk(GOOD, start=6, end=9) + TAIL, "before or after the times"),
    "chunk in chunk": (HEAD + chunk(GOOD + chunk(GOOD)) + TAIL, "kind 6 is in a chunk"),
    "stored size": (HEAD + chunk(GOOD, stored=2**40) + TAIL, "does not fit into its record"),
    "short chunk": (HEAD + record(raw.CHUNK, bytes(30)) + TAIL, "a chunk record of 30 bytes is too short"),
    "two schemas": (
        HEAD + SCHEMA + record(raw.SCHEMA, raw.schema(1, "B", "", b"")) + TAIL,
        "schema 1 is defined twice",
    ),
    "two channels": (
        HEAD + SCHEMA + CHANNEL + chunk(record(raw.CHANNEL, raw.channel(1, 1, "/b", "cdr"))) + TAIL,
        "channel 1 is defined twice",
    ),
    "schema 0": (HEAD + record(raw.SCHEMA, raw.schema(0, "A", "", b"")) + TAIL, "a schema has the id 0"),
    "bogus length": (HEAD + struct.pack("<BQ", 6, HUGE) + TAIL, f"says {HUGE} bytes should follow"),
    "largest length": (HEAD + struct.pack("<BQ", 6, 2**64 - 1) + TAIL, "says 18446744073709551615 bytes"),
    "short top message": (HEAD + SCHEMA + CHANNEL + record(5, b"abc") + TAIL, "message record of 3 bytes is too short"),
    "bad text": (HEAD + record(raw.CHANNEL, struct.pack("<HHI", 1, 1, 2) + b"\xff\xfe") + TAIL, "no proper content"),
    "no data end": (HEAD + SCHEMA + record(raw.FOOTER, bytes(20)), "kind 2 is in the data section"),
    "chunk in summary": (HEAD + END + chunk(GOOD) + record(raw.FOOTER, bytes(20)), "kind 6 is in the summary"),
    "kind 0": (HEAD + record(0, b"") + TAIL, "kind 0"),
    "stranger": (HEAD + SCHEMA + CHANNEL + record(0x85, b"hidden") + TAIL, "unknown kinds, and no count"),
    "stranger in chunk": (HEAD + chunk(GOOD + record(0x85, b"")) + TAIL, "unknown kinds, and no count"),
    "lone index": (HEAD + SCHEMA + CHANNEL + index(1, 1) + TAIL, "a message index follows no chunk"),
    "short index": (HEAD + chunk(GOOD) + record(raw.MESSAGE_INDEX, b"abc") + TAIL, "index record of 3 bytes"),
    "odd index": (HEAD + chunk(GOOD) + record(7, struct.pack("<HI", 1, 17) + bytes(17)) + TAIL, "index of 17 bytes"),
    "long index": (HEAD + chunk(GOOD) + record(7, struct.pack("<HI", 1, 32)) + TAIL, "index of 32 bytes"),
    "wrong index": (HEAD + chunk(GOOD) + index(1, 2) + TAIL, "holds 1 messages, its index has 2"),
    "index of another": (HEAD + chunk(GOOD) + index(2, 1) + TAIL, "holds 1 messages, its index has 1"),
    "data CRC": (
        HEAD + GOOD + record(raw.DATA_END, struct.pack("<I", 77)) + record(raw.FOOTER, bytes(20)),
        "CRC of the data section",
    ),
    "no closing magic": (HEAD + GOOD + TAIL[:-1] + b"x", "should end with the bytes 89 4d|says 20 bytes"),
}
SUMMARIES: dict[str, tuple[bytes, str]] = {
    "summary CRC": (summary(HEAD + GOOD + END, SCHEMA, crc=99), "CRC of the summary"),
    "summary start": (summary(HEAD + GOOD + END, SCHEMA, start=HUGE), f"its footer says at byte {HUGE}"),
    "summary denied": (summary(HEAD + GOOD + END, SCHEMA, start=0), "its footer says at byte 0"),
    "too many": (summary(HEAD + chunk(GOOD) + END, statistics(2, 1)), "counts 2 messages in 1 chunks, the data hold 1"),
    "lost chunk": (summary(HEAD + chunk(GOOD) + END, statistics(1, 2)), "in 2 chunks, the data hold 1 in 1"),
    "another channel": (
        summary(HEAD + chunk(GOOD) + END, statistics(1, 1, channel_id=2)),
        "counts 1 messages in 1 chunks, the data hold 1 in 1, of other channels",
    ),
    "counted outside": (summary(HEAD + GOOD + END, statistics(3, 0)), "counts 3 messages in 0 chunks"),
    "false index": (
        summary(HEAD + chunk(GOOD) + index(1, 2) + END, SCHEMA + CHANNEL + statistics(2, 1)),
        "holds 1 messages, its index has 2",
    ),
    "chunk elsewhere": (
        summary(
            HEAD + chunk(GOOD) + END, record(raw.CHUNK_INDEX, raw.chunk_index((5, 5), (99, 9), {}, 0, "zstd", (1, 1)))
        ),
        "the summary lists 1 chunks, the data hold 1 of other places, times or sizes",
    ),
}


@pytest.mark.parametrize("name", [*CASES, *SUMMARIES])
def test_files_put_together_to_mislead_are_refused(tmp_path: Path, name: str) -> None:
    content, complaint = SUMMARIES[name] if name in SUMMARIES else CASES[name]
    path = tmp_path / "made.mcap"
    path.write_bytes(MAGIC + content + (b"" if name in SUMMARIES or name == "no closing magic" else MAGIC))
    with pytest.raises(LogError, match=complaint) as caught:
        read_all(path)
    assert "made.mcap" in str(caught.value)
    assert re.search(r"at byte \d+", str(caught.value))


def test_the_same_files_without_the_fault_are_read(tmp_path: Path) -> None:
    path = tmp_path / "made.mcap"
    for content in (
        HEAD + chunk(GOOD) + TAIL + MAGIC,
        HEAD + GOOD + TAIL + MAGIC,
        HEAD + chunk(GOOD, start=0, end=0) + index(1, 1) + TAIL + MAGIC,
        HEAD + chunk(b"") + chunk(GOOD) + TAIL + MAGIC,
        summary(HEAD + chunk(GOOD) + record(0x85, b"private") + END, statistics(1, 1)),
    ):
        path.write_bytes(MAGIC + content)
        assert read_all(path).messages == {"/a": [(5, b"\0\1\0\0\7")]}


def test_a_chunk_hidden_behind_another_kind_of_record_is_noticed(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    writer = write_style(path, some_messages(), Style(messages_per_chunk=9, message_index=False, chunk_index=False))
    for kind in (0x86, 0x16, 0x46):
        data = bytearray(path.read_bytes())
        data[writer.chunks[2]] = kind
        (tmp_path / "hidden.mcap").write_bytes(data)
        with pytest.raises(LogError, match=r"summary (counts|lists)|index follows|its index has"):
            read_all(tmp_path / "hidden.mcap")


def heads(style: Style, path: Path) -> Iterator[tuple[int, int]]:
    """Write a file of three chunks, then one with each bit flipped of the head of its second chunk in turn."""
    writer = write_style(path, some_messages(30), replace(style, messages_per_chunk=10, define_in_every_chunk=True))
    data = path.read_bytes()
    head = 9 + 28 + 4 + len(style.compression) + 8
    for bit in range(8 * writer.chunks[1], 8 * (writer.chunks[1] + head)):
        flipped = bytearray(data)
        flipped[bit // 8] ^= 1 << bit % 8
        path.write_bytes(flipped)
        yield writer.chunks[1], bit // 8 - writer.chunks[1]


@pytest.mark.parametrize("compression", ["", "zstd", "lz4"])
@pytest.mark.parametrize("has_crc", [True, False])
def test_a_flipped_bit_in_the_head_of_a_chunk_costs_that_chunk(tmp_path: Path, compression: str, has_crc: bool) -> None:
    path = tmp_path / "run.mcap"
    style = Style(compression=compression, chunk_crc=has_crc, summary_crc=has_crc)
    beside = expected([sent for number, sent in enumerate(some_messages(30)) if not 10 <= number < 20])
    for start, byte in heads(style, path):
        found = read_all(path)
        if not found.findings:
            # The last bytes of an lz4 frame say only that it ends.
            assert found.messages == expected(some_messages(30))
            assert (compression, byte) == ("lz4", 44)
            continue
        assert found.messages == beside, byte
        (finding,) = found.findings
        assert f"run.mcap is damaged: bytes {start} to " in finding.message
        assert ", 10 of 30 messages (" in finding.message


@pytest.mark.parametrize("has_crc", [True, False])
def test_a_flipped_bit_in_the_length_of_a_message_index_costs_nothing(tmp_path: Path, has_crc: bool) -> None:
    path, style = tmp_path / "run.mcap", Style(messages_per_chunk=10, chunk_crc=has_crc, define_in_every_chunk=True)
    writer = write_style(path, some_messages(30), style)
    sound, data = read_all(path), path.read_bytes()
    (length,) = struct.unpack_from("<Q", data, writer.chunks[1] + 1)
    start = writer.chunks[1] + 9 + length
    assert data[start] == raw.MESSAGE_INDEX
    for bit in range(8 * (start + 1), 8 * (start + 9)):
        flipped = bytearray(data)
        flipped[bit // 8] ^= 1 << bit % 8
        path.write_bytes(flipped)
        assert alike(read_all(path), sound), bit // 8 - start


@pytest.mark.parametrize("style", [Style(chunk_index=False), Style(message_index=False), Style(statistics=False)])
def test_without_what_proves_its_place_and_content_a_damaged_head_is_refused(tmp_path: Path, style: Style) -> None:
    path = tmp_path / "run.mcap"
    for _, byte in heads(style, path):
        if byte < 9:
            with pytest.raises(LogError, match=r"is truncated or damaged at byte \d+: .*--salvage"):
                read_all(path)


@pytest.mark.parametrize("place", range(40))
def test_an_index_that_does_not_fit_the_file_proves_nothing(tmp_path: Path, place: int) -> None:
    """Without its CRC a damaged index is no better than a damaged head: the file decides, or is refused."""
    path = tmp_path / "run.mcap"
    style = Style(messages_per_chunk=10, compression="zstd", define_in_every_chunk=True, summary_crc=False)
    writer = write_style(path, some_messages(30), style)
    data = path.read_bytes()
    at = data.index(struct.pack("<Q", writer.chunks[1]), writer.chunks[2] + 200) - 16 + place
    assert refused_or_same(path, data, 8 * at, read_all(path), 10)


@pytest.mark.parametrize(
    ("content", "complaint"), [(b"", "byte 0"), (b"time,fx\n0,1\n", "starts with the bytes 89 4d")]
)
def test_what_is_no_mcap_file_is_refused(tmp_path: Path, content: bytes, complaint: str) -> None:
    path = tmp_path / "other.mcap"
    path.write_bytes(content)
    with pytest.raises(LogError, match=complaint):
        read_all(path)
    with pytest.raises(LogError, match="No such file"):
        McapContainer(tmp_path / "absent.mcap")


def test_a_file_that_shrinks_while_it_is_read_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    write_style(path, some_messages(), Style(messages_per_chunk=10))
    with McapContainer(path) as container:
        channels = [held.channel for held in container.survey().held]
        path.write_bytes(path.read_bytes()[:500])
        with pytest.raises(LogError, match="has become shorter"):
            list(container.read(channels, len_of))


def len_of(batch: object) -> int:
    return int(getattr(batch, "count"))  # noqa: B009 - the batch is typed by the container
