"""What `read_recording` hands on, what it refuses, and how it says so."""

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from identification.errors import LogError
from identification.logs.inspect import inspect_log
from identification.logs.read import read_recording
from identification.logs.roles.cell import Cell, WrenchSource
from tests.identification.logs.log_builder import (
    START_NS,
    Stream,
    command_stream,
    complete,
    pose_stream,
    wrench_stream,
    write_mcap,
)

Change = Callable[[list[Stream]], list[Stream]]


def test_other_topic_names_and_rates_are_found_by_type_and_words(tmp_path: Path) -> None:
    streams = [
        wrench_stream("/wrist/ft_raw", rate_hz=1000.0),
        pose_stream("/tcp", rate_hz=125.0),
        command_stream("/controller/targetFrame", rate_hz=250.0),
    ]
    recording = read_recording(write_mcap(tmp_path / "run.mcap", streams))
    assert recording.command is not None
    signals = (recording.wrench, recording.pose, recording.command)
    assert [signal.topic for signal in signals] == ["/wrist/ft_raw", "/tcp", "/controller/targetFrame"]
    assert [signal.stamp_ns.size for signal in signals] == [400, 50, 100]
    assert list(recording.sha256) == [str(tmp_path / "run.mcap")]
    assert recording.sha256 == {str(tmp_path / "run.mcap"): inspect_log(tmp_path / "run.mcap").sha256}


def test_a_log_without_commands_has_none(tmp_path: Path) -> None:
    path = write_mcap(tmp_path / "run.mcap", [wrench_stream(), pose_stream()])
    assert read_recording(path).command is None
    assert [sentence for sentence in inspect_log(path).missing if "commanded pose" in sentence]


def test_quaternions_that_were_rounded_are_normalised(tmp_path: Path) -> None:
    pose = pose_stream()
    rounded = pose.with_values(np.round(pose.values, 4))
    recording = read_recording(write_mcap(tmp_path / "run.mcap", [wrench_stream(), rounded]))
    # One rounding of each of four components and of the norm: a few times 1.1e-16.
    assert np.allclose(np.linalg.norm(recording.pose.quaternion_xyzw, axis=1), 1.0, rtol=0, atol=1e-15)


def with_stream(index: int, change: Callable[[Stream], Stream]) -> Change:
    return lambda streams: [change(stream) if i == index else stream for i, stream in enumerate(streams)]


def put(rows: slice, columns: slice, value: float) -> Callable[[Stream], Stream]:
    def change(stream: Stream) -> Stream:
        values = stream.values.copy()
        values[rows, columns] = value
        return stream.with_values(values)

    return change


def stamp(
    rows: slice, make: Callable[[NDArray[np.int64]], NDArray[np.int64] | np.int64 | int]
) -> Callable[[Stream], Stream]:
    def change(stream: Stream) -> Stream:
        stamps = stream.stamp_ns.copy()
        stamps[rows] = make(stamps[rows])
        return stream.with_stamps(stamps)

    return change


FAULTS: dict[str, tuple[Change, str]] = {
    "NaN burst": (
        with_stream(0, put(slice(50, 60), slice(2, 3), np.nan)),
        r"/ft/wrench holds 10 samples that are not finite .* the first 0\.100 s and the last 0\.118 s",
    ),
    "infinite position": (with_stream(1, put(slice(7, 8), slice(0, 1), -np.inf)), "/robot/pose holds 1 samples"),
    "NaN quaternion": (with_stream(1, put(slice(7, 8), slice(3, 7), np.nan)), "/robot/pose holds 1 samples"),
    "NaN command": (with_stream(2, put(slice(0, 1), slice(0, 1), np.nan)), "/robot/pose_command holds 1 samples"),
    "zero quaternion": (with_stream(1, put(slice(5, 9), slice(3, 7), 0.0)), r"4 orientations .*\(norm 0\)"),
    "long quaternion": (with_stream(1, lambda s: s.with_values(s.values * 1.01)), r"100 orientations .*\(norm 1\.01\)"),
    "dead axis": (with_stream(0, put(slice(None), slice(1, 2), 0.0)), "force y axis .* is 0 in all 200"),
    "stuck axis": (with_stream(0, put(slice(None), slice(5, 6), 1.25)), r"torque z axis .* is 1\.25 in all 200"),
    "zero stamps": (with_stream(0, stamp(slice(None), np.zeros_like)), "All 200 header stamps .* zero"),
    "constant stamps": (with_stream(2, stamp(slice(None), lambda s: int(s[0]))), "All 100 header stamps .* the same"),
    "some zero stamps": (with_stream(0, stamp(slice(0, 3), np.zeros_like)), "3 header stamps of zero or less"),
    "backwards": (
        with_stream(0, stamp(slice(100, 110), lambda s: s - 50_000_000)),
        r"1 header stamps of topic /ft/wrench go backwards, the first 0\.200 s",
    ),
    "duplicates": (
        with_stream(1, stamp(slice(11, 14), lambda _: START_NS + 40_000_000)),
        r"3 header stamps of topic /robot/pose repeat the one before, the first 0\.044 s",
    ),
    "one message": (
        with_stream(1, lambda s: replace(s, stamp_ns=s.stamp_ns[:1], values=s.values[:1], log_ns=s.log_ns[:1])),
        r"/robot/pose holds 1 message",
    ),
}


@pytest.mark.parametrize("name", FAULTS)
def test_samples_that_cannot_be_used_are_refused_and_reported_by_inspect(tmp_path: Path, name: str) -> None:
    change, complaint = FAULTS[name]
    path = write_mcap(tmp_path / "run.mcap", change(complete()))
    with pytest.raises(LogError, match=complaint):
        read_recording(path)
    errors = " ".join(finding.message for finding in inspect_log(path).findings if finding.severity == "error")
    assert re.search(complaint, errors)


def test_a_fault_in_a_channel_that_is_not_needed_does_no_harm(tmp_path: Path) -> None:
    broken = put(slice(None), slice(None), np.nan)(wrench_stream("/base/ft"))
    path = write_mcap(tmp_path / "run.mcap", [*complete(), broken])
    assert read_recording(path, wrench_topic="/ft/wrench").wrench.topic == "/ft/wrench"


def test_a_frame_that_changes_within_a_topic_is_refused(tmp_path: Path) -> None:
    first = wrench_stream()
    second = replace(first, frame_id="other", stamp_ns=first.stamp_ns + 10**9, log_ns=first.log_ns + 10**9)
    path = write_mcap(tmp_path / "run.mcap", [first, second, pose_stream()])
    with pytest.raises(LogError, match="has 2 frames: 'other', 'tool0'"):
        read_recording(path)


def test_messages_of_varying_frame_name_length_keep_their_order(tmp_path: Path) -> None:
    even, odd = wrench_stream(), wrench_stream()
    shifted = replace(odd, stamp_ns=odd.stamp_ns + 500_000, log_ns=odd.log_ns + 500_000, values=odd.values + 1)
    path = write_mcap(tmp_path / "run.mcap", [even, shifted, pose_stream()])
    force = read_recording(path).wrench.force_n
    assert np.array_equal(force[0::2], even.values[:, :3])
    assert np.array_equal(force[1::2], shifted.values[:, :3])


@pytest.mark.parametrize(
    ("streams", "options", "complaint"),
    [
        (
            [wrench_stream(), wrench_stream("/base/ft"), pose_stream()],
            {},
            r"2 channels of run\.mcap could be the wrench: /base/ft \(.* 200 messages.*\), /ft/wrench .*--wrench-topic",
        ),
        (
            [wrench_stream(), pose_stream("/a"), pose_stream("/b")],
            {},
            r"measured pose: /a \(.*\), /b \(.*\); .*--pose-topic .* if another is the command, --command-topic",
        ),
        (
            [wrench_stream(), pose_stream("/a"), pose_stream("/b"), command_stream()],
            {},
            r"measured pose: /a \(.*\), /b \(",
        ),
        (
            [wrench_stream(), pose_stream(), command_stream("/cmd/a"), command_stream("/cmd/b")],
            {},
            r"commanded pose: /cmd/a \(.*\), /cmd/b \(.*\); .*--command-topic",
        ),
        (
            [wrench_stream(), command_stream()],
            {},
            r"serves as the measured pose, since by their names .* record the measured",
        ),
        ([pose_stream()], {}, r"no channel for the wrench: .* record the force/torque sensor"),
        (
            [wrench_stream("/wrist/ft_raw"), pose_stream()],
            {"wrench_topic": "/ft/wrench"},
            r"^Topic `/ft/wrench` is not in run\.mcap; topics of that type: /wrist/ft_raw\.$",
        ),
        (complete(), {"wrench_topic": "/robot/pose"}, "is geometry_msgs/msg/PoseStamped, the wrench must be"),
        (complete(), {"wrench_topic": "/camera/image"}, "is sensor_msgs/msg/Image, the wrench must be"),
        (complete(), {"pose_topic": "/robot/pose", "command_topic": "/robot/pose"}, "at once"),
        (complete(), {"command_topic": "/nothing"}, "topics of that type: /robot/pose, /robot/pose_command"),
    ],
)
def test_missing_and_ambiguous_channels_are_refused_with_the_option_that_decides(
    tmp_path: Path, streams: list[Stream], options: dict[str, Any], complaint: str
) -> None:
    path = write_mcap(tmp_path / "run.mcap", streams)
    with pytest.raises(LogError, match=complaint):
        read_recording(path, **options)


@pytest.mark.parametrize(
    ("options", "pose", "command"),
    [
        ({"command_topic": "/a"}, "/b", "/a"),
        ({"pose_topic": "/a", "command_topic": "/b"}, "/a", "/b"),
        ({"pose_topic": "/a"}, "/a", None),
    ],
)
def test_named_topics_settle_two_poses(tmp_path: Path, options: dict[str, Any], pose: str, command: str | None) -> None:
    path = write_mcap(tmp_path / "run.mcap", [wrench_stream(), pose_stream("/a"), pose_stream("/b")])
    recording = read_recording(path, **options)
    assert recording.pose.topic == pose
    assert (recording.command.topic if recording.command else None) == command


def test_a_pose_that_sounds_commanded_can_be_named_the_measured_one(tmp_path: Path) -> None:
    path = write_mcap(tmp_path / "run.mcap", [wrench_stream(), command_stream("/target_tracker/pose")])
    recording = read_recording(path, pose_topic="/target_tracker/pose")
    assert recording.pose.topic == "/target_tracker/pose"
    assert recording.command is None


def part_of(stream: Stream, rows: slice) -> Stream:
    return replace(stream, stamp_ns=stream.stamp_ns[rows], values=stream.values[rows], log_ns=stream.log_ns[rows])


def test_a_robot_may_rest_for_a_whole_part_of_a_recording(tmp_path: Path) -> None:
    """Recorders split where nothing moves; that a topic holds one pose is a fault of the whole, not of a part."""
    wrench, pose, command = complete()
    command.values[50:] = command.values[50]
    halves = [
        write_mcap(tmp_path / f"part{i}.mcap", [part_of(wrench, w), part_of(pose, p), part_of(command, p)])
        for i, (w, p) in enumerate([(slice(0, 100), slice(0, 50)), (slice(100, 200), slice(50, 100))])
    ]
    joined = read_recording(halves)
    assert joined.command is not None
    np.testing.assert_array_equal(joined.command.position_m, command.values[:, :3])
    with pytest.raises(LogError, match=r"/robot/pose_command holds one and the same pose"):
        read_recording(halves[1])


def test_the_checks_of_identify_are_reported_by_inspect(tmp_path: Path) -> None:
    """A pose an hour off the wrench: the channels are healthy each, together they are of no use."""
    pose = pose_stream()
    path = write_mcap(tmp_path / "run.mcap", [wrench_stream(), pose.with_stamps(pose.stamp_ns + 3600 * 10**9)])
    assert {"clocks-differ", "unusable"} <= {finding.code for finding in inspect_log(path).findings}


def test_an_axis_that_the_sensor_does_not_measure_is_left_out(tmp_path: Path) -> None:
    wrench = wrench_stream()
    flat = wrench.with_values(wrench.values * [1, 1, 1, 1, 1, 0])
    log = write_mcap(tmp_path / "run.mcap", [flat, pose_stream()])
    with pytest.raises(
        LogError, match=r"torque z axis .* leave it out with `wrench: \{left_out: \[rz\]\}` in cell.yaml"
    ):
        read_recording(log)
    force = write_mcap(tmp_path / "force.mcap", [wrench.with_values(wrench.values * [1, 1, 1, 0, 0, 0]), pose_stream()])
    with pytest.raises(LogError, match=r"torque x, torque y, torque z axes .* are 0 in all .*left_out: \[rx, ry, rz\]"):
        read_recording(force)
    recording = read_recording(log, Cell(wrench=WrenchSource(left_out=("rz",))))
    assert recording.wrench.measured_axes == ("x", "y", "z", "rx", "ry")
    assert np.isnan(recording.wrench.torque_n_m[:, 2]).all()
    assert np.array_equal(recording.wrench.force_n, wrench.values[:, :3])


def test_a_single_pose_that_is_off_is_replaced_and_said_by_inspect_too(tmp_path: Path) -> None:
    """A tenth of a metre in one of a hundred samples of a robot that moves."""
    wrench, pose, _ = complete()
    seconds = (pose.stamp_ns - pose.stamp_ns[0]) * 1e-9
    smooth = np.zeros_like(pose.values)
    smooth[:, 0], smooth[:, 6] = 0.05 * np.sin(6.0 * seconds), 1.0
    spoilt = smooth.copy()
    spoilt[40, 0] += 0.1
    path = write_mcap(tmp_path / "run.mcap", [wrench, pose.with_values(spoilt)])
    recording = read_recording(path)
    # Half of the acceleration 1.8 m/s² times (4 ms)² is 14 µm.
    assert np.max(np.abs(recording.pose.position_m - smooth[:, :3])) < 2e-5
    for findings in (recording.findings, inspect_log(path).findings):
        (said,) = (each for each in findings if each.code == "pose-spikes")
        assert "1 sample(s)" in said.message
        assert "the first 0.160 s after its start" in said.message
