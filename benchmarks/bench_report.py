"""How long a report takes beyond the work that it shows, how large its page is, and how soon Chromium has opened it.

Usage: python benchmarks/bench_report.py [--seconds 75 600]

The logs are those of `bench_identify_speed.py`. `identify` runs with and without `--report`, each in a process of its
own; the difference is the report's. The page is opened in Debian's headless Chromium, where there is one.
"""

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import argparse
import shutil
import sys
import tempfile
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from autotune.simulation.simulate import simulate_cell
from autotune.simulation.truth import SimulatedCell
from benchmarks.bench_identify_speed import program_of, run_alone, write_log

_TARGETS_S = {75.0: 3.0, 600.0: 6.0}
_MOST_BYTES, _OPENS_S = 3_000_000, 1.0
_RUNS = 3


def main() -> int:
    """Measure and print; return 1 when a target is missed."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=float, nargs="+", default=[75.0, 600.0], help="lengths of the logs")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        good = [measure(Path(folder), seconds) for seconds in options.seconds]
    return 0 if all(good) else 1


def measure(folder: Path, seconds: float) -> bool:
    """Measure one log and return whether the targets are met."""
    log = write_log(
        folder / f"log{seconds:.0f}.mcap", simulate_cell(SimulatedCell(), program_of(seconds), seed=1).recording
    )
    page = folder / f"log{seconds:.0f}.html"
    bare = [sys.executable, "-m", "autotune", "identify", str(log), "--quiet", "-o", str(folder / "identified.yaml")]
    full = [*bare, "--report", str(page)]
    run_alone(full)  # compiles what is not compiled yet
    # In turns, so that what else the machine does falls on both.
    pairs = [(run_alone(bare), run_alone(full)) for _ in range(_RUNS)]
    without, taken = (min(pair[i].seconds for pair in pairs) for i in (0, 1))
    processor = min(pair[1].processor_s for pair in pairs) - min(pair[0].processor_s for pair in pairs)
    size, opened, target = page.stat().st_size, open_s(page), _TARGETS_S.get(seconds)
    limit = "" if target is None else f" (target: below {target:g})"
    print(f"{seconds:.0f} s: identify {without:.2f} s, with a report {taken:.2f} s")
    print(f"  the report: {taken - without:.2f} s{limit}, of the processors {processor:.2f} s")
    print(f"  the page: {size / 1e6:.2f} MB (target: below {_MOST_BYTES / 1e6:g})")
    print(f"  opened in {'- (no Chromium)' if opened is None else f'{opened:.2f} s (target: below {_OPENS_S:g})'}")
    in_time = target is None or taken - without < target
    return in_time and size < _MOST_BYTES and (opened is None or opened < _OPENS_S)


def open_s(page: Path) -> float | None:
    """Return how long Chromium takes from the address to the loaded page; None without Chromium or its driver."""
    chromium = shutil.which("chromium")
    try:
        from playwright.sync_api import sync_playwright
    except ImportError:
        return None
    if chromium is None:
        return None
    with sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=chromium, args=["--no-sandbox"])
        found = []
        for _ in range(_RUNS):
            tab = browser.new_page(viewport={"width": 1280, "height": 900})
            begin = time.perf_counter()
            tab.goto(page.as_uri(), wait_until="load")
            found.append(time.perf_counter() - begin)
        browser.close()
    return min(found)


if __name__ == "__main__":
    raise SystemExit(main())
