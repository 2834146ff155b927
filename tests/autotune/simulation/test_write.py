"""The written log, read back with the official reader."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

from autotune.simulation.phases import Program
from autotune.simulation.simulate import simulate_cell
from autotune.simulation.truth import SimulatedCell
from autotune.simulation.write import write_mcap
from identification.signals.recording import PoseSignal, Recording, WrenchSignal

BRIEF = Program(pose_count=1, pose_hold_s=0.3, pose_move_s=0.2, jogging_s=1.5, sweep_s=1.0, contact_count=0, rest_s=0.3)


@pytest.fixture(scope="module")
def recording() -> Recording:
    return simulate_cell(SimulatedCell(), BRIEF, seed=11).recording


@pytest.fixture(scope="module")
def written(recording: Recording, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("log") / "cell.mcap"
    write_mcap(recording, path)
    return path


def decoded(path: Path, topic: str) -> list[tuple[Any, Any]]:
    with path.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()], validate_crcs=True)
        return [(message, value) for _, _, message, value in reader.iter_decoded_messages(topics=[topic])]


def stamps(messages: list[tuple[Any, Any]]) -> list[int]:
    return [value.header.stamp.sec * 10**9 + value.header.stamp.nanosec for _, value in messages]


def numbers(values: list[Any], names: str) -> np.ndarray[Any, np.dtype[np.float64]]:
    return np.array([[getattr(value, name) for name in names] for value in values])


def test_every_wrench_comes_back_bit_for_bit(recording: Recording, written: Path) -> None:
    signal = recording.wrench
    messages = decoded(written, signal.topic)
    assert stamps(messages) == signal.stamp_ns.tolist()
    assert {value.header.frame_id for _, value in messages} == {signal.frame_id}
    np.testing.assert_array_equal(numbers([v.wrench.force for _, v in messages], "xyz"), signal.force_n)
    np.testing.assert_array_equal(numbers([v.wrench.torque for _, v in messages], "xyz"), signal.torque_n_m)


@pytest.mark.parametrize("which", ["pose", "command"])
def test_every_pose_comes_back_bit_for_bit(recording: Recording, written: Path, which: str) -> None:
    signal = getattr(recording, which)
    messages = decoded(written, signal.topic)
    assert stamps(messages) == signal.stamp_ns.tolist()
    assert {value.header.frame_id for _, value in messages} == {signal.frame_id}
    np.testing.assert_array_equal(numbers([v.pose.position for _, v in messages], "xyz"), signal.position_m)
    np.testing.assert_array_equal(numbers([v.pose.orientation for _, v in messages], "xyzw"), signal.quaternion_xyzw)


def test_the_file_is_a_ros2_log_of_three_channels_in_zstd_chunks(recording: Recording, written: Path) -> None:
    with written.open("rb") as stream:
        reader = make_reader(stream)
        header, summary = reader.get_header(), reader.get_summary()
    assert header.profile == "ros2"
    assert summary is not None
    assert summary.statistics is not None
    assert summary.statistics.message_count == 3 * len(recording.wrench.stamp_ns)
    assert {chunk.compression for chunk in summary.chunk_indexes} == {"zstd"}
    assert {c.topic: (summary.schemas[c.schema_id].name, c.message_encoding) for c in summary.channels.values()} == {
        "/ft_sensor/wrench": ("geometry_msgs/msg/WrenchStamped", "cdr"),
        "/flange/pose": ("geometry_msgs/msg/PoseStamped", "cdr"),
        "/flange/command": ("geometry_msgs/msg/PoseStamped", "cdr"),
    }


def test_messages_stand_in_the_order_of_their_stamps(recording: Recording, written: Path) -> None:
    with written.open("rb") as stream:
        found = [message for _, _, message in make_reader(stream).iter_messages(log_time_order=False)]
    times = [message.log_time for message in found]
    assert times == sorted(times)
    assert times == [message.publish_time for message in found]
    assert times[0] == recording.wrench.stamp_ns[0]


def test_a_log_without_command_has_two_channels(recording: Recording, tmp_path: Path) -> None:
    path = tmp_path / "two.mcap"
    write_mcap(Recording(wrench=recording.wrench, pose=recording.pose, command=None), path)
    with path.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    assert {c.topic for c in summary.channels.values()} == {recording.wrench.topic, recording.pose.topic}


def test_channels_of_other_rates_and_names_are_written_as_they_are(recording: Recording, tmp_path: Path) -> None:
    assert recording.command is not None
    wrench, pose = recording.wrench, recording.pose
    other = Recording(
        wrench=WrenchSignal(
            topic="/wrist/raw",
            frame_id="tool",
            stamp_ns=wrench.stamp_ns[::2] + 123,
            force_n=wrench.force_n[::2],
            torque_n_m=wrench.torque_n_m[::2],
        ),
        pose=PoseSignal(
            topic="/tcp",
            frame_id="world",
            stamp_ns=pose.stamp_ns[::5],
            position_m=pose.position_m[::5],
            quaternion_xyzw=pose.quaternion_xyzw[::5],
        ),
        command=recording.command,
    )
    path = tmp_path / "other.mcap"
    write_mcap(other, path)
    assert stamps(decoded(path, "/wrist/raw")) == other.wrench.stamp_ns.tolist()
    assert stamps(decoded(path, "/tcp")) == other.pose.stamp_ns.tolist()


def test_progress_is_reported_in_steps_that_never_exceed_the_whole(recording: Recording, tmp_path: Path) -> None:
    reported: list[int] = []
    write_mcap(recording, tmp_path / "run.mcap", progress=reported.append)
    assert reported
    assert sum(reported) <= 3 * len(recording.wrench.stamp_ns)


def test_a_failed_write_leaves_nothing_behind_and_an_older_file_as_it_was(recording: Recording, tmp_path: Path) -> None:
    def fail(_count: int) -> None:
        raise OSError("no space left on device")

    fresh, older = tmp_path / "fresh.mcap", tmp_path / "older.mcap"
    older.write_bytes(b"kept")
    for path in (fresh, older):
        with pytest.raises(OSError, match="no space left"):
            write_mcap(recording, path, progress=fail)
    assert [path.name for path in tmp_path.iterdir()] == ["older.mcap"]
    assert older.read_bytes() == b"kept"


def test_a_missing_folder_is_an_error_that_creates_nothing(recording: Recording, tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError):
        write_mcap(recording, tmp_path / "absent" / "run.mcap")
    assert list(tmp_path.iterdir()) == []


def test_the_same_recording_gives_the_same_file(recording: Recording, written: Path, tmp_path: Path) -> None:
    again = tmp_path / "again.mcap"
    write_mcap(recording, again)
    assert again.read_bytes() == written.read_bytes()
