"""Messages that no kernel knows: JSON, protobuf and odd ROS types, one by one."""

import re

import pytest
from google.protobuf import (  # type: ignore[import-untyped]  # the package carries no annotations
    descriptor_pb2,
    timestamp_pb2,
)
from google.protobuf.message_factory import GetMessages  # type: ignore[import-untyped]

from identification.errors import LogError
from identification.logs.containers.channel import Channel
from identification.logs.messages.decode import Series, Wanted
from tests.identification.logs.messages.message_builder import MemoryContainer, batch_of, channel_of, read_series

JSON = Channel(topic="/json", type_name="Wrench", encoding="json", schema_encoding="jsonschema", schema=b"{}")
WANTED = Wanted(fields=("f[1].x", "g"))


def read(channel: Channel, message: bytes, wanted: Wanted = WANTED) -> Series:
    return read_series(MemoryContainer((batch_of(channel, [message]),)), {channel: wanted})[channel]


@pytest.mark.parametrize(
    ("header", "stamp_ns", "frame"),
    [
        ('"header": {"stamp": {"sec": 1, "nanosec": 2}, "frame_id": "a"}', 1_000_000_002, "a"),
        ('"header": {"stamp": {"secs": 1, "nsecs": 2}, "frame_id": "a"}', 1_000_000_002, "a"),
        ('"timestamp": {"seconds": 1, "nanos": 2}, "frame_id": "b"', 1_000_000_002, "b"),
        ('"timestamp": {"sec": 1, "nsec": 2}', 1_000_000_002, ""),
    ],
)
def test_stamps_of_json_messages_are_found_in_every_usual_form(header: str, stamp_ns: int, frame: str) -> None:
    series = read(JSON, f'{{{header}, "f": [{{}}, {{"x": 2.5}}], "g": 1}}'.encode())
    assert series.stamp_ns is not None
    assert (series.stamp_ns.tolist(), series.frame_ids) == ([stamp_ns], (frame,))
    assert series.values.tolist() == [[2.5, 1.0]]


@pytest.mark.parametrize(
    ("message", "complaint"),
    [
        ('{"header": {}, "f": [{}, {"x": 1}], "g": 1}', "no header with a stamp"),
        ('{"f": [{}, {"x": 1}], "g": 1, "timestamp": {"sec": 1}}', "no header with a stamp"),
        ('{"f": [{}, {"x": 1}], "g": 1, "timestamp": {"sec": 1.5, "nsec": 0}}', "no header with a stamp"),
        ('{"f": [{}, {"x": 1}], "g": 1, "timestamp": {"sec": 1, "nsec": 1000000000}}', "a second of 1000000000 ns"),
        ('{"f": [{}, {"x": 1}], "g": 1, "timestamp": {"sec": 1, "nsec": -1}}', "a second of -1 ns"),
        ('{"f": [{}, {"x": 1}], "g": 1, "timestamp": {"sec": 10000000000, "nsec": 0}}', "out of range"),
        ('{"f": [{}], "g": 1}', "lacks f[1].x"),
        ('{"f": [{}, 3], "g": 1}', "lacks f[1].x"),
        ('{"f": [{}, {"x": "1"}], "g": 1}', "'1' is no number"),
        ('{"f": [{}, {"x": null}], "g": 1}', "None is no number"),
        ('{"f": [{}, {"x": 1}], "g": 1' + "0" * 400 + "}", "too large"),
        ("{", "Message 1 of topic /json"),
    ],
)
def test_json_messages_that_lack_something_are_refused(message: str, complaint: str) -> None:
    with pytest.raises(LogError, match=re.escape(complaint)) as caught:
        read(JSON, message.encode())
    assert "Message 1 of topic /json" in str(caught.value)


def test_protobuf_messages_are_read_by_attribute() -> None:
    file = descriptor_pb2.FileDescriptorProto(name="w.proto", package="t", syntax="proto3")
    file.dependency.append("google/protobuf/timestamp.proto")
    message = file.message_type.add(name="Wrench")
    kinds = descriptor_pb2.FieldDescriptorProto
    message.field.add(
        name="timestamp", number=1, type=kinds.TYPE_MESSAGE, label=kinds.LABEL_OPTIONAL,
        type_name=".google.protobuf.Timestamp",
    )  # fmt: skip
    message.field.add(name="frame_id", number=2, type=kinds.TYPE_STRING, label=kinds.LABEL_OPTIONAL)
    message.field.add(name="force", number=3, type=kinds.TYPE_DOUBLE, label=kinds.LABEL_REPEATED)
    stamp = descriptor_pb2.FileDescriptorProto()
    timestamp_pb2.DESCRIPTOR.CopyToProto(stamp)
    files = [stamp, file]
    kind = GetMessages(files)["t.Wrench"]
    written = kind(frame_id="tool", force=[1.5, -2.5])
    written.timestamp.seconds, written.timestamp.nanos = 5, 6
    schema = descriptor_pb2.FileDescriptorSet(file=files).SerializeToString()
    channel = Channel(topic="/p", type_name="t.Wrench", encoding="protobuf", schema_encoding="protobuf", schema=schema)

    series = read(channel, written.SerializeToString(), Wanted(fields=("force[1]", "force[0]")))

    assert series.values.tolist() == [[-2.5, 1.5]]
    assert series.stamp_ns is not None
    assert (series.stamp_ns.tolist(), series.frame_ids) == ([5_000_000_006], ("tool",))


def test_an_encoding_that_nobody_knows_is_refused() -> None:
    channel = Channel(topic="/x", type_name="T", encoding="cbor", schema_encoding="", schema=b"")
    with pytest.raises(LogError, match="in the encoding 'cbor'; cdr, ros1, json and protobuf are read"):
        read(channel, b"")


@pytest.mark.parametrize(
    ("schema", "complaint"),
    [
        (b"float64 a b c d\n===", "cannot be parsed"),
        (b"pkg/Unknown u\n", "pkg/msg/Unknown of topic /topic is not defined"),
        (b"\xff\xfe", "cannot be parsed"),
    ],
)
def test_a_definition_that_cannot_be_used_is_refused(schema: bytes, complaint: str) -> None:
    base = channel_of("geometry_msgs/msg/WrenchStamped", "little")
    channel = Channel(
        topic=base.topic, type_name="pkg/msg/Own", encoding="cdr", schema_encoding="ros2msg", schema=schema
    )
    with pytest.raises(LogError, match=complaint):
        read(channel, b"", Wanted(fields=("a",), header=""))


def test_strings_of_wide_characters_are_refused_by_name() -> None:
    channel = Channel(
        topic="/w", type_name="pkg/msg/W", encoding="cdr", schema_encoding="ros2msg", schema=b"wstring a\nfloat64 b\n"
    )
    with pytest.raises(LogError, match="wstring"):
        read(channel, bytes(20), Wanted(fields=("b",), header=""))


@pytest.mark.parametrize("value", ["true", "false", "null", '"12"'])
def test_what_is_no_number_in_json_is_refused(value: str) -> None:
    with pytest.raises(LogError, match=r"is no number"):
        read(JSON, f'{{"timestamp": {{"sec": 1, "nsec": 2}}, "f": [{{}}, {{"x": {value}}}], "g": 1}}'.encode())
