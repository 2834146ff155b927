"""How long `autotune --help` takes, what `identify` and `optimize` take before they begin to work, and with it.

Usage: python benchmarks/bench_startup.py

An empty interpreter is beside the first, numba alone beside the others; these end where the work would begin, and
their processor time counts. At last both commands on the demo's cell, from start to end. Kernels and the modules' byte
code are compiled before.
"""

import os

os.environ.pop("PYTHONDONTWRITEBYTECODE", None)  # an installation holds byte code

import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from autotune.log import simulate_log

RUNS, WHOLE_RUNS = 15, 5
_ENDED = """
import importlib, os
from autotune.cli.main import main
importlib.import_module({module!r}).{name} = lambda *_, **__: os._exit(0)
main({words!r})
"""
_PLANT = """format: autotune/plant
version: 1
mass: 16
coupling_stiffness: 3.0e5
drag: 630
robot: {bandwidth: 3.2, delay: 0.0024}
environment_stiffness: [2.0e4, 5.0e5]
sample_time: 0.0008
"""


def main() -> int:
    empty = _median([sys.executable, "-c", "pass"], time.perf_counter)
    help_s = _median([sys.executable, "-m", "autotune", "--help"], time.perf_counter)
    print(f"python -c pass        {empty * 1e3:7.1f} ms")
    print(f"autotune --help       {help_s * 1e3:7.1f} ms   ({help_s / empty:.1f} times the empty interpreter)")
    with tempfile.TemporaryDirectory() as made:
        log, plant = Path(made) / "run.mcap", Path(made) / "plant.yaml"
        log.write_bytes(b"\x89MCAP0\r\n")
        plant.write_text(_PLANT, encoding="utf-8")
        identify = ["identify", str(log), "-o", f"{made}/identified.yaml"]
        optimize = ["optimize", str(plant), "-o", f"{made}/controller.yaml"]
        for name, code in (
            ("import numba", "import numba"),
            ("autotune identify", _ended("autotune.pipeline", "identify_log", identify)),
            ("autotune optimize", _ended("autotune.tuning.optimize", "optimize", optimize)),
        ):
            print(f"{name:21} {_median([sys.executable, '-c', code], _children_s) * 1e3:7.1f} ms of processor")
        _print_demo(Path(made))
    return 0


def _print_demo(made: Path) -> None:
    """Print what `identify` and `optimize` of the demo's cell take."""
    simulate_log(made / "demo.mcap")
    identify = [sys.executable, "-m", "autotune", "identify", f"{made}/demo.mcap", "-o", f"{made}/demo.yaml"]
    optimize = [sys.executable, "-m", "autotune", "optimize", f"{made}/demo.yaml", "-o", f"{made}/tuned.yaml"]
    for name, command in (("identify, demo", identify), ("optimize, demo", optimize)):
        print(f"{name:21} {_median(command, _children_s, WHOLE_RUNS):7.2f} s of processor")


def _ended(module: str, name: str, words: list[str]) -> str:
    return _ENDED.format(module=module, name=name, words=words)


def _median(command: list[str], clock: Callable[[], float], runs: int = RUNS) -> float:
    _once(command, clock)  # which compiles what is not yet
    return statistics.median(_once(command, clock) for _ in range(runs))


def _once(command: list[str], clock: Callable[[], float]) -> float:
    begin = clock()
    subprocess.run(command, check=True, capture_output=True)
    return clock() - begin


def _children_s() -> float:
    times = os.times()
    return times.children_user + times.children_system


if __name__ == "__main__":
    sys.exit(main())
