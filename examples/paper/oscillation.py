"""Where oscillation begins as K_l grows, in free space, and what resonates at about 9 Hz with the 50 kg payload.

Usage: python examples/paper/oscillation.py [FOLDER]
"""

import sys
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy.optimize import brentq, root

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from examples.paper.modes import Mode, analyse_modes
from examples.paper.page import NONE, Study, Table, new_figure, number, run
from examples.paper.paper_case import (
    CONTACT_N_PER_M,
    DELAY_S,
    DRAG_N_S_PER_M,
    SAMPLE_TIME_S,
    STANDARD,
    example_controllers,
    example_plant,
    printed_robot,
)
from examples.paper.verdicts import Interval, slowest_mode, stable_intervals
from problems.arrays import FloatArray
from problems.model.controller import AdmittanceController
from problems.model.plant import Plant
from problems.model.robot import RobotModel
from problems.model.sampled import build_loop, build_sampled_plant

SCAN_LEAD_S = np.linspace(0.0, 0.12, 121)
MASSES_KG = (10.0, 13.0)
# B_p to ground and B_s in the coupling.
DAMPINGS = ((630.0, 0.0), (300.0, 0.0), (200.0, 0.0), (100.0, 0.0), (0.0, 630.0), (0.0, 300.0), (0.0, 100.0))
DRAWN_DRAG = np.linspace(0.0, 800.0, 81)
MEASURED_LEAD_S, MEASURED_HZ = 0.025, 25.0
HEAVY_KG, HEAVY_N_PER_M, HEAVY_HZ = 50.0, 1.6e5, 9.0
HEAVY_CONTROLLER = AdmittanceController(mass_kg=20.0, damping_n_s_per_m=2000.0, lead_s=0.01)
HEAVY_DAMPINGS = ((630.0, 0.0), (0.0, 0.0), (0.0, 630.0))
HEAVY_ROBOTS_RAD_PER_S = (10.0, 20.0, 40.0)
DRAWN_COUPLING = np.linspace(6e4, 2.4e5, 46)


@dataclass(frozen=True, kw_only=True)
class Onset:
    """Stable K_l [s] of one plant, and the loop's oscillation [Hz] at the upper end (nan if nothing is stable)."""

    intervals: list[Interval]
    upper_hz: float


@dataclass(frozen=True, kw_only=True)
class Explanation:
    """Values that put the onset at the measured K_l; one that is not printed in the paper has been solved for."""

    what: str
    mass_kg: float
    drag_n_s_per_m: float
    delay_s: float
    onset: Onset


@dataclass(frozen=True, kw_only=True)
class Heavy:
    """The 50 kg payload with one robot and damping: its resonance and the loop's mode.

    `coupling_n_per_m` is the K_s that would put the loop's own mode at the observed frequency.
    """

    robot_rad_per_s: float
    drag_n_s_per_m: float
    coupling_n_s_per_m: float
    mode: Mode
    coupling_n_per_m: float


@dataclass(frozen=True, kw_only=True)
class Found:
    """Onsets by (M_a, B_p, B_s), in free space and contact, over `DRAWN_DRAG` by M_a, and the 50 kg payload."""

    free: dict[tuple[float, float, float], Onset]
    contact: dict[tuple[float, float, float], Onset]
    drawn: dict[float, list[Onset]]
    explanations: list[Explanation]
    heavy: list[Heavy]
    heavy_resonance_hz: float
    heavy_modes_hz: FloatArray


def compute() -> Found:
    keys = [(mass, *damping) for mass in MASSES_KG for damping in DAMPINGS]
    robot = RobotModel.from_bandwidth(bandwidth_rad_per_s=20.0, delay_s=DELAY_S)
    return Found(
        free={key: onset(key[0], _example(0.0, key[1], key[2])) for key in keys},
        contact={key: onset(key[0], _example(CONTACT_N_PER_M, key[1], key[2])) for key in keys},
        drawn={mass: [onset(mass, _example(0.0, float(drag), 0.0)) for drag in DRAWN_DRAG] for mass in MASSES_KG},
        explanations=_explanations(),
        heavy=[_heavy(rate, *damping) for rate in HEAVY_ROBOTS_RAD_PER_S for damping in HEAVY_DAMPINGS],
        heavy_resonance_hz=float(np.sqrt(HEAVY_N_PER_M / HEAVY_KG) / (2.0 * np.pi)),
        heavy_modes_hz=np.array(
            [_heavy_mode(_heavy_plant(robot, float(k), 630.0, 0.0)).oscillation_hz for k in DRAWN_COUPLING]
        ),
    )


def _example(contact_n_per_m: float, drag: float, damping: float, delay_s: float = DELAY_S) -> Plant:
    return example_plant(
        contact_n_per_m=contact_n_per_m,
        drag_n_s_per_m=drag,
        coupling_n_s_per_m=damping,
        robot=printed_robot(delay_s),
    )


def onset(mass_kg: float, plant: Plant) -> Onset:
    """Find the stable K_l of standard admittance control with B_a = 1000."""
    sampled, controller = build_sampled_plant(plant, SAMPLE_TIME_S), example_controllers(mass_kg)[STANDARD]
    found = stable_intervals([sampled], lambda value: replace(controller, lead_s=value), SCAN_LEAD_S)
    if not found or found[-1].high == SCAN_LEAD_S[-1]:
        return Onset(intervals=found, upper_hz=float("nan"))
    mode = slowest_mode(sampled, replace(controller, lead_s=found[-1].high))
    return Onset(intervals=found, upper_hz=mode.oscillation_hz if mode else float("nan"))


def _payload_mode(plant: Plant, controller: AdmittanceController, near_hz: float) -> Mode:
    modes = analyse_modes(build_loop(build_sampled_plant(plant, SAMPLE_TIME_S), controller)).modes
    return min(modes, key=lambda mode: abs(mode.oscillation_hz - near_hz))


def _explanations() -> list[Explanation]:
    """Solve for the delay alone (K_l only), then for the delay and B_p (K_l and frequency)."""
    found = []
    for mass in MASSES_KG:
        edge = replace(example_controllers(mass)[STANDARD], lead_s=MEASURED_LEAD_S)

        def growth(delay_s: float, edge: AdmittanceController = edge) -> float:
            plant = _example(0.0, DRAG_N_S_PER_M, 0.0, delay_s)
            return _payload_mode(plant, edge, MEASURED_HZ).decay_rate_per_s

        delay = float(brentq(growth, DELAY_S, 10e-3, xtol=1e-9))
        found.append(_explained("T_d", mass, DRAG_N_S_PER_M, delay))

        def apart(x: FloatArray, edge: AdmittanceController = edge) -> list[float]:
            plant = _example(0.0, 100.0 * max(float(x[1]), 0.0), 0.0, 1e-3 * float(x[0]))
            mode = _payload_mode(plant, edge, MEASURED_HZ)
            return [mode.decay_rate_per_s, mode.oscillation_hz - MEASURED_HZ]

        solved = root(apart, [1e3 * delay, 1e-2 * DRAG_N_S_PER_M], tol=1e-9)
        if solved.success:
            found.append(_explained("T_d and B_p", mass, 100.0 * float(solved.x[1]), 1e-3 * float(solved.x[0])))
    return found


def _explained(what: str, mass: float, drag: float, delay_s: float) -> Explanation:
    return Explanation(
        what=what,
        mass_kg=mass,
        drag_n_s_per_m=drag,
        delay_s=delay_s,
        onset=onset(mass, _example(0.0, drag, 0.0, delay_s)),
    )


def _heavy_plant(robot: RobotModel, coupling: float, drag: float, damping: float) -> Plant:
    return example_plant(
        contact_n_per_m=0.0,
        mass_kg=HEAVY_KG,
        coupling_n_per_m=coupling,
        drag_n_s_per_m=drag,
        coupling_n_s_per_m=damping,
        robot=robot,
    )


def _heavy_mode(plant: Plant) -> Mode:
    return _payload_mode(plant, HEAVY_CONTROLLER, HEAVY_HZ)


def _heavy(rate: float, drag: float, damping: float) -> Heavy:
    robot = RobotModel.from_bandwidth(bandwidth_rad_per_s=rate, delay_s=DELAY_S)

    def apart(coupling: float) -> float:
        return _heavy_mode(_heavy_plant(robot, coupling, drag, damping)).oscillation_hz - HEAVY_HZ

    return Heavy(
        robot_rad_per_s=rate,
        drag_n_s_per_m=drag,
        coupling_n_s_per_m=damping,
        mode=_heavy_mode(_heavy_plant(robot, HEAVY_N_PER_M, drag, damping)),
        coupling_n_per_m=float(brentq(apart, 5e4, 2e5)),
    )


def tables(found: Found) -> tuple[Table, ...]:
    return _onset_table(found), _explanation_table(found), _heavy_table(found)


def _onset_table(found: Found) -> Table:
    rows = [
        (
            number(mass),
            number(drag),
            number(damping),
            _intervals(found.free[mass, drag, damping].intervals),
            number(found.free[mass, drag, damping].upper_hz, 1),
            _intervals(found.contact[mass, drag, damping].intervals),
            number(found.contact[mass, drag, damping].upper_hz, 1),
        )
        for mass, drag, damping in found.free
    ]
    header = (
        "M_a [kg]",
        "B_p [N·s/m]",
        "B_s [N·s/m]",
        "stable K_l, free space [ms]",
        "upper end [Hz]",
        "stable K_l, contact [ms]",
        "upper end [Hz]",
    )
    return Table(name="onset", header=header, rows=tuple(rows))


def _explanation_table(found: Found) -> Table:
    rows = [
        (
            each.what,
            number(each.mass_kg),
            number(1e3 * each.delay_s, 1),
            number(each.drag_n_s_per_m),
            _intervals(each.onset.intervals),
            number(each.onset.upper_hz, 1),
        )
        for each in found.explanations
    ]
    header = (
        "solved for",
        "M_a [kg]",
        "T_d [ms]",
        "B_p [N·s/m]",
        "stable K_l, free space [ms]",
        "upper end [Hz]",
    )
    return Table(name="onset-explained", header=header, rows=tuple(rows))


def _heavy_table(found: Found) -> Table:
    rows = [
        (
            number(each.robot_rad_per_s),
            number(each.drag_n_s_per_m),
            number(each.coupling_n_s_per_m),
            number(found.heavy_resonance_hz, 1),
            number(each.mode.oscillation_hz, 1),
            number(each.mode.damping_ratio, 3),
            number(each.coupling_n_per_m / 1e5, 2),
        )
        for each in found.heavy
    ]
    header = (
        "robot [rad/s]",
        "B_p [N·s/m]",
        "B_s [N·s/m]",
        "√(K_s/M_p)/2π [Hz]",
        "loop's mode [Hz]",
        "its damping ratio",
        "K_s for a mode at 9 Hz [1e5 N/m]",
    )
    return Table(name="heavy", header=header, rows=tuple(rows))


def _intervals(found: list[Interval]) -> str:
    if not found:
        return NONE
    # What reaches the end of the scan goes on beyond it.
    return ", ".join(
        f"{number(1e3 * each.low, 1)} to {'>' if each.high == SCAN_LEAD_S[-1] else ''}{number(1e3 * each.high, 1)}"
        for each in found
    )


def draw(found: Found) -> dict[str, Figure]:
    figure, axes = new_figure()
    _draw_onset(axes[0], found)
    _draw_heavy(axes[1], found)
    return {"oscillation.svg": figure}


def _draw_onset(axes: Axes, found: Found) -> None:
    for mass, style in zip(MASSES_KG, ("-", "--"), strict=True):
        low, high = (
            np.array([1e3 * each.intervals[-1][end] if each.intervals else np.nan for each in found.drawn[mass]])
            for end in (0, 1)
        )
        axes.plot(
            DRAWN_DRAG, high, color="#000000", linestyle=style, label=f"ends of the stable K$_l$, M$_a$ = {mass:g} kg"
        )
        axes.plot(DRAWN_DRAG, low, color="#000000", linestyle=style)
        for drag in (300.0, 500.0, 630.0):
            here = found.drawn[mass][int(np.argmin(np.abs(DRAWN_DRAG - drag)))]
            if mass == MASSES_KG[0]:
                at = (drag, 1e3 * here.intervals[-1].high)
                axes.annotate(
                    f"{here.upper_hz:.0f} Hz", at, (-4, 4), textcoords="offset points", ha="right", fontsize=8
                )
    axes.axhline(1e3 * MEASURED_LEAD_S, color="#CC79A7", linewidth=1.0)
    axes.annotate("measured onset, 25 Hz", (480.0, 1e3 * MEASURED_LEAD_S - 2.5), color="#A0477B", fontsize=8)
    axes.set(xlabel="payload damping to ground B$_p$ [N·s/m]", ylabel="K$_l$ [ms]", xlim=(0.0, 800.0), ylim=(0.0, 60.0))
    axes.set_title("16 kg in free space: stable between the lines")
    axes.legend(frameon=False, fontsize=8, loc="upper left")


def _draw_heavy(axes: Axes, found: Found) -> None:
    coupling = DRAWN_COUPLING / 1e5
    resonance = np.sqrt(DRAWN_COUPLING / HEAVY_KG) / (2.0 * np.pi)
    axes.plot(coupling, found.heavy_modes_hz, color="#0072B2", label="mode of the closed loop")
    axes.plot(coupling, resonance, color="#0072B2", linestyle="--", label="payload on a fixed flange")
    axes.axhline(HEAVY_HZ, color="#CC79A7", linewidth=1.0)
    axes.annotate("observed", (0.62, HEAVY_HZ + 0.1), color="#A0477B", fontsize=8)
    axes.axvline(HEAVY_N_PER_M / 1e5, color="0.5", linewidth=0.8, linestyle=":")
    axes.annotate("paper's K$_s$", (HEAVY_N_PER_M / 1e5 + 0.02, 6.2), color="0.4", fontsize=8)
    axes.set(xlabel="K$_s$ [10$^5$ N/m]", ylabel="frequency [Hz]", xlim=(0.6, 2.4), ylim=(5.0, 14.0))
    axes.set_title("50 kg in free space, M$_a$ = 20 kg, B$_a$ = 2000 N·s/m, K$_l$ = 10 ms")
    axes.legend(frameon=False, fontsize=8, loc="upper left")


STUDY = Study(compute=compute, tables=tables, draw=draw)

if __name__ == "__main__":
    sys.exit(run(STUDY, sys.argv[1:]))
