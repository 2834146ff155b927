"""Search the controller: a seeded global stage, a local polish, and worst-case scenario exchange."""

from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import OptimizeResult, differential_evolution

from autotune.errors import AutotuneError, InfeasibleError
from problems.arrays import FloatArray
from problems.design.batch_evaluation import BatchEvaluator, build_batch_evaluator
from problems.design.batch_result import BatchEvaluation
from problems.design.evaluation import Evaluation, PlantMargins, PreparedScenarios, build_scenarios
from problems.design.problem import BIQUAD_VARIABLES, DesignProblem
from problems.design.uncertainty import Scenario
from problems.progress import no_progress

from .bounds import Box, presentable, spread_out, without_lead
from .descent import BACKOFF, SHORT_WAY, descend, polish_exactly
from .scenario_exchange import (
    NOTHING,
    Counterexamples,
    ImpactTest,
    WholeSet,
    missed_elsewhere,
    misses,
    missing_scenarios,
    moved_scenario,
    softly_missed_scenarios,
    worst_scenarios,
)

_POPULATION, _GENERATIONS, _NEARBY_GENERATIONS = 10, 60, 10
_GATHERED = 0.03
_ROUNDS = 8
# Rounds in which a scenario that joins is given the chance to ask for itself, before more is asked of all.
_PATIENT = 2
_POLISH_STARTS, _OTHER_VALLEYS = 3, 6
# Eight numbers take a longer way, begun anew halfway: the curvature that was learnt far off misleads at its end. One
# that ends a little outside of what is asked goes on.
_WITH_BIQUAD, _LEGS, _MOST_LEGS = 15, 2, 5
_SAME, _NEAR, _FAR = 1e-3, 0.1, 0.45
# Steps along a kink end a little outside: further legs keep more in hand.
_IN_HAND = 5e-4
# A valley that ends higher than this is left: more scenarios only raise it.
_CLOSE = 1.01
# What six digits may cost a requirement.
_RESERVE = 5e-6
_HAIR = 2e-3
# Costs of designs that miss something lie above every force, those of unstable ones above these.
_UNSTABLE = 1e15
_MISSED = 1e12
# A design that misses nothing, but lets a contact bounce for ever.
_BOUNCES = 1.0001 * _MISSED
_FAR_OFF = 0.1


@dataclass(frozen=True, kw_only=True)
class SearchStep:
    """State of the search after so many `evaluations`: `best_cost` over the `scenarios` that it then worked with.

    `whole_cost` is that design's cost over the whole set, at the end of a round; None within the global stage.
    """

    evaluations: int
    scenarios: int
    best_cost: float
    whole_cost: float | None = None


@dataclass(frozen=True, kw_only=True)
class SearchResult:
    """The chosen design, the values of `problem.variables`, and its evaluation.

    `evaluation` is exact (refined margins) over the dense grid of `scenario_count` scenarios; `active` the scenarios
    that the search worked with; `margins` plant by plant; `rounds` how often the worst of the rest was added;
    `evaluations` of designs. `steps` is its progress, from its first feasible design on.
    """

    problem: DesignProblem
    design: FloatArray
    evaluation: Evaluation
    margins: tuple[PlantMargins, ...]
    active: PreparedScenarios
    scenario_count: int
    rounds: int
    evaluations: int
    steps: tuple[SearchStep, ...] = ()


def solve_design(
    problem: DesignProblem,
    *,
    seed: int = 0,
    start: FloatArray | None = None,
    neighbour: SearchResult | None = None,
    counterexamples: Counterexamples = NOTHING,
    others: Sequence[FloatArray] = (),
    explores: bool = True,
    progress: Callable[[float], None] | None = None,
) -> SearchResult:
    """Find the design of the best worst objective that is stable and meets every requirement in every scenario.

    Deterministic for a given seed and `start`, a design (n,) inside the bounds that joins the search; from `others`
    descents begin too. Unless it `explores`, or from the `start` of a biquad, it begins nowhere else. Nothing unstable
    or infeasible is returned: the result is evaluated again, exactly, over a dense grid of the whole uncertainty.
    `neighbour` is the result for another range of K_e: the search begins at its design and with what was worst there,
    and looks around less, so that it may take a valley's end for the best that a search from nowhere would leave.
    `counterexamples` adds plants to the scenarios, and impacts that must come to rest (on a part of their settling
    time: who writes the design down looks again). Raises InfeasibleError with the closest miss when there is none.
    `progress` is called with the share of the work done since the last call.
    """
    report = progress or no_progress
    search, active = _begun(problem, seed, start, neighbour, counterexamples)
    whole = WholeSet(problem, seed, counterexamples.scenarios)
    # The given design is kept if nothing better is found: margins held in reserve could cost a hair otherwise.
    given = None if start is None else (start, *whole.evaluate_design(start))
    search.elite = [search.box.unit(each) for each in others]
    if explores and not (start is not None and search.has_biquad):
        unit = search.explore(active, lambda share: report(0.6 * share))
    else:
        unit = search.elite[0] if start is None else search.box.unit(start)
    for round_index in range(_ROUNDS):
        unit = search.polish(active, unit)
        design = presentable(problem, search.box.design(unit))
        exact, margins = whole.evaluate_design(design)
        report(0.4 / _ROUNDS)
        search.note_round(len(active), exact)
        worse = worst_scenarios(problem, exact, search.last, active)
        worse += tuple(s for s in softly_missed_scenarios(whole, exact, search.last, margins) if s not in active)
        missed = exact.violation
        if not worse and missed <= 0.0:
            if given is not None and search.prefers(given[0], given[1], exact):
                design, exact, margins = given
            return SearchResult(
                problem=problem,
                design=design,
                evaluation=exact,
                margins=margins,
                active=build_scenarios(problem, active),
                scenario_count=len(whole.scenarios),
                rounds=round_index + 1,
                evaluations=search.evaluations,
                steps=tuple(search.steps),
            )
        joined = tuple(dict.fromkeys((*active, *worse, *missing_scenarios(whole, design, exact, margins))))
        # A scenario that joins asks for itself; what is asked for more stays, also once it no longer binds.
        if missed <= _HAIR or len(joined) == len(active):
            asks = round_index < _PATIENT and len(joined) > len(active)
            search.tighten(exact, but=missed_elsewhere(exact, margins, active) if asks else ())
        active = joined
    raise _unsettled(exact)


def _unsettled(last: Evaluation) -> InfeasibleError:
    """Say what the last design misses of a search that did not come to an end."""
    return InfeasibleError(
        f"No design was found that holds over the whole uncertainty within {_ROUNDS} rounds of adding the worst case; "
        f"the last one misses {misses(last)}. Ask for less, or narrow the ranges.",
        missed=last.violation,
    )


def _begun(
    problem: DesignProblem,
    seed: int,
    start: FloatArray | None,
    neighbour: SearchResult | None,
    counterexamples: Counterexamples,
) -> "tuple[Search, tuple[Scenario, ...]]":
    """Return the search and the scenarios that it begins with."""
    if neighbour is None:
        active = tuple(dict.fromkeys((*problem.scenarios(3, 2), *counterexamples.scenarios)))
        return Search(problem, seed, start, impacts=ImpactTest(problem, counterexamples)), active
    begin = neighbour.design if start is None else start
    worst = (moved_scenario(each, neighbour.problem, problem) for each in neighbour.active.scenarios)
    active = tuple(dict.fromkeys((*problem.scenarios(3, 2), *worst)))
    return Search(problem, seed, begin, generations=_NEARBY_GENERATIONS), active


class Search:
    """One run: the box, what was asked (tightened where a grid flattered), the impacts, the count of evaluations.

    With a `goal` the required/achieved of that requirement is minimised instead of the objective. `generations` is the
    most that the global stage makes; it ends as soon as a design costs `enough`.
    """

    def __init__(
        self,
        problem: DesignProblem,
        seed: int,
        start: FloatArray | None = None,
        *,
        goal: str | None = None,
        generations: int = _GENERATIONS,
        enough: float = -np.inf,
        impacts: ImpactTest | None = None,
    ) -> None:
        self.goal, self.generations, self.enough, self.impacts = goal, generations, enough, impacts
        self.problem, self.has_biquad = problem, BIQUAD_VARIABLES[0] in problem.variables
        self.box = Box(problem)
        self.seed = seed
        # A limited peak is a requirement too: without it a miss by a hair elsewhere would look closest.
        self._is_peak_limited = problem.requirements.max_peak_force_n is not None
        self.start = None if start is None else self.box.unit(start)
        self.evaluations = 0
        self.backoff: dict[str, float] = {}
        self.last: Evaluation | None = None
        self.elite: list[FloatArray] = []
        self.steps: list[SearchStep] = []
        # The least cost, over the scenarios at hand, of a design that was seen to come to rest, and that of a descent;
        # where descents ended.
        self._calm = self._reached = np.inf
        self._ends: list[FloatArray] = []

    def explore(self, active: tuple[Scenario, ...], report: Callable[[float], None]) -> FloatArray:
        """Run differential evolution on the active scenarios; return the best point, keep the best few."""
        screen = self.screen(active)
        seen: list[tuple[float, FloatArray]] = []

        def costs(units: FloatArray) -> FloatArray:
            found = self._costs(screen, units.T, peaks_if_missed=self._is_peak_limited)
            seen.extend(zip(found.tolist(), units.T.copy(), strict=True))
            self._note_generation(len(active), float(np.min(found)))
            return found

        found = self._evolve(costs, seed=self.seed, start=self.start, each=lambda: report(1.0 / self.generations))
        plain = without_lead(self.problem.variables, np.asarray(found.x))
        self.elite.append(plain[np.argmin(self._costs(screen, plain, peaks_if_missed=False))])
        if found.fun >= _MISSED:
            # What is known already may hold where a population saw nothing that does.
            return self._recover(screen, [*self._closest(seen), *self.elite])
        good = [unit for value, unit in sorted(seen, key=lambda pair: pair[0]) if value < _MISSED]
        # The best, and the best of other valleys: the generations leave a valley that starts higher, but may end lower.
        near, far = spread_out(good, _NEAR, _POLISH_STARTS), spread_out(good, _FAR, _OTHER_VALLEYS)[1:]
        self.elite = [*near, *far, *self.elite]
        return np.asarray(found.x)

    def _note_generation(self, scenarios: int, found: float) -> None:
        best = min([found, *(step.best_cost for step in self.steps[-1:])])
        if best < _MISSED:
            self.steps.append(SearchStep(evaluations=self.evaluations, scenarios=scenarios, best_cost=best))

    def note_round(self, scenarios: int, exact: Evaluation) -> None:
        """Keep what a round ended with."""
        if self.last is not None:
            best, whole, count = self.last.cost, exact.cost, self.evaluations
            self.steps.append(SearchStep(evaluations=count, scenarios=scenarios, best_cost=best, whole_cost=whole))

    def _evolve(
        self,
        costs: Callable[[FloatArray], FloatArray],
        *,
        seed: int,
        start: FloatArray | None,
        each: Callable[[], None],
    ) -> OptimizeResult:
        """Run differential evolution on costs (m,) of points (n, m), until descents know the rest of the way."""

        def has_gathered(intermediate_result: OptimizeResult) -> bool:
            each()
            energies = intermediate_result.population_energies
            gathered = np.max(energies) < _MISSED and np.std(energies) <= _GATHERED * abs(np.mean(energies))
            return bool(gathered or np.min(energies) <= self.enough)

        try:
            return differential_evolution(
                costs,
                [(0.0, 1.0)] * len(self.problem.variables),
                popsize=_POPULATION,
                maxiter=self.generations,
                init="sobol",
                x0=start,
                rng=np.random.default_rng(seed),
                polish=False,
                tol=1e-5,
                vectorized=True,
                updating="deferred",
                callback=has_gathered,
            )
        except RuntimeError as error:
            # scipy takes a ValueError of the costs, such as that of an objective, for one of its own map.
            raise (error.__cause__ if isinstance(error.__cause__, AutotuneError) else error) from None

    def screen(self, active: tuple[Scenario, ...]) -> BatchEvaluator:
        """Return the batch evaluator over the active scenarios, of the goal if there is one."""
        self._calm = self._reached = np.inf
        self._ends = []
        return replace(build_batch_evaluator(build_scenarios(self.problem, active)), goal=self.goal)

    def _costs(
        self, screen: BatchEvaluator, units: FloatArray, *, peaks_if_missed: bool, tightened: bool = False
    ) -> FloatArray:
        """Order points (m, n): every feasible one before every infeasible one before every unstable one."""
        designs = self.box.design(units)
        found = screen.evaluate(designs, margins_if_missed=tightened, peaks_if_missed=peaks_if_missed)
        self.evaluations += len(units)
        missed = -np.min(self._slack(found), axis=0, initial=0.0) if tightened else found.violation
        with np.errstate(invalid="ignore"):
            judged = np.where(missed > 0.0, _MISSED * (1.0 + np.minimum(missed, 500.0)), found.cost)
        costs = np.where(found.is_stable, judged, _UNSTABLE * found.radius)
        if self.impacts:
            self._ask_impacts(self.impacts, units, costs)
        return costs

    def _ask_impacts(self, impacts: ImpactTest, units: FloatArray, costs: FloatArray) -> None:
        """Raise the costs (m,) of points that let a contact bounce, as far as they would be the best otherwise.

        Following a bounce is dear: what costs more than a point that comes to rest is not asked.
        """
        for i in np.argsort(costs, kind="stable"):
            if costs[i] >= min(self._calm, _MISSED):
                return
            if impacts.passes(self.box.design(units[i])):
                self._calm = float(costs[i])
            else:
                costs[i] = _BOUNCES

    def prefers(self, design: FloatArray, given: Evaluation, found: Evaluation) -> bool:
        """Return whether a design that was given is as good as the one found."""
        better = given.is_feasible and given.cost <= found.cost
        return better and (not self.impacts or self.impacts.passes(design))

    def polish(self, active: tuple[Scenario, ...], unit: FloatArray) -> FloatArray:
        """Improve locally from `unit` and from the elite; return the best design that is feasible."""
        screen = self.screen(active)
        known = [unit, *self.elite] if self.start is None else [unit, *self.elite, self.start]
        starts = spread_out(known, _SAME, len(known))
        # A descent may end a little outside of what is asked: what it began at counts too.
        candidates = np.array([unit, *starts, *(self.local(screen, start) for start in starts)])
        costs = self._tightened_costs(screen, candidates)
        order = np.argsort(costs, kind="stable")
        best = candidates[order[0]]
        # The next round starts where this one ended, in the best few valleys.
        enough = min(_MISSED, _CLOSE * costs[order[0]])
        self.elite = spread_out([candidates[i] for i in order if costs[i] < enough], _NEAR, _POLISH_STARTS)
        if np.min(costs) >= _MISSED:
            # The population knew other scenarios, and may have left the valley that holds over these too.
            best = self._recover(screen, [best], far=self.goal is None)
        if self.goal is None:
            design = polish_exactly(screen, self.box.design(best), backoff=self.backoff, reserve=_RESERVE)
            finer = np.array([best, self.box.unit(design)])
            best = finer[int(np.argmin(self._tightened_costs(screen, finer)))]
        self.last = screen.prepared.evaluate(self.box.design(best), peaks_if_missed=True)
        return np.asarray(best)

    def _closest(self, seen: Iterable[tuple[float, FloatArray]]) -> list[FloatArray]:
        """Return the points that miss least, of those that lie apart; fewer for a goal that is sought near a design."""
        count = _OTHER_VALLEYS if self.goal is None or self.start is None else _POLISH_STARTS
        return spread_out((unit for _, unit in sorted(seen, key=lambda pair: pair[0])), _FAR, count)

    def _recover(self, screen: BatchEvaluator, closest: list[FloatArray], *, far: bool = False) -> FloatArray:
        """Walk from points that miss something into the feasible set, or say why there is no way.

        A population may end beside the set, or in a valley that has none of it: neither shows that there is none. Where
        little is missed, or `far` from there too, another one is asked before anything is refused.
        """
        ends = [*closest, *(self.local(screen, start) for start in closest)]
        costs = self._tightened_costs(screen, np.array(ends))
        if np.min(costs) < _MISSED:
            return ends[int(np.argmin(costs))]
        if np.min(costs) > (1.0 + _FAR_OFF) * _MISSED and not far:
            raise self._refusal(screen.prepared, ends)
        seen: list[tuple[float, FloatArray]] = []

        def noted(units: FloatArray) -> FloatArray:
            found = self._tightened_costs(screen, units.T)
            seen.extend(zip(found.tolist(), units.T.copy(), strict=True))
            return found

        found = self._evolve(noted, seed=self.seed + 1, start=ends[int(np.argmin(costs))], each=lambda: None)
        more = [np.asarray(found.x), *(self.local(screen, start) for start in self._closest(seen))]
        costs = self._tightened_costs(screen, np.array(more))
        if np.min(costs) >= _MISSED:
            raise self._refusal(screen.prepared, [*ends, *more])
        return more[int(np.argmin(costs))]

    def _tightened_costs(self, screen: BatchEvaluator, units: FloatArray) -> FloatArray:
        return self._costs(screen, units, peaks_if_missed=self._is_peak_limited, tightened=True)

    def _slack(self, found: BatchEvaluation) -> FloatArray:
        """Return 1 − required/achieved per requirement (k, m), what the grid flattered taken off."""
        return np.array([1.0 - value * self._tightened(name) for name, value in found.requirements.items()]).reshape(
            len(found.rows), len(found.radius)
        )

    def _tightened(self, name: str) -> float:
        return 1.0 + self.backoff.get(name, 0.0)

    def tighten(self, exact: Evaluation, but: Collection[str] = ()) -> None:
        """Ask for more of what the exact evaluation misses by a hair although the grid was content."""
        for name, value in exact.requirements.items():
            if value > 1.0 and name not in but:
                flattered = min(value - 1.0, 0.02)
                self.backoff[name] = self.backoff.get(name, 0.0) + 1.5 * flattered + BACKOFF

    def local(self, screen: BatchEvaluator, start: FloatArray) -> FloatArray:
        """Descend from a point, with what the grid flattered asked for."""
        unit, reserve = start, BACKOFF
        iterations, legs = (_WITH_BIQUAD, _LEGS) if self.has_biquad else (SHORT_WAY, 1)
        for leg in range(_MOST_LEGS):
            begun = unit
            found = descend(screen, self.box, unit, backoff=self.backoff, reserve=reserve, iterations=iterations)
            unit = found.unit
            self.evaluations += found.evaluations
            # A valley whose end is known.
            is_near = any(np.linalg.norm(unit - end) < _NEAR for end in self._ends)
            if is_near and found.cost > (1.0 - _SAME) * self._reached:
                break
            if found.missed == 0.0:
                self._reached = min(self._reached, found.cost)
                if np.linalg.norm(unit - begun) < _SAME:
                    break
            # A cost that is too high already while something is missed only grows on the way back.
            if leg + 1 >= legs and not (0.0 < found.missed < _FAR_OFF and found.cost < self._reached):
                if found.missed == 0.0:
                    self._ends.append(unit)
                break
            reserve = _IN_HAND if leg + 1 >= legs else BACKOFF
        if not self.impacts:
            return unit
        return self.box.unit(self.impacts.walk_back(self.box.design(start), self.box.design(unit)))

    def _refusal(self, prepared: PreparedScenarios, units: list[FloatArray]) -> InfeasibleError:
        """Say why nothing is feasible: what the design misses at which the search ended, the better one of these."""
        found = [prepared.evaluate(self.box.design(unit), peaks_if_missed=True) for unit in units]
        evaluation = min(found, key=lambda each: (each.violation, each.spectral_radius))
        if not evaluation.is_stable:
            return InfeasibleError(
                "No controller within the bounds is stable in every scenario (closest: largest |z| = "
                f"{evaluation.spectral_radius:.4f}); raise the upper bound of the damping or narrow the ranges."
            )
        if self.impacts and evaluation.is_feasible:
            said = f"Every controller that was found to meet all requirements {self.impacts.failing}"
            return InfeasibleError(
                f"{said}; ask for a larger modulus_margin, narrow the ranges of stiffness and payload, or widen the "
                "bounds.",
                bare=said,
                missed=0.0,
            )
        said = "No controller within the bounds meets all requirements in every scenario"
        # The screen passes over what a design misses further on, so this one need not be the closest.
        return InfeasibleError(
            f"{said}; the search ended at one that misses {misses(evaluation)}. Relax what it misses, narrow the "
            "ranges of stiffness and payload, or widen the bounds.",
            bare=said,
            missed=evaluation.violation,
        )
