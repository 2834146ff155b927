"""Bode magnitudes: F → v in free space and F^d → F in contact, continuous and exactly sampled.

Usage: python examples/paper/bode.py [FOLDER]
"""

import sys
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from examples.paper.continuous import continuous_loop
from examples.paper.modes import Mode
from examples.paper.page import NONE, Study, Table, new_figure, number, run
from examples.paper.paper_case import (
    COLOURS,
    FEEDBACK,
    FEEDBACK_PER_SAMPLE_S,
    SAMPLE_TIME_S,
    STANDARD,
    example_controllers,
    example_plant,
    printed_robot,
)
from examples.paper.verdicts import continuous_is_stable, slowest_mode
from problems.arrays import FloatArray
from problems.model.controller import AdmittanceController
from problems.model.plant import Plant
from problems.model.response import free_space_admittance, loop_response
from problems.model.sampled import build_sampled_plant
from problems.stability.margins import find_margins

DRAWN_HZ = np.geomspace(0.3, 100.0, 240)
DENSE_HZ = np.geomspace(0.1, 100.0, 6000)
READ_HZ = np.array([1.0, 2.0, 5.0, 7.0, 10.0, 20.0])
DAMPED_N_S_PER_M = 2000.0
VERDICTS = ("controller", "continuous", "continuous, T_d + h/2", "sampled")
PER_SAMPLE = f"{FEEDBACK}, per sample"


@dataclass(frozen=True, kw_only=True)
class Curve:
    """One controller's magnitude, continuous and sampled, over `DENSE_HZ`, with the verdicts on both loops.

    `mode` is the slowest to decay of those of the sampled loop that oscillate, `modulus` its margin (None: unstable).
    """

    controller: AdmittanceController
    continuous: FloatArray
    sampled: FloatArray
    continuous_is_stable: bool
    held_is_stable: bool
    sampled_is_stable: bool
    mode: Mode | None
    modulus: float | None


@dataclass(frozen=True, kw_only=True)
class Found:
    """Curves by controller: |G| in m/(s·N) in free space, |F/F^d| in contact with the printed and with twice the B_a.

    `without_delay` is in contact with the printed B_a and T_d = 0.
    """

    free: dict[str, Curve]
    contact: dict[str, Curve]
    damped: dict[str, Curve]
    without_delay: dict[str, Curve]


def compute() -> Found:
    controllers = example_controllers()
    controllers[PER_SAMPLE] = replace(controllers[FEEDBACK], feedback_damping_s=FEEDBACK_PER_SAMPLE_S)
    free, contact = example_plant(contact_n_per_m=0.0), example_plant()
    instant = example_plant(robot=printed_robot(0.0))
    return Found(
        free={name: _curve(controller, free) for name, controller in controllers.items()},
        contact={name: _curve(controller, contact) for name, controller in controllers.items()},
        damped={
            name: _curve(replace(controller, damping_n_s_per_m=DAMPED_N_S_PER_M), contact)
            for name, controller in controllers.items()
        },
        without_delay={name: _curve(controller, instant) for name, controller in controllers.items()},
    )


def _curve(controller: AdmittanceController, plant: Plant) -> Curve:
    sampled, omega = build_sampled_plant(plant, SAMPLE_TIME_S), 2.0 * np.pi * DENSE_HZ
    loop = continuous_loop(plant, controller, omega)
    if plant.environment.is_free_space:
        continuous, exact = loop.rendered_admittance, free_space_admittance(sampled, controller, omega)
    else:
        at_force = loop_response(sampled, controller, omega).at_force
        continuous, exact = loop.closed_loop, -at_force / (1.0 + at_force)
    slowest = slowest_mode(sampled, controller)
    stable = slowest is not None and slowest.decay_rate_per_s > 0.0
    return Curve(
        controller=controller,
        continuous=np.abs(continuous),
        sampled=np.abs(exact),
        continuous_is_stable=continuous_is_stable(plant, controller),
        held_is_stable=continuous_is_stable(plant, controller, half_sample_of_s=SAMPLE_TIME_S),
        sampled_is_stable=stable,
        mode=slowest,
        modulus=find_margins(sampled, controller).modulus if stable else None,
    )


def tables(found: Found) -> tuple[Table, ...]:
    return _free_table(found), _contact_table(found), _damped_table(found)


def _free_table(found: Found) -> Table:
    rows = []
    reference = found.free[STANDARD].sampled
    for name, curve in found.free.items():
        apart = 20.0 * np.log10(curve.sampled / reference)
        read = [number(float(np.interp(hz, DENSE_HZ, apart)), 1) for hz in READ_HZ]
        hidden = [NONE] * len(READ_HZ)
        rows.append((name, *_verdicts(curve), *(read if curve.sampled_is_stable else hidden)))
    return Table(name="bode-free", header=(*VERDICTS, *(f"at {hz:g} Hz [dB]" for hz in READ_HZ)), rows=tuple(rows))


def _contact_table(found: Found) -> Table:
    rows = [
        (
            name,
            *_verdicts(curve),
            *_peak(curve.continuous, curve.continuous_is_stable),
            *_peak(curve.sampled, curve.sampled_is_stable),
            number(curve.modulus, 2),
            number(curve.mode.oscillation_hz, 1) if curve.mode else NONE,
            number(curve.mode.damping_ratio, 3) if curve.mode else NONE,
        )
        for name, curve in found.contact.items()
    ]
    header = (
        *VERDICTS,
        "peak, continuous [dB]",
        "at [Hz]",
        "peak, sampled [dB]",
        "at [Hz]",
        "modulus margin",
        "slowest mode [Hz]",
        "its damping ratio",
    )
    return Table(name="bode-contact", header=header, rows=tuple(rows))


def _damped_table(found: Found) -> Table:
    rows = [
        (
            name,
            *_peak(curve.continuous, curve.continuous_is_stable),
            *_peak(curve.sampled, curve.sampled_is_stable),
            *_peak(instant.continuous, instant.continuous_is_stable),
        )
        for (name, curve), instant in zip(found.damped.items(), found.without_delay.values(), strict=True)
    ]
    header = (
        "controller",
        "B_a = 2000: peak, continuous [dB]",
        "at [Hz]",
        "peak, sampled [dB]",
        "at [Hz]",
        "B_a = 1000, T_d = 0: peak, continuous [dB]",
        "at [Hz]",
    )
    return Table(name="bode-damped", header=header, rows=tuple(rows))


def _verdicts(curve: Curve) -> tuple[str, str, str]:
    first, second, third = (
        "stable" if verdict else "unstable"
        for verdict in (curve.continuous_is_stable, curve.held_is_stable, curve.sampled_is_stable)
    )
    return first, second, third


def _peak(magnitude: FloatArray, is_stable: bool) -> tuple[str, str]:
    """Return the peak in dB and its frequency, of a stable loop only."""
    if not is_stable:
        return NONE, NONE
    at = int(np.argmax(magnitude))
    peak_db = 20.0 * float(np.log10(magnitude[at]))
    # Without a resonance the largest value is that at rest, 0 dB.
    return (number(peak_db, 1), number(float(DENSE_HZ[at]), 1)) if peak_db > 0.05 else ("0.0", NONE)


def draw(found: Found) -> dict[str, Figure]:
    force = "|F/F$^d$| [-]"
    return {
        "bode_free.svg": _picture(found.free, "|V/F| [m/(s·N)]", "free space", 4e-6),
        "bode_contact.svg": _picture(found.contact, force, "contact, B$_a$ = 1000 N·s/m", 2e-3),
        "bode_contact_damped.svg": _picture(found.damped, force, "contact, B$_a$ = 2000 N·s/m", 2e-3),
    }


def _picture(curves: dict[str, Curve], label: str, place: str, lowest: float) -> Figure:
    figure, axes = new_figure(height=4.4)
    for i, (name, colour) in enumerate(COLOURS.items()):
        curve = curves[name]
        for each, magnitude, is_stable in (
            (axes[0], curve.continuous, curve.continuous_is_stable),
            (axes[1], curve.sampled, curve.sampled_is_stable),
        ):
            drawn = np.exp(np.interp(np.log(DRAWN_HZ), np.log(DENSE_HZ), np.log(magnitude)))
            # Later curves are thinner, so that one below another still shows.
            style, width = ("-", 2.2 - 0.15 * i) if is_stable else ((0, (2, 2)), 0.9)
            each.loglog(DRAWN_HZ, drawn, color=colour, linestyle=style, linewidth=width)
    highest = axes[0].get_ylim()[1]
    for each, form in zip(axes, ("continuous", "exact sampled loop"), strict=True):
        each.set(xlabel="frequency [Hz]", xlim=(DRAWN_HZ[0], DRAWN_HZ[-1]), ylim=(lowest, highest))
        each.set_title(f"{form}, {place}")
    axes[0].set_ylabel(label)
    handles = [Line2D([], [], color=colour, label=name) for name, colour in COLOURS.items()]
    handles.append(Line2D([], [], color="0.4", linestyle=(0, (2, 2)), label="dashed: unstable, formula only"))
    figure.legend(handles=handles, loc="outside lower center", ncols=4, frameon=False)
    return figure


STUDY = Study(compute=compute, tables=tables, draw=draw)

if __name__ == "__main__":
    sys.exit(run(STUDY, sys.argv[1:]))
