"""Which scenarios join the search: where a design is worse, over the whole uncertainty, than the known ones showed."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from operator import attrgetter

import numpy as np

from problems.design.evaluation import Evaluation, PlantMargins
from problems.design.problem import DesignProblem
from problems.design.uncertainty import Scenario

from .worst import WholeSet

_WORSE_PEAK = 1e-3


def worst_scenarios(
    problem: DesignProblem, exact: Evaluation, known: Evaluation | None, active: tuple[Scenario, ...]
) -> tuple[Scenario, ...]:
    """Return the scenarios with the highest peaks that beat what the active ones showed.

    What counts is the objective's force, and the one at the contact where it is limited.
    """
    if known is None or not exact.peaks:
        return ()
    kinds = {"peak_contact_force_n" if problem.objective == "contact_force" else "peak_sensor_force_n"}
    if problem.requirements.max_peak_force_n is not None:
        kinds.add("peak_contact_force_n")
    found = []
    for force in map(attrgetter, sorted(kinds)):
        worst = max(exact.peaks, key=force)
        if force(worst) > (1.0 + _WORSE_PEAK) * max(map(force, known.peaks)) and worst.scenario not in active:
            found.append(worst.scenario)
    return tuple(found)


def softly_missed_scenarios(
    whole: WholeSet, exact: Evaluation, known: Evaluation | None, margins: tuple[PlantMargins, ...]
) -> tuple[Scenario, ...]:
    """Return the scenarios where soft requirements cost more than the active ones showed."""
    if known is None:
        return ()
    least = _WORSE_PEAK * exact.objective_n
    worse = [name for name, cost in exact.soft_cost_n.items() if cost > known.soft_cost_n.get(name, 0.0) + least]
    return scenarios_of(whole, exact, margins, worse)


def scenarios_of(
    whole: WholeSet, exact: Evaluation, margins: tuple[PlantMargins, ...], names: Sequence[str]
) -> tuple[Scenario, ...]:
    """Return for each of these requirements the scenario that misses it most; each brings its free space along."""
    found = whole.worst_of(exact, names, "robot", *(["contact"] if exact.peaks else []))
    return (*found, *margin_scenarios(dict.fromkeys(names, np.inf), margins))


def margin_scenarios(
    ratios: Mapping[str, float], margins: tuple[PlantMargins, ...], limit: float = 1.0
) -> tuple[Scenario, ...]:
    """Return for every requirement of a loop whose required/achieved is above `limit` the scenario of the largest."""
    missed = [name for name, value in ratios.items() if value > limit and margins and name in margins[0].ratios]
    return tuple(margins[int(np.argmax([each.ratios[name] for each in margins]))].scenario for name in missed)


def moved_scenario(scenario: Scenario, old: DesignProblem, new: DesignProblem) -> Scenario:
    """Return a scenario at the same share of the new range of K_e, the other parameters as they are."""
    (low, high), (new_low, new_high) = old.environment_stiffness_n_per_m, new.environment_stiffness_n_per_m
    stiffness = scenario.environment_stiffness_n_per_m
    if stiffness >= high:
        return replace(scenario, environment_stiffness_n_per_m=new_high)
    moved = new_low * (new_high / new_low) ** (math.log(stiffness / low) / math.log(high / low))
    return replace(scenario, environment_stiffness_n_per_m=min(max(moved, new_low), new_high))
