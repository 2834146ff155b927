"""The collision response on the small robot, and variable damping in manual guidance (full simulation).

The operator of the second table is simulated too: a mass, a damper and a spring between the payload and a way of least
jerk (Flash and Hogan, *Journal of Neuroscience* 5(7), 1985) from 0.3 m before the table to 0.1 m behind its surface,
whatever the controller is. With their duration and spring the first row has its printed time and speed.

Usage: python examples/paper/collision.py [FOLDER]
"""

import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy.optimize import brentq, root

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
from problems.arrays import FloatArray
from problems.contact.nonlinear_simulation import NonlinearRun, Operator, simulate_nonlinear, simulate_operator
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
# The hand: between what is measured of relaxed and of stiffened arms (docs/method.md, "A hand that holds the payload").
HAND_KG, HAND_N_S_PER_M = 2.0, 50.0
WAY_M, TASK_S = (-0.3, 0.1), 8.0


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
    printed: "Printed"
    run: NonlinearRun
    led: NonlinearRun

    @property
    def energy_j(self) -> float:
        """Return ∫ |F v| dt of the flange up to the touch [J]."""
        until = round((self.led.impact_time_s or 0.0) / SAMPLE_TIME_S)
        return float(np.sum(np.abs(self.led.sensor_force_n * self.led.flange_velocity_m_s)[:until]) * SAMPLE_TIME_S)

    @property
    def damping_at_peak(self) -> float:
        """Return B_a when the force at the sensor peaks."""
        return float(self.run.damping_n_s_per_m[round(self.run.time_of_sensor_peak_s / SAMPLE_TIME_S)])


class Printed(NamedTuple):
    """A row of the paper's second table: contact speed [m/s], peak [N], Σ |F v| [kW] and time to the contact [s]."""

    speed_m_s: float
    peak_n: float
    energy: float
    time_s: float


class Person(NamedTuple):
    """The operator's spring [N/m] and the duration of the way [s]."""

    stiffness_n_per_m: float
    duration_s: float


@dataclass(frozen=True, kw_only=True)
class Found:
    """Collision responses, guided contacts, and the largest B_p with which the printed threshold stays silent."""

    responses: list[Responses]
    guided: list[Guided]
    person: Person
    largest_drag_n_s_per_m: float


FIRST = Person(1100.0, 6.0)
# Lead, feedback, collision detection, variable B_a; then what is printed.
GUIDED_ROWS = (
    ((False, False, False, False), Printed(0.084, 95.3, 2.97, 5.1)),
    ((True, False, False, False), Printed(0.078, 93.9, 3.05, 5.0)),
    ((True, True, False, False), Printed(0.085, 81.5, 3.17, 4.3)),
    ((True, True, True, False), Printed(0.078, 76.8, 3.44, 4.2)),
    ((False, False, False, True), Printed(0.097, 121.0, 2.72, 4.2)),
    ((True, True, False, True), Printed(0.078, 81.8, 3.33, 3.5)),
    ((False, False, True, True), Printed(0.093, 116.0, 2.83, 3.4)),
    ((True, True, True, True), Printed(0.072, 76.1, 3.51, 3.5)),
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
    person = fitted_person()
    guided = [_guided(switches, printed, person) for switches, printed in GUIDED_ROWS]
    return Found(responses=responses, guided=guided, person=person, largest_drag_n_s_per_m=silent)


def fitted_person() -> Person:
    """Return the operator with whom the first row has its printed contact speed and time; no other row is used."""
    switches, printed = GUIDED_ROWS[0]

    def apart(shares: FloatArray) -> list[float]:
        run_ = _led(switches, Person(FIRST.stiffness_n_per_m * shares[0], FIRST.duration_s * shares[1]))
        speed, time_s = run_.impact_speed_m_s or 0.0, run_.impact_time_s or TASK_S
        return [speed / printed.speed_m_s - 1.0, time_s / printed.time_s - 1.0]

    found = root(apart, np.ones(2), options={"eps": 1e-3, "xtol": 1e-4})
    return Person(FIRST.stiffness_n_per_m * float(found.x[0]), FIRST.duration_s * float(found.x[1]))


def _led(switches: tuple[bool, bool, bool, bool], person: Person) -> NonlinearRun:
    controller, effects = _controlled(*switches)
    hand = Operator(
        mass_kg=HAND_KG,
        damping_n_s_per_m=HAND_N_S_PER_M,
        stiffness_n_per_m=person.stiffness_n_per_m,
        path_m=_least_jerk(person.duration_s),
    )
    return simulate_operator(_guided_plant(), controller, hand, sample_time_s=SAMPLE_TIME_S, effects=effects)


def _least_jerk(duration_s: float) -> FloatArray:
    """Return the positions of a hand at the ticks: 10 s³ − 15 s⁴ + 6 s⁵ of its way in the share s of the duration."""
    share = np.clip(np.arange(0.0, TASK_S, SAMPLE_TIME_S) / duration_s, 0.0, 1.0)
    return np.asarray(WAY_M[0] + (WAY_M[1] - WAY_M[0]) * share**3 * (10.0 - 15.0 * share + 6.0 * share**2))


def fitted_robot(drag: float, damping: float) -> float:
    """Return the robot's bandwidth [rad/s] that gives the printed peak without a response: the one number fitted.

    Whole, as it is printed: the tick of the detection turns on less than a hundredth of it.
    """

    def apart(rate: float) -> float:
        plant = _small_plant(rate, drag, damping, SETTINGS[0][1])
        return _small_run(plant, SETTINGS[0][0], "none").peak_sensor_force_n - PRINTED_PEAK_N

    return float(round(brentq(apart, 20.0, 90.0, xtol=0.01)))


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


def _guided_plant() -> Plant:
    return example_plant(
        contact_n_per_m=in_series(TABLE_N_PER_M, COUPLING_N_PER_M),
        drag_n_s_per_m=0.0,
        coupling_n_s_per_m=630.0,
        robot=printed_robot(),
    )


def _controlled(lead: bool, feedback: bool, detects: bool, varies: bool) -> tuple[AdmittanceController, Nonlinearities]:
    """Return what is switched on in a row."""
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
    return controller, effects


def _guided(switches: tuple[bool, bool, bool, bool], printed: Printed, person: Person) -> Guided:
    controller, effects = _controlled(*switches)
    approach = Approach(speed_m_s=printed.speed_m_s, driven_by="hand", after_impact_n=HAND_AFTER_IMPACT_N)
    lead, feedback, detects, varies = switches
    return Guided(
        lead=lead,
        feedback=feedback,
        detects=detects,
        varies=varies,
        printed=printed,
        run=simulate_nonlinear(
            _guided_plant(), controller, approach, sample_time_s=SAMPLE_TIME_S, duration_s=1.0, effects=effects
        ),
        led=_led(switches, person),
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
            number(100.0 * each.printed.speed_m_s, 1),
            number(each.printed.peak_n, 1),
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
        *_operated(found),
    )


def _operated(found: Found) -> tuple[Table, ...]:
    led_rows = [
        (
            *("x" if switch else "" for switch in (each.lead, each.feedback, each.detects, each.varies)),
            number(100.0 * each.printed.speed_m_s, 1),
            number(100.0 * (each.led.impact_speed_m_s or 0.0), 1),
            number(each.printed.peak_n, 1),
            number(each.led.peak_sensor_force_n, 1),
            number(each.printed.energy, 2),
            number(each.energy_j, 1),
            number(each.printed.time_s, 1),
            number(each.led.impact_time_s or 0.0, 1),
        )
        for each in found.guided
    ]
    return (
        Table(
            name="operator",
            header=("the operator", "value"),
            rows=(
                ("K_h [N/m]", number(found.person.stiffness_n_per_m)),
                ("duration of the way [s]", number(found.person.duration_s, 1)),
            ),
        ),
        Table(
            name="operated",
            header=(
                *("K_l", "B_fb", "C Det", "Var B_a"),
                *("printed v_c [cm/s]", "model v_c"),
                *("printed peak [N]", "model peak"),
                *("printed energy", "model energy [J]"),
                *("printed time [s]", "model time"),
            ),
            rows=tuple(led_rows),
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
