"""Protobuf messages: by the descriptors in the log, as the `mcap_protobuf` library writes them."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from google.protobuf import (  # type: ignore[import-untyped]  # the package carries no annotations
    descriptor_pb2,
    descriptor_pool,
    message_factory,
    timestamp_pb2,
)
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap_protobuf.writer import Writer

from identification.errors import LogError
from identification.logs.containers.channel import Channel
from identification.logs.containers.mcap_file import McapContainer
from identification.logs.messages.protobuf_objects import build_parser

_FIELD = descriptor_pb2.FieldDescriptorProto


def file_of(name: str, messages: dict[str, list[tuple[str, int, int, str]]], *imports: str) -> Any:
    """A descriptor by hand: per message its fields (name, label, type, type name)."""
    file = descriptor_pb2.FileDescriptorProto(name=name, package="cell", syntax="proto2", dependency=imports)
    for title, fields in messages.items():
        message = file.message_type.add(name=title)
        for number, (field, label, kind, type_name) in enumerate(fields, start=1):
            message.field.add(name=field, number=number, label=label, type=kind, type_name=type_name or None)
    return file


ONE, MANY, MUST = _FIELD.LABEL_OPTIONAL, _FIELD.LABEL_REPEATED, _FIELD.LABEL_REQUIRED
DOUBLE, TEXT, MESSAGE = _FIELD.TYPE_DOUBLE, _FIELD.TYPE_STRING, _FIELD.TYPE_MESSAGE
VECTOR = file_of("vector.proto", {"Vector": [(axis, ONE, DOUBLE, "") for axis in "xyz"]})
WRENCH = file_of(
    "wrench.proto",
    {
        "Wrench": [
            ("stamp", ONE, MESSAGE, ".google.protobuf.Timestamp"),
            ("force", ONE, MESSAGE, ".cell.Vector"),
            ("raw", MANY, DOUBLE, ""),
            ("frame_id", ONE, TEXT, ""),
        ]
    },
    "vector.proto",
    "google/protobuf/timestamp.proto",
)
STAMP = descriptor_pb2.FileDescriptorProto.FromString(timestamp_pb2.DESCRIPTOR.serialized_pb)


def set_of(*files: Any) -> bytes:
    return bytes(descriptor_pb2.FileDescriptorSet(file=files).SerializeToString())


def channel_of(schema: bytes, type_name: str = "cell.Wrench") -> Channel:
    return Channel(topic="/ft", type_name=type_name, encoding="protobuf", schema_encoding="protobuf", schema=schema)


def class_of(type_name: str = "cell.Wrench") -> Any:
    pool = descriptor_pool.DescriptorPool()
    for file in (STAMP, VECTOR, WRENCH):
        pool.Add(file)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName(type_name))


SOUND = channel_of(set_of(STAMP, VECTOR, WRENCH))


def message(index: int) -> Any:
    built = class_of()(frame_id=f"tool{index}", raw=[index, -index])
    built.stamp.seconds = 1_700_000_000 + index
    built.force.x = 0.1 * index
    return built


def test_messages_of_an_mcap_file_are_read(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    sent = [message(index) for index in range(1, 40)]
    with path.open("wb") as file, Writer(file) as writer:
        for index, each in enumerate(sent):
            writer.write_message("/ft", each, log_time=index)
    container = McapContainer(path)
    (held,) = container.survey().held
    parse = build_parser(held.channel)
    found: list[Any] = [
        each
        for _, parsed in container.read(
            [held.channel],
            lambda batch: [
                parse(batch.data[start : start + size].tobytes())
                for start, size in zip(batch.starts, batch.sizes, strict=True)
            ],
        )
        for each in parsed
    ]
    container.close()
    assert [each.force.x for each in found] == [0.1 * index for index in range(1, 40)]
    assert [each.raw[1] for each in found] == [-index for index in range(1, 40)]
    assert [(each.frame_id, each.stamp.seconds) for each in found] == [(e.frame_id, e.stamp.seconds) for e in sent]


@pytest.mark.parametrize("files", [(WRENCH, VECTOR, STAMP), (VECTOR, WRENCH), (WRENCH, STAMP, VECTOR, STAMP)])
def test_the_files_of_a_set_may_stand_in_any_order_and_lack_protobufs_own(files: tuple[Any, ...]) -> None:
    parsed: Any = build_parser(channel_of(set_of(*files)))(message(3).SerializeToString())
    assert (parsed.force.x, parsed.force.y, parsed.frame_id) == (0.1 * 3, 0.0, "tool3")


def test_logs_with_other_definitions_of_one_name_do_not_disturb_each_other() -> None:
    other = file_of("wrench.proto", {"Wrench": [("frame_id", ONE, DOUBLE, "")]})
    first, second = build_parser(SOUND), build_parser(channel_of(set_of(other)))
    data = b"\x09" + np.float64(2.5).tobytes()
    parsed: Any = second(data)
    assert parsed.frame_id == 2.5
    parsed = first(message(4).SerializeToString())
    assert parsed.frame_id == "tool4"


CYCLE = (file_of("a.proto", {"A": []}, "b.proto"), file_of("b.proto", {"B": []}, "a.proto"))


@pytest.mark.parametrize(
    ("schema", "type_name"),
    [
        (b"", "cell.Wrench"),
        (b"no descriptors", "cell.Wrench"),
        (SOUND.schema[:-5], "cell.Wrench"),
        (SOUND.schema, "cell.Pose"),
        (SOUND.schema, ""),
        (SOUND.schema, "cell..Wrench"),
        (set_of(WRENCH), "cell.Wrench"),
        (set_of(*CYCLE), "cell.A"),
        (set_of(file_of("a.proto", {"A": []}, "a.proto")), "cell.A"),
        (set_of(file_of("a.proto", {"A": [("v", ONE, MESSAGE, ".cell.None")]})), "cell.A"),
        (set_of(file_of("a.proto", {"A": [("v", ONE, DOUBLE, ""), ("v", ONE, TEXT, "")]})), "cell.A"),
    ],
)
def test_descriptors_that_do_not_define_the_type_are_refused(schema: bytes, type_name: str) -> None:
    with pytest.raises(LogError, match=r"The Protobuf descriptors of topic /ft do not define") as caught:
        build_parser(channel_of(schema, type_name))
    assert "\n" not in str(caught.value)


def test_messages_that_are_none_of_the_type_are_refused() -> None:
    parse = build_parser(SOUND)
    data = message(1).SerializeToString()
    for cut in range(1, len(data)):
        try:
            parse(data[:cut])
        except LogError as error:
            assert str(error).startswith("A message of topic /ft is no cell.Wrench: it is damaged")  # noqa: PT017
    with pytest.raises(LogError, match="it is damaged"):
        parse(data[:-1])
    with pytest.raises(LogError, match="holds fields that its descriptors do not define"):
        parse(data + b"\x28\x01")
    nested = bytes([0x12, 2, 0x28, 1])
    with pytest.raises(LogError, match="holds fields that its descriptors do not define"):
        parse(nested)


def test_a_required_field_must_be_there() -> None:
    needs = file_of("a.proto", {"A": [("v", MUST, DOUBLE, "")]})
    parse = build_parser(channel_of(set_of(needs), "cell.A"))
    parsed: Any = parse(b"\x09" + np.float64(2.5).tobytes())
    assert parsed.v == 2.5
    with pytest.raises(LogError, match=r"lacks a required field|is damaged"):
        parse(b"")


@settings(max_examples=300, deadline=None)
@given(data=st.binary(max_size=80))
def test_any_bytes_are_read_or_refused(data: bytes) -> None:
    parse = build_parser(SOUND)
    try:
        parse(data)
    except LogError as error:
        assert "\n" not in str(error)  # noqa: PT017 - some inputs are messages


@settings(max_examples=200, deadline=None)
@given(place=st.integers(0, len(SOUND.schema) - 1), bit=st.integers(0, 7))
def test_a_flipped_bit_in_the_descriptors_raises_nothing_else(place: int, bit: int) -> None:
    schema = bytearray(SOUND.schema)
    schema[place] ^= 1 << bit
    try:
        build_parser(replace(SOUND, schema=bytes(schema)))(message(1).SerializeToString())
    except LogError as error:
        assert "\n" not in str(error)  # noqa: PT017 - a name in the descriptors may be any
