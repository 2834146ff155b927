"""What one period of the runtime costs, in Python and as exported C, beside the period of 0.8 ms.

Usage: python benchmarks/bench_runtime.py

Six axes, a tool that moves and turns. The C is compiled with gcc, if there is one, and stepped inside a loop of C.
The imports are measured in processes of their own.
"""

import shutil
import statistics
import subprocess
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from autotune.export.c_source import render_c
from autotune.formats.limits import VariableDampingSettings
from autotune.runtime import (
    AXES,
    START,
    AxisLimits,
    CollisionResponse,
    Limits,
    Payload,
    RuntimeController,
    State,
    step,
)
from benchmarks.timing import best
from tests.autotune.runtime.cases import make_axis

PERIOD_S = 8e-4
STEPS = 2000
C_STEPS = 1_000_000
PROCESSES = 7

# The readings of the loop are those of no cell: only what moves nothing at the start is kept short.
LIMITS = Limits(
    force_n=1e3,
    torque_n_m=1e3,
    axes=dict.fromkeys(AXES, AxisLimits(speed=1e3, acceleration=1e6)),
    pose_speed_m_s=10.0,
    pose_speed_rad_s=10.0,
    stale_wrench_s=0.02,
    stale_pose_s=0.1,
    rest_samples=1,
    rest_force_n=1e3,
    rest_torque_n_m=1e3,
)

VARIED = VariableDampingSettings(
    highest=1800.0, lowest=1200.0, decay_s_per_m=10.0, update_periods=13, largest_change=30.0
)

LOOP = """
#include "cell.h"
#include <stdio.h>
#include <stdlib.h>
#include <time.h>
static cell_reading readings[2];
int main(int count, char **words)
{
    cell_state state;
    cell_command command;
    struct timespec begin, end;
    double s = 1e-4, sum = 0.0;
    long k, steps = count > 1 ? atol(words[1]) : 0;
    for (k = 0; k < 2; ++k) {
        int i;
        for (i = 0; i < 6; ++i) readings[k].wrench_S[i] = k ? 30.0 : -20.0;
        readings[k].has_tick = 1;
        readings[k].R_WS[0] = readings[k].R_WS[4] = readings[k].R_WS[8] = 1.0;
    }
    readings[1].R_WS[1] = -s;
    readings[1].R_WS[3] = s;
    readings[1].position_W_m[0] = s;
    cell_start(&state);
    clock_gettime(CLOCK_MONOTONIC, &begin);
    for (k = 0; k < steps; ++k) {
        readings[k & 1].tick = (uint32_t)k;
        if (cell_step(&state, &cell_file_payload, &readings[k & 1], &command)) return 1;
        sum += command.increment_S[0];
    }
    clock_gettime(CLOCK_MONOTONIC, &end);
    sum *= 0.0; /* used, so that no step is left out */
    sum += (double)(end.tv_sec - begin.tv_sec) + 1e-9 * (double)(end.tv_nsec - begin.tv_nsec);
    printf("%.9g\\n", sum / (double)steps);
    return 0;
}
"""


def main() -> int:
    for what, controller in (("", example()), (", B_a varies", example(VARIED))):
        _print_time(f"Python step{what}", _python_s(controller))
        if shutil.which("gcc") is None:
            print("no gcc: the C was not measured")
        else:
            _print_time(f"C step (gcc -O2){what}", _c_s(controller))
    _print_processes()
    return 0


def example(variable: VariableDampingSettings | None = None) -> RuntimeController:
    """Return a controller of six axes with deadband and collision response; B_a of three of them may vary."""
    plain = (make_axis(name, deadband=5.0, is_subtractive=True) for name in AXES)
    axes = tuple(replace(each, variable_damping=None if each.turns else variable) for each in plain)
    payload = Payload(
        mass_kg=16.0, com_S_m=(0.01, -0.02, 0.1), force_bias_S_n=(1.5, -0.2, 3.0), torque_bias_S_n_m=(0.1, 0.2, -0.3)
    )
    return RuntimeController(
        checksum="0" * 64,
        sample_time_s=PERIOD_S,
        axes=axes,
        response=CollisionResponse.RESET,
        threshold_n=150.0,
        payload=payload,
        limits=LIMITS,
    )


def _python_s(controller: RuntimeController) -> float:
    level, turned = (
        ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)),
        ((1.0, -1e-4, 0.0), (1e-4, 1.0, 0.0), (0.0, 0.0, 1.0)),
    )

    def run() -> None:
        state: State = START
        for k in range(0, STEPS, 2):
            state, _ = step(controller, state, wrench_S=(-20.0,) * 6, position_W_m=(0.0, 0.0, 0.0), R_WS=level, tick=k)
            state, command = step(
                controller, state, wrench_S=(30.0,) * 6, position_W_m=(1e-4, 0.0, 0.0), R_WS=turned, tick=k + 1
            )
        if command.fault:
            raise RuntimeError(command.fault.name)

    return best(run, 5) / STEPS


def _c_s(controller: RuntimeController) -> float:
    with tempfile.TemporaryDirectory() as work:
        text = render_c(replace(controller, checksum="0" * 64), "cell", {})
        for name, content in (("cell.h", text.header), ("cell.c", text.source), ("loop.c", LOOP)):
            (Path(work) / name).write_text(content, encoding="ascii")
        command = ["gcc", "-std=gnu99", "-O2", "-ffp-contract=off", "-o", "loop", "loop.c", "cell.c"]
        subprocess.run(command, cwd=work, check=True)
        runs = [subprocess.run(["./loop", str(C_STEPS)], cwd=work, check=True, capture_output=True) for _ in range(5)]
    return min(float(run.stdout.split()[0]) for run in runs)


def _print_time(what: str, seconds: float) -> None:
    print(f"{what:<30}{seconds * 1e6:9.3f} µs   {100.0 * seconds / PERIOD_S:8.4f} % of the period")


def _print_processes() -> None:
    for what in ("autotune.runtime", "numpy", "autotune.formats.controller"):
        code = f"import time; t = time.perf_counter(); import {what}; print(time.perf_counter() - t)"
        runs = [subprocess.run([sys.executable, "-c", code], check=True, capture_output=True) for _ in range(PROCESSES)]
        times = [float(run.stdout) for run in runs]
        print(f"import {what:<28}{min(times) * 1e3:7.1f} ms   median {statistics.median(times) * 1e3:7.1f} ms")


if __name__ == "__main__":
    sys.exit(main())
