"""The collision response on the small robot, and variable damping in manual guidance (full simulation).

Usage: python examples/paper/collision.py [FOLDER]
"""

import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy.optimize import brentq

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from examples.paper.page import Study, Table, new_figure, number, run
from examples.paper.paper_case import (
    COUPLING_N_PER_M,
    DELAY_S,
    EXPERIMENT_FEEDBACK_S,
    SAMPLE_TIME_S,
    TABLE_N_PER_M,
    example_plant,
    in_series,
    printed_robot,
)
from problems.contact.nonlinear_simulation import NonlinearRun, simulate_nonlinear
from problems.contact.nonlinearities import Collision, Deadband, Nonlinearities, Response, VariableDamping
from problems.contact.transient import Approach
from problems.model.controller import AdmittanceController
from problems.model.plant import Plant
from problems.model.robot import RobotModel

# Printed: 6.3 kg, threshold 7 N, F^d = 30 N, B_a = 800. Assumed: K_s, delay and M_a of the other experiments.
SMALL_KG, THRESHOLD_N, DESIRED_N = 6.3, 7.0, 30.0
SMALL_CONTROLLER = AdmittanceController(
    mass_kg=13.0, damping_n_s_per_m=800.0, lead_s=0.013, feedback_damping_s=EXPERIMENT_FEEDBACK_S
)
# The damping of the payload is assumed, once in the coupling and once to ground (B_p, B_s).
DAMPINGS = ((0.0, 630.0), (150.0, 300.0))
RESPONSES: dict[Response, str] = {"none": "no response", "reset": "proposed", "stop": "full stop"}
COLOUR_OF_RESPONSE = {"none": "#1B1B1B", "reset": "#2166AC", "stop": "#B2182B"}
PRINTED_PEAK_N, PRINTED_RESET_N = 44.0, 36.0
# K_l and secant stiffness of the three pictures in the paper.
SETTINGS = ((0.013, 32e3), (0.02, 32e3), (0.013, 15e3))
DEADBAND = Deadband(width_n=5.0)
HAND_AFTER_IMPACT_N = 30.0


@dataclass(frozen=True, kw_only=True)
class Responses:
    """The runs of one setting, by response."""

    drag_n_s_per_m: float
    coupling_n_s_per_m: float
    robot_rad_per_s: float
    lead_s: float
    secant_n_per_m: float
    runs: dict[Response, NonlinearRun]


@dataclass(frozen=True, kw_only=True)
class Guided:
    """One row of the paper's second table: what is switched on, its printed peak, and the run at its printed speed."""

    lead: bool
    feedback: bool
    detects: bool
    varies: bool
    speed_m_s: float
    printed_peak_n: float
    run: NonlinearRun

    @property
    def damping_at_peak(self) -> float:
        """Return B_a when the force at the sensor peaks."""
        return float(self.run.damping_n_s_per_m[round(self.run.time_of_sensor_peak_s / SAMPLE_TIME_S)])


@dataclass(frozen=True, kw_only=True)
class Found:
    """Collision responses, guided contacts, and the largest B_p with which the printed threshold stays silent."""

    responses: list[Responses]
    guided: list[Guided]
    largest_drag_n_s_per_m: float


# Lead, feedback, collision detection, variable B_a; contact speed [m/s], peak [N], as printed.
GUIDED_ROWS = (
    (False, False, False, False, 0.084, 95.3),
    (True, False, False, False, 0.078, 93.9),
    (True, True, False, False, 0.085, 81.5),
    (True, True, True, False, 0.078, 76.8),
    (False, False, False, True, 0.097, 121.0),
    (True, True, False, True, 0.078, 81.8),
    (False, False, True, True, 0.093, 116.0),
    (True, True, True, True, 0.072, 76.1),
)


def compute() -> Found:
    responses = []
    for drag, damping in DAMPINGS:
        rate = fitted_robot(drag, damping)
        for lead, secant in SETTINGS:
            plant = _small_plant(rate, drag, damping, secant)
            responses.append(
                Responses(
                    drag_n_s_per_m=drag,
                    coupling_n_s_per_m=damping,
                    robot_rad_per_s=rate,
                    lead_s=lead,
                    secant_n_per_m=secant,
                    runs={response: _small_run(plant, lead, response) for response in RESPONSES},
                )
            )
    silent = THRESHOLD_N * SMALL_CONTROLLER.damping_n_s_per_m / (DESIRED_N - THRESHOLD_N)
    return Found(responses=responses, guided=[_guided(*row) for row in GUIDED_ROWS], largest_drag_n_s_per_m=silent)


def fitted_robot(drag: float, damping: float) -> float:
    """Return the robot's bandwidth [rad/s] that gives the printed peak without a response: the one number fitted."""

    def apart(rate: float) -> float:
        plant = _small_plant(rate, drag, damping, SETTINGS[0][1])
        return _small_run(plant, SETTINGS[0][0], "none").peak_sensor_force_n - PRINTED_PEAK_N

    return float(brentq(apart, 20.0, 90.0, xtol=0.01))


def _small_plant(rate: float, drag: float, damping: float, secant: float) -> Plant:
    return example_plant(
        contact_n_per_m=in_series(secant, COUPLING_N_PER_M),
        coupling_n_s_per_m=damping,
        mass_kg=SMALL_KG,
        drag_n_s_per_m=drag,
        robot=RobotModel.from_bandwidth(bandwidth_rad_per_s=rate, delay_s=DELAY_S),
    )


def _small_run(plant: Plant, lead_s: float, response: Response) -> NonlinearRun:
    return simulate_nonlinear(
        plant,
        replace(SMALL_CONTROLLER, lead_s=lead_s),
        Approach(force_n=DESIRED_N),
        sample_time_s=SAMPLE_TIME_S,
        duration_s=1.0,
        effects=Nonlinearities(deadband=DEADBAND, collision=Collision(response=response, threshold_n=THRESHOLD_N)),
    )


def _guided(lead: bool, feedback: bool, detects: bool, varies: bool, speed_m_s: float, printed: float) -> Guided:
    plant = example_plant(
        contact_n_per_m=in_series(TABLE_N_PER_M, COUPLING_N_PER_M),
        drag_n_s_per_m=0.0,
        coupling_n_s_per_m=630.0,
        robot=printed_robot(),
    )
    controller = AdmittanceController(
        mass_kg=13.0,
        damping_n_s_per_m=1000.0,
        lead_s=0.013 if lead else 0.0,
        feedback_damping_s=EXPERIMENT_FEEDBACK_S if feedback else 0.0,
    )
    effects = Nonlinearities(
        deadband=DEADBAND,
        collision=Collision(threshold_n=THRESHOLD_N) if detects else None,
        variable_damping=VariableDamping() if varies else None,
    )
    approach = Approach(speed_m_s=speed_m_s, driven_by="hand", after_impact_n=HAND_AFTER_IMPACT_N)
    run_ = simulate_nonlinear(plant, controller, approach, sample_time_s=SAMPLE_TIME_S, duration_s=1.0, effects=effects)
    return Guided(
        lead=lead,
        feedback=feedback,
        detects=detects,
        varies=varies,
        speed_m_s=speed_m_s,
        printed_peak_n=printed,
        run=run_,
    )


def tables(found: Found) -> tuple[Table, ...]:
    response_rows = [
        (
            number(each.drag_n_s_per_m),
            number(each.coupling_n_s_per_m),
            number(each.robot_rad_per_s),
            number(1e3 * each.lead_s),
            number(each.secant_n_per_m / 1e3),
            *(number(each.runs[response].peak_sensor_force_n, 1) for response in RESPONSES),
            number(1e3 * (each.runs["reset"].collision_time_s or 0.0), 1),
        )
        for each in found.responses
    ]
    guided_rows = [
        (
            *("x" if switch else "" for switch in (each.lead, each.feedback, each.detects, each.varies)),
            number(100.0 * each.speed_m_s, 1),
            number(each.printed_peak_n, 1),
            number(each.run.peak_sensor_force_n, 1),
            number(1e3 * each.run.time_of_sensor_peak_s),
            number(each.damping_at_peak),
        )
        for each in found.guided
    ]
    return (
        Table(
            name="collision",
            header=(
                "B_p [N·s/m]",
                "B_s [N·s/m]",
                "robot [rad/s]",
                "K_l [ms]",
                "K_e [N/mm]",
                *(f"peak, {name} [N]" for name in RESPONSES.values()),
                "detected after [ms]",
            ),
            rows=tuple(response_rows),
        ),
        Table(
            name="collision-threshold",
            header=("approach at F^d = 30 N, B_a = 800", "value"),
            rows=(("largest B_p whose drag stays below 7 N [N·s/m]", number(found.largest_drag_n_s_per_m)),),
        ),
        Table(
            name="guided",
            header=(
                "K_l",
                "B_fb",
                "C Det",
                "Var B_a",
                "contact speed [cm/s]",
                "printed peak [N]",
                "model [N]",
                "at [ms]",
                "B_a then [N·s/m]",
            ),
            rows=tuple(guided_rows),
        ),
    )


def draw(found: Found) -> dict[str, Figure]:
    figure, axes = new_figure(columns=4, width=11.0, height=3.4)
    for each, panel in zip(found.responses[: len(SETTINGS)], axes[:3], strict=True):
        for response, name in RESPONSES.items():
            run_ = each.runs[response]
            panel.plot(1e3 * run_.time_s, run_.sensor_force_n, color=COLOUR_OF_RESPONSE[response], label=name)
        panel.set(xlabel="time after impact [ms]", xlim=(0.0, 600.0), ylim=(-2.0, 48.0))
        panel.set_title(f"K$_l$ = {1e3 * each.lead_s:g} ms, K$_e$ = {each.secant_n_per_m / 1e3:g} N/mm")
    axes[0].set_ylabel("force at the sensor [N]")
    axes[2].legend(frameon=False, loc="lower right")
    _draw_damping(axes[3], found.guided)
    return {"collision.svg": figure}


def _draw_damping(axes: Axes, guided: Sequence[Guided]) -> None:
    run_ = next(each.run for each in guided if each.varies)
    peak = 1e3 * run_.time_of_sensor_peak_s
    axes.plot(1e3 * run_.time_s, run_.damping_n_s_per_m, color="#5E3C99")
    axes.axvline(peak, color="0.4", linewidth=0.8, linestyle=":")
    axes.annotate("peak force", (peak + 4.0, 790.0), color="0.3", fontsize=8)
    axes.set(xlabel="time after impact [ms]", ylabel="B$_a$ [N·s/m]", xlim=(0.0, 300.0), ylim=(500.0, 850.0))
    axes.set_title("variable damping, 9.7 cm/s")


STUDY = Study(compute=compute, tables=tables, draw=draw)

if __name__ == "__main__":
    sys.exit(run(STUDY, sys.argv[1:]))
