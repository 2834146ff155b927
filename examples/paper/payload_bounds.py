"""Stable bounds of K_l and B_a over the payload's natural frequency and damping ratio.

K_s stays; M_p = K_s/ω², B_p = 2ζ sqrt(M_p K_s) (ω printed upside down, docs/method.md, erratum 3).
Usage: python examples/paper/payload_bounds.py [FOLDER]
"""

import sys
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from examples.paper.page import NONE, Study, Table, new_figure, number, run
from examples.paper.paper_case import (
    CONTACT_N_PER_M,
    COUPLING_N_PER_M,
    DRAG_N_S_PER_M,
    LEAD_S,
    PAYLOAD_KG,
    SAMPLE_TIME_S,
    STANDARD,
    example_controllers,
    example_plant,
)
from examples.paper.verdicts import Interval, last_interval, stable_intervals
from problems.model.sampled import SampledPlant, build_sampled_plant

FREQUENCY_HZ = np.geomspace(5.0, 40.0, 37)
RATIOS = (0.05, 0.1, 0.2, 0.4)
# Dark is badly damped.
COLOUR_OF_RATIO = {0.05: "#49006A", 0.1: "#AE017E", 0.2: "#F768A1", 0.4: "#FBB4B9"}
READ_HZ = (9.0, 12.0, 16.0, 21.8, 30.0, 40.0)
SCAN_LEAD_S = np.linspace(0.0, 0.15, 151)
SCAN_N_S_PER_M = np.geomspace(20.0, 20_000.0, 100)


@dataclass(frozen=True, kw_only=True)
class Bounds:
    """At one payload: stable K_l [s] at B_a = 1000 in contact and in free space, smallest B_a in contact.

    B_a at K_l = 0 and at K_l = 0.02, nan if none of the scan is stable.
    """

    lead_in_contact: list[Interval]
    lead_in_free_space: list[Interval]
    damping_without_lead: float
    damping_with_lead: float


@dataclass(frozen=True, kw_only=True)
class Found:
    """Bounds by damping ratio, over `FREQUENCY_HZ` and over `READ_HZ`, and the example's own ω [Hz] and ζ."""

    drawn: dict[float, list[Bounds]]
    read: dict[float, list[Bounds]]
    example_hz: float
    example_ratio: float


def compute() -> Found:
    rate = np.sqrt(COUPLING_N_PER_M / PAYLOAD_KG)
    return Found(
        drawn={ratio: [bounds_at(float(hz), ratio) for hz in FREQUENCY_HZ] for ratio in RATIOS},
        read={ratio: [bounds_at(hz, ratio) for hz in READ_HZ] for ratio in RATIOS},
        example_hz=float(rate / (2.0 * np.pi)),
        example_ratio=float(DRAG_N_S_PER_M / (2.0 * np.sqrt(PAYLOAD_KG * COUPLING_N_PER_M))),
    )


def _plant(frequency_hz: float, ratio: float, contact_n_per_m: float) -> SampledPlant:
    mass = COUPLING_N_PER_M / (2.0 * np.pi * frequency_hz) ** 2
    drag = 2.0 * ratio * np.sqrt(mass * COUPLING_N_PER_M)
    plant = example_plant(contact_n_per_m=contact_n_per_m, mass_kg=float(mass), drag_n_s_per_m=float(drag))
    return build_sampled_plant(plant, SAMPLE_TIME_S)


def bounds_at(frequency_hz: float, ratio: float) -> Bounds:
    """Find the bounds of one payload."""
    contact, free = _plant(frequency_hz, ratio, CONTACT_N_PER_M), _plant(frequency_hz, ratio, 0.0)
    standard = example_controllers()[STANDARD]

    def leads(plant: SampledPlant) -> list[Interval]:
        return stable_intervals([plant], lambda value: replace(standard, lead_s=value), SCAN_LEAD_S)

    def smallest(lead_s: float) -> float:
        found = stable_intervals(
            [contact], lambda value: replace(standard, lead_s=lead_s, damping_n_s_per_m=value), SCAN_N_S_PER_M
        )
        last = last_interval(found, float(SCAN_N_S_PER_M[-1]))
        return last.low if last else float("nan")

    return Bounds(
        lead_in_contact=leads(contact),
        lead_in_free_space=leads(free),
        damping_without_lead=smallest(0.0),
        damping_with_lead=smallest(LEAD_S),
    )


def tables(found: Found) -> tuple[Table, ...]:
    lead_rows = [
        (
            f"{hz:g}",
            *(_intervals(found.read[ratio][i].lead_in_contact) for ratio in RATIOS),
            *(_intervals(found.read[ratio][i].lead_in_free_space) for ratio in RATIOS),
        )
        for i, hz in enumerate(READ_HZ)
    ]
    damping_rows = [
        (
            f"{hz:g}",
            *(number(found.read[ratio][i].damping_without_lead) for ratio in RATIOS),
            *(number(found.read[ratio][i].damping_with_lead) for ratio in RATIOS),
        )
        for i, hz in enumerate(READ_HZ)
    ]
    return (
        Table(
            name="payload-lead",
            header=(
                "ω [Hz]",
                *(f"K_l in contact [ms], ζ = {ratio:g}" for ratio in RATIOS),
                *(f"K_l in free space [ms], ζ = {ratio:g}" for ratio in RATIOS),
            ),
            rows=tuple(lead_rows),
        ),
        Table(
            name="payload-damping",
            header=(
                "ω [Hz]",
                *(f"B_a [N·s/m], K_l = 0, ζ = {ratio:g}" for ratio in RATIOS),
                *(f"B_a [N·s/m], K_l = 20 ms, ζ = {ratio:g}" for ratio in RATIOS),
            ),
            rows=tuple(damping_rows),
        ),
        Table(
            name="payload-example",
            header=("the example's payload", "value"),
            rows=(
                ("natural frequency [Hz]", number(found.example_hz, 1)),
                ("damping ratio", number(found.example_ratio, 3)),
            ),
        ),
    )


def _intervals(found: list[Interval]) -> str:
    # What reaches the end of the scan goes on beyond it.
    return (
        ", ".join(
            f"{number(1e3 * each.low, 1)} to {'>' if each.high == SCAN_LEAD_S[-1] else ''}{number(1e3 * each.high, 1)}"
            for each in found
        )
        or NONE
    )


def draw(found: Found) -> dict[str, Figure]:
    figure, axes = new_figure(height=4.2, columns=3)
    for ratio in RATIOS:
        colour, bounds = COLOUR_OF_RATIO[ratio], found.drawn[ratio]
        _draw_leads(axes[0], [each.lead_in_contact for each in bounds], colour)
        _draw_leads(axes[1], [each.lead_in_free_space for each in bounds], colour)
        axes[2].loglog(FREQUENCY_HZ, [each.damping_with_lead for each in bounds], color=colour, label=f"ζ = {ratio:g}")
        axes[2].loglog(FREQUENCY_HZ, [each.damping_without_lead for each in bounds], color=colour, linestyle="--")
    for each, title in zip(axes[:2], ("contact", "free space"), strict=True):
        each.set(xscale="log", ylim=(0.0, 100.0), ylabel="stable K$_l$ [ms]", title=f"{title}, B$_a$ = 1000 N·s/m")
    axes[2].set(ylabel="smallest stable B$_a$ [N·s/m]", title="contact; dashed: K$_l$ = 0, solid: 20 ms")
    for each in axes:
        each.set(xlabel="payload natural frequency [Hz]", xlim=(5.0, 40.0))
        each.set_xticks([5, 10, 20, 40], ["5", "10", "20", "40"])
        each.minorticks_off()
        each.axvline(found.example_hz, color="0.5", linewidth=0.8, linestyle=":")
    figure.legend(*axes[2].get_legend_handles_labels(), loc="outside lower center", ncols=4, frameon=False)
    return {"payload_bounds.svg": figure}


def _draw_leads(axes: Axes, intervals: list[list[Interval]], colour: str) -> None:
    """Draw the lower and the upper end of the stable K_l [ms]."""
    low = np.array([1e3 * each[-1].low if each else np.nan for each in intervals])
    high = np.array([1e3 * each[-1].high if each else np.nan for each in intervals])
    axes.plot(FREQUENCY_HZ, low, color=colour)
    axes.plot(FREQUENCY_HZ, high, color=colour)


STUDY = Study(compute=compute, tables=tables, draw=draw)

if __name__ == "__main__":
    sys.exit(run(STUDY, sys.argv[1:]))
