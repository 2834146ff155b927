"""Is the design optimal, and what does each requirement cost: the Karush–Kuhn–Tucker conditions at the result.

In u = (ln M_a, ln B_a, K_l, B_fb, the last two by the width of their bounds) the search minimises the largest
φ_s = ln F_s over the scenarios under c_j = ln(required/achieved) ≤ 0. At an optimum some λ_s ≥ 0 of sum 1, μ_j ≥ 0 and
ν_b ≥ 0 balance Σ λ_s ∇φ_s + Σ μ_j ∇c_j + Σ ν_b n_b = 0 over what is active; what is left of that sum is the residual,
and Σ λ_s (φ − φ_s) + Σ μ_j |c_j| is what the design could still gain, to first order, by using up its slack. μ_j is the
share by which the peak grows when requirement j is raised by one share.
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

from problems.contact import transient_from
from problems.controller import AdmittanceController
from problems.design import VARIABLES, DesignProblem
from problems.evaluation import PreparedScenarios, normalise_margins
from problems.margins import PreparedMargins
from problems.sampled import SampledPlant, build_loop, spectral_radius
from problems.slopes import (
    Slope,
    admittance_slope,
    decay_slope,
    delay_slope,
    gain_slope,
    modulus_slope,
    peak_slope,
    phase_slope,
)

FloatArray = NDArray[np.float64]
Key = tuple[str, int]

PEAK = "peak"
_NEAR = 2e-3
_AGREES = 2e-3
_STEP = 1e-5
_LATEST_TICK = 600
_SUM_WEIGHT = 1e3
_AT_BOUND = 1e-6
LINEAR_VARIABLES = ("lead_s", "feedback_damping_s")
"""Variables that u counts by the width of their bounds; the others count by their logarithm."""
_LOGARITHMIC = np.array([name not in LINEAR_VARIABLES for name in VARIABLES])

_MARGIN_SLOPES: dict[str, Callable[[SampledPlant, AdmittanceController], Slope | None]] = {
    "gain_margin_db": gain_slope,
    "phase_margin_deg": phase_slope,
    "delay_margin_s": delay_slope,
    "decay_rate_per_s": decay_slope,
}


@dataclass(frozen=True, kw_only=True)
class Row:
    """A peak or requirement near its limit: its logarithm and the gradient of that by u, (4,).

    `is_exact` where the symbolic derivative was taken, else central differences of the simulation.
    """

    name: str
    value: float
    gradient: FloatArray
    is_exact: bool


@dataclass(frozen=True, kw_only=True)
class Optimality:
    """How the conditions hold: `residual` of the balance beside `gradient`, the largest ∇φ_s of an active scenario.

    `multipliers` are those of requirements and of bounds ("lower bound of mass"), by name, the largest first;
    `scenarios` how many peaks are at the top together; `exact_share` of the gradients that are symbolic; `slack` the
    share of the peak that using up what the active ones leave could still save.
    """

    residual: float
    gradient: float
    multipliers: dict[str, float]
    scenarios: int
    exact_share: float
    slack: float

    @property
    def relative_residual(self) -> float:
        """The residual as a share of the gradient; 0 where the peak does not depend on the design at all."""
        return self.residual / self.gradient if self.gradient > 0.0 else 0.0


def check_optimality(prepared: PreparedScenarios, design: FloatArray) -> Optimality:
    """Check the conditions at a stable design (4,) over prepared scenarios."""
    peaks, limits = active_rows(prepared, design)
    bounds = dict(_active_bounds(prepared.problem, design))
    top = [row for row in peaks if row.value >= max(row.value for row in peaks) - _NEAR]
    rows = [row.gradient for row in top] + [row.gradient for row in limits] + list(bounds.values())
    left = [max(row.value for row in top) - row.value for row in top] + [-row.value for row in limits]
    slack = np.maximum([*left, *[0.0] * len(bounds)], 0.0)
    # λ sum to one: a row of its own, so heavy that the sum is met to rounding. Of many active rows those without slack.
    heavy = np.array([_SUM_WEIGHT] * len(top) + [0.0] * (len(rows) - len(top)))
    matrix = np.vstack([np.column_stack(rows), slack, heavy])
    weights, _ = nnls(matrix, np.append(np.zeros(len(VARIABLES) + 1), _SUM_WEIGHT))
    balance = matrix[: len(VARIABLES)] @ weights
    names = [row.name for row in limits] + list(bounds)
    merged: dict[str, float] = {}
    for name, weight in zip(names, weights[len(top) :], strict=True):
        merged[name] = merged.get(name, 0.0) + float(weight)
    exact = [row.is_exact for row in (*top, *limits)]
    return Optimality(
        residual=float(np.linalg.norm(balance)),
        gradient=max(float(np.linalg.norm(row.gradient)) for row in top),
        multipliers=dict(sorted(merged.items(), key=lambda pair: -pair[1])),
        scenarios=len(top),
        exact_share=float(np.mean(exact)),
        slack=float(slack @ weights),
    )


def active_rows(
    prepared: PreparedScenarios, design: FloatArray, near: float = _NEAR
) -> tuple[tuple[Row, ...], tuple[Row, ...]]:
    """Return the peaks within `near` of the largest one, and the requirements within `near` of their limit."""
    rows = {key: row_at(prepared, design, key) for key in near_keys(prepared, design, near)}
    peaks = tuple(row for (name, _), row in rows.items() if name == PEAK)
    return peaks, tuple(row for (name, _), row in rows.items() if name != PEAK)


def near_keys(prepared: PreparedScenarios, design: FloatArray, near: float) -> tuple[Key, ...]:
    """Return which peaks lie within `near` of the largest one, then which requirements of their limit.

    A key is a name and the index of a scenario, of a plant, or 0.
    """
    problem, controller = prepared.problem, prepared.problem.controller(design)
    found = prepared.peaks(controller)
    values = np.array(
        [p.peak_contact_force_n if problem.objective == "contact_force" else p.peak_sensor_force_n for p in found]
    )
    keys = [(PEAK, int(i)) for i in np.flatnonzero(np.log(values) >= math.log(float(np.max(values))) - near)]
    margins = prepared.margins(controller, prepared.radii(controller))
    for i, each in enumerate(margins):
        asked = normalise_margins(problem.requirements, each.margins, problem.sample_time_s)
        keys += [(name, i) for name, value in asked.items() if value > 0.0 and math.log(value) >= -near]
    for name, value in prepared.achieved_admittance(controller).items():
        keys += [(name, 0)] if math.log(value) >= -near else []
    limit = problem.requirements.max_peak_force_n
    if limit is not None:
        forces = np.array([p.peak_contact_force_n for p in found])
        keys += [("max_peak_force_n", int(i)) for i in np.flatnonzero(np.log(forces / limit) >= -near)]
    return tuple(keys)


def row_at(prepared: PreparedScenarios, design: FloatArray, key: Key) -> Row:
    """Return value and gradient of one peak or requirement, named by `near_keys`, at a stable design (4,)."""
    problem, (name, index) = prepared.problem, key
    widths = unit_widths(problem, design)
    if name == PEAK:
        return _peak_row(prepared, index, design, widths, at_sensor=problem.objective != "contact_force")
    if name == "max_peak_force_n":
        row = _peak_row(prepared, index, design, widths, at_sensor=False)
        return replace(row, name=name, value=row.value - math.log(problem.requirements.max_peak_force_n or 1.0))
    if name == "free_space_admittance":
        return _admittance_row(prepared, design, widths)
    return _margin_row(prepared.plants[index], problem, name, design, widths)


def unit_widths(problem: DesignProblem, design: FloatArray) -> FloatArray:
    """Return dx/du of every variable (4,): itself for M_a and B_a, the width of the bounds for K_l and B_fb.

    A variable that its bounds fix does not move: 0.
    """
    bounds = np.array([problem.bounds[name] for name in VARIABLES])
    width = bounds[:, 1] - bounds[:, 0]
    return np.where(width > 0.0, np.where(_LOGARITHMIC, design, width), 0.0)


def _peak_row(
    prepared: PreparedScenarios, index: int, design: FloatArray, widths: FloatArray, *, at_sensor: bool
) -> Row:
    problem, controller = prepared.problem, prepared.problem.controller(design)
    pair = prepared.pairs[index]
    run = transient_from(pair, controller, problem.approach)
    value = run.peak_sensor_force_n if at_sensor else run.peak_contact_force_n
    moment = run.time_of_sensor_peak_s if at_sensor else run.time_of_peak_s
    # A force that has crept so long is nearly at rest; unrolled that far, its derivative costs a hundred simulations.
    slope = None
    if moment <= _LATEST_TICK * problem.sample_time_s:
        slope = peak_slope(pair.contact, controller, problem.approach, moment, at_sensor=at_sensor)
    if slope is not None and abs(slope.value - value) <= _AGREES * value:
        return Row(name=PEAK, value=math.log(value), gradient=_scaled(slope, widths) / value, is_exact=True)

    # The payload has left before, or the force creeps up to its rest: what the simulation says, by differences.
    def log_peak(moved: FloatArray) -> float:
        again = transient_from(pair, problem.controller(moved), problem.approach)
        return math.log(again.peak_sensor_force_n if at_sensor else again.peak_contact_force_n)

    return Row(name=PEAK, value=math.log(value), gradient=_differences(log_peak, design, widths), is_exact=False)


def _margin_row(
    plant: PreparedMargins, problem: DesignProblem, name: str, design: FloatArray, widths: FloatArray
) -> Row:
    controller = problem.controller(design)
    margins = plant.find(controller, spectral_radius(build_loop(plant.sampled, controller)))
    value = normalise_margins(problem.requirements, margins, problem.sample_time_s)[name]
    required = getattr(problem.requirements, name)
    slope: Slope | None
    if name == "modulus_margin":
        slope = modulus_slope(plant.sampled, controller, 2.0 * math.pi * margins.modulus_hz)
    else:
        slope = _MARGIN_SLOPES[name](plant.sampled, controller)
    if slope is not None and abs(required / slope.value - value) <= _AGREES * value:
        return _row(name, required, slope, widths)
    gradient = _differences(_log_requirement(problem, plant, name), design, widths)
    return Row(name=name, value=math.log(value), gradient=gradient, is_exact=False)


def _admittance_row(prepared: PreparedScenarios, design: FloatArray, widths: FloatArray) -> Row:
    problem, name = prepared.problem, "free_space_admittance"
    target, controller = problem.requirements.free_space_admittance, problem.controller(design)
    assert target is not None
    robots = {plant.plant.robot: plant for plant in prepared.free}
    slopes = [admittance_slope(plant, controller, target.band_hz) for plant in robots.values()]
    return _row(name, target.min_m_s_per_n, min(slopes, key=lambda slope: slope.value), widths)


def _log_requirement(problem: DesignProblem, plant: PreparedMargins, name: str) -> Callable[[FloatArray], float]:
    def log_of(design: FloatArray) -> float:
        controller = problem.controller(design)
        margins = plant.find(controller, spectral_radius(build_loop(plant.sampled, controller)))
        return math.log(normalise_margins(problem.requirements, margins, problem.sample_time_s)[name])

    return log_of


def _row(name: str, required: float, slope: Slope, widths: FloatArray) -> Row:
    return Row(
        name=name,
        value=math.log(required / slope.value),
        gradient=-_scaled(slope, widths) / slope.value,
        is_exact=True,
    )


def _scaled(slope: Slope, widths: FloatArray) -> FloatArray:
    return np.asarray(slope.by_controller[: len(VARIABLES)] * widths)


def _differences(value: Callable[[FloatArray], float], design: FloatArray, widths: FloatArray) -> FloatArray:
    """Return central differences by u, one-sided where a parameter would become negative."""
    gradient = np.zeros(len(design))
    for i in np.flatnonzero(widths > 0.0):
        step = np.zeros(len(design))
        step[i] = _STEP * widths[i]
        up, down = design + step, np.maximum(design - step, 0.0)
        gradient[i] = (value(up) - value(down)) * widths[i] / (up[i] - down[i])
    return gradient


def _active_bounds(problem: DesignProblem, design: FloatArray) -> Iterator[tuple[str, FloatArray]]:
    """Yield the bounds that the design lies on, with the outward direction in u."""
    for i, name in enumerate(VARIABLES):
        low, high = problem.bounds[name]
        for side, bound, sign in (("lower", low, -1.0), ("upper", high, 1.0)):
            if high > low and abs(design[i] - bound) <= _AT_BOUND * (high - low):
                normal = np.zeros(len(VARIABLES))
                normal[i] = sign
                yield f"{side} bound of {name}", normal
