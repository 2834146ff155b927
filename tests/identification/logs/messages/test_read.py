"""The compiled reader against two other libraries, on messages of any content."""

from dataclasses import replace
from functools import reduce
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap_ros2._dynamic import generate_dynamic

from identification.errors import LogError
from identification.logs.containers.channel import Batch, Channel
from identification.logs.messages.decode import Series, Wanted, build_program, parse_path
from identification.logs.messages.objects import ObjectDecoder, build_decoder
from tests.identification.logs.messages.message_builder import (
    ADMITTANCE,
    ENCODINGS,
    MIXED,
    Encoding,
    MemoryContainer,
    RandomMessages,
    batch_of,
    channel_of,
    deserialise,
    number_paths,
    read_series,
    serialise,
    store_of,
)

LAW = settings(deadline=None, max_examples=60)
TYPES = {
    "geometry_msgs/msg/WrenchStamped": "header",
    "geometry_msgs/msg/PoseStamped": "header",
    "geometry_msgs/msg/TwistStamped": "header",
    "geometry_msgs/msg/TransformStamped": "header",
    "geometry_msgs/msg/Wrench": "",
    "sensor_msgs/msg/JointState": "header",
    "std_msgs/msg/Float64MultiArray": "",
    ADMITTANCE: "wrench_base.header",
    MIXED: "header",
}
ENTRIES = 3
SEEDS = st.integers(0, 2**32 - 1)


def read_one(channel: Channel, messages: list[bytes], wanted: Wanted) -> Series:
    return read_series(MemoryContainer((batch_of(channel, messages),)), {channel: wanted})[channel]


def pick(message: Any, path: str) -> Any:
    return reduce(lambda thing, token: thing[token] if isinstance(token, int) else getattr(thing, token),
                  parse_path(path), message)  # fmt: skip


def same(first: Any, second: Any) -> bool:
    """Tell whether two arrays hold the same doubles; which NaN a float32 NaN becomes is left open."""
    return np.array_equal(first, second, equal_nan=True)


@LAW
@given(st.sampled_from(sorted(TYPES)), st.sampled_from(ENCODINGS), SEEDS, st.integers(1, 4))
def test_every_number_of_a_type_is_what_rosbags_reads(
    type_name: str, encoding: Encoding, seed: int, count: int
) -> None:
    channel, random = channel_of(type_name, encoding), RandomMessages(seed, encoding, ENTRIES)
    messages = [serialise(random.message(type_name), type_name, encoding) for _ in range(count)]
    header = TYPES[type_name]
    every = number_paths(store_of(encoding), type_name, ENTRIES)
    fields = tuple(path for path in every if not header or not path.startswith(f"{header}."))
    wanted = Wanted(fields=fields, header=header)

    series = read_one(channel, messages, wanted)

    assert build_program(channel, wanted) is not None
    oracle = [deserialise(message, type_name, encoding) for message in messages]
    expected = np.array([[float(pick(message, field)) for field in fields] for message in oracle])
    assert same(series.values, expected.reshape(count, len(fields)))
    if wanted.header:
        headers = [pick(message, wanted.header) for message in oracle]
        assert series.stamp_ns is not None
        assert series.stamp_ns.tolist() == [h.stamp.sec * 10**9 + h.stamp.nanosec for h in headers]
        assert series.frame_ids == tuple(sorted({h.frame_id for h in headers}))
    else:
        assert series.stamp_ns is None
        assert series.frame_ids == ()


@LAW
@given(st.sampled_from(sorted(TYPES)), st.booleans(), SEEDS)
def test_doubles_are_bit_for_bit_those_of_the_ros_2_library_for_mcap(type_name: str, little: bool, seed: int) -> None:
    encoding: Encoding = "little" if little else "big"
    channel, random = channel_of(type_name, encoding), RandomMessages(seed, encoding, ENTRIES)
    message = serialise(random.message(type_name), type_name, encoding)
    store = store_of(encoding)
    fields = tuple(number_paths(store, type_name, ENTRIES))

    series = read_one(channel, [message], Wanted(fields=fields, header=""))

    oracle = generate_dynamic(type_name, channel.schema.decode())[type_name](message)
    expected = np.array([[float(pick(oracle, field)) for field in fields]])
    assert same(series.values, expected)
    whole = [index for index in range(len(fields)) if np.isfinite(expected[0, index])]
    assert series.values[:, whole].tobytes() == expected[:, whole].tobytes()


@LAW
@given(st.sampled_from(sorted(TYPES)), st.sampled_from(ENCODINGS), SEEDS, st.data())
def test_any_choice_of_fields_gives_the_columns_of_all_of_them(
    type_name: str, encoding: Encoding, seed: int, data: st.DataObject
) -> None:
    channel, random = channel_of(type_name, encoding), RandomMessages(seed, encoding, ENTRIES)
    messages = [serialise(random.message(type_name), type_name, encoding) for _ in range(3)]
    every = tuple(number_paths(store_of(encoding), type_name, ENTRIES))
    chosen = tuple(data.draw(st.lists(st.sampled_from(every), max_size=6, unique=True)))

    some = read_one(channel, messages, Wanted(fields=chosen, header=""))

    whole = read_one(channel, messages, Wanted(fields=every, header=""))
    assert same(some.values, whole.values[:, [every.index(field) for field in chosen]])


@LAW
@given(st.sampled_from(sorted(TYPES)), st.sampled_from(ENCODINGS), SEEDS)
def test_sequences_of_any_length_are_passed_over(type_name: str, encoding: Encoding, seed: int) -> None:
    channel, random = channel_of(type_name, encoding), RandomMessages(seed, encoding)
    messages = [serialise(random.message(type_name), type_name, encoding) for _ in range(4)]
    header = TYPES[type_name]
    every = number_paths(store_of(encoding), type_name, 0)
    wanted = Wanted(fields=tuple(path for path in every if not path.startswith(header or " ")), header=header)

    batch = batch_of(channel, messages)
    compiled, plain = build_decoder(channel, wanted)(batch), ObjectDecoder(channel, wanted)(batch)

    assert same(compiled.values, plain.values)
    assert compiled.frame_ids == plain.frame_ids
    assert (compiled.stamp_ns is None) == (plain.stamp_ns is None)
    if compiled.stamp_ns is not None and plain.stamp_ns is not None:
        assert compiled.stamp_ns.tolist() == plain.stamp_ns.tolist()


def test_messages_are_put_in_order_of_recording_and_equal_times_stay_in_file_order() -> None:
    channel = channel_of("geometry_msgs/msg/Wrench", "little")
    random = RandomMessages(1, "little")
    messages = [serialise(random.message(channel.type_name), channel.type_name, "little") for _ in range(6)]
    wanted = Wanted(fields=("force.x",), header="")
    in_file = read_one(channel, messages, wanted).values[:, 0]
    first, second = batch_of(channel, messages[:4]), batch_of(channel, messages[4:])
    batches = (
        replace(first, log_ns=np.array([40, 20, 20, 50])),
        replace(second, log_ns=np.array([10, 20])),
    )

    series = read_series(MemoryContainer(batches), {channel: wanted})[channel]

    assert series.log_ns.tolist() == [10, 20, 20, 20, 40, 50]
    assert same(series.values[:, 0], in_file[[4, 1, 2, 5, 0, 3]])


def test_a_type_that_the_log_defines_otherwise_is_read_by_its_own_definition() -> None:
    text = (
        "std_msgs/Header header\ngeometry_msgs/Wrench wrench\n"
        + "=" * 80
        + "\nMSG: geometry_msgs/Wrench\ngeometry_msgs/Vector3 torque\ngeometry_msgs/Vector3 force\n"
        + "=" * 80
        + "\nMSG: geometry_msgs/Vector3\nfloat32 x\nfloat32 y\nfloat32 z\n"
    )
    channel = replace(channel_of("geometry_msgs/msg/WrenchStamped", "little"), schema=text.encode())
    message = b"\0\1\0\0" + np.array([7, 500, 4], "<i4").tobytes() + b"ft0\0" + np.arange(1, 7, dtype="<f4").tobytes()

    series = read_one(channel, [message], Wanted(fields=("wrench.force.x", "wrench.torque.z")))

    assert series.values.tolist() == [[4, 3]]
    assert series.stamp_ns is not None
    assert (series.stamp_ns.tolist(), series.frame_ids) == ([7_000_000_500], ("ft0",))


def test_a_channel_without_messages_gives_an_empty_series() -> None:
    channel = channel_of("geometry_msgs/msg/WrenchStamped", "little")
    series = read_series(MemoryContainer(()), {channel: Wanted(fields=("wrench.force.x", "wrench.force.y"))})[channel]
    assert series.values.shape == (0, 2)
    assert series.stamp_ns is not None
    assert series.stamp_ns.size == series.log_ns.size == 0


def test_hundreds_of_frame_names_are_all_found() -> None:
    channel = channel_of("geometry_msgs/msg/PoseStamped", "little")
    random = RandomMessages(5, "little")
    messages, names = [], []
    for index in range(300):
        message = random.message(channel.type_name)
        message.header.frame_id = f"frame_{index % 250}"
        names.append(message.header.frame_id)
        messages.append(serialise(message, channel.type_name, "little"))
    assert read_one(channel, messages, Wanted(fields=())).frame_ids == tuple(sorted(set(names)))


@pytest.mark.parametrize(
    ("type_name", "wanted", "complaint"),
    [
        ("geometry_msgs/msg/Wrench", Wanted(fields=("force.w",), header=""), "has no 'w', only x, y, z"),
        ("geometry_msgs/msg/Wrench", Wanted(fields=("force",), header=""), "Vector3 is no number"),
        ("geometry_msgs/msg/Wrench", Wanted(fields=("force.x.y",), header=""), "nothing inside"),
        ("geometry_msgs/msg/Wrench", Wanted(fields=("force[0]",), header=""), "has no 0"),
        ("geometry_msgs/msg/Wrench", Wanted(fields=("force.x",)), "has no 'header'"),
        ("geometry_msgs/msg/WrenchStamped", Wanted(fields=(), header="wrench"), "is no std_msgs/msg/Header"),
        ("sensor_msgs/msg/JointState", Wanted(fields=("effort",)), "a sequence is no number"),
        ("sensor_msgs/msg/JointState", Wanted(fields=("effort.x",)), "entries like"),
        ("sensor_msgs/msg/JointState", Wanted(fields=("effort[0].x",)), "nothing inside"),
        ("sensor_msgs/msg/JointState", Wanted(fields=("header.frame_id",), header=""), "a string is no number"),
        (MIXED, Wanted(fields=("g[3]",)), "array of 3 entries has no 3"),
        (MIXED, Wanted(fields=("g",)), "an array is no number"),
        (MIXED, Wanted(fields=("g..x",)), "is no path to a number"),
        (MIXED, Wanted(fields=("[3]",)), "is no path to a number"),
        (MIXED, Wanted(fields=(".a",)), "is no path to a number"),
        (MIXED, Wanted(fields=("g[01]",)), "is no path to a number"),
        (MIXED, Wanted(fields=("a", "h", "a")), "a of topic /topic is wanted twice"),
    ],
)
def test_what_a_type_does_not_have_is_refused_before_anything_is_read(
    type_name: str, wanted: Wanted, complaint: str
) -> None:
    with pytest.raises(LogError, match=complaint.replace("[", r"\[")):
        build_decoder(channel_of(type_name, "little"), wanted)


def test_a_stamp_that_is_also_wanted_as_numbers_is_both() -> None:
    channel = channel_of("geometry_msgs/msg/WrenchStamped", "little")
    message = RandomMessages(4, "little").message(channel.type_name)
    data = serialise(message, channel.type_name, "little")
    series = read_one(channel, [data], Wanted(fields=("header.stamp.nanosec", "wrench.force.x")))
    assert same(series.values, np.array([[message.header.stamp.nanosec, message.wrench.force.x]]))
    assert series.stamp_ns is not None
    assert series.stamp_ns[0] % 10**9 == message.header.stamp.nanosec


def test_a_number_inside_a_sequence_of_messages_is_read_through_the_library() -> None:
    channel = channel_of(MIXED, "little")
    random = RandomMessages(3, "little", ENTRIES)
    message = random.message(MIXED)
    wanted = Wanted(fields=("several[2].last", "several[0].points[1].y", "pair[1].data[2]"))
    assert build_program(channel, wanted) is None
    series = read_one(channel, [serialise(message, MIXED, "little")], wanted)
    expected = [message.several[2].last, message.several[0].points[1].y, message.pair[1].data[2]]
    assert same(series.values[0], np.array(expected, dtype=np.float64))


def test_a_batch_may_be_decoded_again_and_its_times_are_copied() -> None:
    channel = channel_of("geometry_msgs/msg/Wrench", "little")
    message = serialise(RandomMessages(1, "little").message(channel.type_name), channel.type_name, "little")
    batch: Batch = batch_of(channel, [message])
    decoder = build_decoder(channel, Wanted(fields=("force.x",), header=""))
    first = decoder(batch)
    batch.log_ns[0] = 99
    assert first.log_ns.tolist() == [0]
    assert same(decoder(batch).values, first.values)
