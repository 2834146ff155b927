"""Evaluate given designs over the dense scenarios: an existing controller beside the new one, or one chosen by hand."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from autotune.errors import InfeasibleError, UsageError
from autotune.formats.controller import ControllerFile
from autotune.formats.controller_record import is_linear
from autotune.prediction.law import PresentGains
from problems.arrays import FloatArray
from problems.design.evaluation import PreparedScenarios, build_scenarios
from problems.design.problem import BIQUAD_VARIABLES, CONTROLLER_VARIABLES, FURTHER_VARIABLES, DesignProblem
from problems.design.requirements import smallest_admittance
from problems.model.controller import AdmittanceController
from problems.model.response import hand_force_per_speed
from problems.stability.margins import UnstableLoopError

from .bounds import bounds_of, presentable
from .record import MARGIN_NAMES, admittance_band_hz
from .scenario_exchange import WholeSet
from .search import SearchResult

_SAME_PERIOD = 1e-6


@dataclass(frozen=True, kw_only=True)
class Performance:
    """What a stable controller does over the uncertainty: worst peaks, smallest margins, least |G| over the band.

    `missed` maps each requirement that is not met to required/achieved.
    """

    peak_sensor_force_n: float
    peak_contact_force_n: float
    margins: Mapping[str, float]
    min_m_s_per_n: float
    hand_force_n_per_m_s: float
    missed: Mapping[str, float]


@dataclass(frozen=True, kw_only=True)
class EvaluatedController:
    """One controller on one axis; `performance` is None when the loop is unstable, since nothing of it is a number.

    `unstable_at` is then the worst plant, M_p and K_e (0 in free space).
    """

    law: AdmittanceController
    spectral_radius: float
    performance: Performance | None
    unstable_at: tuple[float, float] | None = None


@dataclass(frozen=True, kw_only=True)
class SideBySide:
    """The old and the new controller of one axis; `is_start`: whether the search began from the old one too."""

    old: EvaluatedController
    new: EvaluatedController
    is_start: bool


def check_comparable(present: PresentGains, problems: Mapping[str, DesignProblem]) -> None:
    """Raise UsageError unless the present gains have one of the axes and run as the new ones will."""
    if not set(problems) & set(present.laws):
        where = present.label if present.file is None else present.file.path
        raise UsageError(
            f"{where} holds {', '.join(present.laws)}, and {', '.join(problems)} is tuned here; compare with a "
            "controller of the same axes."
        )
    if present.file is not None:
        _check_same_run(present.file, problems)


def _check_same_run(old: ControllerFile, problems: Mapping[str, DesignProblem]) -> None:
    """Raise UsageError for a controller file of another period, or with more than gains."""
    controller = old.controller
    period = next(iter(problems.values())).sample_time_s
    if abs(controller.sample_time_s / period - 1.0) > _SAME_PERIOD:
        raise UsageError(
            f"{old.path} runs every {controller.sample_time_s * 1e3:.6g} ms and this cell every {period * 1e3:.6g} ms; "
            "its numbers make another controller here."
        )
    if not is_linear(controller):
        raise UsageError(
            f"{old.path} responds to collisions or varies its damping, which the comparison does not evaluate; compare "
            "with its gains alone, optimized without free.collision_threshold_n and variable_damping_n_s_per_m."
        )


def start_design(law: AdmittanceController, problem: DesignProblem) -> FloatArray | None:
    """Return gains as a design of a problem, None where they lie outside of its bounds."""
    if law.has_biquad != (BIQUAD_VARIABLES[0] in problem.variables):
        return None
    values = dict(zip(CONTROLLER_VARIABLES, law.numbers(), strict=False))
    fixed = dict(zip(values, problem.controller(bounds_of(problem)[:, 0]).numbers(), strict=True))
    held = [each for each in _in_use(law) if each not in problem.variables]
    if any(values[each] != fixed[each] for each in held):
        return None
    design = np.array([values[each] for each in problem.variables])
    bounds = bounds_of(problem)
    return design if bool(np.all((bounds[:, 0] <= design) & (design <= bounds[:, 1]))) else None


def _in_use(law: AdmittanceController) -> tuple[str, ...]:
    """Return which of the further variables change what the law does; its velocity filter counts in any case."""
    return FURTHER_VARIABLES if law.compensates else ("velocity_filter_rad_per_s", "compensation_mass_kg")


def compare(old: PresentGains, searches: Mapping[str, SearchResult]) -> dict[str, SideBySide]:
    """Evaluate both controllers of every axis that both have, exactly, over the dense grid of the new problem."""
    found = {}
    for name, search in searches.items():
        if name in old.laws:
            problem = search.problem
            dense, law = WholeSet(problem).prepared, old.laws[name].controller
            found[name] = SideBySide(
                old=evaluate_controller(dense, law),
                new=evaluate_controller(dense, problem.controller(search.design)),
                is_start=start_design(law, problem) is not None,
            )
    return found


def evaluate_controller(prepared: PreparedScenarios, law: AdmittanceController) -> EvaluatedController:
    """Evaluate one controller over the scenarios."""
    radii = prepared.radii(law)
    worst = int(np.argmax(radii))
    radius = float(radii[worst])
    if not radius < 1.0:
        plant = prepared.plants[worst].sampled.plant
        where = plant.payload.mass_kg, plant.environment.stiffness_n_per_m
        return EvaluatedController(law=law, spectral_radius=radius, performance=None, unstable_at=where)
    exact = prepared.evaluate_exactly(law)
    peaks, problem = exact.evaluation.peaks, prepared.problem
    band = admittance_band_hz(problem.requirements)
    performance = Performance(
        peak_sensor_force_n=max(peak.peak_sensor_force_n for peak in peaks),
        peak_contact_force_n=max(peak.peak_contact_force_n for peak in peaks),
        margins={name: min(float(getattr(each.margins, name)) for each in exact.margins) for name in MARGIN_NAMES},
        min_m_s_per_n=smallest_admittance(prepared.free[0], law, band),
        hand_force_n_per_m_s=hand_force_per_speed(problem.plants.nominal, law),
        missed={name: value for name, value in exact.evaluation.requirements.items() if value > 1.0},
    )
    return EvaluatedController(law=law, spectral_radius=radius, performance=performance)


def judge_design(problem: DesignProblem, design: FloatArray, *, seed: int = 0) -> SearchResult:
    """Evaluate one design (n,), exactly and over the whole uncertainty, as the result of a search that chose it.

    The design is taken with six digits, as a search writes its own. Raises InfeasibleError, with what is missed, for a
    design that lies outside the bounds, is unstable for a plant of the uncertainty, or misses a requirement.
    """
    bounds, chosen = bounds_of(problem), presentable(problem, design)
    for name, value, (low, high) in zip(problem.variables, design, bounds, strict=True):
        # Six digits may lie outside of a bound by half of the last one.
        if not low * (1.0 - 1e-6) <= value <= high * (1.0 + 1e-6):
            raise InfeasibleError(f"{name} must lie within {low:g} and {high:g}, found {value:g}.")
    whole = WholeSet(problem, seed)
    try:
        exact = whole.evaluate(problem.controller(chosen))
    except UnstableLoopError as error:
        raise InfeasibleError(
            f"The design is unstable for a plant of the whole set (largest |z| = {error.spectral_radius:.4f})."
        ) from error
    missed = {name: value for name, value in exact.evaluation.requirements.items() if value > 1.0}
    if missed:
        names = ", ".join(
            f"{name} ({min(100.0 / value, 99.9):.3g} % of what is asked)" for name, value in missed.items()
        )
        raise InfeasibleError(f"The design misses {names} over the whole set of plants.")
    return SearchResult(
        problem=problem,
        design=chosen,
        evaluation=exact.evaluation,
        margins=exact.margins,
        active=build_scenarios(problem, problem.scenarios(3, 2)),
        scenario_count=len(whole.scenarios),
        rounds=0,
        evaluations=1,
    )
