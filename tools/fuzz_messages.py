"""Fuzz the compiled reader of messages: whatever the bytes, it says what rosbags says, or refuses, and never strays.

Usage: python tools/fuzz_messages.py [--seconds 60] [--seed 0]

Sound messages of many types are altered: bits flipped, bytes cut, doubled or replaced by lengths that mislead. Each is
read by the compiled kernels, with a check of every index, and by rosbags. It is a fault when the kernels touch a byte
outside of the message's array, take what rosbags refuses (other than for text that was not wanted), read another
number, or refuse without one of the reasons for which they are meant to be stricter. The loop is a plain mutational
one: tools that are guided by coverage see Python code only, and the kernels are none.
"""

import os
import sys
import tempfile
from pathlib import Path

# The kernels are compiled with a check of every index, in a cache of their own.
os.environ["NUMBA_BOUNDSCHECK"] = "1"
os.environ.setdefault("NUMBA_CACHE_DIR", tempfile.mkdtemp(prefix="fuzz_messages_"))
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

import argparse
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from functools import reduce
from typing import Any

import numpy as np
from rosbags.serde import SerdeError

from identification.logs.containers.channel import Batch, Channel
from identification.logs.containers.mcap_kernel import RecordCounter, gather
from identification.logs.messages.decode import MessageError, Series, Wanted, parse_path
from identification.logs.messages.objects import build_decoder
from identification.logs.messages.transforms import FIELDS, build_transform_decoder
from tests.identification.logs.messages.message_builder import (
    ADMITTANCE,
    ENCODINGS,
    MIXED,
    Encoding,
    RandomMessages,
    channel_of,
    deserialise,
    number_paths,
    serialise,
    store_of,
)

TYPES = {
    "geometry_msgs/msg/WrenchStamped": "header",
    "geometry_msgs/msg/PoseStamped": "header",
    "geometry_msgs/msg/TransformStamped": "header",
    "sensor_msgs/msg/JointState": "header",
    "std_msgs/msg/Float64MultiArray": "",
    "tf2_msgs/msg/TFMessage": "",
    ADMITTANCE: "wrench_base.header",
    MIXED: "header",
}
TF = "tf2_msgs/msg/TFMessage"
STRICTER = ("fewer entries than are wanted", "more than 999999999 ns")
"""Reasons for which a message is refused that rosbags takes."""
LENGTHS = np.array([0, 1, 2, 3, 7, 255, 2**16, 2**28, 2**31 - 1, 2**31, 2**32 - 1], dtype=np.uint64)
ENTRIES = 2
Mutate = Callable[[np.random.Generator, bytes], bytes]


class FaultError(Exception):
    """The compiled reader is wrong about a message."""


@dataclass(frozen=True, kw_only=True)
class Target:
    """A type in an encoding, and what decodes it."""

    channel: Channel
    encoding: Encoding
    fields: tuple[str, ...]
    header: str
    decode: Callable[[Batch], Series]


def main() -> int:
    """Fuzz for a while; return 1 and the message when a fault is found."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    random = np.random.default_rng(options.seed)
    targets = [build_target(name, encoding) for name in TYPES for encoding in ENCODINGS]
    check_that_indices_are_checked(targets[0])
    counts: Counter[str] = Counter()
    stop = time.monotonic() + options.seconds
    while time.monotonic() < stop:
        target = targets[random.integers(len(targets))]
        sound = serialise(
            RandomMessages(int(random.integers(2**32)), target.encoding, ENTRIES).message(target.channel.type_name),
            target.channel.type_name,
            target.encoding,
        )
        for _ in range(20):
            data = mutate(random, sound)
            try:
                counts[examine(target, data)] += 1
                counts["records"] += examine_records(random, data)
            except (FaultError, IndexError) as fault:
                print(f"{target.channel.type_name} {target.encoding} {data.hex()}: {fault!r}", file=sys.stderr)
                return 1
    print(", ".join(f"{count} {what}" for what, count in sorted(counts.items())))
    return 0


def build_target(type_name: str, encoding: Encoding) -> Target:
    channel, header = channel_of(type_name, encoding), TYPES[type_name]
    if type_name == TF:
        return Target(
            channel=channel,
            encoding=encoding,
            fields=FIELDS,
            header="header",
            decode=build_transform_decoder(channel, ("", "a")),
        )
    every = number_paths(store_of(encoding), type_name, ENTRIES)
    fields = tuple(path for path in every if not header or not path.startswith(f"{header}."))
    wanted = Wanted(fields=fields, header=header)
    return Target(
        channel=channel, encoding=encoding, fields=fields, header=header, decode=build_decoder(channel, wanted)
    )


def check_that_indices_are_checked(target: Target) -> None:
    """Read beyond the end of an array on purpose, so that a build without checks is not taken for a clean one."""
    try:
        target.decode(batch_of(target.channel, b"\0\1\0\0" + bytes(8), claimed=2**16))
    except IndexError:
        return
    raise SystemExit("The kernels were compiled without a check of their indices.")


def batch_of(channel: Channel, data: bytes, claimed: int | None = None) -> Batch:
    """Put one message into an array that ends where it does."""
    return Batch(
        channel=channel,
        log_ns=np.zeros(1, dtype=np.int64),
        data=np.frombuffer(data, dtype=np.uint8),
        starts=np.zeros(1, dtype=np.int64),
        sizes=np.array([len(data) if claimed is None else claimed], dtype=np.int64),
    )


def mutate(random: np.random.Generator, sound: bytes) -> bytes:
    """Alter a message in one to three places, or now and then not at all."""
    for _ in range(int(random.integers(0, 4))):
        sound = MUTATIONS[random.integers(len(MUTATIONS))](random, sound)
    return sound


def _flip(random: np.random.Generator, data: bytes) -> bytes:
    changed = bytearray(data or b"\0")
    changed[random.integers(len(changed))] ^= 1 << int(random.integers(8))
    return bytes(changed)


def _cut(random: np.random.Generator, data: bytes) -> bytes:
    return data[: random.integers(len(data) + 1)]


def _remove(random: np.random.Generator, data: bytes) -> bytes:
    at = int(random.integers(len(data) + 1))
    return data[:at] + data[at + int(random.integers(1, 9)) :]


def _insert(random: np.random.Generator, data: bytes) -> bytes:
    at = int(random.integers(len(data) + 1))
    return data[:at] + random.bytes(int(random.integers(1, 9))) + data[at:]


def _append(random: np.random.Generator, data: bytes) -> bytes:
    return data + bytes(int(random.integers(1, 6)))


def _length(random: np.random.Generator, data: bytes) -> bytes:
    at = 4 * int(random.integers(len(data) // 4 + 1))
    value = int(random.choice(LENGTHS)) if random.integers(2) else int(random.integers(0, 2 * len(data) + 2))
    order: Any = "little" if random.integers(2) else "big"
    return data[:at] + value.to_bytes(4, order) + data[at + 4 :]


MUTATIONS: tuple[Mutate, ...] = (_flip, _flip, _cut, _remove, _insert, _append, _length, _length)


def examine(target: Target, data: bytes) -> str:
    """Read a message both ways; return how it went, raise FaultError where the compiled way is wrong."""
    refusal, part = "", None
    try:
        part = target.decode(batch_of(target.channel, data))
    except MessageError as error:
        refusal = error.reason
    try:
        oracle = deserialise(data, target.channel.type_name, target.encoding)
    except (SerdeError, MemoryError) as error:
        if part is None or "codec can't decode" in str(error):
            return "refused by both" if part is None else "taken, with text that was not wanted damaged"
        raise FaultError(f"taken, though rosbags refuses it: {error}") from error
    if part is None:
        if any(reason in refusal for reason in STRICTER):
            return "refused, more strictly than by rosbags"
        raise FaultError(f"refused, though rosbags takes it: {refusal}")
    compare(target, part, oracle)
    return "taken by both"


def compare(target: Target, part: Series, oracle: Any) -> None:
    """Raise FaultError unless numbers, stamps and frames are those of rosbags."""
    if target.channel.type_name == TF:
        things = [t for t in oracle.transforms if (t.header.frame_id, t.child_frame_id) == ("", "a")]
        expected = [[pick(thing.transform, path) for path in target.fields] for thing in things]
    else:
        things, expected = [oracle], [[float(pick(oracle, path)) for path in target.fields]]
    values = np.array(expected, dtype=np.float64).reshape(-1, len(target.fields))
    if not np.array_equal(part.values, values, equal_nan=True):
        raise FaultError(f"{part.values} is not {values}")
    if target.header:
        headers = [pick(thing, target.header) for thing in things]
        stamps = [header.stamp.sec * 10**9 + header.stamp.nanosec for header in headers]
        if part.stamp_ns is None or part.stamp_ns.tolist() != stamps:
            raise FaultError(f"{part.stamp_ns} is not {stamps}")
        if {*part.frame_ids} != {header.frame_id for header in headers}:
            raise FaultError(f"{part.frame_ids} are not the frames {headers}")


def pick(thing: Any, path: str) -> Any:
    return reduce(
        lambda at, token: at[token] if isinstance(token, int) else getattr(at, token), parse_path(path), thing
    )


def examine_records(random: np.random.Generator, data: bytes) -> bool:
    """Walk the same bytes as records of a chunk, some behind a sound frame; return whether they were taken."""
    if random.integers(2):
        data = b"\5" + (22 + len(data)).to_bytes(8, "little") + bytes(22) + data
        data = mutate(random, data + data)
    array = np.frombuffer(data, dtype=np.uint8)
    record_counts = RecordCounter().count(array)
    if record_counts.fault:
        return False
    total = sum(record_counts.counts.values())
    table = np.empty((3, total), dtype=np.int64)
    slots = np.zeros(2**16, dtype=np.int64)
    gather(array, 0, array.size, slots, np.zeros(1, dtype=np.int64), *table)
    _, starts, sizes = table
    if total and not (bool(np.all(starts >= 31)) and bool(np.all(starts + sizes <= array.size))):
        raise FaultError("a record reaches beyond its chunk")
    return True


if __name__ == "__main__":
    sys.exit(main())
