"""Logs of which one chunk is damaged: what its container cannot see, and what is said of the rest."""

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from mcap.writer import CompressionType

from identification.errors import LogError
from identification.logs.inspect import inspect_log
from identification.logs.read import read_recording
from identification.logs.roles.registry import Role
from identification.logs.summary import LogSummary
from identification.result import Finding
from tests.identification.logs.log_builder import START_NS, Options, complete, write_bag, write_mcap

NO_CRC = Options(compression=CompressionType.NONE, enable_crcs=False, extra=())


def mcap(folder: Path) -> tuple[Path, bytes]:
    """Write a log without checksums; return how its wrenches name their frame, too."""
    return write_mcap(folder / "run.mcap", complete(), NO_CRC), b"\x06\x00\x00\x00tool0\x00"


def bag(folder: Path) -> tuple[Path, bytes]:
    return write_bag(folder / "run.bag", complete(), chunk_size=16 * 1024), b"\x05\x00\x00\x00tool0"


def overwrite(path: Path, text: bytes, place: int, by: bytes) -> None:
    """Overwrite a text of a file, the one that many places on from its middle."""
    replace_at(path, text, place, 0, by)


def replace_at(path: Path, text: bytes, place: int, before: int, by: bytes) -> bytes:
    """Overwrite what is so many bytes before such a text, or in a name that it holds; return what was there."""
    data = bytearray(path.read_bytes())
    at = len(data) // 2
    for _ in range(place):
        at = data.index(text, at + 1)
    at += text.index(b"tool0") if by.startswith(b"tool") else -before
    was = bytes(data[at : at + len(by)])
    data[at : at + len(by)] = by
    path.write_bytes(data)
    return was


def the(code: str, summary: LogSummary) -> Finding:
    (finding,) = (each for each in summary.findings if each.code == code)
    return finding


def counts(summary: LogSummary) -> dict[str, int]:
    return {channel.topic: channel.count for channel in summary.channels}


@pytest.mark.parametrize("write", [mcap, bag])
@pytest.mark.parametrize("salvage", [False, True])
def test_nonsense_in_a_message_without_a_checksum_costs_its_chunk(
    tmp_path: Path, write: Callable[[Path], tuple[Path, bytes]], salvage: bool
) -> None:
    path, frame = write(tmp_path)
    whole = counts(inspect_log(path, salvage=salvage))
    overwrite(path, frame, 3, b"\xff" * len(frame))
    found = inspect_log(path, salvage=salvage)
    said = the("salvaged", found).message
    assert "of topic /ft/wrench cannot be decoded: a field at byte " in said
    lost = sum(whole.values()) - sum(counts(found).values())
    assert 3 < lost < 200
    assert f"{lost} of {sum(whole.values())} messages" in said
    # What shared the chunk is left out with it.
    assert all(counts(found)[topic] < whole[topic] for topic in whole)
    wrench = read_recording(path, salvage=salvage).wrench
    assert len(wrench.stamp_ns) == counts(found)["/ft/wrench"]


@pytest.mark.parametrize("write", [mcap, bag])
def test_where_no_message_is_what_its_type_says_the_topic_is_refused(
    tmp_path: Path, write: Callable[[Path], tuple[Path, bytes]]
) -> None:
    path, frame = write(tmp_path)
    path.write_bytes(path.read_bytes().replace(frame, b"\xff" * len(frame)))
    with pytest.raises(LogError, match=r"Message 1 of topic /ft/wrench is damaged or no geometry_msgs"):
        read_recording(path)
    found = inspect_log(path)
    assert "Message 1 of topic /ft/wrench" in the("undecodable", found).message
    assert "salvaged" not in {finding.code for finding in found.findings}


@pytest.mark.parametrize("write", [mcap, bag])
@pytest.mark.parametrize(
    ("before", "by", "reason"),
    [
        (0, b"tool1", "names the frame '{}' and '{}', those around it '{}'"),
        (8, b"\0\0\0\0\0\0\0\0", "has a stamp that is more than 60 s from those around it"),
        (8, b"\xff\xff\xff\x7f\0\0\0\0", "has a stamp that is more than 60 s from those around it"),
    ],
)
def test_an_altered_header_in_a_chunk_without_a_checksum_costs_its_chunk(
    tmp_path: Path, write: Callable[[Path], tuple[Path, bytes]], before: int, by: bytes, reason: str
) -> None:
    """One renamed frame, or one stamp of another year, refused the log."""
    path, frame = write(tmp_path)
    whole = counts(inspect_log(path))
    was = replace_at(path, frame, 3, before, by)
    assert was != by
    found = inspect_log(path)
    said = the("salvaged", found).message
    assert f"a message of topic /ft/wrench {reason.format('tool0', 'tool1', 'tool0')}" in said
    assert 3 < sum(whole.values()) - sum(counts(found).values()) < 200
    wrench = read_recording(path).wrench
    assert len(wrench.stamp_ns) == counts(found)["/ft/wrench"] < whole["/ft/wrench"]


@pytest.mark.parametrize("write", [mcap, bag])
def test_a_frame_that_is_renamed_for_longer_than_a_chunk_is_no_damage(
    tmp_path: Path, write: Callable[[Path], tuple[Path, bytes]]
) -> None:
    path, frame = write(tmp_path)
    data = path.read_bytes()
    half = len(data) // 2
    path.write_bytes(data[:half] + data[half:].replace(frame, frame.replace(b"tool0", b"tool1")))
    assert "salvaged" not in {finding.code for finding in inspect_log(path).findings}
    with pytest.raises(LogError, match="tool1"):
        read_recording(path)


def test_a_frame_that_comes_again_and_again_is_no_damage(tmp_path: Path) -> None:
    """Two publishers of one topic by turns, each in some chunks."""
    path = write_mcap(tmp_path / "run.mcap", complete(), replace(NO_CRC, chunk_size=2048))
    name, data = b"\x06\0\0\0tool0\0", path.read_bytes()
    parts = data.split(name)
    frames = [name.replace(b"tool0", b"tool1") if k % 30 < 10 else name for k in range(len(parts) - 1)]
    path.write_bytes(b"".join(part + frame for part, frame in zip(parts, [*frames, b""], strict=True)))
    assert "salvaged" not in {finding.code for finding in inspect_log(path).findings}
    with pytest.raises(LogError, match="tool1"):
        read_recording(path)


def test_a_damaged_chunk_is_one_warning_of_damage_and_one_of_the_hole(tmp_path: Path) -> None:
    """Rate and number of messages are those of what was read."""
    path = write_mcap(tmp_path / "run.mcap", complete(), replace(NO_CRC, enable_crcs=True))
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 0x10
    path.write_bytes(data)
    for said in (inspect_log(path).findings, read_recording(path).findings):
        (hole,) = (finding for finding in said if finding.code == "hole")
        assert re.match(
            r"Topics (/[a-z/_]+(, )?){3} have 1 hole\(s\) in which nothing is known: 0\.\d+ s from", hole.message
        )
        assert "what happens behind one up to the next rest is not used" in hole.message
        assert [finding.code for finding in said].count("salvaged") == 1
    recording = read_recording(path)
    left = len(recording.wrench.stamp_ns)
    assert 100 < left < 197
    (wrench,) = (finding.message for finding in recording.findings if finding.message.startswith("The wrench is read"))
    assert f"{left} messages, 500.0 Hz, frame tool0" in wrench
    summary = inspect_log(path)
    (candidate,) = next(role for role in summary.roles if role.role is Role.WRENCH).candidates
    (channel,) = (channel for channel in summary.channels if Role.WRENCH in channel.roles)
    assert candidate.count == channel.count == left
    assert candidate.rate_hz == channel.rate_hz == pytest.approx(500.0)


@pytest.mark.parametrize("salvage", [False, True])
def test_after_a_lost_first_chunk_it_is_said_where_times_count_from(tmp_path: Path, salvage: bool) -> None:
    path = write_mcap(tmp_path / "run.mcap", complete(), replace(NO_CRC, enable_crcs=True))
    whole = inspect_log(path)
    data = bytearray(path.read_bytes())
    data[1000] ^= 0x10
    path.write_bytes(data)
    recording = read_recording(path, salvage=salvage)
    late = 1e-9 * (recording.wrench.stamp_ns[0] - START_NS)
    assert late > 0.1
    (said,) = (finding.message for finding in recording.findings if finding.code == "start-lost")
    counted = float(re.findall(r"were recorded (\d\.\d+) s after the log's start: from there count", said)[0])
    # The pose may begin a period later, and the first message was recorded 0.2 ms after it was stamped.
    assert counted == pytest.approx(late, abs=0.005)
    summary = inspect_log(path, salvage=salvage)
    assert said in {finding.message for finding in summary.findings}
    assert (summary.start_ns, summary.end_ns) == (whole.start_ns, whole.end_ns)
