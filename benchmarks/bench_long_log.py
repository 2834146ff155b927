"""Memory and time of what reads a log over the log's length, beside a plain pass over its chunks.

`python benchmarks/bench_long_log.py --hours 1 2 4` writes an MCAP of three channels at 1.25 kHz for each length (1.7 GB
an hour), runs `inspect`, `identify`, `validate --log` and `predict --log` on it, and prints the slope of their memory
over the hours, and what a day would take if it went on so, which it does not (`--hours 24` shows the day): that of all
processes of a command together, what they share counted once (PSS, looked at every tenth of a second), and the largest
that one of them ever had. The controller of the log is one that was optimized for the cell. The peer is the MCAP
library's own pass over the chunks, with their checksums, without a look into any message; wall and processor time of
each command are given in those of a pass right before it.
"""

import os

os.environ.pop("PYTHONDONTWRITEBYTECODE", None)  # an installation holds byte code

import argparse
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
from identification.logs.read import WINDOW_S

_DAY_H = 24.0
_SHORTER_S = 120.0


_LOOK_S = 0.1


def _run(*words: str) -> tuple[float, float, float, float]:
    """Return wall and processor time [s], memory [MiB] of all processes and of the largest one of a command."""
    code = subprocess.run([sys.executable, __file__, "--command", *words], stdout=subprocess.DEVNULL, check=False)
    if code.returncode:
        print(f"{' '.join(words)} ended with {code.returncode}")
    took, spent, together, largest = map(float, Path(words[-1]).read_text(encoding="utf-8").split())
    return took, spent, together, largest


def _command(words: list[str]) -> int:
    """Run a command of autotune in a process that starts no other; write what `_run` returns to the last word."""
    together, begun = 0.0, time.perf_counter()
    with subprocess.Popen([sys.executable, "-m", "autotune", *words[:-1]]) as process:
        while process.poll() is None:
            together = max(together, sum(map(_share_mib, _family(process.pid))))
            time.sleep(_LOOK_S)
    took, used = time.perf_counter() - begun, resource.getrusage(resource.RUSAGE_CHILDREN)
    spent, largest = used.ru_utime + used.ru_stime, used.ru_maxrss / 1024
    Path(words[-1]).write_text(f"{took} {spent} {together} {largest}", encoding="utf-8")
    return process.returncode


def _family(process: int) -> list[int]:
    """Return a process and all that it has started."""
    try:
        started = [path.read_text() for path in Path(f"/proc/{process}/task").glob("*/children")]
    except OSError:
        return []
    return [process, *(each for child in " ".join(started).split() for each in _family(int(child)))]


def _share_mib(process: int) -> float:
    """Return the memory of a process, of what it shares with others its share; 0 where it is gone."""
    try:
        lines = Path(f"/proc/{process}/smaps_rollup").read_text().splitlines()
    except OSError:
        return 0.0
    return sum(int(line.split()[1]) for line in lines if line.startswith("Pss:")) / 1024


def _tuned_cell(path: Path, folder: Path, said: str) -> SimulatedCell:
    """Return the cell under a controller that was optimized for it, which is written; its log of minutes is at `path`.

    What `identify` shows of that is written too.
    """
    write_long_log(path, 60.0, [SimulatedCell()])
    _run("identify", str(path), "-o", f"{folder}/identified.yaml", said)
    _run("optimize", f"{folder}/identified.yaml", "-o", f"{folder}/controller.yaml", said)
    law = admittance_controller(read_controller(folder / "controller.yaml").controller, "x")
    return SimulatedCell(controller=law)


def _pass(path: Path) -> tuple[float, float]:
    """Return wall and processor time [s] of the peer's pass."""
    wall, begun = time.perf_counter(), time.process_time()
    with path.open("rb") as file:
        for record in StreamReader(file, emit_chunks=True, validate_crcs=True).records:
            if isinstance(record, Chunk):
                len(record.data)
    return time.perf_counter() - wall, time.process_time() - begun


def main() -> int:
    if sys.argv[1:2] == ["--command"]:
        return _command(sys.argv[2:])
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--hours", type=float, nargs="+", default=[0.5, 1.0, 2.0], help="lengths of the logs, to ten minutes"
    )
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
        memories: dict[str, list[tuple[float, float]]] = {name: [] for name in options.commands or commands}
        lengths = [max(1, round(3600.0 * hours / WINDOW_S)) * WINDOW_S / 3600.0 for hours in options.hours]
        for hours in lengths:
            # The last window is no longer than the others, which would pass for growth: it takes in half a window.
            count = write_long_log(path, 3600.0 * hours - _SHORTER_S, [cell], compression=options.compression)
            print(f"{hours:.3g} h, {path.stat().st_size / 1e9:.2f} GB, {count} messages")
            for name, found in memories.items():
                # Beside each command, as the machine's speed drifts.
                passed, passing = _pass(path)
                wall, spent, *memory = _run(name, *commands[name], said)
                found.append((memory[0], memory[1]))
                print(
                    f"  {name}: {wall:.1f} s, {spent:.1f} s of processor, {wall / passed:.2f} and "
                    f"{spent / passing:.2f} times a pass ({passed:.1f}, {passing:.1f} s), {memory[0]:.0f} MiB, "
                    f"largest process {memory[1]:.0f} MiB",
                    flush=True,
                )
    if len(lengths) > 1:
        for name, found in memories.items():
            (slope, of_one), (start, one) = np.polyfit(lengths, found, 1)
            day, largest = start + _DAY_H * slope, one + _DAY_H * of_one
            print(f"{name}: {slope:+.1f} MiB per hour, for a day {day:.0f} MiB if it went on so;", end=" ")
            print(f"of the largest process {of_one:+.1f}, {largest:.0f} MiB. --hours 24 shows the day")
    return 0


if __name__ == "__main__":
    sys.exit(main())
