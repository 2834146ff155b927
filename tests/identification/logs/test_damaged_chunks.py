"""Logs of which one chunk is damaged: what its container cannot see, and what is said of the rest."""

from collections.abc import Callable
from pathlib import Path

import pytest
from mcap.writer import CompressionType

from identification.errors import LogError
from identification.logs.inspect import inspect_log
from identification.logs.read import read_recording
from identification.logs.summary import LogSummary
from identification.result import Finding
from tests.identification.logs.log_builder import Options, complete, write_bag, write_mcap

NO_CRC = Options(compression=CompressionType.NONE, enable_crcs=False, extra=())


def mcap(folder: Path) -> tuple[Path, bytes]:
    """Write a log without checksums; return how its wrenches name their frame, too."""
    return write_mcap(folder / "run.mcap", complete(), NO_CRC), b"\x06\x00\x00\x00tool0\x00"


def bag(folder: Path) -> tuple[Path, bytes]:
    return write_bag(folder / "run.bag", complete(), chunk_size=16 * 1024), b"\x05\x00\x00\x00tool0"


def overwrite(path: Path, text: bytes, place: int, by: bytes) -> None:
    """Overwrite a text of a file, the one that many places on from its middle."""
    data = bytearray(path.read_bytes())
    at = len(data) // 2
    for _ in range(place):
        at = data.index(text, at + 1)
    data[at : at + len(text)] = by
    path.write_bytes(data)


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
