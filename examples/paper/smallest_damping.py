"""The smallest B_a that keeps the contact stable over the environment's stiffness, for every controller.

Usage: python examples/paper/smallest_damping.py [FOLDER]
"""

import sys
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from examples.paper.page import Study, Table, new_figure, number, run
from examples.paper.paper_case import COLOURS, LEAD_IDEAL, SAMPLE_TIME_S, example_controllers, example_plant
from examples.paper.verdicts import continuous_is_stable, last_interval, stable_intervals
from problems.arrays import FloatArray
from problems.model.controller import AdmittanceController
from problems.model.plant import Plant
from problems.model.sampled import SampledPlant, build_sampled_plant

STIFFNESS_N_PER_M = np.geomspace(1e4, 2e6, 41)
READ_N_PER_M = (2e4, 5e4, 1e5, 2e5, 5e5, 1e6)
SCAN_N_S_PER_M = np.geomspace(20.0, 20_000.0, 120)
COMPARED_N_PER_M = 5e5
_BISECTIONS = 10


@dataclass(frozen=True, kw_only=True)
class Found:
    """Smallest stable B_a [N·s/m] by controller, nan where none of the scan is.

    `drawn` over `STIFFNESS_N_PER_M`, `read` over `READ_N_PER_M`, `free` in free space; `continuous` and `held` at
    `COMPARED_N_PER_M` for the continuous loop with T_d and with T_d + h/2.
    """

    drawn: dict[str, FloatArray]
    read: dict[str, FloatArray]
    free: dict[str, float]
    continuous: dict[str, float]
    held: dict[str, float]


def compute() -> Found:
    # The ideal compensation of a lead cannot be sampled, see the Bode tables.
    controllers = {name: each for name, each in example_controllers().items() if name != LEAD_IDEAL}
    drawn, read = _sampled(STIFFNESS_N_PER_M), _sampled(READ_N_PER_M)
    (free,) = _sampled((0.0,))
    compared = example_plant(contact_n_per_m=COMPARED_N_PER_M)
    return Found(
        drawn={name: np.array([smallest(plant, each) for plant in drawn]) for name, each in controllers.items()},
        read={name: np.array([smallest(plant, each) for plant in read]) for name, each in controllers.items()},
        free={name: smallest(free, each) for name, each in controllers.items()},
        continuous={name: smallest_continuous(compared, each, None) for name, each in controllers.items()},
        held={name: smallest_continuous(compared, each, SAMPLE_TIME_S) for name, each in controllers.items()},
    )


def _sampled(stiffness: FloatArray | tuple[float, ...]) -> list[SampledPlant]:
    return [build_sampled_plant(example_plant(contact_n_per_m=float(k)), SAMPLE_TIME_S) for k in stiffness]


def smallest(plant: SampledPlant, controller: AdmittanceController) -> float:
    """Return the smallest B_a from which on every scanned B_a is stable."""
    found = stable_intervals([plant], lambda value: replace(controller, damping_n_s_per_m=value), SCAN_N_S_PER_M)
    last = last_interval(found, float(SCAN_N_S_PER_M[-1]))
    return last.low if last else float("nan")


def smallest_continuous(plant: Plant, controller: AdmittanceController, half_sample_of_s: float | None) -> float:
    """Return the smallest stable B_a of the continuous loop, by bisection."""
    low, high = float(np.log(SCAN_N_S_PER_M[0])), float(np.log(SCAN_N_S_PER_M[-1]))
    for _ in range(_BISECTIONS):
        middle = 0.5 * (low + high)
        tried = replace(controller, damping_n_s_per_m=float(np.exp(middle)))
        inside = continuous_is_stable(plant, tried, half_sample_of_s=half_sample_of_s)
        low, high = (low, middle) if inside else (middle, high)
    return float(np.exp(high))


def tables(found: Found) -> tuple[Table, ...]:
    rows = [
        (
            name,
            _text(found.free[name]),
            *(_text(float(value)) for value in values),
            _text(found.continuous[name]),
            _text(found.held[name]),
        )
        for name, values in found.read.items()
    ]
    header = (
        "smallest stable B_a [N·s/m]",
        "free space",
        *(f"K_e = {stiffness / 1e3:g} N/mm" for stiffness in READ_N_PER_M),
        "500 N/mm, continuous",
        "500 N/mm, continuous, T_d + h/2",
    )
    return (Table(name="smallest-damping", header=header, rows=tuple(rows)),)


def _text(value: float) -> str:
    return "any" if value <= SCAN_N_S_PER_M[0] else number(value)


def draw(found: Found) -> dict[str, Figure]:
    figure, (axes,) = new_figure(width=6.4, height=4.6, columns=1)
    for name, values in found.drawn.items():
        axes.loglog(STIFFNESS_N_PER_M / 1e3, values, color=COLOURS[name], label=name)
    axes.axhline(1000.0, color="0.5", linewidth=0.8, linestyle=":")
    axes.annotate("printed B$_a$", (10.5, 1040.0), color="0.4", fontsize=8)
    axes.set(xlabel="K$_e$ [N/mm]", ylabel="smallest stable B$_a$ [N·s/m]", xlim=(10.0, 2000.0), ylim=(20.0, 3000.0))
    axes.set_title("exact sampled loop, contact, M$_a$ = 10 kg")
    figure.legend(loc="outside lower center", ncols=3, frameon=False)
    return {"smallest_damping.svg": figure}


STUDY = Study(compute=compute, tables=tables, draw=draw)

if __name__ == "__main__":
    sys.exit(run(STUDY, sys.argv[1:]))
