"""The decoding of message bytes against the deserialiser of another library."""

import struct
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from identification.errors import LogError
from identification.logs.channel import Channel, RawChannel
from identification.logs.definitions import POSE, WRENCH, has_header, is_standard
from identification.logs.messages import POSE_FIELDS, WRENCH_FIELDS, decode_headers, decode_values
from tests.identification.logs.log_builder import ROS1, ROS2, Stream, as_object, pose_stream, wrench_stream

DOUBLES = st.floats(width=64)
STAMPS = st.integers(min_value=0, max_value=2**31 * 10**9 - 1)
FRAMES = st.text(alphabet=st.characters(exclude_characters="\x00", exclude_categories=["Cs"]), max_size=40)


def raw_channel(messages: list[bytes], type_name: str, encoding: str = "cdr", definition: str = "") -> RawChannel:
    return RawChannel(
        channel=Channel(topic="/topic", type_name=type_name, encoding=encoding, definition=definition),
        log_ns=np.arange(len(messages), dtype=np.int64),
        sizes=np.array([len(message) for message in messages], dtype=np.int64),
        payload=np.frombuffer(b"".join(messages), dtype=np.uint8),
    )


def one(type_name: str, stamp: int, values: list[float], frame_id: str) -> Stream:
    return Stream(
        topic="/topic",
        type_name=type_name,
        stamp_ns=np.array([stamp]),
        values=np.array([values]),
        log_ns=np.array([0]),
        frame_id=frame_id,
    )


@given(
    st.sampled_from([(WRENCH, WRENCH_FIELDS), (POSE, POSE_FIELDS)]),
    st.lists(st.tuples(st.booleans(), STAMPS, FRAMES, st.lists(DOUBLES, min_size=7, max_size=7)), min_size=1),
)
def test_cdr_of_either_byte_order_and_any_frame_name_decodes_as_rosbags_does(
    kind: tuple[str, tuple[str, ...]], drawn: list[tuple[bool, int, str, list[float]]]
) -> None:
    type_name, fields = kind
    streams = [one(type_name, stamp, values[: len(fields)], frame) for _, stamp, frame, values in drawn]
    messages = [
        bytes(ROS2.serialize_cdr(as_object(ROS2, stream, 0), type_name, little_endian=little))
        for stream, (little, *_) in zip(streams, drawn, strict=True)
    ]
    raw = raw_channel(messages, type_name)

    headers, values = decode_headers(raw), decode_values(raw, fields)

    oracle = [ROS2.deserialize_cdr(message, type_name) for message in messages]
    stamps = [m.header.stamp.sec * 10**9 + m.header.stamp.nanosec for m in oracle]  # type: ignore[attr-defined]
    assert headers.stamp_ns.tolist() == stamps == [stamp for _, stamp, _, _ in drawn]
    assert set(headers.frame_ids) == {m.header.frame_id for m in oracle}  # type: ignore[attr-defined]
    assert values.tobytes() == np.array([stream.values[0] for stream in streams]).tobytes()


@given(st.lists(st.tuples(STAMPS, FRAMES, st.lists(DOUBLES, min_size=7, max_size=7)), min_size=1))
def test_ros1_messages_decode_as_rosbags_wrote_them(drawn: list[tuple[int, str, list[float]]]) -> None:
    streams = [one(POSE, stamp, values, frame) for stamp, frame, values in drawn]
    raw = raw_channel([bytes(ROS1.serialize_ros1(as_object(ROS1, s, 0), POSE)) for s in streams], POSE, "ros1")

    headers = decode_headers(raw)

    assert headers.stamp_ns.tolist() == [stamp for stamp, _, _ in drawn]
    assert set(headers.frame_ids) == {frame for _, frame, _ in drawn}
    assert decode_values(raw, POSE_FIELDS).tobytes() == np.array([s.values[0] for s in streams]).tobytes()


def test_a_type_that_the_log_defines_otherwise_is_decoded_by_its_own_definition() -> None:
    definition = (
        "std_msgs/Header header\ngeometry_msgs/Wrench wrench\n"
        + "=" * 80
        + "\nMSG: geometry_msgs/Wrench\ngeometry_msgs/Vector3 torque\ngeometry_msgs/Vector3 force\n"
        + "=" * 80
        + "\nMSG: geometry_msgs/Vector3\nfloat32 x\nfloat32 y\nfloat32 z\n"
    )
    header = struct.pack("<4B iI I4s", 0, 1, 0, 0, 7, 500, 4, b"ft0\0")
    raw = raw_channel([header + struct.pack("<6f", 4, 5, 6, 1, 2, 3)], WRENCH, definition=definition)

    assert not is_standard(raw.channel)
    assert has_header(raw.channel)
    assert decode_headers(raw).stamp_ns.tolist() == [7_000_000_500]
    assert decode_values(raw, WRENCH_FIELDS).tolist() == [[1, 2, 3, 4, 5, 6]]


def test_a_definition_without_the_fields_is_refused() -> None:
    definition = "std_msgs/Header header\nfloat64 pressure\n"
    header = struct.pack("<4B iI I4s", 0, 1, 0, 0, 7, 500, 4, b"ft0\0")
    raw = raw_channel([header + struct.pack("<d", 1.0)], WRENCH, definition=definition)
    with pytest.raises(LogError, match=r"lacks a number among wrench\.force\.x"):
        decode_values(raw, WRENCH_FIELDS)


def test_the_standard_definition_is_recognised_whatever_library_wrote_it() -> None:
    for name in (WRENCH, POSE):
        channel = raw_channel([], name, definition=ROS2.generate_msgdef(name, ros_version=2)[0]).channel
        assert is_standard(channel)
        assert has_header(channel)


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        (lambda message: message[:15], "has 15 bytes"),
        (lambda message: message[:-1], "takes"),
        (lambda message: message + bytes(4), "takes"),
        (lambda message: b"\x00\x07" + message[2:], "plain CDR"),
        (lambda message: message[:12] + struct.pack("<I", 2**31) + message[16:], "takes"),
    ],
)
def test_bytes_that_are_no_wrench_are_refused(change: object, complaint: str) -> None:
    assert callable(change)
    message = bytes(ROS2.serialize_cdr(as_object(ROS2, wrench_stream(), 0), WRENCH))
    with pytest.raises(LogError, match=complaint):
        decode_values(raw_channel([message, change(message)], WRENCH), WRENCH_FIELDS)


def test_a_stamp_with_more_than_a_second_of_nanoseconds_is_refused() -> None:
    message = bytearray(ROS2.serialize_cdr(as_object(ROS2, pose_stream(), 0), POSE))
    message[8:12] = struct.pack("<I", 10**9)
    with pytest.raises(LogError, match="1000000000 ns in a second"):
        decode_headers(raw_channel([bytes(message)], POSE))


def test_messages_out_of_order_are_put_into_order_of_recording() -> None:
    stream = wrench_stream()
    streams = [replace(stream, frame_id="a" * length) for length in (1, 20, 3)]
    messages = [bytes(ROS2.serialize_cdr(as_object(ROS2, s, i), WRENCH)) for i, s in enumerate(streams)]
    raw = replace(raw_channel(messages, WRENCH), log_ns=np.array([30, 10, 20])).sorted_by_log_time()
    assert raw.log_ns.tolist() == [10, 20, 30]
    assert raw.message(1) == messages[2]
    assert decode_values(raw, WRENCH_FIELDS).tolist() == stream.values[[1, 2, 0]].tolist()
