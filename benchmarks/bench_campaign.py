"""A campaign on one and two workers beside a plain pool of processes that calls `identify_log`, and what a task costs.

`python benchmarks/bench_campaign.py` writes `--logs 40` logs of the simulated cell, of 69 s as the demo's or with
`--short` of 29 s, and identifies each, by one worker, by two, by two campaigns of one worker each that share their
state, as two hosts would, and by `concurrent.futures` alone with two; then the same campaign again, of which nothing is
missing; and hundreds of runs that are refused at once, which is what the machinery around them takes, without the start
of the worker, which is that of one such run, and with the folder of files that a run which is not refused writes.
Processor time stands beside: on a busy machine it says whether two workers do no more work than one. Memory is the
largest of any worker. `--storage` keeps the state there instead of in a SQLite file.
"""

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as the command line does

import argparse
import sys
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from contextlib import suppress
from multiprocessing import active_children, get_context
from pathlib import Path
from threading import Thread

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from autotune.campaign.manifest import read_manifest
from autotune.campaign.options import RunOptions
from autotune.campaign.run import work_on_runs
from autotune.formats.atomic import write_folder_atomic
from autotune.pipeline import identify_log
from autotune.simulation.phases import Program
from autotune.simulation.simulate import simulate_cell
from autotune.simulation.truth import SimulatedCell
from autotune.simulation.write import write_mcap

_SHORT = Program(pose_count=6, pose_hold_s=0.7, pose_move_s=0.6, jogging_s=0.0, sweep_s=5.0, contact_count=2)
_LOOK_S = 0.2
_IDENTIFY = RunOptions(optimize=False)


def _identify(log: Path) -> float:
    value = identify_log(log).result.payload.mass_kg.value
    assert value is not None
    return value


def _write_logs(folder: Path, count: int, program: Program) -> None:
    for seed in range(count):
        cell = folder / f"cell{seed:03d}"
        cell.mkdir(parents=True)
        write_mcap(simulate_cell(SimulatedCell(), program, seed=seed).recording, cell / "run.mcap")


def _write_refused(folder: Path, count: int) -> None:
    for number in range(count):
        cell = folder / f"cell{number:03d}"
        cell.mkdir(parents=True)
        (cell / "run.csv").write_text(f"t,a\n0,{number}\n1,2\n", encoding="utf-8")


def _timed(name: str, logs: Path, out: Path, jobs: int, storage: str | None, campaigns: int = 1) -> float:
    before, begun = _spent_s(), time.perf_counter()
    runs = read_manifest(logs)
    with ThreadPoolExecutor(campaigns) as hosts:
        asked = [hosts.submit(work_on_runs, runs, out, _IDENTIFY, jobs=jobs, storage=storage) for _ in range(campaigns)]
        outcomes = next(each.result() for each in asked)
    took = time.perf_counter() - begun
    good = sum(not each.refused for each in outcomes)
    print(f"{name}: {took:.2f} s, {_spent_s() - before:.2f} s of processor, {good} of {len(outcomes)} identified")
    return took


def _folder_s(folder: Path, count: int = 100) -> float:
    """Return how long a folder with a file as long as an identified.yaml takes."""
    begun = time.perf_counter()
    for number in range(count):
        write_folder_atomic(folder / str(number), {"identified.yaml": "a: 1\n" * 5000})
    return (time.perf_counter() - begun) / count


class _Memory(Thread):
    """Looks at the workers' peaks of resident memory, without what their parent had before they began."""

    def __init__(self) -> None:
        super().__init__(daemon=True)
        self.largest_mb = 0.0

    def run(self) -> None:
        while True:
            for child in (each.pid for each in active_children()):
                with suppress(OSError):
                    lines = Path(f"/proc/{child}/status").read_text(encoding="utf-8").splitlines()
                    peaks = (1.024e-3 * float(line.split()[1]) for line in lines if line.startswith("VmHWM:"))
                    self.largest_mb = max(self.largest_mb, *peaks, 0.0)
            time.sleep(_LOOK_S)


def _spent_s() -> float:
    times = os.times()
    return times.user + times.system + times.children_user + times.children_system


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--logs", type=int, default=40, help="how many logs")
    parser.add_argument("--short", action="store_true", help="logs of 29 s, of which the start of a worker is more")
    parser.add_argument("--refused", type=int, default=400, help="how many runs that end at once")
    parser.add_argument("--storage", help="URL of the state")
    options = parser.parse_args()
    at = options.storage
    with tempfile.TemporaryDirectory() as made:
        folder = Path(made)
        _write_logs(folder / "logs", options.logs, _SHORT if options.short else Program())
        _write_refused(folder / "refused", options.refused)
        _write_refused(folder / "alone", 1)
        _identify(folder / "logs" / "cell000" / "run.mcap")  # kernels are compiled once
        memory = _Memory()
        memory.start()
        one = _timed("campaign, one worker", folder / "logs", folder / "one", 1, at)
        two = _timed("campaign, two workers", folder / "logs", folder / "two", 2, at)
        shared = _timed("two campaigns, one worker each", folder / "logs", folder / "shared", 1, at, campaigns=2)
        begun = time.perf_counter()
        with ProcessPoolExecutor(2, mp_context=get_context("spawn")) as pool:
            list(pool.map(_identify, sorted((folder / "logs").glob("*/run.mcap"))))
        peer = time.perf_counter() - begun
        print(f"concurrent.futures alone, two workers: {peer:.2f} s")
        _timed("campaign again, nothing missing", folder / "logs", folder / "two", 2, at)
        start = _timed("1 run refused at once, one worker", folder / "alone", folder / "nothing", 1, at)
        refused = _timed(
            f"{options.refused} runs refused at once, one worker", folder / "refused", folder / "none", 1, at
        )
        again = _timed("the same again", folder / "refused", folder / "none", 1, at)
        print(f"two workers are {one / two:.2f} times as fast as one; {two / peer:.2f} of the time of the pool alone")
        print(f"two campaigns are {one / shared:.2f} times as fast as one")
        each, new = 1e3 / options.refused, 1e3 / (options.refused - 1)
        (folder / "files").mkdir()
        print(
            f"a task costs {new * (refused - start):.1f} ms, its files {1e3 * _folder_s(folder / 'files'):.1f} ms",
            end=", ",
        )
        print(f"one that is done {each * again:.2f} ms; a worker starts in {start:.1f} s")
        print(f"largest worker: {memory.largest_mb:.0f} MB")
    return 0


if __name__ == "__main__":
    sys.exit(main())
