"""What the runtime notices: what was fed, which fault followed, what was commanded, in Python and in the exported C.

Usage: python benchmarks/bench_abuse.py [CONTROLLER] [--ticks 1000000] [--seed 0] [--sanitize]

Without CONTROLLER it is the demo's, which takes a minute. With `--ticks` the table is followed by random readings with
faults among them, which Python and C must answer with the same bits; `--sanitize` compiles the C with ASan and UBSan,
which then must be preloaded (ASAN_OPTIONS=detect_leaks=0, since Python itself is not watched):

    LD_PRELOAD="$(gcc -print-file-name=libasan.so) $(gcc -print-file-name=libubsan.so)" python benchmarks/...

Exit code 1: something was not noticed, or differs.
"""

import argparse
import math
import shutil
import sys
import tempfile
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from autotune.export.c_source import render_c
from autotune.formats.limits import CollisionResponse
from autotune.runtime import AXES, START, AxisLimits, Command, Fault, Limits, RuntimeController, rearm, step
from autotune.runtime.load import read_law
from benchmarks.abuse_cases import CASES, Case, Cell, Fed, random_episodes
from tests.autotune.export.c_twin import Twin, compile_c, numbers
from tests.autotune.runtime.cases import random_runtime

SANITIZERS = ("-fsanitize=address,undefined", "-fno-sanitize-recover=all")
# Narrow, so that random readings break every one of them.
NARROW = Limits(
    force_n=400.0,
    torque_n_m=100.0,
    axes=dict.fromkeys(AXES, AxisLimits(speed=1.0, acceleration=1000.0)),
    pose_speed_m_s=1.0,
    pose_speed_rad_s=5.0,
    stale_wrench_s=0.008,
    stale_pose_s=0.02,
    rest_samples=4,
    rest_force_n=2.0,
    rest_torque_n_m=1.0,
)


def row_of(command: Command) -> bytes:
    """Return everything in a command as bits."""
    status = (command.missing_mass_kg, command.is_started, command.phase, command.fault)
    return np.array([*command.increment_S, *command.twist_S, *command.wrench_S, *status], dtype=np.float64).tobytes()


def compiled(controller: RuntimeController, folder: Path, name: str = "cell", *flags: str) -> Twin:
    """Export, compile with every warning an error, and load."""
    done = compile_c(render_c(controller, name, {}), folder, name, *flags)
    if done.returncode or done.stderr:
        raise RuntimeError(done.stderr)
    return Twin(folder / f"{name}.so", name)


@dataclass(frozen=True, kw_only=True)
class Row:
    """One line of the table: what came of it in Python, and which fault in C, with the same bits or not."""

    fed: Fed
    c_fault: Fault | None
    same: bool

    @property
    def is_noticed(self) -> bool:
        """Whether the fault is an expected one, in both the same."""
        expected = (self.fed.case.fault, *self.fed.case.or_else)
        return self.fed.fault in expected and (self.c_fault is None or self.c_fault is self.fed.fault)


def run_case(controller: RuntimeController, case: Case, twin: Twin | None) -> Row:
    """Feed one case to Python, and the same readings to C; the robot follows Python's command."""
    cell, state, same, c_fault = Cell(controller, case), START, True, None
    fault, after, fastest, begun = Fault.NONE, math.nan, 0.0, 0.0
    missing = 0.0
    if twin is not None:
        twin.start(at_rest=False)
    for reading in cell.readings():
        if cell.time_s < 0.0:
            begun = cell.command
        state, command = step(controller, state, **reading.arguments())  # type: ignore[arg-type]  # lists of numbers
        if twin is not None:
            answer = twin.step(reading)
            same = same and numbers(answer).tobytes() == row_of(command)
            c_fault = Fault(answer.fault)
        if fault is Fault.NONE and command.fault is not Fault.NONE:
            fault, after, missing = command.fault, cell.time_s, command.missing_mass_kg
        if cell.time_s >= 0.0:
            fastest = max(fastest, abs(command.twist_S[cell.axis]))
        cell.follow(command.increment_S[cell.axis])
    fed = Fed(
        case=case,
        fault=fault,
        after_s=after,
        largest_speed_m_s=fastest,
        way_m=abs(cell.command - begun),
        missing_mass_kg=missing,
    )
    return Row(fed=fed, c_fault=c_fault, same=same)


@dataclass(frozen=True, kw_only=True)
class Compared:
    """How many random periods were compared, which faults were among them, and after how many they differed first."""

    ticks: int
    faults: Counter[Fault]
    differs_at: int | None


def compare_random(ticks: int, seed: int, folder: Path, *flags: str) -> Compared:
    """Step random controllers in Python and C through random readings, each run from the start on."""
    rng, done, faults, number = np.random.default_rng(seed), 0, Counter[Fault](), 0
    responses = list(CollisionResponse)
    while done < ticks:
        controller = random_runtime(rng, responses[number % 3], NARROW)
        twin = compiled(controller, folder, f"cell{number}", *flags)
        episodes, last = random_episodes(controller, rng), min(ticks, done + max(2000, ticks // 20))
        while done < last:
            state = START
            twin.start(at_rest=False)
            for k, reading in enumerate(next(episodes)):
                if k % 50 == 49:
                    state = rearm(state)
                    twin.rearm()
                before = state.fault
                state, command = step(controller, state, **reading.arguments())  # type: ignore[arg-type]
                done += 1
                if numbers(twin.step(reading)).tobytes() != row_of(command):
                    return Compared(ticks=done, faults=faults, differs_at=done)
                if command.fault is not before:
                    faults[command.fault] += 1
        number += 1
    return Compared(ticks=done, faults=faults, differs_at=None)


def print_table(rows: list[Row]) -> None:
    """Print one line per case."""
    print(f"{'fed':<42}{'fault':<17}{'after':>9}{'commanded':>12}{'way':>10}  {'in C':<17}bits")
    for row in rows:
        fed = row.fed
        after = "" if math.isnan(fed.after_s) else ("start" if fed.after_s < 0.0 else f"{1e3 * fed.after_s:.1f} ms")
        c = "not compiled" if row.c_fault is None else ("" if row.c_fault is Fault.NONE else row.c_fault.name)
        name = "" if fed.fault is Fault.NONE else fed.fault.name
        mass = f", {fed.missing_mass_kg:+.2f} kg" if fed.fault in (Fault.RESIDUAL_WRENCH, Fault.OTHER_PAYLOAD) else ""
        verdict = "" if row.is_noticed else "   NOT NOTICED" if fed.fault is Fault.NONE else "   ANOTHER FAULT"
        print(
            f"{fed.case.fed:<42}{name:<17}{after:>9}{fed.largest_speed_m_s:>8.3f} m/s{1e3 * fed.way_m:>7.1f} mm  "
            f"{c:<17}{'same' if row.same else 'DIFFERENT'}{mass}{verdict}"
        )


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("controller", nargs="?", type=Path)
    parser.add_argument("--ticks", type=int, default=0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--sanitize", action="store_true")
    asked = parser.parse_args()
    flags = SANITIZERS if asked.sanitize else ()
    with tempfile.TemporaryDirectory() as work:
        folder = Path(work)
        controller = read_law(asked.controller or _demo(folder))
        twin = compiled(controller, folder, "cell", *flags) if shutil.which("gcc") else None
        rows = [run_case(controller, case, twin) for case in CASES]
        print_table(rows)
        good = all(row.is_noticed and row.same for row in rows)
        if asked.ticks:
            found = compare_random(asked.ticks, asked.seed, folder, *flags)
            counts = ", ".join(f"{fault.name} {count}" for fault, count in sorted(found.faults.items()))
            verdict = "the same bits" if found.differs_at is None else f"DIFFERENT at {found.differs_at}"
            print(f"{found.ticks} random periods in Python and C: {verdict}; faults: {counts}")
            good = good and found.differs_at is None
    return 0 if good else 1


def _demo(folder: Path) -> Path:
    from autotune.demo import run_demo

    return run_demo(folder / "demo").files.controller


if __name__ == "__main__":
    sys.exit(main())
