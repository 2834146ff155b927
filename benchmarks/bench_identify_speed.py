"""`autotune identify` from the command line in a process of its own, on 75 s and on ten minutes at 1250 Hz.

Usage: python benchmarks/bench_identify_speed.py [--seconds 75 600] [--logs 4]

The logs hold wrench, measured and commanded pose of the demo cell (poses, hand-led motion, sweep, contacts; the longer
log has more of each) as zstd-compressed CDR. The time is that of the process from start to end, imports included, with
the kernels and the modules' byte code compiled before. The memory is the highest of that process less that of one which
imports the same and starts numba, code that no log makes larger, beside the arrays of the three channels. No peer
identifies a whole cell: what rosbags takes for reading the same messages alone stands beside it. At last several logs
of 75 s, recorded an hour apart: on one processor, and on all.
"""

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)  # an installation holds byte code

import argparse
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from mcap.writer import CompressionType, Writer
from numpy.typing import NDArray
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_typestore

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from autotune.simulation.phases import Program
from autotune.simulation.simulate import made_later, simulate_cell
from autotune.simulation.truth import SimulatedCell
from identification.signals.recording import PoseSignal, Recording, WrenchSignal

_TARGETS_S = {75.0: 5.0, 600.0: 20.0}
_MEMORY_TIMES = 5.0
_TOGETHER_S = 75.0
_FIXED_S, _CONTACT_S = 30.0, 4.7
_IMPORTS = "import autotune.cli.main, autotune.pipeline, autotune.formats.identified"
_START = f"{_IMPORTS}, numba; numba.njit(lambda x: x + 1.0)(1.0)"


def main() -> int:
    """Measure and print; return 1 when a target is missed."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=float, nargs="+", default=[75.0, 600.0], help="lengths of the logs")
    parser.add_argument("--logs", type=int, default=4, help="how many logs are identified side by side")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        imports = run_alone([sys.executable, "-c", _IMPORTS]).peak_mib
        bare = run_alone([sys.executable, "-c", _START]).peak_mib
        print(f"a process that only imports: {imports:.0f} MiB at its highest, with numba started {bare:.0f} MiB")
        good = [measure(Path(folder), seconds, bare) for seconds in options.seconds]
        measure_together(Path(folder), options.logs)
    return 0 if all(good) else 1


def measure(folder: Path, seconds: float, bare_mib: float) -> bool:
    """Measure one log and return whether the targets are met."""
    recording = simulate_cell(SimulatedCell(), program_of(seconds), seed=1).recording
    path = write_log(folder / f"log{seconds:.0f}.mcap", recording)
    signals = signals_of(recording)
    count = sum(len(s.stamp_ns) for s in signals)
    # Stamps of header and recorder, and the numbers.
    arrays_mib = sum(len(s.stamp_ns) * 8 * (2 + width(s)) for s in signals) / 2**20
    lasts = float(recording.wrench.stamp_ns[-1] - recording.wrench.stamp_ns[0]) * 1e-9
    command = [sys.executable, "-m", "autotune", "identify", str(path), "--quiet", "-o", str(folder / "out.yaml")]
    run_alone(command)  # compiles what is not compiled yet
    runs = [run_alone(command) for _ in range(2)]
    taken, peak = min(run.seconds for run in runs), max(run.peak_mib for run in runs)
    processor = min(run.processor_s for run in runs)
    start = time.perf_counter()
    read_rosbags(path)
    peer = time.perf_counter() - start
    target = _TARGETS_S.get(seconds)
    times = (peak - bare_mib) / arrays_mib
    print(f"{lasts:.0f} s at 1250 Hz, {count} messages, {path.stat().st_size / 1e6:.0f} MB")
    limit = "" if target is None else f" (target: at most {target:g})"
    print(f"  autotune identify: {taken:.2f} s{limit}, of the processors {processor:.2f} s")
    print(f"  rosbags, reading alone: {peer:.2f} s, {peer / taken:.2f} of it")
    print(
        f"  memory: {peak:.0f} MiB at its highest, {peak - bare_mib:.0f} more than imports and numba, arrays of "
        f"{arrays_mib:.0f} MiB: {times:.1f} times (target: at most {_MEMORY_TIMES:g})"
    )
    return (target is None or taken <= target) and times <= _MEMORY_TIMES


def measure_together(folder: Path, count: int) -> None:
    """Measure several logs of the same cell, one after the other and side by side."""
    logs = []
    for hour in range(count):
        recording = simulate_cell(SimulatedCell(), program_of(_TOGETHER_S), seed=hour).recording
        logs.append(str(write_log(folder / f"hour{hour}.mcap", made_later(recording, hour))))
    # Logs of different seeds may disagree on a parameter; that is no matter here.
    command = [sys.executable, "-m", "autotune", "identify", *logs, "--quiet", "--allow-partial"]
    command += ["-o", str(folder / "out.yaml")]
    processors = sorted(os.sched_getaffinity(0))
    several = run_alone(command).seconds
    os.sched_setaffinity(0, processors[:1])
    single = run_alone(command).seconds
    os.sched_setaffinity(0, processors)
    print(f"{count} logs of {_TOGETHER_S:g} s: {single:.2f} s on one processor, {several:.2f} s on {len(processors)}")


def program_of(seconds: float) -> Program:
    """Return a program of about that length: the demo's, with more contacts, hand-led motion and sweep."""
    rest = max(seconds - _FIXED_S, 0.0)
    contacts = max(3, round(0.45 * rest / _CONTACT_S))
    left = max(rest - contacts * _CONTACT_S, 10.0)
    return Program(contact_count=contacts, jogging_s=0.45 * left, sweep_s=0.55 * left)


@dataclass(frozen=True, kw_only=True)
class Cost:
    """What a process took: time on the wall, time of all processors, memory at its highest."""

    seconds: float
    processor_s: float
    peak_mib: float


def run_alone(command: Sequence[str]) -> Cost:
    """Run a command and return what it took.

    The memory is asked of the running process: what `wait4` reports begins with that of the process that started it.
    """
    start, before, peak = time.perf_counter(), resource.getrusage(resource.RUSAGE_CHILDREN), 0.0
    with subprocess.Popen(command, stdout=subprocess.DEVNULL) as process:
        while process.poll() is None:
            peak = max(peak, highest_mib(process.pid))
            time.sleep(0.01)
    taken, after = time.perf_counter() - start, resource.getrusage(resource.RUSAGE_CHILDREN)
    if process.returncode:
        raise SystemExit(f"{' '.join(command)} ended with {process.returncode}")
    processor = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return Cost(seconds=taken, processor_s=processor, peak_mib=peak)


def highest_mib(pid: int) -> float:
    """Return the highest memory of a process so far, 0 when it is gone."""
    try:
        lines = Path(f"/proc/{pid}/status").read_text(encoding="ascii").splitlines()
    except (FileNotFoundError, ProcessLookupError):
        return 0.0
    return next((int(line.split()[1]) / 1024 for line in lines if line.startswith("VmHWM:")), 0.0)


def signals_of(recording: Recording) -> list[WrenchSignal | PoseSignal]:
    """Return the channels that the log holds."""
    poses = [pose for pose in (recording.pose, recording.command) if pose is not None]
    return [recording.wrench, *poses]


def width(signal: WrenchSignal | PoseSignal) -> int:
    """Return how many numbers a message has."""
    return 6 if isinstance(signal, WrenchSignal) else 7


def write_log(path: Path, recording: Recording) -> Path:
    """Write all messages as CDR, their bytes by numpy, the file by the MCAP library."""
    store = get_typestore(Stores.ROS2_HUMBLE)
    signals = signals_of(recording)
    with path.open("wb") as stream:
        writer = Writer(stream, compression=CompressionType.ZSTD)
        writer.start(profile="ros2", library="benchmark")
        channels = []
        for signal in signals:
            name = f"geometry_msgs/msg/{'WrenchStamped' if isinstance(signal, WrenchSignal) else 'PoseStamped'}"
            text = store.generate_msgdef(name, ros_version=2)[0].encode()
            schema = writer.register_schema(name=name, encoding="ros2msg", data=text)
            channels.append(writer.register_channel(topic=signal.topic, message_encoding="cdr", schema_id=schema))
        bodies = [cdr(signal) for signal in signals]
        stamps = [signal.stamp_ns.tolist() for signal in signals]
        for i in range(len(stamps[0])):
            for channel, body, stamp in zip(channels, bodies, stamps, strict=True):
                writer.add_message(
                    channel_id=channel, log_time=stamp[i], publish_time=stamp[i], data=body[i].tobytes(), sequence=i
                )
        writer.finish()
    return path


def cdr(signal: WrenchSignal | PoseSignal) -> NDArray[np.void]:
    """Return the messages (n,) as they stand in the file; the frame's name is padded, to align the doubles."""
    name = signal.frame_id.encode() + b"\0"
    # Stamp and length of the name take 12 bytes behind the encapsulation.
    padding = -(12 + len(name)) % 8
    numbers = (
        (signal.force_n, signal.torque_n_m)
        if isinstance(signal, WrenchSignal)
        else (signal.position_m, signal.quaternion_xyzw)
    )
    values = np.hstack(numbers)
    kind = np.dtype(
        [
            ("encapsulation", "u1", 4), ("sec", "<i4"), ("nanosec", "<u4"), ("name_bytes", "<u4"),
            ("name", "u1", len(name)), ("padding", "u1", padding), ("values", "<f8", values.shape[1]),
        ]
    )  # fmt: skip
    out = np.zeros(len(values), dtype=kind)
    out["encapsulation"][:, 1] = 1
    out["sec"], out["nanosec"] = signal.stamp_ns // 10**9, signal.stamp_ns % 10**9
    out["name_bytes"], out["name"], out["values"] = len(name), np.frombuffer(name, dtype=np.uint8), values
    return out


def read_rosbags(path: Path) -> int:
    """Deserialize every message with rosbags and count them."""
    store = get_typestore(Stores.ROS2_HUMBLE)
    with Reader(path) as reader:
        return sum(
            store.deserialize_cdr(data, connection.msgtype) is not None for connection, _, data in reader.messages()
        )


if __name__ == "__main__":
    sys.exit(main())
