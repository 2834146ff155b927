"""Table I: the robot fitted on rows 1, 2, 6 and 7 only, rows 3, 4 and 5 predicted.

Usage: python examples/paper/table_one.py [FOLDER]
"""

import sys
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from scipy.optimize import least_squares, minimize

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from examples.paper.modes import ModalAnalysis, analyse_modes
from examples.paper.page import Study, Table, new_figure, number, run
from examples.paper.paper_case import (
    COUPLING_N_PER_M,
    DELAY_S,
    DRAG_N_S_PER_M,
    EXPERIMENT_FEEDBACK_PER_SAMPLE_S,
    EXPERIMENT_FEEDBACK_S,
    PAYLOAD_KG,
    SAMPLE_TIME_S,
    example_plant,
    in_series,
    printed_robot,
)
from problems.arrays import FloatArray
from problems.contact.transient import Approach, build_sampled_contact, simulate_contact
from problems.model.controller import AdmittanceController
from problems.model.robot import RobotModel
from problems.model.sampled import SampledPlant, build_loop, build_sampled_plant
from problems.stability.margins import UnstableLoopError

APPROACH = Approach(force_n=30.0)
FITTED, PREDICTED = (0, 1, 5, 6), (2, 3, 4)
# Bounds of the fit: bandwidth [rad/s], damping ratio of two poles, delay.
RATE_RAD_PER_S, RATIO, LONGEST_DELAY_S = (0.5, 200.0), (0.3, 20.0), 0.04
# Bandwidth [rad/s], delay [ms] beyond the shortest, damping ratio of two poles.
Start = tuple[float, float, float]
STARTS: tuple[Start, ...] = ((4.0, 1.0, 1.0), (10.0, 3.0, 1.0), (25.0, 8.0, 1.0))
# A row whose loop is unstable counts as this many times its printed peak.
_UNSTABLE = 3.0
_PAYLOAD_HZ = (10.0, 60.0)
_SLOWEST_HZ = 0.05


@dataclass(frozen=True, kw_only=True)
class Row:
    """One printed row; `feedback` says whether B_fb is on, `secant_n_per_m` is the printed K_e."""

    lead_s: float
    feedback: bool
    compensation_kg: float
    secant_n_per_m: float
    peak_n: float
    frequency_hz: float


ROWS = (
    Row(lead_s=0.0, feedback=False, compensation_kg=0.0, secant_n_per_m=32.3e3, peak_n=77.5, frequency_hz=2.1),
    Row(lead_s=0.02, feedback=False, compensation_kg=0.0, secant_n_per_m=32.3e3, peak_n=72.5, frequency_hz=2.5),
    Row(lead_s=0.02, feedback=True, compensation_kg=0.0, secant_n_per_m=32.3e3, peak_n=58.2, frequency_hz=2.6),
    Row(lead_s=0.02, feedback=True, compensation_kg=16.0, secant_n_per_m=32.3e3, peak_n=66.4, frequency_hz=3.2),
    Row(lead_s=0.02, feedback=True, compensation_kg=0.0, secant_n_per_m=11.2e3, peak_n=55.6, frequency_hz=3.1),
    Row(lead_s=0.02, feedback=True, compensation_kg=0.0, secant_n_per_m=5.1e3, peak_n=39.6, frequency_hz=2.3),
    Row(lead_s=0.02, feedback=True, compensation_kg=0.0, secant_n_per_m=2.7e3, peak_n=34.4, frequency_hz=14.7),
)


@dataclass(frozen=True, kw_only=True)
class Assumptions:
    """What the table leaves open; the defaults are the paper's values elsewhere."""

    mass_kg: float = 13.0
    damping_n_s_per_m: float = 1000.0
    drag_n_s_per_m: float = DRAG_N_S_PER_M
    coupling_n_s_per_m: float = 0.0
    coupling_n_per_m: float = COUPLING_N_PER_M
    feedback_s: float = EXPERIMENT_FEEDBACK_S
    is_series: bool = True
    shortest_delay_s: float = 0.0
    has_two_poles: bool = False
    fits_frequencies: bool = False


PRINTED = Assumptions()
IN_COUPLING = replace(PRINTED, drag_n_s_per_m=0.0, coupling_n_s_per_m=630.0)
VARIANTS = {
    "as assumed (B_p = 630, one pole)": PRINTED,
    "two poles": replace(PRINTED, has_two_poles=True),
    "T_d at least 2.4 ms": replace(PRINTED, shortest_delay_s=DELAY_S),
    "damping in the coupling (B_s = 630)": IN_COUPLING,
    "B_s = 630, T_d at least 2.4 ms": replace(IN_COUPLING, shortest_delay_s=DELAY_S),
    "B_p = 300": replace(PRINTED, drag_n_s_per_m=300.0),
    "K_s = 1.6e5": replace(PRINTED, coupling_n_per_m=1.6e5),
    "K_s = 6e5": replace(PRINTED, coupling_n_per_m=6e5),
    "K_e is the environment alone": replace(PRINTED, is_series=False),
    "B_fb read per sample": replace(PRINTED, feedback_s=EXPERIMENT_FEEDBACK_PER_SAMPLE_S),
    "M_a = 10": replace(PRINTED, mass_kg=10.0),
    "B_a = 800": replace(PRINTED, damping_n_s_per_m=800.0),
    "B_s = 630, frequencies of rows 1, 2 too": replace(IN_COUPLING, fits_frequencies=True),
}
MAIN = ("as assumed (B_p = 630, one pole)", "damping in the coupling (B_s = 630)")
FEEDBACK_SCAN_S = (0.0, 0.0075, 0.015, 0.03, 0.06, 0.12, 0.25, 0.5)


@dataclass(frozen=True, kw_only=True)
class Prediction:
    """One row of the model: peak of the force at the sensor [N] (None: unstable) and two of its modes [Hz].

    `contact_hz` is that of payload and controller on the surface, the slowest that oscillates; None if none does.
    `payload_hz` that of the payload on its coupling.
    """

    peak_n: float | None
    contact_hz: float | None
    payload_hz: float | None


@dataclass(frozen=True, kw_only=True)
class Fit:
    """A fitted robot and what it says about every row; `error` is the root mean square of ln(peak/printed)."""

    robot: RobotModel
    rate_rad_per_s: float
    ratio: float | None
    delay_s: float
    error: float
    predicted_error: float
    rows: tuple[Prediction, ...]


@dataclass(frozen=True, kw_only=True)
class Found:
    """Fits by the name of the variant; rows with the printed robot; the peak of row 3 [N] over B_fb by main fit.

    `payload_n_per_m` is the K_s that puts 16 kg on a fixed flange at the frequency printed in row 7.
    """

    fits: dict[str, Fit]
    printed_robot: list[Prediction]
    payload_n_per_m: float
    feedback: dict[str, list[float | None]]


def compute(near: Mapping[str, Start] | None = None) -> Found:
    """Fit every variant, from all `STARTS` or `near` a place that is given for it."""
    fits = {name: fit(assumed, None if near is None else near[name]) for name, assumed in VARIANTS.items()}
    return Found(
        fits=fits,
        printed_robot=[predict(row, printed_robot(), PRINTED) for row in ROWS],
        payload_n_per_m=float(PAYLOAD_KG * (2.0 * np.pi * ROWS[6].frequency_hz) ** 2),
        feedback={
            name: [
                predict(ROWS[2], fits[name].robot, replace(VARIANTS[name], feedback_s=value)).peak_n
                for value in FEEDBACK_SCAN_S
            ]
            for name in MAIN
        },
    )


def row_loop(row: Row, robot: RobotModel, assumed: Assumptions) -> tuple[SampledPlant, AdmittanceController]:
    """Return the sampled plant and the controller of a row."""
    stiffness = in_series(row.secant_n_per_m, assumed.coupling_n_per_m) if assumed.is_series else row.secant_n_per_m
    plant = example_plant(
        contact_n_per_m=stiffness,
        coupling_n_per_m=assumed.coupling_n_per_m,
        coupling_n_s_per_m=assumed.coupling_n_s_per_m,
        drag_n_s_per_m=assumed.drag_n_s_per_m,
        robot=robot,
    )
    controller = AdmittanceController(
        mass_kg=assumed.mass_kg,
        damping_n_s_per_m=assumed.damping_n_s_per_m,
        lead_s=row.lead_s,
        feedback_damping_s=assumed.feedback_s if row.feedback else 0.0,
        compensation_mass_kg=row.compensation_kg,
    )
    return build_sampled_plant(plant, SAMPLE_TIME_S), controller


def predict(row: Row, robot: RobotModel, assumed: Assumptions) -> Prediction:
    """Simulate the contact of a row, approached with F^d = 30 N until the speed is steady, and find its modes."""
    sampled, controller = row_loop(row, robot, assumed)
    modes = analyse_modes(build_loop(sampled, controller))
    slow, fast = _PAYLOAD_HZ
    return Prediction(
        peak_n=_peak(sampled, controller),
        contact_hz=_mode_hz(modes, _SLOWEST_HZ, slow),
        payload_hz=_mode_hz(modes, slow, fast),
    )


def _peak(sampled: SampledPlant, controller: AdmittanceController) -> float | None:
    try:
        return simulate_contact(build_sampled_contact(sampled), controller, APPROACH).peak_sensor_force_n
    except UnstableLoopError:
        return None


def _mode_hz(modes: ModalAnalysis, low: float, high: float) -> float | None:
    return next((mode.oscillation_hz for mode in modes.modes if low < mode.oscillation_hz < high), None)


def build_robot(values: FloatArray, assumed: Assumptions) -> RobotModel:
    """Build the robot from (ln ω_b, delay in 10 ms, ln ζ with two poles)."""
    rate, delay = float(np.exp(values[0])), 1e-2 * max(float(values[1]), 0.0)
    if not assumed.has_two_poles:
        return RobotModel.from_bandwidth(bandwidth_rad_per_s=rate, delay_s=delay)
    ratio = float(np.exp(values[2]))
    return RobotModel(
        numerator=np.array([rate**2]), denominator=np.array([1.0, 2.0 * ratio * rate, rate**2]), delay_s=delay
    )


def residuals(values: FloatArray, assumed: Assumptions) -> FloatArray:
    """Return ln(model/printed) of the peaks of the fitted rows, and of the frequencies of the first two if asked."""
    robot = build_robot(values, assumed)
    loops = [row_loop(ROWS[i], robot, assumed) for i in FITTED]
    apart = [_apart(_peak(*loop), ROWS[i].peak_n) for i, loop in zip(FITTED, loops, strict=True)]
    if assumed.fits_frequencies:
        apart += [_apart(predict(ROWS[i], robot, assumed).contact_hz, ROWS[i].frequency_hz) for i in (0, 1)]
    return np.array(apart)


def _apart(value: float | None, printed: float) -> float:
    return float(np.log(_UNSTABLE if value is None else value / printed))


def fit(assumed: Assumptions, near: Start | None = None) -> Fit:
    """Fit the robot from several starts, or near one place, and predict every row.

    Least squares leads into the valley; the peaks are those of the ticks and have kinks in the delay, over which a
    simplex goes on.
    """
    low, high = _bounds(assumed)
    if near is None:
        runs = [
            least_squares(
                residuals,
                _vector(start, assumed),
                bounds=(low, high),
                args=(assumed,),
                diff_step=1e-3,
                xtol=1e-6,
                ftol=1e-6,
            )
            for start in STARTS
        ]
        valley = min(runs, key=lambda each: float(each.cost)).x
    else:
        valley = np.clip(_vector(near, assumed), low, high)
    best = _descend(valley, assumed)
    robot = build_robot(best, assumed)
    rows = tuple(predict(row, robot, assumed) for row in ROWS)
    errors = np.array([_apart(each.peak_n, row.peak_n) for each, row in zip(rows, ROWS, strict=True)])
    return Fit(
        robot=robot,
        rate_rad_per_s=float(np.exp(best[0])),
        ratio=float(np.exp(best[2])) if assumed.has_two_poles else None,
        delay_s=robot.delay_s,
        error=float(np.sqrt(np.mean(errors[list(FITTED)] ** 2))),
        predicted_error=float(np.sqrt(np.mean(errors[list(PREDICTED)] ** 2))),
        rows=rows,
    )


def _vector(start: Start, assumed: Assumptions) -> FloatArray:
    """Return (ln ω_b, delay in 10 ms, ln ζ with two poles)."""
    rate, delay_ms, ratio = start
    whole = np.array([np.log(rate), 0.1 * delay_ms + 100.0 * assumed.shortest_delay_s, np.log(ratio)])
    return whole if assumed.has_two_poles else whole[:2]


def _bounds(assumed: Assumptions) -> tuple[FloatArray, FloatArray]:
    longest_ms = 1e3 * (LONGEST_DELAY_S - assumed.shortest_delay_s)
    return (
        _vector((RATE_RAD_PER_S[0], 0.0, RATIO[0]), assumed),
        _vector((RATE_RAD_PER_S[1], longest_ms, RATIO[1]), assumed),
    )


def _descend(valley: FloatArray, assumed: Assumptions) -> FloatArray:
    """Descend by a simplex with one corner at the valley, the others a step away from it and inside the bounds."""
    low, high = _bounds(assumed)
    steps = np.array([0.05, 0.1, 0.1])[: len(valley)]
    corners = valley + np.vstack([np.zeros(len(valley)), np.diag(np.where(valley + steps > high, -steps, steps))])
    found = minimize(
        lambda values: float(np.sum(residuals(values, assumed) ** 2)),
        valley,
        method="Nelder-Mead",
        bounds=list(zip(low, high, strict=True)),
        options={"initial_simplex": corners, "xatol": 1e-4, "fatol": 1e-9},
    )
    return np.asarray(found.x, dtype=np.float64)


def tables(found: Found) -> tuple[Table, ...]:
    payload = ("K_s for the 14.7 Hz of row 7 [1e5 N/m]", number(found.payload_n_per_m / 1e5, 2))
    return (
        _rows_table(found),
        _variants_table(found),
        Table(
            name="table-one-feedback",
            header=("peak of row 3 [N]", *(f"B_fb = {1e3 * value:g} ms" for value in FEEDBACK_SCAN_S)),
            rows=tuple((name, *(number(value, 1) for value in found.feedback[name])) for name in MAIN),
        ),
        Table(name="table-one-payload", header=("16 kg on a fixed flange", "value"), rows=(payload,)),
    )


def _rows_table(found: Found) -> Table:
    first, second = (found.fits[name] for name in MAIN)
    rows = [
        (
            str(i + 1),
            "fitted" if i in FITTED else "predicted",
            number(row.secant_n_per_m / 1e3, 1),
            number(in_series(row.secant_n_per_m, COUPLING_N_PER_M) / 1e3, 1),
            number(row.peak_n, 1),
            *(number(each.rows[i].peak_n, 1) for each in (first, second)),
            number(found.printed_robot[i].peak_n, 1),
            number(row.frequency_hz, 1),
            *(number(each.rows[i].contact_hz, 1) for each in (first, second)),
            *(number(each.rows[i].payload_hz, 1) for each in (first, second)),
        )
        for i, row in enumerate(ROWS)
    ]
    header = (
        "row",
        "use",
        "printed K_e [N/mm]",
        "environment behind it [N/mm]",
        "printed peak [N]",
        "model, B_p = 630 [N]",
        "model, B_s = 630 [N]",
        "printed r(s), T_d [N]",
        "printed ω [Hz]",
        "contact mode, B_p [Hz]",
        "B_s [Hz]",
        "payload mode, B_p [Hz]",
        "B_s [Hz]",
    )
    return Table(name="table-one", header=header, rows=tuple(rows))


def _variants_table(found: Found) -> Table:
    rows = [
        (
            name,
            number(each.rate_rad_per_s, 2),
            number(each.ratio, 1),
            number(1e3 * each.delay_s, 1),
            number(100.0 * each.error, 1),
            number(100.0 * each.predicted_error, 1),
            *(number(each.rows[i].peak_n, 1) for i in PREDICTED),
        )
        for name, each in found.fits.items()
    ]
    header = (
        "assumption",
        "ω_b [rad/s]",
        "ζ",
        "T_d [ms]",
        "error, fitted rows [%]",
        "error, predicted rows [%]",
        *(f"row {i + 1} [N]" for i in PREDICTED),
    )
    return Table(name="table-one-variants", header=header, rows=tuple(rows))


def draw(found: Found) -> dict[str, Figure]:
    figure, (axes,) = new_figure(width=7.2, height=3.6, columns=1)
    places = np.arange(len(ROWS))
    axes.bar(places - 0.27, [row.peak_n for row in ROWS], width=0.26, color="#1B1B1B", label="printed")
    looks = (("model, damping to ground B$_p$", "#4393C3"), ("model, damping in the coupling B$_s$", "#F4A582"))
    for offset, name, (label, colour) in zip((0.0, 0.27), MAIN, looks, strict=True):
        heights = [each.peak_n or np.nan for each in found.fits[name].rows]
        axes.bar(places + offset, heights, width=0.26, color=colour, label=label)
    axes.axhline(30.0, color="0.5", linewidth=0.8, linestyle=":")
    axes.set_xticks(places, [f"row {i + 1}\n{'fitted' if i in FITTED else 'predicted'}" for i in places])
    axes.set(ylabel="largest force at the sensor [N]", ylim=(0.0, 100.0), title="Table I; dotted: F$^d$")
    axes.legend(frameon=False)
    return {"table_one.svg": figure}


STUDY = Study(compute=compute, tables=tables, draw=draw)

if __name__ == "__main__":
    sys.exit(run(STUDY, sys.argv[1:]))
