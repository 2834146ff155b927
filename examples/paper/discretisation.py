"""Tustin against the Euler forms: smallest stable B_a, margin and peak force on the compliant table.

Usage: python examples/paper/discretisation.py [FOLDER]
"""

import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from examples.paper.page import NONE, Study, Table, new_figure, number, run
from examples.paper.paper_case import (
    CONTACT_N_PER_M,
    COUPLING_N_PER_M,
    EXPERIMENT_FEEDBACK_S,
    LEAD_S,
    PAYLOAD_KG,
    SAMPLE_TIME_S,
    TABLE_N_PER_M,
    example_plant,
    in_series,
)
from examples.paper.verdicts import last_interval, least_damped, stable_intervals
from problems.arrays import FloatArray
from problems.contact.transient import Approach, build_sampled_contact, simulate_contact
from problems.model.controller import AdmittanceController, Discretization
from problems.model.sampled import SampledPlant, build_sampled_plant
from problems.stability.margins import UnstableLoopError, find_margins

FORMS: dict[Discretization, str] = {
    "tustin": "Tustin",
    "forward_euler": "forward Euler",
    "backward_euler": "backward Euler",
}
COLOUR_OF_FORM = {"tustin": "#1B1B1B", "forward_euler": "#B2182B", "backward_euler": "#2166AC"}
SCAN_N_S_PER_M = np.geomspace(10.0, 10_000.0, 120)
SURFACES = {
    "table": in_series(TABLE_N_PER_M, COUPLING_N_PER_M),
    "K_e = 5e5": CONTACT_N_PER_M,
}
APPROACH = Approach(force_n=30.0)
DRAWN_S = 0.6


@dataclass(frozen=True, kw_only=True)
class Case:
    """One controller in one form on one surface; what an unstable loop does not have is None."""

    form: Discretization
    surface: str
    controller: AdmittanceController
    smallest_n_s_per_m: float
    modulus: float | None
    damping_ratio: float | None
    peak_n: float | None
    trace: tuple[FloatArray, FloatArray] | None


def compute() -> list[Case]:
    """Evaluate every form of the controllers of the experiment, with M_a = 10 and B_a = 1000."""
    plants = {
        name: build_sampled_plant(example_plant(contact_n_per_m=k), SAMPLE_TIME_S) for name, k in SURFACES.items()
    }
    return [
        _case(plant, surface, replace(controller, discretization=form))
        for surface, plant in plants.items()
        for controller in controllers()
        for form in FORMS
    ]


def controllers() -> list[AdmittanceController]:
    """Return lead alone, lead with feedback damping, and both with the filtered compensation."""
    lead = AdmittanceController(mass_kg=10.0, damping_n_s_per_m=1000.0, lead_s=LEAD_S)
    both = replace(lead, feedback_damping_s=EXPERIMENT_FEEDBACK_S)
    return [lead, both, replace(both, compensation_mass_kg=PAYLOAD_KG)]


def _case(plant: SampledPlant, surface: str, controller: AdmittanceController) -> Case:
    found = stable_intervals([plant], lambda value: replace(controller, damping_n_s_per_m=value), SCAN_N_S_PER_M)
    last = last_interval(found, float(SCAN_N_S_PER_M[-1]))
    try:
        run_ = simulate_contact(build_sampled_contact(plant), controller, APPROACH)
        modulus, peak = find_margins(plant, controller).modulus, run_.peak_sensor_force_n
        shown = run_.time_s <= DRAWN_S
        trace = (run_.time_s[shown], run_.sensor_force_n[shown])
    except UnstableLoopError:
        modulus, peak, trace = None, None, None
    return Case(
        form=controller.discretization,
        surface=surface,
        controller=controller,
        smallest_n_s_per_m=last.low if last else float("nan"),
        modulus=modulus,
        damping_ratio=least_damped(plant, controller).damping_ratio if modulus is not None else None,
        peak_n=peak,
        trace=trace,
    )


def tables(found: Sequence[Case]) -> tuple[Table, ...]:
    rows = [
        (
            each.surface,
            _name(each.controller),
            FORMS[each.form],
            number(each.smallest_n_s_per_m),
            number(each.modulus, 3),
            number(each.damping_ratio, 3),
            number(each.peak_n, 1),
        )
        for each in found
    ]
    header = (
        "surface",
        "controller",
        "form",
        "smallest stable B_a [N·s/m]",
        "modulus margin",
        "least damping ratio",
        "peak force [N]",
    )
    return (Table(name="discretisation", header=header, rows=tuple(rows)),)


def _name(controller: AdmittanceController) -> str:
    parts = ["lead"] if controller.lead_s > 0.0 else []
    parts += ["feedback"] if controller.feedback_damping_s > 0.0 else []
    parts += ["filtered comp."] if controller.compensates else []
    return " + ".join(parts) or NONE


def draw(found: Sequence[Case]) -> dict[str, Figure]:
    figure, axes = new_figure()
    bars = [each for each in found if each.surface == "table"]
    places = np.arange(len(bars)) + 0.6 * (np.arange(len(bars)) // len(FORMS))
    axes[0].bar(places, [each.smallest_n_s_per_m for each in bars], color=[COLOUR_OF_FORM[each.form] for each in bars])
    axes[0].set_xticks(
        places[1 :: len(FORMS)], [_name(each.controller).replace(" + ", " +\n") for each in bars[1 :: len(FORMS)]]
    )
    axes[0].set(ylabel="smallest stable B$_a$ [N·s/m]", title="compliant table, exact sampled loop")
    for each in bars[-len(FORMS) :]:
        if each.trace:
            axes[1].plot(1e3 * each.trace[0], each.trace[1], color=COLOUR_OF_FORM[each.form], label=FORMS[each.form])
    axes[1].set(
        xlabel="time after impact [ms]", ylabel="force at the sensor [N]", xlim=(0.0, 1e3 * DRAWN_S), ylim=(0.0, None)
    )
    axes[1].set_title("lead + feedback + filtered comp., M$_a$ = 10 kg, B$_a$ = 1000 N·s/m")
    axes[1].legend(frameon=False, loc="lower right")
    return {"discretisation.svg": figure}


STUDY = Study(compute=compute, tables=tables, draw=draw)

if __name__ == "__main__":
    sys.exit(run(STUDY, sys.argv[1:]))
