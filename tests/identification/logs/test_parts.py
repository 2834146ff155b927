"""Parts of one run, joined again."""

from dataclasses import fields, replace
from typing import Any

import numpy as np
import pytest

from identification.errors import LogError
from identification.signals.recording import PoseSignal, Recording, WrenchSignal, join_recordings


def cut(signal: Any, first_s: float, last_s: float) -> Any:
    since = (signal.stamp_ns - signal.stamp_ns[0]) * 1e-9
    inside = (since >= first_s - 1e-9) & (since < last_s - 1e-9)
    arrays = {
        field.name: getattr(signal, field.name)[inside]
        for field in fields(signal)
        if isinstance(getattr(signal, field.name), np.ndarray)
    }
    return replace(signal, **arrays)


def part(recording: Recording, first_s: float, last_s: float, name: str) -> Recording:
    return replace(
        recording,
        wrench=cut(recording.wrench, first_s, last_s),
        pose=cut(recording.pose, first_s, last_s),
        command=cut(recording.command, first_s, last_s),
        sha256={name: name * 2},
    )


def assert_same(first: WrenchSignal | PoseSignal | None, second: WrenchSignal | PoseSignal | None) -> None:
    assert first is not None
    assert second is not None
    for field in fields(first):
        np.testing.assert_array_equal(getattr(first, field.name), getattr(second, field.name))


@pytest.mark.parametrize("order", [(0, 1, 2), (2, 0, 1)])
@pytest.mark.parametrize("overlap_s", [0.0, 0.1])
def test_parts_give_the_whole_in_any_order_with_repeats_dropped(
    demo_recording: Recording, order: tuple[int, ...], overlap_s: float
) -> None:
    end = 1e6
    parts = [
        part(demo_recording, 0.0, 20.0, "a"),
        part(demo_recording, 20.0 - overlap_s, 41.3, "b"),
        part(demo_recording, 41.3 - overlap_s, end, "c"),
    ]
    joined = join_recordings([parts[i] for i in order])
    assert_same(joined.wrench, demo_recording.wrench)
    assert_same(joined.pose, demo_recording.pose)
    assert_same(joined.command, demo_recording.command)
    assert joined.sha256 == {"a": "aa", "b": "bb", "c": "cc"}
    assert joined.findings == ()


def test_a_gap_between_parts_is_reported_with_its_length(demo_recording: Recording) -> None:
    joined = join_recordings([part(demo_recording, 0.0, 20.0, "a"), part(demo_recording, 20.5, 40.0, "b")])
    assert [each.code for each in joined.findings] == ["gap-between-parts"] * 3
    assert "0.5008 s of `/ft_sensor/wrench` are missing" in joined.findings[0].message


def test_an_overlap_with_other_samples_is_refused(demo_recording: Recording) -> None:
    first, second = part(demo_recording, 0.0, 20.0, "a"), part(demo_recording, 19.0, 40.0, "b")
    other = replace(second, wrench=replace(second.wrench, force_n=second.wrench.force_n + 1e-12 + 1e-9))
    with pytest.raises(LogError, match=r"the wrench `/ft_sensor/wrench` overlap by 0\.999 s with different samples"):
        join_recordings([first, other])
    shifted = replace(second, pose=replace(second.pose, stamp_ns=second.pose.stamp_ns + 7))
    with pytest.raises(LogError, match="the pose `/flange/pose` overlap"):
        join_recordings([first, shifted])


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        (lambda p: replace(p, wrench=replace(p.wrench, topic="/other")), "agree in the topic of the wrench"),
        (lambda p: replace(p, pose=replace(p.pose, frame_id="map")), "agree in the frame_id of the pose"),
        (lambda p: replace(p, command=None), "the command is missing in b"),
        (
            lambda p: replace(p, wrench=replace(p.wrench, gravity_compensated=True)),
            "agree in the gravity_compensated of the wrench",
        ),
    ],
)
def test_parts_of_different_logs_are_refused(demo_recording: Recording, change: Any, complaint: str) -> None:
    parts = [part(demo_recording, 0.0, 20.0, "a"), change(part(demo_recording, 20.0, 40.0, "b"))]
    with pytest.raises(LogError, match=complaint):
        join_recordings(parts)


def test_one_part_is_the_whole_and_none_is_refused(demo_recording: Recording) -> None:
    assert_same(join_recordings([demo_recording]).wrench, demo_recording.wrench)
    with pytest.raises(LogError, match="at least one log"):
        join_recordings([])
