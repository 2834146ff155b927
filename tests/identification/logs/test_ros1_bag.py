"""ROS 1 bags: written by rosbags, damaged, and the recorded ones of a real cell."""

import bz2
import struct
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from rosbags.rosbag1 import Writer

from identification.errors import LogError
from identification.logs import Role, inspect_log, read_recording, ros1_bag
from tests.identification.logs.log_builder import complete, write_bag

FORMATS = [None, Writer.CompressionFormat.BZ2, Writer.CompressionFormat.LZ4]


@pytest.mark.parametrize("compression", FORMATS)
def test_a_bag_gives_the_samples_that_were_written(
    tmp_path: Path, compression: Writer.CompressionFormat | None
) -> None:
    streams = complete()
    recording = read_recording(write_bag(tmp_path / "run.bag", streams, compression))
    assert recording.command is not None
    assert np.array_equal(recording.wrench.stamp_ns, streams[0].stamp_ns)
    assert np.array_equal(recording.wrench.force_n, streams[0].values[:, :3])
    assert np.array_equal(recording.pose.position_m, streams[1].values[:, :3])
    assert np.array_equal(recording.command.position_m, streams[2].values[:, :3])
    assert recording.wrench.frame_id == "tool0"


def test_truncated_bags_are_refused(tmp_path: Path) -> None:
    data = write_bag(tmp_path / "run.bag", complete()).read_bytes()
    cut = tmp_path / "cut.bag"
    for size in range(20, len(data), len(data) // 60):
        cut.write_bytes(data[:size])
        with pytest.raises(LogError, match=r"cut\.bag"):
            read_recording(cut)


@pytest.mark.parametrize("compression", FORMATS)
def test_flipped_bits_never_raise_anything_else(tmp_path: Path, compression: Writer.CompressionFormat | None) -> None:
    data = write_bag(tmp_path / "run.bag", complete(), compression).read_bytes()
    path, refused = tmp_path / "flip.bag", 0
    chooser = np.random.default_rng(7)
    # The first 300 bytes and the index at the end steer the reader; the samples themselves carry no checksum.
    places = [*range(13, 300), *chooser.integers(300, len(data), 150), *range(len(data) - 900, len(data), 3)]
    for place in places:
        damaged = bytearray(data)
        damaged[place] ^= 1 << int(chooser.integers(8))
        path.write_bytes(damaged)
        try:
            read_recording(path)
        except LogError:
            refused += 1
    assert refused > 100


def test_a_chunk_that_unpacks_too_far_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write_bag(tmp_path / "run.bag", complete(), Writer.CompressionFormat.BZ2)
    monkeypatch.setattr(ros1_bag, "CHUNK_LIMIT_BYTES", 10_000)
    with pytest.raises(LogError, match="unpacks to more than 10000 bytes"):
        read_recording(path)


def test_the_limit_stops_the_unpacking_itself(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ros1_bag, "CHUNK_LIMIT_BYTES", 10**5)
    bomb = bz2.compress(bytes(2 * 10**7))
    tracemalloc.start()
    with pytest.raises(LogError, match="unpacks to more than 100000 bytes"):
        ros1_bag._bounded_bz2(bomb)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    # The decompressor's own block is 900 kB, of which it keeps four bytes for each.
    assert peak < 5 * 10**6


def test_a_bag_that_was_not_closed_is_refused(tmp_path: Path) -> None:
    path = write_bag(tmp_path / "run.bag", complete())
    data = bytearray(path.read_bytes())
    where = data.index(b"index_pos=") + len(b"index_pos=")
    data[where : where + 8] = struct.pack("<Q", 0)
    path.write_bytes(data)
    with pytest.raises(LogError, match="not indexed"):
        inspect_log(path)


@pytest.mark.parametrize(
    ("name", "rate_hz", "offset_s"), [("single_mode_middle.bag", 195.65, 2745.5), ("yellow_table_1.bag", 39.88, 53.9)]
)
def test_recorded_bags_are_told_truthfully(shared_data: Path, name: str, rate_hz: float, offset_s: float) -> None:
    path = shared_data / "nj60" / name
    summary = inspect_log(path)
    channels = {channel.topic: channel for channel in summary.channels}
    for topic in ("/robot_state", "/impedance_gains"):
        assert channels[topic].type == "sensor_msgs/msg/JointState"
        assert channels[topic].roles == (Role.JOINT_STATE,)
        # Given to the digits written above.
        assert channels[topic].rate_hz == pytest.approx(rate_hz, abs=0.01)
        assert channels[topic].header_minus_log_s == pytest.approx(offset_s, abs=0.05)
    codes = [finding.code for finding in summary.findings]
    assert codes.count("layout-undeclared") == 2
    assert codes.count("effort-deadband") == 1
    assert codes.count("clock-offset") == 2
    assert [sentence.split(":")[0] for sentence in summary.missing] == [
        f"{name} has no channel for the {what}" for what in ("wrench", "measured pose", "commanded pose")
    ]


def test_recorded_bags_are_refused_with_the_reason(shared_data: Path) -> None:
    with pytest.raises(
        LogError, match=r"no channel for the wrench.*may carry a wrench, but its layout is not declared"
    ):
        read_recording(shared_data / "nj60" / "yellow_table_1.bag")
