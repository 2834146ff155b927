"""What `inspect_log` tells about sound logs and about odd ones."""

import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest

from identification.logs.checks import samples
from identification.logs.inspect import inspect_log
from identification.logs.read import read_recording
from identification.logs.roles.cell import Cell, Saturation, WrenchSource
from identification.logs.roles.registry import ROLES, FieldPaths, Role, RoleKind
from identification.result import Finding
from tests.identification.logs.log_builder import START_NS, complete, pose_stream, wrench_stream, write_mcap
from tests.identification.logs.message_builder import Topic, Tree, header, write_log


def test_a_complete_log_lacks_nothing(tmp_path: Path) -> None:
    path = write_mcap(tmp_path / "run.mcap", complete())
    summary = inspect_log(path)
    assert summary.missing == ()
    # Orientations drawn at random jump, and 0.4 s say nothing of clocks.
    assert {finding.code for finding in summary.findings} == {"orientation-jumps", "clock-offset-unknown"}
    assert (summary.container, summary.size_bytes) == ("mcap", path.stat().st_size)
    assert summary.start_ns == START_NS
    channels = {channel.topic: channel for channel in summary.channels}
    wrench = channels["/ft/wrench"]
    assert (wrench.count, wrench.clock, wrench.frame_ids, wrench.roles) == (200, "header", ("tool0",), (Role.WRENCH,))
    assert wrench.rate_hz == pytest.approx(500.0)
    assert wrench.median_gap_s == pytest.approx(0.002)
    assert wrench.max_gap_s == pytest.approx(0.002)
    assert (wrench.backwards_steps, wrench.duplicates) == (0, 0)
    assert wrench.header_minus_log_s == pytest.approx(-0.0003)
    assert channels["/robot/pose"].roles == (Role.POSE,)
    assert channels["/robot/pose_command"].roles == (Role.COMMAND,)
    camera = channels["/camera/image"]
    assert (camera.type, camera.count, camera.roles) == ("sensor_msgs/msg/Image", 3, ())
    assert camera.rate_hz == pytest.approx(1.0)
    assert camera.frame_ids == ("camera",)


def test_a_topic_has_one_rate_wherever_it_is_named(tmp_path: Path) -> None:
    """It is (messages − 1)/(last − first stamp) without holes, also where others begin before and end after it."""
    late = wrench_stream(rate_hz=500.0, duration_s=0.2)
    late = replace(late, stamp_ns=late.stamp_ns + 90_000_000, log_ns=late.log_ns + 90_000_000)
    path = write_mcap(tmp_path / "run.mcap", [late, pose_stream()])
    summary = inspect_log(path)
    (candidate,) = next(role for role in summary.roles if role.role is Role.WRENCH).candidates
    (channel,) = (channel for channel in summary.channels if Role.WRENCH in channel.roles)
    assert candidate.rate_hz == channel.rate_hz == pytest.approx(500.0)
    (chosen,) = (f.message for f in read_recording(path).findings if "The wrench is read" in f.message)
    assert "(geometry_msgs/msg/WrenchStamped, 100 messages, 500.0 Hz, frame tool0)" in chosen


def test_dropped_samples_are_counted(tmp_path: Path) -> None:
    full = wrench_stream()
    kept = np.delete(np.arange(200), [*range(50, 54), 120])
    holed = replace(full, stamp_ns=full.stamp_ns[kept], log_ns=full.log_ns[kept], values=full.values[kept])
    summary = inspect_log(write_mcap(tmp_path / "run.mcap", [holed, pose_stream()]))
    text = [finding.message for finding in summary.findings if finding.code == "dropped-samples"]
    assert len(text) == 1
    assert "lacks about 5 messages in 2 gaps" in text[0]
    assert "the longest lasts 0.0100 s" in text[0]


def test_clocks_that_differ_are_reported(tmp_path: Path) -> None:
    other = pose_stream()
    late = other.with_stamps(other.stamp_ns - 40_000_000)
    summary = inspect_log(write_mcap(tmp_path / "run.mcap", [wrench_stream(), late]))
    spread = [finding.message for finding in summary.findings if finding.code == "clocks-differ"]
    # Stamps 40.2 ms before recording against 0.3 ms.
    assert len(spread) == 1
    assert re.search(r"/ft/wrench and /robot/pose are \+0\.0399 ", spread[0])


def test_ambiguous_channels_are_reported_as_missing_decisions(tmp_path: Path) -> None:
    streams = [wrench_stream("/a"), wrench_stream("/b"), pose_stream("/p"), pose_stream("/q")]
    missing = inspect_log(write_mcap(tmp_path / "run.mcap", streams)).missing
    assert ["--wrench-topic" in missing[0], "--pose-topic" in missing[1], "commanded pose" in missing[2]] == [True] * 3


def test_steps_of_stamps_are_counted_per_channel(tmp_path: Path) -> None:
    stream = wrench_stream()
    stamps = stream.stamp_ns.copy()
    stamps[100:] -= 10_000_000
    stamps[3] = stamps[2]
    summary = inspect_log(write_mcap(tmp_path / "run.mcap", [stream.with_stamps(stamps), pose_stream()]))
    wrench = next(channel for channel in summary.channels if channel.topic == "/ft/wrench")
    assert (wrench.backwards_steps, wrench.duplicates) == (1, 1)


def test_channels_without_a_known_definition_are_counted_and_not_decoded(shared_data: Path) -> None:
    summary = inspect_log(shared_data / "rosbag2_fixtures" / "talker.db3")
    assert {channel.topic: (channel.count, channel.clock) for channel in summary.channels} == {
        "/parameter_events": (0, "recording"),
        "/rosout": (10, "recording"),
        "/topic": (10, "recording"),
    }
    assert [finding for finding in summary.findings if finding.severity == "error"] == []
    assert len(summary.missing) == 3


def test_a_role_is_added_by_one_entry(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """An entry in the registry: the channel is found, listed by `inspect`, and its samples are read and checked."""
    path = write_mcap(tmp_path / "run.mcap", complete())
    role, image = cast(Role, "image size"), "sensor_msgs/msg/Image"
    assert role not in {each.role for each in inspect_log(path).roles}
    layout = FieldPaths(fields=("height", "width"), header="header")
    kind = RoleKind(entry="camera", label="image size", layouts={image: layout}, tiers=((image,),))
    monkeypatch.setitem(ROLES, role, kind)
    (found,) = (each for each in inspect_log(path).roles if each.role == role)
    assert (found.entry, found.topic) == ("camera", "/camera/image")
    (channel,) = (each for each in inspect_log(path).channels if each.topic == "/camera/image")
    assert channel.roles == (role,)
    messages = [finding.message for finding in read_recording(path).findings]
    assert any(message.startswith("The image size is read from /camera/image") for message in messages)


def test_a_wrench_whose_topic_says_that_it_was_filtered_is_questioned(tmp_path: Path) -> None:
    codes = [
        {
            finding.code
            for finding in read_recording(write_mcap(tmp_path / "run.mcap", [stream, pose_stream()])).findings
        }
        for stream in (wrench_stream(), wrench_stream("/ft/wrench_filtered"))
    ]
    assert ["wrench-may-be-processed" in found for found in codes] == [False, True]


@pytest.mark.parametrize(("band", "code"), [(0.0, "effort-may-be-wrench"), (1.0, "effort-deadband")])
def test_six_efforts_may_be_a_wrench(tmp_path: Path, band: float, code: str) -> None:
    force = np.random.default_rng(0).normal(size=(200, 6))
    force[np.abs(force) < band] = 0.0

    def message(i: int, stamp: int) -> Tree:
        return {"header": header(stamp, ""), "effort": force[i].tolist()}

    log = write_log(
        tmp_path / "run.mcap", [Topic(topic="/state", type_name="sensor_msgs/msg/JointState", message=message)]
    )
    found = {finding.code for finding in inspect_log(log).findings if finding.code.startswith("effort")}
    assert found == {code}


def test_the_samples_of_a_role_are_examined_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Reading for identify finds what the summary of the channel found of the same numbers, and of others anew."""
    seen: list[Role] = []
    plain = samples.role_faults

    def counted(role: Role, *arguments: Any, **options: Any) -> Iterator[Finding]:
        seen.append(role)
        return plain(role, *arguments, **options)

    monkeypatch.setattr(samples, "role_faults", counted)
    path = write_mcap(tmp_path / "run.mcap", complete())
    assert "unusable" not in {finding.code for finding in inspect_log(path).findings}
    assert sorted(seen) == sorted([Role.WRENCH, Role.POSE, Role.COMMAND])
    # A saturation that the cell declares is another question.
    seen.clear()
    limited = Cell(wrench=WrenchSource(saturation=Saturation(force_n=(1.0, 1.0, 1.0))))
    assert "unusable" in {finding.code for finding in inspect_log(path, limited).findings}
    assert sorted(seen) == sorted([Role.WRENCH, Role.WRENCH, Role.POSE, Role.COMMAND])
