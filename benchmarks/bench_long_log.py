"""Memory and time of what reads a log over the log's length, beside a plain pass over its chunks.

`python benchmarks/bench_long_log.py --hours 1 2 4` writes an MCAP of three channels at 1.25 kHz for each length (1.7 GB
an hour), runs `inspect`, `identify`, `validate --log` and `predict --log` on it, and prints the slope of their memory
over the hours, and what a day would take. The controller of the log is one that was optimized for the cell. The
peer is the MCAP library's own pass over the chunks, with their checksums, without a look into any message.
"""

import argparse
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from mcap.records import Chunk
from mcap.stream_reader import StreamReader

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from autotune.formats.controller import read_controller
from autotune.formats.controller_record import admittance_controller
from autotune.simulation.truth import SimulatedCell
from benchmarks.long_log import write_long_log

_DAY_H = 24.0
_SHORTER_S = 120.0


def _run(*words: str) -> tuple[float, float, float]:
    """Return wall time [s], processor time [s] and the largest memory of any process [MiB] of a command."""
    before = os.times()
    begun = time.perf_counter()
    code = subprocess.run([sys.executable, __file__, "--command", *words], stdout=subprocess.DEVNULL, check=False)
    took, after = time.perf_counter() - begun, os.times()
    if code.returncode:
        print(f"{' '.join(words)} ended with {code.returncode}")
    memory = float(Path(words[-1]).read_text(encoding="utf-8"))
    spent = after.children_user + after.children_system - before.children_user - before.children_system
    return took, spent, memory


def _command(words: list[str]) -> int:
    """Run a command of autotune and write the largest memory of it and of its workers to the last word."""
    done = subprocess.run([sys.executable, "-m", "autotune", *words[:-1]], check=False)
    memory = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1024
    Path(words[-1]).write_text(f"{memory}", encoding="utf-8")
    return done.returncode


def _tuned_cell(path: Path, folder: Path, said: str) -> SimulatedCell:
    """Return the cell under a controller that was optimized for it, which is written; its log of minutes is at `path`.

    What `identify` shows of that is written too.
    """
    write_long_log(path, 60.0, [SimulatedCell()])
    _run("identify", str(path), "-o", f"{folder}/identified.yaml", said)
    _run("optimize", f"{folder}/identified.yaml", "-o", f"{folder}/controller.yaml", said)
    law = admittance_controller(read_controller(folder / "controller.yaml").controller, "x")
    return SimulatedCell(controller=law)


def _pass(path: Path) -> float:
    begun = time.perf_counter()
    with path.open("rb") as file:
        for record in StreamReader(file, emit_chunks=True, validate_crcs=True).records:
            if isinstance(record, Chunk):
                len(record.data)
    return time.perf_counter() - begun


def main() -> int:
    if sys.argv[1:2] == ["--command"]:
        return _command(sys.argv[2:])
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--hours", type=float, nargs="+", default=[0.5, 1.0, 2.0], help="lengths of the logs")
    parser.add_argument("--compression", choices=["", "zstd"], default="", help="of the chunks")
    parser.add_argument("--commands", nargs="+", choices=["inspect", "identify", "validate", "predict"])
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as made:
        path, said = Path(made) / "long.mcap", str(Path(made) / "memory.txt")
        cell = _tuned_cell(path, Path(made), said)
        of_controller = [f"{made}/controller.yaml", "--log", str(path)]
        commands = {
            "inspect": [str(path)],
            "identify": [str(path), "-o", f"{made}/identified.yaml"],
            "validate": [*of_controller, "--samples", "0"],
            "predict": [f"{made}/identified.yaml", "--controller", *of_controller],
        }
        memories: dict[str, list[float]] = {name: [] for name in options.commands or commands}
        for hours in options.hours:
            # The last window is no longer than the others, which would pass for growth.
            count = write_long_log(path, 3600.0 * hours - _SHORTER_S, [cell], compression=options.compression)
            print(f"{hours:g} h, {path.stat().st_size / 1e9:.2f} GB, {count} messages; a pass: {_pass(path):.1f} s")
            for name, found in memories.items():
                wall, spent, memory = _run(name, *commands[name], said)
                found.append(memory)
                print(f"  {name}: {wall:.1f} s, {spent:.1f} s of processor, largest process {memory:.0f} MiB")
    if len(options.hours) > 1:
        for name, found in memories.items():
            slope, start = np.polyfit(options.hours, found, 1)
            print(f"{name}: {slope:+.1f} MiB per hour, so a day takes {start + _DAY_H * slope:.0f} MiB")
    return 0


if __name__ == "__main__":
    sys.exit(main())
