"""Scenario exchange: the worst plants of the whole uncertainty for a design, and which of them join a search.

`WholeSet` looks over grid, corners and samples, then locally from the worst few. Beyond them a search takes in
counterexamples: plants at which a proof failed, impacts that bounced for ever, and the other axes on the payload.
"""

import math
from collections.abc import Callable, Collection, Container, Hashable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from operator import attrgetter
from typing import Any, TypeVar

import numpy as np

from autotune.validation.bouncing import LEAST_FORCE, SPEEDS, RefutedError
from problems.arrays import FloatArray
from problems.contact.bouncing import Ending, follow_contact, settling_window
from problems.contact.transient import Approach, SampledContact, build_sampled_contact
from problems.design.evaluation import Evaluation, ExactEvaluation, PlantMargins, build_scenarios
from problems.design.objectives import CONTACT_FORCE, Objective
from problems.design.problem import DesignProblem
from problems.design.requirements.base import LoopRequirement
from problems.design.stable_design import StableDesign, StableLoop
from problems.design.uncertainty import Scenario
from problems.model.controller import AdmittanceController
from problems.model.plant import FREE_SPACE
from problems.model.response import hand_force_per_speed
from problems.model.sampled import build_sampled_plant
from problems.stability.margins import UnstableLoopError, prepare_margins

Place = TypeVar("Place", bound=Hashable)

DENSE_STIFFNESS, DENSE_MASS = 33, 3
SAMPLES = 128
# A margin this far from its limit on every plant that was looked at does not get there between them.
_NEAR = 0.9
# In free space a margin may fall from here to its limit between two samples of a lightly damped payload.
_NOT_FAR = 0.7
_STARTS = 2
# Looks for each direction of a climb.
_LOOKS = 12
_FIRST_STEP, _LAST_STEP = 0.08, 0.002
_GAIN = 1e-4
_UNSTABLE = 8
_WORSE = 1e-3
# Beside the impact that was found, faster and slower ones on its plant: how a contact ends hangs on the ratio of speed
# and force alone (`validation.bouncing`).
_LADDER = tuple(np.geomspace(4.0, SPEEDS[1] / LEAST_FORCE, 4).tolist())
# Of the settling time, for designs that are only looked at in passing; four of them are still enough to see a bounce.
_WINDOW_SHARE, _SHORTEST_WINDOW = 0.25, 64


class WholeSet:
    """The scenarios of a problem's whole uncertainty, prepared once, and the search between them.

    `scenarios` are the dense grid of K_e × M_p at the nominal plant and, where more is uncertain, the corners of the
    set and samples of it, and those of `also`. Deterministic for a given seed.
    """

    def __init__(self, problem: DesignProblem, seed: int = 0, also: tuple[Scenario, ...] = ()) -> None:
        self.problem = problem
        self.plants = problem.plants
        grid = problem.scenarios(DENSE_STIFFNESS, DENSE_MASS)
        more = (*self.plants.corners(), *self.plants.samples(SAMPLES, seed=seed)) if problem.plants.further else ()
        self.prepared = build_scenarios(problem, tuple(dict.fromkeys((*grid, *more, *also))))

    @property
    def scenarios(self) -> tuple[Scenario, ...]:
        """The scenarios that every design is held against."""
        return self.prepared.scenarios

    def evaluate(
        self, controller: AdmittanceController, *, climbs_objective: bool = True, every_margin: bool = False
    ) -> ExactEvaluation:
        """Evaluate exactly over the scenarios, and at the worst plants that a local search finds from them.

        Without `climbs_objective` that search looks for the worst of the requirements alone, with `every_margin` also
        of margins that are far from their limits. Raises UnstableLoopError when any of them is unstable.
        """
        exact = self.prepared.evaluate_exactly(controller)
        found = self._search(controller, exact, climbs_objective=climbs_objective, every_margin=every_margin)
        if not found:
            return exact
        return exact.together_with(build_scenarios(self.problem, found).evaluate_exactly(controller))

    def evaluate_design(self, design: FloatArray) -> tuple[Evaluation, tuple[PlantMargins, ...]]:
        """Evaluate a design (n,); an unstable scenario counts as an infinite miss, with no margins."""
        try:
            exact = self.evaluate(self.problem.controller(design))
        except UnstableLoopError:
            return self.prepared.evaluate(design), ()
        return exact.evaluation, exact.margins

    def unstable(self, controller: AdmittanceController) -> tuple[Scenario, ...]:
        """Return the scenarios of the largest spectral radii among those that are unstable."""
        radii = self.prepared.radii(controller)
        of_plant = (*self.prepared.scenarios, *self.prepared.free_of)
        order = np.argsort(-radii, kind="stable")
        found = (of_plant[i] for i in order if not radii[i] < 1.0)
        return tuple(dict.fromkeys(found))[:_UNSTABLE]

    def worst_of(self, exact: Evaluation, names: Container[str], *depends_on: str) -> tuple[Scenario, ...]:
        """Return the worst scenario for each of these requirements that depends on the robot, or on the contact."""
        design = StableDesign(self.prepared, exact.controller, peaks=exact.peaks)
        asked = [(each, value) for each, value in self.problem.requirements.of(*depends_on) if each.name in names]
        return tuple(each.worst_scenario(value, design) for each, value in asked)

    def _search(
        self, controller: AdmittanceController, exact: ExactEvaluation, *, climbs_objective: bool, every_margin: bool
    ) -> tuple[Scenario, ...]:
        if not self.plants.varying:
            return ()
        found: list[Scenario] = []
        for name, value in (*exact.evaluation.requirements.items(), *exact.evaluation.soft.items()):
            requirement = self.problem.requirements.kind(name)
            if not isinstance(requirement, LoopRequirement):
                continue
            starts = _worst_plants(exact.margins, name) if value >= _NEAR or every_margin else []
            free = [each for each in exact.margins if each.free_space]
            starts += _worst_plants(free, name, 0.0 if every_margin else _NOT_FAR)[:1]
            missed = partial(self._missed, controller, requirement, self.problem.requirements.asked()[name])
            found += [self._climb(place, partial(missed, is_free)) for place, is_free in dict.fromkeys(starts)]
            found += self._at_softest(found, partial(missed, False))
        # The objective, and the force at the contact, which may be limited whatever the objective is.
        costs: dict[Objective, list[tuple[Scenario, float]]] = {}
        if climbs_objective or self.problem.requirements.max_peak_force_n is not None:
            costs[CONTACT_FORCE] = [(p.scenario, p.peak_contact_force_n) for p in exact.evaluation.peaks]
        if climbs_objective:
            costs[self.problem.objective] = [(row.scenario, row.cost) for row in exact.evaluation.objective]
        for objective in sorted(costs, key=lambda each: each is not self.problem.objective):
            cost = partial(self._cost, controller, objective)
            worst = _worst([s for s, _ in costs[objective]], [value for _, value in costs[objective]])
            found += [self._climb(start, cost) for start in worst]
        known = set(self.scenarios)
        return tuple(s for s in dict.fromkeys(found) if s not in known)

    def _at_softest(self, found: Sequence[Scenario], value: Callable[[Scenario], float]) -> list[Scenario]:
        """Return what a climb finds from the worst of these plants on the softest surface, if that is near the limit.

        A margin has minima over K_e, and no climb crosses from one to the other.
        """
        softest = self.plants.environment_stiffness_n_per_m[0]
        moved = dict.fromkeys(replace(each, environment_stiffness_n_per_m=softest) for each in found)
        values = {each: value(each) for each in moved if each not in found}
        worst = max(values, key=lambda each: values[each], default=None)
        return [] if worst is None or values[worst] < _NEAR else [self._climb(worst, value)]

    def _missed(
        self,
        controller: AdmittanceController,
        requirement: LoopRequirement[Any],
        asked: Any,
        free_space: bool,
        scenario: Scenario,
    ) -> float:
        """Return required/achieved of the loop of a scenario, in contact or free; infinite where that is unstable."""
        plant = self.problem.plant(scenario)
        sampled = build_sampled_plant(
            plant.in_contact_with(FREE_SPACE) if free_space else plant, self.problem.sample_time_s
        )
        loop = StableLoop(sampled=sampled, controller=controller, prepared=prepare_margins(sampled))
        if not loop.spectral_radius < 1.0:
            return np.inf
        return float(requirement.ratio(asked, requirement.of_loop(asked, loop)))

    def _cost(self, controller: AdmittanceController, objective: Objective, scenario: Scenario) -> float:
        """Return the largest cost of an objective in one scenario; infinite where the loop is unstable."""
        try:
            stable = build_scenarios(self.problem, [scenario]).stable(controller)
        except UnstableLoopError:
            return np.inf
        return float(np.max(objective.costs(self.problem.requirements, stable)))

    def _climb(self, start: Scenario, value: Callable[[Scenario], float]) -> Scenario:
        """Return a scenario that is at least as bad: a pattern search in the unit cube, pulled into the set."""
        unit, best = self.plants.to_unit(start), start
        worst, step, looks = value(start), _FIRST_STEP, 0
        while step >= _LAST_STEP and looks < _LOOKS * len(unit) and np.isfinite(worst):
            moved = False
            for direction in (*np.eye(len(unit)), *-np.eye(len(unit))):
                there = np.clip(unit + step * direction, 0.0, 1.0)
                scenario = self.plants.from_unit(there)
                if np.array_equal(there, unit) or scenario == best:
                    continue
                found, looks = value(scenario), looks + 1
                if found > worst * (1.0 + _GAIN):
                    unit, best, worst, moved = there, scenario, found, True
                    break
            if not moved:
                step *= 0.25
        return best


def _worst_plants(margins: Sequence[PlantMargins], name: str, least: float = 0.0) -> list[tuple[Scenario, bool]]:
    """Return the plants that miss a requirement most, of those that use up more than `least` of it.

    Each as its scenario, and whether in free space.
    """
    known = [each for each in margins if each.ratios[name] >= least]
    return _worst([(each.scenario, each.free_space) for each in known], [each.ratios[name] for each in known])


def _worst(places: Sequence[Place], values: Sequence[float]) -> list[Place]:
    """Return the places of the largest values, a different one each."""
    order = sorted(range(len(values)), key=lambda i: -values[i])
    return list(dict.fromkeys(places[i] for i in order[: 4 * _STARTS]))[:_STARTS]


def worst_scenarios(
    problem: DesignProblem, exact: Evaluation, known: Evaluation | None, active: tuple[Scenario, ...]
) -> tuple[Scenario, ...]:
    """Return the worst scenarios that beat what the active ones showed.

    What counts is the objective, and the force at the contact where it is limited.
    """
    if known is None or not exact.peaks:
        return ()
    found = []
    if problem.requirements.max_peak_force_n is not None:
        force = attrgetter("peak_contact_force_n")
        peak = max(exact.peaks, key=force)
        if force(peak) > (1.0 + _WORSE) * max(map(force, known.peaks)):
            found.append(peak.scenario)
    row = max(exact.objective, key=attrgetter("cost"))
    if row.cost > (1.0 + _WORSE) * known.objective_cost:
        found.append(row.scenario)
    return tuple(scenario for scenario in dict.fromkeys(found) if scenario not in active)


def softly_missed_scenarios(
    whole: WholeSet, exact: Evaluation, known: Evaluation | None, margins: tuple[PlantMargins, ...]
) -> tuple[Scenario, ...]:
    """Return the scenarios where soft requirements cost more than the active ones showed."""
    if known is None:
        return ()
    least = _WORSE * exact.cost
    worse = [name for name, cost in exact.soft_cost_n.items() if cost > known.soft_cost_n.get(name, 0.0) + least]
    return scenarios_of(whole, exact, margins, worse)


def scenarios_of(
    whole: WholeSet, exact: Evaluation, margins: tuple[PlantMargins, ...], names: Sequence[str]
) -> tuple[Scenario, ...]:
    """Return for each of these requirements the scenario that misses it most; each brings its free space along."""
    found = whole.worst_of(exact, names, "robot", *(["contact"] if exact.peaks else []))
    return (*found, *margin_scenarios(dict.fromkeys(names, np.inf), margins))


def missing_scenarios(
    whole: WholeSet, design: FloatArray, exact: Evaluation, margins: tuple[PlantMargins, ...]
) -> tuple[Scenario, ...]:
    """Return the scenarios in which a design is unstable, or misses a requirement most."""
    if not exact.is_stable:
        # Stability is cheap to ask, so the grid joins too.
        unstable = whole.unstable(whole.problem.controller(design))
        return (*unstable, *whole.problem.scenarios(DENSE_STIFFNESS, 2))
    missing = [name for name, value in exact.requirements.items() if value > 1.0]
    return scenarios_of(whole, exact, margins, missing) if missing else ()


def margin_scenarios(
    ratios: Mapping[str, float], margins: tuple[PlantMargins, ...], limit: float = 1.0
) -> tuple[Scenario, ...]:
    """Return for every requirement of a loop whose required/achieved is above `limit` the scenario of the largest."""
    missed = [name for name, value in ratios.items() if value > limit and margins and name in margins[0].ratios]
    return tuple(margins[int(np.argmax([each.ratios[name] for each in margins]))].scenario for name in missed)


def missed_elsewhere(
    exact: Evaluation, margins: tuple[PlantMargins, ...], active: Collection[Scenario]
) -> tuple[str, ...]:
    """Return the requirements of a loop that are missed on none of the active scenarios: no grid flattered those."""
    known = [each.ratios for each in margins if each.scenario in active]
    return tuple(
        name
        for name, value in exact.requirements.items()
        if value > 1.0 and known and all(each.get(name, np.inf) <= 1.0 for each in known)
    )


def moved_scenario(scenario: Scenario, old: DesignProblem, new: DesignProblem) -> Scenario:
    """Return a scenario at the same share of the new range of K_e, the other parameters as they are."""
    (low, high), (new_low, new_high) = (each.plants.environment_stiffness_n_per_m for each in (old, new))
    stiffness = scenario.environment_stiffness_n_per_m
    if stiffness >= high:
        return replace(scenario, environment_stiffness_n_per_m=new_high)
    moved = new_low * (new_high / new_low) ** (math.log(stiffness / low) / math.log(high / low))
    return replace(scenario, environment_stiffness_n_per_m=min(max(moved, new_low), new_high))


@dataclass(frozen=True, kw_only=True)
class Counterexamples:
    """Plants that join the scenarios of a search, and impacts that must come to rest as (plant, ratio s).

    s is the speed at the impact times (B_a + B_p) over F^d, so that it is the same impact whatever the damping.
    `beside` says of a law whether it goes with those of the other axes on the payload, `soft` whether with the
    payload's bumper; None where nothing is asked.
    """

    scenarios: tuple[Scenario, ...] = ()
    impacts: tuple[tuple[Scenario, float], ...] = ()
    beside: Callable[[AdmittanceController], bool] | None = None
    soft: Callable[[AdmittanceController], bool] | None = None

    def joined(self, error: RefutedError) -> "Counterexamples":
        """Return the same with what an error names."""
        if error.impact is None:
            return replace(self, scenarios=tuple(dict.fromkeys((*self.scenarios, error.scenario))))
        impact = (error.scenario, error.impact.ratio)
        return replace(self, impacts=tuple(dict.fromkeys((*self.impacts, impact))))


NOTHING = Counterexamples()


class ImpactTest:
    """Tests whether designs come to rest after the impacts of counterexamples, and go with what else these name."""

    def __init__(self, problem: DesignProblem, counterexamples: Counterexamples) -> None:
        self._problem = problem
        self._beside, self._soft = counterexamples.beside, counterexamples.soft
        self._known: dict[bytes, bool] = {}
        self._cases: list[tuple[SampledContact, Sequence[float]]] = []
        for scenario, ratio in counterexamples.impacts:
            pair = build_sampled_contact(build_sampled_plant(problem.plant(scenario), problem.sample_time_s))
            self._cases.append((pair, (ratio, *_LADDER)))

    def __bool__(self) -> bool:
        return bool(self._cases) or self._beside is not None or self._soft is not None

    @property
    def failing(self) -> str:
        """What a design does that does not pass, for a sentence."""
        others = [
            *(["does not go with the other axes on the payload"] if self._beside is not None else []),
            *(["misses something with the bumper of the payload"] if self._soft is not None else []),
        ]
        if not others:
            return "lets a contact bounce for ever"
        return ", or ".join([*others, *(["lets a contact bounce"] if self._cases else [])])

    def passes(self, design: FloatArray) -> bool:
        """Return whether a design (n,) that is stable in both loops passes everything."""
        key = np.asarray(design).tobytes()
        if key not in self._known:
            controller = self._problem.controller(design)
            goes = all(each is None or each(controller) for each in (self._soft, self._beside))
            self._known[key] = goes and all(_comes_to_rest(pair, controller, ratios) for pair, ratios in self._cases)
        return self._known[key]

    def walk_back(self, passing: FloatArray, end: FloatArray) -> FloatArray:
        """Return the design nearest to `end` on the line from a passing one that passes; `end` where none does."""
        if self.passes(end) or not self.passes(passing):
            return end
        low, high = 0.0, 1.0
        for _ in range(_WALK_STEPS):
            middle = 0.5 * (low + high)
            low, high = (middle, high) if self.passes(passing + middle * (end - passing)) else (low, middle)
        # Not to the very edge: what is written has six digits.
        return np.asarray(passing + _INSIDE * low * (end - passing))


_WALK_STEPS, _INSIDE = 7, 0.98


def _comes_to_rest(pair: SampledContact, controller: AdmittanceController, ratios: Sequence[float]) -> bool:
    try:
        window = max(_SHORTEST_WINDOW, int(_WINDOW_SHARE * settling_window(pair, controller)))
    except UnstableLoopError:
        return False
    resistance = hand_force_per_speed(pair.free.plant, controller)
    for ratio in ratios:
        approach = Approach(speed_m_s=ratio / resistance, after_impact_n=1.0)
        if follow_contact(pair, controller, approach, window=window).ending is Ending.BOUNCING:
            return False
    return True


def misses(evaluation: Evaluation) -> str:
    """Say what a design misses, and by how much."""
    missed = [(name, value) for name, value in evaluation.requirements.items() if value > 1.0]
    return (
        ", ".join(f"{name} (only {min(100.0 / value, 99.9):.3g} % of what is asked)" for name, value in missed)
        or "a peak"
    )
