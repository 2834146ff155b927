"""Transforms of one pair of frames, against rosbags."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from identification.errors import LogError
from identification.logs.containers.channel import Channel
from identification.logs.gather import list_frames, read_transform
from identification.logs.messages.transforms import FIELDS
from tests.identification.logs.messages.message_builder import (
    ENCODINGS,
    Encoding,
    MemoryContainer,
    RandomMessages,
    batch_of,
    channel_of,
    deserialise,
    serialise,
)

LAW = settings(deadline=None, max_examples=60)
TF, TRANSFORM = "tf2_msgs/msg/TFMessage", "geometry_msgs/msg/TransformStamped"
NAMES = ("base", "base_link", "tool0", "")


def draw(seed: int, type_name: str, encoding: Encoding, count: int) -> list[bytes]:
    """Messages whose frames are of a few names, so that pairs repeat."""
    random, chooser, messages = RandomMessages(seed, encoding), np.random.default_rng(seed), []
    for _ in range(count):
        message = random.message(type_name)
        for each in message.transforms if type_name == TF else [message]:
            each.header.frame_id, each.child_frame_id = chooser.choice(NAMES), chooser.choice(NAMES)
        messages.append(serialise(message, type_name, encoding))
    return messages


def numbers(each: Any) -> list[float]:
    return [getattr(getattr(each.transform, path.split(".")[0]), path.split(".")[1]) for path in FIELDS]


@LAW
@given(st.sampled_from([TF, TRANSFORM]), st.sampled_from(ENCODINGS), st.integers(0, 2**32 - 1))
def test_the_transforms_of_every_pair_are_those_that_rosbags_reads(
    type_name: str, encoding: Encoding, seed: int
) -> None:
    channel = channel_of(type_name, encoding)
    messages = draw(seed, type_name, encoding, 4)
    container = MemoryContainer((batch_of(channel, messages[:3]), batch_of(channel, messages[3:])))

    every = [
        (index % 3, each)
        for index, data in enumerate(messages)
        for each in (
            deserialise(data, type_name, encoding).transforms
            if type_name == TF
            else [deserialise(data, type_name, encoding)]
        )
    ]
    pairs = {(each.header.frame_id, each.child_frame_id) for _, each in every}
    assert list_frames(container, channel) == tuple(sorted(pairs))
    for parent, child in pairs:
        chosen = [(log, e) for log, e in every if (e.header.frame_id, e.child_frame_id) == (parent, child)]
        chosen.sort(key=lambda item: item[0])
        series = read_transform(container, channel, parent, child)
        assert series.fields == FIELDS
        assert series.frame_ids == (parent,)
        assert series.log_ns.tolist() == [log for log, _ in chosen]
        assert series.stamp_ns is not None
        assert series.stamp_ns.tolist() == [e.header.stamp.sec * 10**9 + e.header.stamp.nanosec for _, e in chosen]
        assert series.values.tobytes() == np.array([numbers(e) for _, e in chosen]).tobytes()


def test_a_layout_of_its_own_is_read_through_the_library() -> None:
    text = "std_msgs/Header header\nstring child_frame_id\nuint32 quality\ngeometry_msgs/Transform transform\n"
    channel = replace(channel_of(TRANSFORM, "little"), schema=text.encode())
    message = (
        b"\0\1\0\0" + np.array([1, 2, 5], "<i4").tobytes() + b"base\0\0\0\0" + np.array([5], "<i4").tobytes()
        + b"tool\0\0\0\0" + np.array([9], "<u4").tobytes() + bytes(4) + np.arange(7.0).tobytes()
    )  # fmt: skip
    series = read_transform(MemoryContainer((batch_of(channel, [message]),)), channel, "base", "tool")
    assert series.values.tolist() == [[0, 1, 2, 3, 4, 5, 6]]
    assert series.stamp_ns is not None
    assert series.stamp_ns.tolist() == [1_000_000_002]


def test_transforms_in_json_are_read_alike() -> None:
    channel = Channel(topic="/tf", type_name=TF, encoding="json", schema_encoding="", schema=b"")
    message = b"""{"transforms": [{"header": {"stamp": {"sec": 3, "nsec": 4}, "frame_id": "base"},
        "child_frame_id": "tool", "transform": {"translation": {"x": 1, "y": 2, "z": 3},
        "rotation": {"x": 0, "y": 0, "z": 0, "w": 1.5}}}]}"""
    series = read_transform(MemoryContainer((batch_of(channel, [message]),)), channel, "base", "tool")
    assert series.values.tolist() == [[1, 2, 3, 0, 0, 0, 1.5]]
    assert series.stamp_ns is not None
    assert series.stamp_ns.tolist() == [3_000_000_004]


def test_frames_that_do_not_occur_are_refused_with_those_that_do() -> None:
    channel = channel_of(TF, "little")
    message = RandomMessages(1, "little", 1).message(TF)
    message.transforms[0].header.frame_id, message.transforms[0].child_frame_id = "base", "tool0"
    container = MemoryContainer((batch_of(channel, [serialise(message, TF, "little")]),))
    with pytest.raises(LogError, match="no transform from 'base' to 'tool1'; it holds: base to tool0"):
        read_transform(container, channel, "base", "tool1")
    with pytest.raises(LogError, match="no transforms"):
        list_frames(container, channel_of("geometry_msgs/msg/PoseStamped", "little"))


def test_a_topic_may_hold_far_more_transforms_of_a_pair_than_messages() -> None:
    channel = channel_of(TF, "little")
    messages, every = [], []
    for seed, count in ((1, 1000), (2, 3), (3, 1500)):
        message = RandomMessages(seed, "little", count).message(TF)
        for each in message.transforms:
            each.header.frame_id, each.child_frame_id = "base", "tool"
        every += [numbers(each) for each in message.transforms]
        messages.append(serialise(message, TF, "little"))
    container = MemoryContainer(tuple(batch_of(channel, [message]) for message in messages))
    series = read_transform(container, channel, "base", "tool")
    assert series.values.tobytes() == np.array(every).tobytes()
    assert series.log_ns.size == 2503


def test_hundreds_of_pairs_are_all_found() -> None:
    channel = channel_of(TF, "little")
    message = RandomMessages(1, "little", 200).message(TF)
    for index, each in enumerate(message.transforms):
        each.header.frame_id, each.child_frame_id = f"frame{index}", f"child{index}"
    container = MemoryContainer((batch_of(channel, [serialise(message, TF, "little")]),))
    assert len(list_frames(container, channel)) == 200
    assert (
        read_transform(container, channel, "frame150", "child150").values.tolist() == [numbers(message.transforms[150])]
        or np.isnan(numbers(message.transforms[150])).any()
    )
