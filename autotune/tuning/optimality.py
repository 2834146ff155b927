"""Is the design optimal, and what does each requirement cost: the Karush–Kuhn–Tucker conditions at the result.

In u (variables that may be zero by the width of their bounds, the others by their logarithm) the search minimises the
largest φ_s = ln F_s over the scenarios under c_j = ln(required/achieved) ≤ 0. At an optimum some λ_s ≥ 0 of sum 1,
μ_j ≥ 0 and ν_b ≥ 0 balance Σ λ_s ∇φ_s + Σ μ_j ∇c_j + Σ ν_b n_b = 0 over what is active; what is left of that sum is the
residual, and Σ λ_s (φ − φ_s) + Σ μ_j |c_j| is what the design could still gain, to first order, by using up its slack.
μ_j is the share by which the peak grows when requirement j is raised by one share. A soft requirement that is missed,
with the price p and the ratio r = e^c, has multipliers of the sum p r/F: what missing it costs; just met, at most that.
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

from problems.contact.transient import transient_from
from problems.design.evaluation import PreparedScenarios, normalise_margins, normalise_plant, passivity_ratios
from problems.design.gradients import (
    Gradient,
    admittance_gradient,
    decay_gradient,
    delay_gradient,
    gain_gradient,
    modulus_gradient,
    passivity_gradient,
    peak_gradient,
    phase_gradient,
)
from problems.design.problem import FURTHER_VARIABLES, VARIABLES, DesignProblem
from problems.design.requirements import LARGEST_SHARE
from problems.model.controller import AdmittanceController
from problems.model.sampled import SampledPlant, build_loop, spectral_radius
from problems.stability.margins import PreparedMargins
from problems.stability.noise import command_speed_gain
from problems.stability.passivity import PreparedPort

from .bounds import bounds_of, linear_variables

FloatArray = NDArray[np.float64]
Key = tuple[str, int]

PEAK = "peak"
_NEAR = 2e-3
_AGREES = 2e-3
_STEP = 1e-5
_LATEST_TICK = 600
_SUM_WEIGHT = 1e3
_AT_BOUND = 1e-6
LEAST_RATIO = 1e-100
# The order of the controller's parameters in a slope.
_PARAMETERS = (*VARIABLES, *FURTHER_VARIABLES)

_MARGIN_SLOPES: dict[str, Callable[[SampledPlant, AdmittanceController], Gradient | None]] = {
    "gain_margin_db": gain_gradient,
    "phase_margin_deg": phase_gradient,
    "delay_margin_s": delay_gradient,
    "decay_rate_per_s": decay_gradient,
}


@dataclass(frozen=True, kw_only=True)
class Row:
    """A peak or requirement near its limit: its logarithm and the gradient of that by u, (n,).

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
    """Check the conditions at a stable design (n,) over prepared scenarios."""
    peaks, limits = active_rows(prepared, design)
    count, bounds = len(design), dict(_active_bounds(prepared.problem, design))
    top = [row for row in peaks if row.value >= max(row.value for row in peaks) - _NEAR]
    prices = _prices(prepared.problem, top, limits)
    columns = [row.gradient for row in top] + [row.gradient for row in limits] + list(bounds.values())
    # What is just met need not take its whole price: the rest goes to a column without gradient.
    spare = [name for name, (_, _, is_missed) in prices.items() if not is_missed]
    columns += [np.zeros(count)] * len(spare)
    left = [max(row.value for row in top) - row.value for row in top]
    left += [(prices[row.name][1] if row.name in prices else 0.0) - row.value for row in limits]
    slack = np.maximum([*left, *[0.0] * (len(bounds) + len(spare))], 0.0)
    # λ sum to one, those of a soft requirement to its price: rows so heavy that the sums are met to rounding. Of many
    # active rows those without slack.
    groups = [*[PEAK] * len(top), *(row.name for row in limits), *bounds, *spare]
    sums = {PEAK: 1.0, **{name: price for name, (price, _, _) in prices.items()}}
    heavy = [[_SUM_WEIGHT * (group == name) for group in groups] for name in sums]
    matrix = np.vstack([np.column_stack(columns), slack, heavy])
    weights, _ = nnls(matrix, np.concatenate([np.zeros(count + 1), _SUM_WEIGHT * np.array(list(sums.values()))]))
    balance = matrix[:count] @ weights
    merged: dict[str, float] = {}
    for name, weight in list(zip(groups, weights, strict=True))[len(top) : len(groups) - len(spare)]:
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


def _prices(problem: DesignProblem, top: list[Row], limits: tuple[Row, ...]) -> dict[str, tuple[float, float, bool]]:
    """Return for each active soft requirement p r/F, its largest c, and whether it is missed by more than a hair."""
    peak, found = math.exp(max(row.value for row in top)), {}
    for name, price in problem.requirements.soft_n.items():
        worst = max((row.value for row in limits if row.name == name), default=None)
        if worst is not None:
            ratio = math.exp(min(worst, math.log(LARGEST_SHARE)))
            found[name] = (price * ratio / peak, max(worst, 0.0), worst > _NEAR)
    return found


def active_rows(
    prepared: PreparedScenarios, design: FloatArray, near: float = _NEAR
) -> tuple[tuple[Row, ...], tuple[Row, ...]]:
    """Return the peaks within `near` of the largest one, and the requirements within `near` of their limit.

    Of a soft requirement that is missed those within `near` of the worst.
    """
    rows = {key: row_at(prepared, design, key) for key in near_keys(prepared, design, near)}
    peaks = tuple(row for (name, _), row in rows.items() if name == PEAK)
    return peaks, tuple(row for (name, _), row in rows.items() if name != PEAK)


def near_keys(prepared: PreparedScenarios, design: FloatArray, near: float) -> tuple[Key, ...]:
    """Return which peaks lie within `near` of the largest one, then which requirements of their limit or worst.

    A key is a name and the index of a scenario, of a plant, or 0.
    """
    problem, controller = prepared.problem, prepared.problem.controller(design)
    found = prepared.peaks(controller)
    values = np.array(
        [p.peak_contact_force_n if problem.objective == "contact_force" else p.peak_sensor_force_n for p in found]
    )
    keys = [(PEAK, int(i)) for i in np.flatnonzero(np.log(values) >= math.log(float(np.max(values))) - near)]
    asked, ratios = problem.requirements, dict[str, list[float]]()
    for each in prepared.margins(controller, prepared.radii(controller)):
        for name, value in normalise_plant(asked, each, problem.sample_time_s).items():
            ratios.setdefault(name, []).append(value)
    ratios |= {name: [value] for name, value in prepared.achieved_admittance(controller).items()}
    if asked.passivity is not None:
        ratios["passivity"] = list(passivity_ratios(asked.passivity, prepared.ports, controller))
    if asked.max_peak_force_n is not None:
        ratios["max_peak_force_n"] = [p.peak_contact_force_n / asked.max_peak_force_n for p in found]
    for name, of_name in ratios.items():
        logs = np.log(np.clip(of_name, LEAST_RATIO, LARGEST_SHARE))
        limit = max(0.0, float(np.max(logs))) if name in asked.soft_n else 0.0
        keys += [(name, int(i)) for i in np.flatnonzero(logs >= limit - near)]
    return tuple(keys)


def row_at(prepared: PreparedScenarios, design: FloatArray, key: Key) -> Row:
    """Return value and gradient of one peak or requirement, named by `near_keys`, at a stable design (n,)."""
    problem, (name, index) = prepared.problem, key
    widths = unit_widths(problem, design)
    if name == PEAK:
        return _peak_row(prepared, index, design, widths, at_sensor=problem.objective != "contact_force")
    if name == "max_peak_force_n":
        row = _peak_row(prepared, index, design, widths, at_sensor=False)
        return replace(row, name=name, value=row.value - math.log(problem.requirements.max_peak_force_n or 1.0))
    if name == "free_space_admittance":
        return _admittance_row(prepared, design, widths)
    if name == "passivity":
        return _passivity_row(prepared.ports[index], problem, design, widths)
    if name == "command_noise":
        return _noise_row(prepared.plants[index].sampled, problem, design, widths)
    return _margin_row(prepared.plants[index], problem, name, design, widths)


def unit_widths(problem: DesignProblem, design: FloatArray) -> FloatArray:
    """Return dx/du of every variable (n,): itself where u is a logarithm, else the width of the bounds.

    A variable that its bounds fix does not move: 0.
    """
    bounds = bounds_of(problem)
    width = bounds[:, 1] - bounds[:, 0]
    return np.where(width > 0.0, np.where(linear_variables(problem), width, design), 0.0)


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
    if moment <= _LATEST_TICK * problem.sample_time_s and _moves_exactly(problem, controller):
        slope = peak_gradient(pair.contact, controller, problem.approach, moment, at_sensor=at_sensor)
    if slope is not None and abs(slope.value - value) <= _AGREES * value:
        return Row(name=PEAK, value=math.log(value), gradient=_scaled(slope, problem, widths) / value, is_exact=True)

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
    slope: Gradient | None
    if name == "modulus_margin":
        slope = modulus_gradient(plant.sampled, controller, 2.0 * math.pi * margins.modulus_hz)
    else:
        slope = _MARGIN_SLOPES[name](plant.sampled, controller)
    exact = slope is not None and _moves_exactly(problem, controller)
    if exact and slope is not None and abs(required / slope.value - value) <= _AGREES * value:
        return _row(name, required, slope, problem, widths)
    gradient = _differences(_log_requirement(problem, plant, name), design, widths)
    return Row(name=name, value=math.log(value), gradient=gradient, is_exact=False)


def _admittance_row(prepared: PreparedScenarios, design: FloatArray, widths: FloatArray) -> Row:
    problem, name = prepared.problem, "free_space_admittance"
    target, controller = problem.requirements.free_space_admittance, problem.controller(design)
    assert target is not None
    robots = {plant.plant.port: plant for plant in prepared.free}
    if not _moves_exactly(problem, controller):

        def log_of(moved: FloatArray) -> float:
            return math.log(prepared.achieved_admittance(problem.controller(moved))[name])

        gradient = _differences(log_of, design, widths)
        return Row(name=name, value=log_of(design), gradient=gradient, is_exact=False)
    slopes = [admittance_gradient(plant, controller, target.band_hz) for plant in robots.values()]
    return _row(name, target.min_m_s_per_n, min(slopes, key=lambda slope: slope.value), problem, widths)


def _passivity_row(port: PreparedPort, problem: DesignProblem, design: FloatArray, widths: FloatArray) -> Row:
    target, controller = problem.requirements.passivity, problem.controller(design)
    assert target is not None

    def log_of(moved: FloatArray) -> float:
        ratio = float(passivity_ratios(target, [port], problem.controller(moved))[0])
        return math.log(min(ratio, LARGEST_SHARE))

    value = log_of(design)
    fails_hz = target.passive_below_hz / math.exp(value)
    if (
        _moves_exactly(problem, controller)
        and value < math.log(LARGEST_SHARE)
        and fails_hz < 0.499 / port.sampled.sample_time_s
    ):
        slope = passivity_gradient(port.sampled, controller, fails_hz)
        return _row("passivity", target.passive_below_hz, slope, problem, widths)
    return Row(name="passivity", value=value, gradient=_differences(log_of, design, widths), is_exact=False)


def _noise_row(sampled: SampledPlant, problem: DesignProblem, design: FloatArray, widths: FloatArray) -> Row:
    """Return the command's noise; it is smooth, so central differences give all the digits that matter."""
    limit = problem.requirements.command_noise
    assert limit is not None

    def log_of(moved: FloatArray) -> float:
        return math.log(limit.ratio(command_speed_gain(sampled, problem.controller(moved))))

    gradient = _differences(log_of, design, widths)
    return Row(name="command_noise", value=log_of(design), gradient=gradient, is_exact=False)


def _moves_exactly(problem: DesignProblem, controller: AdmittanceController) -> bool:
    """Whether the symbolic form has every variable: without compensation it leaves P̂ out."""
    return controller.compensates or "compensation_mass_kg" not in problem.variables


def _log_requirement(problem: DesignProblem, plant: PreparedMargins, name: str) -> Callable[[FloatArray], float]:
    def log_of(design: FloatArray) -> float:
        controller = problem.controller(design)
        margins = plant.find(controller, spectral_radius(build_loop(plant.sampled, controller)))
        return math.log(normalise_margins(problem.requirements, margins, problem.sample_time_s)[name])

    return log_of


def _row(name: str, required: float, slope: Gradient, problem: DesignProblem, widths: FloatArray) -> Row:
    return Row(
        name=name,
        value=math.log(required / slope.value),
        gradient=-_scaled(slope, problem, widths) / slope.value,
        is_exact=True,
    )


def _scaled(slope: Gradient, problem: DesignProblem, widths: FloatArray) -> FloatArray:
    free = [_PARAMETERS.index(name) for name in problem.variables]
    return np.asarray(slope.by_controller[free] * widths)


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
    for i, name in enumerate(problem.variables):
        low, high = problem.bounds[name]
        for side, bound, sign in (("lower", low, -1.0), ("upper", high, 1.0)):
            if high > low and abs(design[i] - bound) <= _AT_BOUND * (high - low):
                normal = np.zeros(len(design))
                normal[i] = sign
                yield f"{side} bound of {name}", normal
