"""What every optimizer of the comparison is judged by: the same compiled evaluator, and a clock that starts with it."""

import time
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from autotune.tuning.bounds import Box
from problems.arrays import FloatArray
from problems.design.batch_evaluation import BatchEvaluator, build_batch_evaluator
from problems.design.evaluation import build_scenarios
from problems.design.problem import VARIABLES, DesignProblem

# What a peer sees of the ranges (stiffnesses, masses), and what it is judged over in the end.
SEEN, JUDGED = (9, 3), (33, 3)
DIMENSION = len(VARIABLES)
# A grid flatters a margin by less than this; exact margins decide what `solve_design` returns.
_FLATTERED = 1e-4
_UNSTABLE, _MISSED = 1e9, 1e6


class BudgetError(Exception):
    """The processor time of a peer is over."""


@dataclass(frozen=True, kw_only=True)
class Verdict:
    """A design over the judge's scenarios: largest share of what is asked that is missing, and its worst peak [N]."""

    is_stable: bool
    violation: float
    objective_n: float

    @property
    def is_feasible(self) -> bool:
        """Whether nothing is missed by more than the evaluator's own grid errs."""
        return self.is_stable and self.violation <= _FLATTERED


@dataclass(frozen=True, kw_only=True)
class Incumbent:
    """A design (4,), the processor seconds after which it was had, and what its finder took its worst peak for [N]."""

    seconds: float
    design: FloatArray
    objective_n: float


class Clock:
    """Processor seconds of this process since it was made; it does not see what other processes do."""

    def __init__(self) -> None:
        self._begin = time.process_time()

    def seconds(self) -> float:
        """Return the seconds that went by."""
        return time.process_time() - self._begin


@dataclass(kw_only=True)
class Trace:
    """What one peer found by when; `budget_s` ends its run at the next evaluation."""

    problem: DesignProblem
    budget_s: float
    incumbents: list[Incumbent] = field(default_factory=list)
    note: str = ""
    clock: Clock = field(default_factory=Clock)

    def left_s(self) -> float:
        """Return what is left of the budget."""
        return self.budget_s - self.clock.seconds()

    def add(self, design: FloatArray, objective_n: float) -> None:
        """Note a design if it is the best so far."""
        if not self.incumbents or objective_n < self.incumbents[-1].objective_n:
            self.incumbents.append(
                Incumbent(seconds=self.clock.seconds(), design=np.array(design), objective_n=objective_n)
            )


def screen_of(problem: DesignProblem, counts: tuple[int, int]) -> BatchEvaluator:
    """Prepare the evaluator over a grid of (stiffnesses, masses)."""
    return build_batch_evaluator(build_scenarios(problem, problem.scenarios(*counts)))


def judge(screen: BatchEvaluator, design: FloatArray) -> Verdict:
    """Evaluate one design over the screen's scenarios."""
    found = screen.evaluate(design[None], peaks_if_missed=True)
    return Verdict(
        is_stable=bool(found.is_stable[0]),
        violation=float(found.violation[0]),
        objective_n=float(found.cost[0]),
    )


def ranked_costs(screen: BatchEvaluator, box: Box) -> Callable[[FloatArray], FloatArray]:
    """Return costs (m,) of points (m, 4) of the unit cube for methods that know no constraints.

    The order is that of the search itself: every feasible design before every infeasible one (by what it misses)
    before every unstable one. A feasible design costs its worst peak [N].
    """

    def costs(units: FloatArray) -> FloatArray:
        found = screen.evaluate(box.design(units))
        judged = np.where(found.violation > 0.0, _MISSED * (1.0 + np.minimum(found.violation, 500.0)), found.cost)
        return np.where(found.is_stable, judged, _UNSTABLE * np.maximum(found.radius, 1.0))

    return costs


def is_peak(cost: float) -> bool:
    """Tell a feasible design's cost from the others'."""
    return cost < _MISSED


def traced_costs(trace: Trace) -> Callable[[FloatArray], FloatArray]:
    """Return `ranked_costs` over the seen scenarios that note the best design and end with the budget."""
    box, costs = Box(trace.problem), ranked_costs(screen_of(trace.problem, SEEN), Box(trace.problem))

    def noted(units: FloatArray) -> FloatArray:
        if trace.left_s() <= 0.0:
            raise BudgetError
        found = costs(units)
        best = int(np.argmin(found))
        if is_peak(found[best]):
            trace.add(box.design(units[best]), float(found[best]))
        return found

    return noted


def solution_noter(trace: Trace) -> Callable[[FloatArray], None]:
    """Return what notes a solver's answer, good or bad, by its cost over the seen scenarios."""
    box, costs = Box(trace.problem), ranked_costs(screen_of(trace.problem, SEEN), Box(trace.problem))

    def note(design: FloatArray) -> None:
        if np.all(np.isfinite(design)):
            trace.add(design, float(costs(box.unit(design)[None])[0]))

    return note


@dataclass(frozen=True, kw_only=True)
class TraceOutcome:
    """A peer's run in the judge's eyes: `to_one_percent_s` is infinite where it never came that close."""

    to_one_percent_s: float
    final: Verdict | None
    seconds: float
    note: str


def judge_trace(trace: Trace, screen: BatchEvaluator, best_n: float) -> TraceOutcome:
    """Judge what a peer found: the first feasible design within 1 % of `best_n`, and the last one."""
    verdicts = [(each.seconds, judge(screen, each.design)) for each in trace.incumbents]
    close = [seconds for seconds, verdict in verdicts if verdict.is_feasible and verdict.objective_n <= 1.01 * best_n]
    feasible = [verdict for _, verdict in verdicts if verdict.is_feasible]
    last = verdicts[-1][1] if verdicts else None
    return TraceOutcome(
        to_one_percent_s=min(close, default=np.inf),
        final=min(feasible, key=lambda verdict: verdict.objective_n) if feasible else last,
        seconds=trace.clock.seconds(),
        note=trace.note,
    )
