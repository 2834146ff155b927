"""Find the smallest relaxation, of each requirement alone, that makes a problem feasible."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from autotune.errors import InfeasibleError
from problems.arrays import FloatArray
from problems.design.batch_result import EVERY_REQUIREMENT
from problems.design.problem import VARIABLES, DesignProblem, Requirements
from problems.design.uncertainty import Scenario
from problems.progress import ProgressSlice, no_progress
from problems.stability.margins import UnstableLoopError

from .bounds import presentable
from .scenario_exchange import WholeSet, margin_scenarios
from .search import Search

ADMITTANCE = "free_space_admittance"
DAMPING = VARIABLES.index("damping")
_ROUNDS = 6
# Which requirements can be met without one needs fewer generations than the last newton of a peak, and fewer again
# from a design that misses all of them equally.
_GENERATIONS, _NEARBY_GENERATIONS, _EXPLORED = 30, 15, 0.6
_DIGITS = 3
_HAIR = 2e-3
# Of all together only which ones bind is asked, and where to begin: the grid shows that, without a climb in between.
_ROUGHLY = 0.03
_BINDS = 0.9


@dataclass(frozen=True, kw_only=True)
class Relaxation:
    """One requirement, what is asked of it, and the most that can be had while every other one is met.

    `damping` is B_a of the design that has it; `met_by` is that design (n,) where it meets all that is asked after all.
    """

    name: str
    asked: float
    possible: float
    damping: float | None = None
    met_by: tuple[float, ...] = ()

    @property
    def share(self) -> float:
        """By which share of what is asked it would have to be relaxed."""
        return abs(self.possible - self.asked) / self.asked

    def describe(self, unit: str) -> str:
        """Return what would be enough in words; `unit` is empty where the requirement's name holds it."""
        if self.name == EVERY_REQUIREMENT:
            return f"all requirements together at {self.possible:g} % of what is asked"
        gains = "" if self.damping is None else f" (with B_a {self.damping:.3g})"
        return f"{self.name} {self.possible:g} instead of {f'{self.asked:g} {unit}'.strip()}{gains}"

    def within(self, requirements: Requirements, share: float = 0.0) -> Requirements:
        """Return the requirements with this relaxation, easier by a further share."""
        names = asked_of(requirements) if self.name == EVERY_REQUIREMENT else {self.name: self.asked}
        eased = self.possible / self.asked
        for name, asked in names.items():
            kind = requirements.kind(name)
            # What is asked of all together is a share of each: an upper limit is eased by its inverse.
            factor = 1.0 / eased if kind.is_upper_limit and self.name == EVERY_REQUIREMENT else eased
            factor *= 1.0 + share if kind.is_upper_limit else 1.0 - share
            threshold = _rounded(asked * factor, is_upper=kind.is_upper_limit)
            requirements = requirements.with_asked(name, kind.with_threshold(requirements.asked()[name], threshold))
        return requirements


@dataclass(frozen=True, kw_only=True)
class _Least:
    """The least required/achieved of a goal over the whole uncertainty, the design (n,) that has it, and its others."""

    ratio: float
    design: FloatArray
    ratios: Mapping[str, float]


def find_relaxations(
    problem: DesignProblem, *, seed: int = 0, progress: Callable[[float], None] | None = None
) -> tuple[Relaxation, ...]:
    """Return the relaxations of single requirements that would be enough, the smallest share first.

    For each requirement in turn, required/achieved is minimised over the bounds while all others are met, over the
    whole uncertainty as in the search; what is returned was reached by a design, exactly evaluated, and is rounded to
    the easier side. Where no single one is enough, all together by one share (`EVERY_REQUIREMENT`, in per cent of what
    is asked). Empty where nothing is stable. What does not bind where all are missed by the same share is not tried
    alone. A design that meets everything ends it: the one relaxation that is returned then holds it. `progress` gets
    the share of the work done since the last call.
    """
    asked, report = asked_numbers(problem), progress or no_progress

    def least(goal: str, start: FloatArray | None = None) -> _Least | None:
        part = ProgressSlice(report, 1.0 / (len(asked) + 1))
        found = _least(problem, goal, seed, part, start, is_rough=start is None)
        part.finish()
        return found

    together = least(EVERY_REQUIREMENT)
    found = []
    for name, number in asked.items():
        # Without one that does not bind where all are missed by the same least share, that share stays what it is.
        binds = together is not None and together.ratios[name] >= _BINDS * together.ratio
        if together is None or not binds:
            report(1.0 / (len(asked) + 1))
            continue
        alone = least(name, together.design)
        if alone is not None and alone.ratio <= 1.0:
            met_by = tuple(alone.design.tolist())
            return (Relaxation(name=name, asked=number, possible=number, met_by=met_by),)
        if alone is not None:
            found.append(
                Relaxation(
                    name=name,
                    asked=number,
                    possible=_reached(number, alone.ratio, is_upper=problem.requirements.kind(name).is_upper_limit),
                    damping=float(alone.design[DAMPING]) if name == ADMITTANCE else None,
                )
            )
    if together is not None and not found:
        # Only here is the share of all together said.
        closer = _least(problem, EVERY_REQUIREMENT, seed, start=together.design) or together
        possible = _reached(100.0, closer.ratio)
        return (Relaxation(name=EVERY_REQUIREMENT, asked=100.0, possible=possible),)
    return tuple(sorted(found, key=lambda each: each.share))


def find_nearest(problem: DesignProblem, *, seed: int) -> FloatArray | None:
    """Return the design (n,) that misses all requirements by the least share, roughly; None where nothing is stable."""
    found = _least(problem, EVERY_REQUIREMENT, seed, is_rough=True)
    return None if found is None else found.design


def find_met(problem: DesignProblem, *, seed: int, start: FloatArray | None = None) -> FloatArray | None:
    """Return a design (n,) that meets every requirement over a few scenarios only; None where none was found.

    From a `start` by a descent alone, else by a short search.
    """
    search = Search(problem, seed, goal=EVERY_REQUIREMENT, generations=_NEARBY_GENERATIONS, enough=1.0)
    active = problem.scenarios(3, 2)
    try:
        unit = search.explore(active, no_progress) if start is None else search.box.unit(start)
    except InfeasibleError:
        return None
    screen = search.screen(active)
    for point in (unit, search.local(screen, unit)):
        design = search.box.design(point[None])
        if screen.evaluate(design).cost[0] <= 1.0:
            return np.asarray(design[0])
    return None


def attainable(problem: DesignProblem, *, seed: int, progress: Callable[[float], None] = no_progress) -> float | None:
    """Return the most free-space admittance that can be had while every other requirement is met; None without any."""
    found = _least(problem, ADMITTANCE, seed, progress)
    return None if found is None else _reached(problem.requirements.threshold(ADMITTANCE), found.ratio)


def is_feasible(problem: DesignProblem, *, seed: int) -> bool:
    """Return whether a design was found that meets every requirement, whatever its objective."""
    found = _least(problem, EVERY_REQUIREMENT, seed)
    return found is not None and found.ratio <= 1.0


def relaxation_message(problem: DesignProblem, found: Sequence[Relaxation], *, turning: bool = False) -> str:
    """Return sentences on what would be enough, for which requirements nothing was found, and what else helps."""
    enough = "; or ".join(each.describe(_unit(problem.requirements, each.name, turning=turning)) for each in found)
    names = {each.name for each in found}
    others = [name for name in asked_numbers(problem) if name not in names]
    if EVERY_REQUIREMENT in names:
        said = f"No single requirement was found that would be enough to ease; enough would be: {enough}."
    else:
        listed = " or ".join(filter(None, (", ".join(others[:-1]), *others[-1:])))
        useless = f" No easing of {listed} alone was found to be enough." if others else ""
        said = f"Enough by itself would be: {enough}.{useless}"
    asked = problem.requirements.asked()
    notes = "".join(
        problem.requirements.kind(each.name).easing_note(asked[each.name], each.possible, turning=turning)
        for each in found
        if each.name in asked
    )
    return f"{said}{notes} Or narrow the ranges of stiffness and payload, or widen the bounds."


def _unit(requirements: Requirements, name: str, *, turning: bool) -> str:
    """Return the unit of a requirement whose name does not end in it: one that has several keys."""
    if name == EVERY_REQUIREMENT:
        return ""
    kind = requirements.kind(name)
    return kind.unit_on(turning=turning) if kind.asked_as is not None else ""


def asked_numbers(problem: DesignProblem) -> dict[str, float]:
    """Return what is asked of each requirement as one number, soft requirements left out."""
    return asked_of(problem.requirements)


def asked_of(requirements: Requirements) -> dict[str, float]:
    """Return the threshold of each hard requirement."""
    return {name: requirements.threshold(name) for name in requirements.asked() if name not in requirements.soft_n}


def _least(
    problem: DesignProblem,
    goal: str,
    seed: int,
    report: Callable[[float], None] = no_progress,
    start: FloatArray | None = None,
    *,
    is_rough: bool = False,
) -> _Least | None:
    """Return the least required/achieved of one requirement over the whole uncertainty; None if others are missed.

    `start` is a design (n,) that joins the search, which then looks around less. A rough look is over the dense grid
    alone, and ends where it would gain little. `report` gets the share of the work done since the last call.
    """
    generations, hair = _GENERATIONS if start is None else _NEARBY_GENERATIONS, _ROUGHLY if is_rough else _HAIR
    search, whole = Search(problem, seed, start, goal=goal, generations=generations), WholeSet(problem, seed)
    active: tuple[Scenario, ...] = problem.scenarios(3, 2)
    best: _Least | None = None
    try:
        unit = search.explore(active, lambda done: report(_EXPLORED * done))
        for _ in range(_ROUNDS):
            report((1.0 - _EXPLORED) / _ROUNDS)
            unit = search.polish(active, unit)
            design = presentable(problem, search.box.design(unit))
            controller = problem.controller(design)
            expected = 1.0 if search.last is None else _of(goal, search.last.requirements)
            try:
                grid = whole.prepared
                exact = (
                    grid.evaluate_exactly(controller)
                    if is_rough
                    else whole.evaluate(controller, climbs_objective=False)
                )
            except UnstableLoopError:
                active = tuple(dict.fromkeys((*active, *whole.unstable(controller))))
                continue
            ratios = dict(exact.evaluation.requirements)
            sought = {name: value for name, value in ratios.items() if goal in (name, EVERY_REQUIREMENT)}
            others = {name: value for name, value in ratios.items() if name not in sought}
            if all(value <= 1.0 for value in others.values()):
                before, reached = best, _of(goal, ratios)
                if before is None or reached < before.ratio:
                    best = _Least(ratio=reached, design=design, ratios=ratios)
                # What more scenarios no longer change is not worth another look at the whole uncertainty.
                no_better = before is not None and reached >= before.ratio * (1.0 - hair)
                if reached <= expected * (1.0 + hair) or no_better:
                    break
            worse = margin_scenarios(others, exact.margins)
            worse = (*worse, *margin_scenarios(sought, exact.margins, limit=expected))
            highest = max(exact.evaluation.peaks, key=lambda peak: peak.peak_contact_force_n).scenario
            robots = whole.worst_of(exact.evaluation, ratios, "robot")
            joined = tuple(dict.fromkeys((*active, *worse, highest, *robots)))
            if joined == active:
                search.tighten(exact.evaluation)
            active = joined
    except InfeasibleError:
        pass
    # A port that is passive nowhere has no number to be relaxed to.
    return best if best is not None and np.isfinite(best.ratio) else None


def _of(goal: str, ratios: Mapping[str, float]) -> float:
    return max(ratios.values()) if goal == EVERY_REQUIREMENT else ratios[goal]


def _reached(asked: float, ratio: float, *, is_upper: bool = False) -> float:
    """Return what the design reached, with three digits, on the easier side of it."""
    return _rounded(asked * ratio if is_upper else asked / ratio, is_upper=is_upper)


def _rounded(reached: float, *, is_upper: bool) -> float:
    """Return a value with three digits, on the easier side of it."""
    unit = 10.0 ** (math.floor(math.log10(reached)) - _DIGITS + 1)
    steps = math.ceil(reached / unit) if is_upper else math.floor(reached / unit)
    return float(f"{steps * unit:.{_DIGITS}g}")
