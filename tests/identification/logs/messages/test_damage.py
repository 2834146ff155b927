"""Messages that are not what their type says: each is refused with its number, topic and byte."""

import re
import struct
from collections.abc import Callable

import pytest

from identification.errors import LogError
from identification.logs.containers.channel import Channel
from identification.logs.gather import read_transform
from identification.logs.messages.decode import Wanted
from problems.arrays import FloatArray
from tests.identification.logs.messages.message_builder import (
    ADMITTANCE,
    ENCODINGS,
    Encoding,
    MemoryContainer,
    RandomMessages,
    batch_of,
    channel_of,
    read_series,
    serialise,
)

WRENCH = "geometry_msgs/msg/WrenchStamped"
FIELDS = tuple(f"wrench.{part}.{axis}" for part in ("force", "torque") for axis in "xyz")
# encapsulation, stamp, name of 4 characters and its zero, 3 bytes up to a multiple of 8 from byte 4, six doubles
SOUND = struct.pack("<4B iI I5s 7x 6d", 0, 1, 0, 0, 7, 500, 5, b"tool\0", *range(6))
ROS1 = struct.pack("<III I4s 6d", 3, 7, 500, 4, b"tool", *range(6))
# a joint state without names, positions and velocities, and with two efforts
JOINTS = struct.pack("<4B iI I4s 3I I 2d", 0, 1, 0, 0, 7, 500, 4, b"arm\0", 0, 0, 0, 2, 1.0, 2.0)


def read(channel: Channel, messages: list[bytes], wanted: Wanted) -> FloatArray:
    batches = tuple(batch_of(channel, [message]) for message in messages)
    return read_series(MemoryContainer(batches), {channel: wanted})[channel].values


def test_the_messages_that_are_damaged_below_are_sound() -> None:
    assert read(channel_of(WRENCH, "little"), [SOUND], Wanted(fields=FIELDS)).tolist() == [[0, 1, 2, 3, 4, 5]]
    assert read(channel_of(WRENCH, "ros1"), [ROS1], Wanted(fields=FIELDS)).tolist() == [[0, 1, 2, 3, 4, 5]]
    joints = Wanted(fields=("effort[1]", "effort[0]"))
    assert read(channel_of("sensor_msgs/msg/JointState", "little"), [JOINTS], joints).tolist() == [[2, 1]]


@pytest.mark.parametrize("spare", [0, 1, 2, 3])
def test_up_to_three_bytes_behind_a_cdr_message_are_padding(spare: int) -> None:
    assert read(channel_of(WRENCH, "little"), [SOUND + bytes(spare)], Wanted(fields=FIELDS)).tolist() == [
        [0, 1, 2, 3, 4, 5]
    ]


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        (lambda _: b"", "byte 0 does not fit into its 0 bytes"),
        (lambda m: m[:3], "byte 0 does not fit into its 3 bytes"),
        (lambda m: m[:4], "byte 4 does not fit into its 4 bytes"),
        (lambda m: m[:15], "byte 12 does not fit into its 15 bytes"),
        (lambda m: m[:-1], "byte 28 does not fit into its 75 bytes"),
        (lambda m: m + bytes(4), "its type ends at byte 76, the message has 80"),
        (lambda m: b"\x00\x02" + m[2:], "encapsulation 00 02 00 00 is not plain CDR"),
        (lambda m: b"\x00\x03" + m[2:], "encapsulation 00 03 00 00 is not plain CDR"),
        (lambda m: b"\x00\x07" + m[2:], "encapsulation 00 07 00 00 is not plain CDR"),
        (lambda m: b"\x01\x01" + m[2:], "encapsulation 01 01 00 00 is not plain CDR"),
        (lambda m: m[:12] + struct.pack("<I", 2**31) + m[16:], "byte 12 does not fit"),
        (lambda m: m[:12] + struct.pack("<I", 2**32 - 1) + m[16:], "byte 12 does not fit"),
        (lambda m: m[:12] + bytes(4) + m[16:], "byte 12 does not fit"),
        (lambda m: m[:20] + b"x" + m[21:], "end with a zero at byte 20"),
        (lambda m: m[:8] + struct.pack("<I", 10**9) + m[12:], "more than 999999999 ns at byte 8"),
        (lambda m: m[:16] + b"\xff\xfe" + m[18:], "a frame name is no text"),
    ],
)
def test_bytes_that_are_no_wrench_are_refused(change: Callable[[bytes], bytes], complaint: str) -> None:
    with pytest.raises(LogError, match=re.escape(complaint)) as caught:
        read(channel_of(WRENCH, "little"), [SOUND, SOUND, change(SOUND), SOUND], Wanted(fields=FIELDS))
    assert "Message 3 of topic /topic" in str(caught.value)


@pytest.mark.parametrize("claimed", [4, 5, 8, 2**31])
def test_a_string_does_not_reach_into_what_follows_the_message(claimed: int) -> None:
    channel = Channel(
        topic="/s", type_name="pkg/msg/S", encoding="cdr", schema_encoding="ros2msg", schema=b"string text"
    )
    sound, wanted = struct.pack("<4BI3s", 0, 1, 0, 0, 3, b"ab\0"), Wanted(fields=(), header="")
    for message, is_sound in ((sound, True), (sound[:4] + struct.pack("<I", claimed) + sound[8:], False)):
        container = MemoryContainer((batch_of(channel, [message], gap=bytes(16)),))
        if is_sound:
            assert read_series(container, {channel: wanted})[channel].log_ns.size == 1
        else:
            with pytest.raises(LogError, match="byte 4 does not fit"):
                read_series(container, {channel: wanted})


@pytest.mark.parametrize("cut", [*range(len(ROS1))])
def test_every_truncation_of_a_ros_1_message_is_refused(cut: int) -> None:
    with pytest.raises(LogError, match="Message 1 of topic /topic"):
        read(channel_of(WRENCH, "ros1"), [ROS1[:cut]], Wanted(fields=FIELDS))


def test_a_ros_1_message_has_no_padding() -> None:
    with pytest.raises(LogError, match=f"its type ends at byte {len(ROS1)}, the message has {len(ROS1) + 1}"):
        read(channel_of(WRENCH, "ros1"), [ROS1 + b"\0"], Wanted(fields=FIELDS))


@pytest.mark.parametrize("encoding", ENCODINGS)
@pytest.mark.parametrize("type_name", [ADMITTANCE, "sensor_msgs/msg/JointState", "tf2_msgs/msg/TFMessage"])
def test_every_truncation_of_a_nested_message_is_refused(type_name: str, encoding: Encoding) -> None:
    channel = channel_of(type_name, encoding)
    message = serialise(RandomMessages(7, encoding, 2).message(type_name), type_name, encoding)
    for cut in range(len(message)):
        with pytest.raises(LogError):
            read(channel, [message[:cut]], Wanted(fields=(), header=""))


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        (lambda m: m, "sequence at byte 36 has fewer entries than are wanted"),
        (lambda m: m[:32] + struct.pack("<I", 2**29) + m[36:], "does not fit"),
        (lambda m: m[:32] + struct.pack("<I", 2**32 - 1) + m[36:], "does not fit"),
        (lambda m: m[:20] + struct.pack("<I", 2**32 - 1) + m[24:], "does not fit"),
    ],
)
def test_sequences_that_are_too_short_or_too_long_are_refused(change: Callable[[bytes], bytes], complaint: str) -> None:
    with pytest.raises(LogError, match=complaint):
        read(channel_of("sensor_msgs/msg/JointState", "little"), [change(JOINTS)], Wanted(fields=("effort[2]",)))


def test_a_stamp_before_1970_is_negative() -> None:
    channel = channel_of(WRENCH, "little")
    message = SOUND[:4] + struct.pack("<iI", -2, 5) + SOUND[12:]
    series = read_series(MemoryContainer((batch_of(channel, [message]),)), {channel: Wanted(fields=FIELDS)})[channel]
    assert series.stamp_ns is not None
    assert series.stamp_ns.tolist() == [-1_999_999_995]


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_every_truncation_of_a_message_of_transforms_is_refused(encoding: Encoding) -> None:
    channel = channel_of("tf2_msgs/msg/TFMessage", encoding)
    message = RandomMessages(7, encoding, 2).message(channel.type_name)
    message.transforms[1].header.frame_id, message.transforms[1].child_frame_id = "base", "tool"
    data = serialise(message, channel.type_name, encoding)
    assert read_transform(MemoryContainer((batch_of(channel, [data]),)), channel, "base", "tool").log_ns.size == 1
    for cut in range(len(data)):
        with pytest.raises(LogError, match="Message 1 of topic /topic"):
            read_transform(MemoryContainer((batch_of(channel, [data[:cut]]),)), channel, "base", "tool")
