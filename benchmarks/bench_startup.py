"""How long `autotune --help` takes, beside an empty interpreter.

Usage: python benchmarks/bench_startup.py
"""

import statistics
import subprocess
import sys
import time

RUNS = 15


def main() -> int:
    empty = _median([sys.executable, "-c", "pass"])
    help_s = _median([sys.executable, "-m", "autotune", "--help"])
    print(f"python -c pass        {empty * 1e3:7.1f} ms")
    print(f"autotune --help       {help_s * 1e3:7.1f} ms   ({help_s / empty:.1f} times the empty interpreter)")
    return 0


def _median(command: list[str]) -> float:
    return statistics.median(_once(command) for _ in range(RUNS))


def _once(command: list[str]) -> float:
    begin = time.perf_counter()
    subprocess.run(command, check=True, capture_output=True)
    return time.perf_counter() - begin


if __name__ == "__main__":
    sys.exit(main())
