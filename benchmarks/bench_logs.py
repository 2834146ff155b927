"""Ten minutes of wrench, pose and twist at 1250 Hz (2.25 M messages), beside the bare work and the peer readers.

Usage: python benchmarks/bench_logs.py [--whole] [--seconds 600]

For zstd and lz4: the time to read a file's chunks, unpack them and copy the content into one array (one thread, no
check), ours (counts, CRCs, two threads), rosbags, and mcap with mcap-ros2-support. The two peers read a tenth of the
time, written to a file of its own, and their time is multiplied; with --whole they read all. Every value is compared
with theirs bit for bit. The memory is that of a process that reads the file once, beside the arrays it returns.
"""

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import argparse
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import lz4.frame  # type: ignore[import-untyped]  # the package carries no annotations
import numpy as np
import zstandard
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from numpy.typing import NDArray
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_typestore

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from benchmarks.log_file import TOPICS, write_log
from identification.logs.containers.channel import FileBytes
from identification.logs.containers.mcap_file import McapContainer
from identification.logs.containers.mcap_layout import Walker
from identification.logs.gather import gather
from identification.logs.messages.decode import Wanted, parse_path
from identification.logs.messages.objects import build_decoder

SHARE = 10
FIELDS = {
    "/ft/wrench": tuple(f"wrench.{part}.{axis}" for part in ("force", "torque") for axis in "xyz"),
    "/robot/pose": tuple(f"pose.position.{axis}" for axis in "xyz") + tuple(f"pose.orientation.{a}" for a in "xyzw"),
    "/robot/twist": tuple(f"twist.{part}.{axis}" for part in ("linear", "angular") for axis in "xyz"),
}
Columns = Mapping[str, tuple[NDArray[np.int64], NDArray[np.float64]]]
"""By topic: header stamps (n,) and values (n, k)."""


def main() -> int:
    """Measure and print; return 1 when a value differs or a target is missed."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--whole", action="store_true", help="let the peers read all of the file")
    parser.add_argument("--seconds", type=float, default=600.0, help="length of the log")
    parser.add_argument("--memory-of", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.memory_of is not None:
        return print_memory(options.memory_of)
    with tempfile.TemporaryDirectory() as folder:
        good = [run(Path(folder), name, options.seconds, whole=options.whole) for name in ("zstd", "lz4")]
    return 0 if all(good) else 1


def run(folder: Path, compression: str, seconds: float, *, whole: bool) -> bool:
    """Measure one compression and return whether all targets are met."""
    path = write_log(folder / f"{compression}.mcap", compression, seconds)
    share = 1 if whole else SHARE
    part = path if whole else write_log(folder / f"{compression}_part.mcap", compression, seconds / share)
    read_ours(part)  # compiles what is not compiled yet
    bare, ours = alternate(lambda: read_bare(path), lambda: read_ours(path))
    count = sum(stamps.size for stamps, _ in read_ours(path).values())
    print(f"{compression}: {count} messages, {path.stat().st_size / 1e6:.0f} MB [s]")
    print(f"  {'bare: read, unpack, copy':42} {bare:8.3f}")
    print(f"  {'ours':42} {ours:8.3f}   {ours / bare:6.2f} times the bare work (target: at most 2)")
    good = ours <= 2 * bare
    expected = read_ours(part)
    for name, read, target in (("rosbags", read_rosbags, 20), ("mcap, mcap-ros2-support", read_mcap, 60)):
        start = time.perf_counter()
        found = read(part)
        peer = (time.perf_counter() - start) * share
        same = alike(expected, found)
        scaled = "" if share == 1 else f" (1/{share} of it, times {share})"
        print(
            f"  {name + scaled:42} {peer:8.3f}   ours is {peer / ours:.0f} times faster (target: {target}), "
            f"values {'the same' if same else 'DIFFER'}"
        )
        good = good and same and peer >= target * ours
    command = [sys.executable, str(Path(__file__)), "--memory-of", str(path)]
    print(subprocess.run(command, check=True, capture_output=True, text=True).stdout, end="")
    return good


def alternate(*readers: Callable[[], object], rounds: int = 7) -> list[float]:
    """Return the best time of each reader, run in turn so that what disturbs the machine disturbs all."""
    best = [float("inf")] * len(readers)
    for _ in range(rounds):
        for index, read in enumerate(readers):
            start = time.perf_counter()
            read()
            best[index] = min(best[index], time.perf_counter() - start)
    return best


def read_bare(path: Path) -> NDArray[np.uint8]:
    """Read every chunk, unpack it and copy its content to where it belongs in one array; nothing is checked."""
    file = FileBytes(path)
    chunks = Walker(file).walk().chunks
    out = np.empty(sum(chunk.declared for chunk in chunks), dtype=np.uint8)
    at = 0
    for chunk in chunks:
        packed = file.read(chunk.body, chunk.stored)
        if chunk.compression == "zstd":
            data = zstandard.decompress(packed, max_output_size=chunk.declared)
        else:
            data = lz4.frame.decompress(packed)
        out[at : at + len(data)] = np.frombuffer(data, dtype=np.uint8)
        at += len(data)
    file.close()
    return out


def read_ours(path: Path) -> Columns:
    """Read with this project."""
    with McapContainer(path) as container:
        wanted = {
            held.channel: Wanted(fields=FIELDS[held.channel.topic])
            for held in container.survey().held
            if held.channel.topic in FIELDS
        }
        series = gather(container, {each: build_decoder(each, wanted[each]) for each in wanted}, wanted)
    return {
        channel.topic: (each.stamp_ns, each.values) for channel, each in series.items() if each.stamp_ns is not None
    }


class _Gathered:
    """Stamps and values of each topic while a peer hands over one message after the other."""

    def __init__(self) -> None:
        self._paths = {topic: [parse_path(field) for field in fields] for topic, fields in FIELDS.items()}
        self._stamps: dict[str, list[int]] = {topic: [] for topic in FIELDS}
        self._rows: dict[str, list[list[float]]] = {topic: [] for topic in FIELDS}

    def add(self, topic: str, message: Any) -> None:
        stamp = message.header.stamp
        self._stamps[topic].append(stamp.sec * 10**9 + stamp.nanosec)
        self._rows[topic].append(
            [getattr(getattr(getattr(message, a), b), c) for a, b, c in self._paths[topic]]  # type: ignore[arg-type]
        )

    def finish(self) -> Columns:
        return {topic: (np.array(self._stamps[topic]), np.array(self._rows[topic])) for topic in FIELDS}


def read_rosbags(path: Path) -> Columns:
    """Read with rosbags."""
    store, gathered = get_typestore(Stores.ROS2_HUMBLE), _Gathered()
    with Reader(path) as reader:
        for connection, _, data in reader.messages():
            gathered.add(connection.topic, store.deserialize_cdr(data, connection.msgtype))
    return gathered.finish()


def read_mcap(path: Path) -> Columns:
    """Read with mcap and mcap-ros2-support."""
    gathered = _Gathered()
    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        for _, channel, _, message in reader.iter_decoded_messages():
            gathered.add(channel.topic, message)
    return gathered.finish()


def alike(first: Columns, second: Columns) -> bool:
    """Return whether all stamps and values are the same, bit for bit."""
    return all(
        first[topic][0].tolist() == second[topic][0].tolist()
        and first[topic][1].tobytes() == second[topic][1].tobytes()
        for topic in TOPICS
    )


def print_memory(path: Path) -> int:
    """Read a file once and print by how much the memory of this process grew at its highest."""
    before = status_mib("VmRSS")
    columns = read_ours(path)
    grown = status_mib("VmHWM") - before
    arrays = sum(stamps.nbytes * 2 + values.nbytes for stamps, values in columns.values()) / 2**20
    print(
        f"  memory: at its highest {grown:.0f} MiB more than before, arrays of {arrays:.0f} MiB: "
        f"{grown / arrays:.2f} times (target: at most 3)"
    )
    return 0


def status_mib(name: str) -> float:
    """Return a figure of this process's memory in MiB; `ru_maxrss` would include that of the process it comes from."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) / 1024 for line in lines if line.startswith(f"{name}:"))


if __name__ == "__main__":
    sys.exit(main())
