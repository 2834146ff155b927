"""Passivity of the port F → V beside the stability of the loop: what the lead gain does to either.

Usage: python examples/paper/port_passivity.py [FOLDER]
"""

import sys
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from examples.paper.modes import analyse_modes
from examples.paper.page import Study, Table, new_figure, number, run
from examples.paper.paper_case import (
    COLOURS,
    DELAY_S,
    LEAD,
    SAMPLE_TIME_S,
    STANDARD,
    example_controllers,
    example_plant,
    printed_robot,
)
from problems.model.controller import AdmittanceController
from problems.model.sampled import build_loop, build_sampled_plant
from problems.stability.passivity import prepare_port

READ_LEAD_S = (0.0, 0.005, 0.008, 0.009, 0.02, 0.04, 0.046, 0.047, 0.06)
DRAWN_LEAD_S = np.linspace(0.0, 0.07, 71)


@dataclass(frozen=True, kw_only=True)
class Port:
    """One K_l: up to which frequency [Hz] G is passive, and how fast the free loop's slowest mode decays [1/s].

    None is "at every frequency", continuous without delay and sampled with all of it. Negative decay is growth.
    """

    lead_s: float
    instant_hz: float | None
    sampled_hz: float | None
    decay_rate_per_s: float
    oscillation_hz: float


@dataclass(frozen=True, kw_only=True)
class Found:
    """The port over `READ_LEAD_S` and `DRAWN_LEAD_S`; from `enough_lead_s` on the port without delay is passive."""

    read: list[Port]
    drawn: list[Port]
    enough_lead_s: float


def compute() -> Found:
    return Found(
        read=[_port(lead) for lead in READ_LEAD_S],
        drawn=[_port(float(lead)) for lead in DRAWN_LEAD_S],
        enough_lead_s=enough_lead_s(example_controllers()[STANDARD], 20.0),
    )


def enough_lead_s(controller: AdmittanceController, bandwidth_rad_per_s: float) -> float:
    """Return the K_l from which G is passive without delay: M_a/(M_a ω_b + B_a), for r(s) = ω_b/(s + ω_b).

    Re 1/G has the sign of B_a ω_b − M_a ω² + K_l ω² (M_a ω_b + B_a).
    """
    mass, damping = controller.mass_kg, controller.damping_n_s_per_m
    return mass / (mass * bandwidth_rad_per_s + damping)


def passive_up_to_hz(controller: AdmittanceController, bandwidth_rad_per_s: float) -> float | None:
    """Return where Re G turns negative without delay and sampling, see `enough_lead_s`."""
    mass, damping, lead = controller.mass_kg, controller.damping_n_s_per_m, controller.lead_s
    short = mass - lead * (mass * bandwidth_rad_per_s + damping)
    return float(np.sqrt(damping * bandwidth_rad_per_s / short) / (2.0 * np.pi)) if short > 0.0 else None


def _port(lead_s: float) -> Port:
    controller = replace(example_controllers()[STANDARD], lead_s=lead_s)
    free = build_sampled_plant(example_plant(contact_n_per_m=0.0, robot=printed_robot(DELAY_S)), SAMPLE_TIME_S)
    # The rigid motion behind the controller's own poles is not the payload's; what oscillates is.
    slowest = next(mode for mode in analyse_modes(build_loop(free, controller)).modes if mode.oscillation_hz > 5.0)
    return Port(
        lead_s=lead_s,
        instant_hz=passive_up_to_hz(controller, 20.0),
        sampled_hz=prepare_port(free).fails_above_hz(controller),
        decay_rate_per_s=slowest.decay_rate_per_s,
        oscillation_hz=slowest.oscillation_hz,
    )


def tables(found: Found) -> tuple[Table, ...]:
    rows = [
        (
            number(1e3 * each.lead_s, 0),
            "all" if each.instant_hz is None else number(each.instant_hz, 1),
            "all" if each.sampled_hz is None else number(each.sampled_hz, 1),
            "stable" if each.decay_rate_per_s > 0.0 else "unstable",
            number(each.decay_rate_per_s, 1),
            number(each.oscillation_hz, 1),
        )
        for each in found.read
    ]
    header = (
        "K_l [ms]",
        "passive up to, no delay [Hz]",
        "passive up to, sampled loop [Hz]",
        "free space",
        "payload mode's decay [1/s]",
        "its frequency [Hz]",
    )
    enough = Table(
        name="passivity-enough",
        header=("without delay", "value"),
        rows=(("K_l from which the port is passive at every frequency [ms]", number(1e3 * found.enough_lead_s, 1)),),
    )
    return Table(name="passivity", header=header, rows=tuple(rows)), enough


def draw(found: Found) -> dict[str, Figure]:
    figure, axes = new_figure(width=6.4, height=4.6, columns=1, rows=2)
    lead = np.array([1e3 * each.lead_s for each in found.drawn])
    passive = np.array([np.nan if each.sampled_hz is None else each.sampled_hz for each in found.drawn])
    decay = np.array([each.decay_rate_per_s for each in found.drawn])
    axes[0].plot(lead, passive, color=COLOURS[LEAD])
    axes[0].set(ylabel="F → V passive up to [Hz]", ylim=(0.0, None), title="exact sampled loop, free space")
    axes[1].plot(lead, decay, color=COLOURS[LEAD])
    axes[1].axhline(0.0, color="0.4", linewidth=0.8)
    axes[1].set(xlabel="K$_l$ [ms]", ylabel="payload mode's decay [1/s]")
    crossing = float(np.interp(0.0, -decay[20:], lead[20:]))
    for each in axes:
        each.set_xlim(lead[0], lead[-1])
        each.axvspan(crossing, lead[-1], color="0.92", linewidth=0.0)
    axes[1].annotate("unstable", (crossing + 1.0, 2.0), color="0.3", fontsize=8)
    return {"passivity.svg": figure}


STUDY = Study(compute=compute, tables=tables, draw=draw)

if __name__ == "__main__":
    sys.exit(run(STUDY, sys.argv[1:]))
