"""Choose the stiffness of a compliance: the least worst peak over K_e to be built, each design safe for its tolerance.

A grid over log K_e with an ordinary search at each point, begun at that of the nearest point; then the gaps around the
best point, above the stiffest one that is nearly as good and above the stiffest one that meets everything are halved
until they are small. Nothing is taken to be monotone, and nothing between two points that were tried is claimed.
"""

import math
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from autotune.errors import InfeasibleError, UsageError
from autotune.formats.problem import ComplianceSpec, Interval, ProblemSpec, Uncertain
from autotune.formats.units import ROTATIONAL_AXES
from identification.result import Identified
from problems.design.objectives import ContactForce, force_of
from problems.design.problem import DesignProblem
from problems.design.uncertainty import STIFFNESS
from problems.progress import no_progress

from .problems import build_problems
from .search import SearchResult, solve_design

RESOLUTION = 0.05
"""The share by which the next stiffness that was tried lies above one that is reported."""
NEARLY = 0.01
"""What counts as nearly as good as the best, as a share of the peak."""
_SAME = 1e-3
_GRID = 9
_DIGITS, _FURTHER_DIGITS = 4, 10
# Of a usual run, after the grid; for the progress bar alone.
_HALVINGS = 5


@dataclass(frozen=True, kw_only=True)
class CompliancePoint:
    """One K_e [N/m] and the best design over its tolerance, None where nothing meets the requirements.

    `missed` is the share by which something that is asked is missed there, 0 where everything is met.
    """

    stiffness_n_per_m: float
    found: SearchResult | None
    missed: float

    @property
    def cost(self) -> float:
        """The objective's cost with the price of what is missed, infinite where something is missed."""
        return math.inf if self.found is None or self.missed > 0.0 else self.found.evaluation.cost


@dataclass(frozen=True, kw_only=True)
class Compliance:
    """What was asked, and every K_e that was tried, from the softest on.

    `settled_n_per_m` is the chosen one once a controller is made for it.
    """

    asked: ComplianceSpec
    points: tuple[CompliancePoint, ...]
    settled_n_per_m: float | None = None

    @property
    def chosen(self) -> CompliancePoint:
        """The point of least objective, the stiffest of those as good; where none meets all, the one nearest to it."""
        if self.settled_n_per_m is not None:
            return next(point for point in self.points if point.stiffness_n_per_m == self.settled_n_per_m)
        least = min(point.cost for point in self.points)
        if math.isinf(least):
            return min(self.points, key=lambda point: point.missed)
        return self._stiffest((1.0 + _SAME) * least)

    @property
    def nearly_as_good(self) -> CompliancePoint:
        """The stiffest point whose objective lies within `NEARLY` of the chosen one's."""
        return self._stiffest((1.0 + NEARLY) * self.chosen.cost)

    @property
    def stiffest(self) -> CompliancePoint:
        """The stiffest point that meets everything."""
        return self._stiffest(math.inf)

    @property
    def active_bound(self) -> str | None:
        """Which bound the chosen point lies on, where the bounds leave a choice."""
        low, high = self.asked.bounds
        ends = {low: "lower", high: "upper"} if low < high else {}
        return ends.get(self.chosen.stiffness_n_per_m)

    def _stiffest(self, most: float) -> CompliancePoint:
        """Return the stiffest point that meets everything with at most this objective, or else the chosen one."""
        good = [point for point in self.points if point.missed == 0.0 and point.cost <= most]
        return good[-1] if good else self.chosen

    def next_stiffness(self) -> float | None:
        """Return the middle of the first gap that is still to be halved, None where all are small enough."""
        if all(math.isinf(point.missed) for point in self.points):
            return None
        tried = [point.stiffness_n_per_m for point in self.points]
        best = tried.index(self.chosen.stiffness_n_per_m)
        above = [tried.index(point.stiffness_n_per_m) for point in (self.nearly_as_good, self.stiffest)]
        for index in (best - 1, best, *above):
            if 0 <= index < len(tried) - 1 and tried[index + 1] > (1.0 + RESOLUTION) * tried[index]:
                return _digits(math.sqrt(tried[index] * tried[index + 1]), _DIGITS)
        return None

    def on(self, problem: DesignProblem, stiffness_n_per_m: float) -> DesignProblem:
        """Return the problem with K_e (1 ± tolerance) as the range that must be safe."""
        certified = certified_range(stiffness_n_per_m, self.asked.tolerance)
        return replace(problem, plants=problem.plants.with_ranges({STIFFNESS: certified}))

    def on_chosen(self, problem: DesignProblem) -> DesignProblem:
        """Return the problem on the chosen compliance."""
        return self.on(problem, self.chosen.stiffness_n_per_m)

    def with_point(self, point: CompliancePoint) -> "Compliance":
        """Return the same with one more point, or with this one in the place of that of its stiffness."""
        others = [each for each in self.points if each.stiffness_n_per_m != point.stiffness_n_per_m]
        return replace(self, points=tuple(sorted((*others, point), key=lambda each: each.stiffness_n_per_m)))

    def nearest(self, stiffness_n_per_m: float) -> SearchResult | None:
        """Return the result at the nearest point that has one, by ratio."""
        found = [point for point in self.points if point.found is not None]
        ratios = [abs(math.log(point.stiffness_n_per_m / stiffness_n_per_m)) for point in found]
        return found[int(np.argmin(ratios))].found if found else None


def build_compliance_problems(identified: Identified, spec: ProblemSpec) -> dict[str, DesignProblem]:
    """Return the design problem of the one axis that is asked, on the softest compliance.

    Raises UsageError where the surface is said twice, or for several axes or a turning one, and what `build_problems`
    raises.
    """
    asked = _asked(spec)
    if "environment_stiffness" in spec.options:
        raise UsageError(
            "--environment-stiffness and free.environment_stiffness_n_per_m in problem.yaml both say the surface; give "
            "one of them."
        )
    names = list(identified.axes) if spec.axes is None else list(spec.axes)
    if len(names) > 1:
        raise UsageError(
            "environment_stiffness_n_per_m can be free for one axis at a time only; name it in problem.yaml with axis "
            f"(to be tuned: {', '.join(names)})."
        )
    if ROTATIONAL_AXES.intersection(names):
        raise UsageError(f"environment_stiffness_n_per_m is in N/m, and {names[0]} turns; leave it out of free.")
    return build_problems(identified, at_stiffness(spec, asked.bounds[0]))


def at_stiffness(spec: ProblemSpec, stiffness_n_per_m: float) -> ProblemSpec:
    """Return the ordinary problem with K_e (1 ± tolerance) as the range that must be safe."""
    certified = certified_range(stiffness_n_per_m, _asked(spec).tolerance)
    # What is built takes the place of the identified surface, whose damping says nothing of it.
    uncertain: Uncertain = {"environment_damping_n_s_per_m": "nominal", **spec.uncertain}
    return replace(spec, compliance=None, environment_stiffness=certified, uncertain=uncertain)


def certified_range(stiffness_n_per_m: float, tolerance: float) -> Interval:
    """Return K_e (1 ± tolerance), [N/m]."""
    low, high = (stiffness_n_per_m * (1.0 + sign * tolerance) for sign in (-1.0, 1.0))
    return _digits(low, _FURTHER_DIGITS), _digits(high, _FURTHER_DIGITS)


def choose_compliance(
    problem: DesignProblem,
    asked: ComplianceSpec,
    *,
    seed: int = 0,
    step: Callable[[float], None] | None = None,
    progress: Callable[[float], None] | None = None,
) -> Compliance:
    """Search the problem on every compliance of a grid, and where the grid is too coarse for what is reported.

    Deterministic for a given seed. That no point meets the requirements is no error: the nearest one is chosen then.
    `step` gets each K_e [N/m] as its search begins, `progress` the share of the work done since the last call.
    """
    begin, report = step or no_progress, progress or no_progress
    grid = _grid(asked.bounds)
    found = Compliance(asked=asked, points=())
    for stiffness in grid:
        begin(stiffness)
        found = found.with_point(_point(problem, found, stiffness, seed))
        report(1.0 / (len(grid) + _HALVINGS))
    return _narrowed(problem, found, seed, begin, lambda: report(1.0 / (len(grid) + _HALVINGS)))


def settle_compliance(problem: DesignProblem, compliance: Compliance, search: SearchResult, seed: int) -> Compliance:
    """Return the compliance with the ordinary search's result at the chosen stiffness, and what that leaves open."""
    stiffness = compliance.chosen.stiffness_n_per_m
    point = CompliancePoint(stiffness_n_per_m=stiffness, found=search, missed=0.0)
    found = replace(compliance.with_point(point), settled_n_per_m=stiffness)
    return _narrowed(problem, found, seed, no_progress, lambda: None)


def _narrowed(
    problem: DesignProblem, found: Compliance, seed: int, begin: Callable[[float], None], each: Callable[[], None]
) -> Compliance:
    """Halve gaps until they are small enough to be reported."""
    while (stiffness := found.next_stiffness()) is not None:
        begin(stiffness)
        found = found.with_point(_point(problem, found, stiffness, seed))
        each()
    return found


def compliance_tree(compliance: Compliance) -> dict[str, Any]:
    """Return the plain tree of `provenance.compliance` of one axis; stiffnesses in N/m, peaks in N."""
    return {
        "bounds_n_per_m": list(compliance.asked.bounds),
        "tolerance": compliance.asked.tolerance,
        "chosen_n_per_m": compliance.chosen.stiffness_n_per_m,
        "active_bound": compliance.active_bound,
        "stiffest_within_one_percent_n_per_m": compliance.nearly_as_good.stiffness_n_per_m,
        "stiffest_that_meets_all_n_per_m": compliance.stiffest.stiffness_n_per_m,
        "resolution": RESOLUTION,
        "tried": [_point_tree(point) for point in compliance.points],
    }


def infeasible_message(name: str, compliance: Compliance) -> str:
    """Say where it was looked, and on which stiffness least is missed."""
    (low, high), tolerance = compliance.asked.bounds, 100.0 * compliance.asked.tolerance
    return (
        f"Axis {name}: none of {len(compliance.points)} compliances from {1e-3 * low:g} to {1e-3 * high:g} N/mm, each "
        f"built to ± {tolerance:g} %, has a controller; nearest to one is that of "
        f"{1e-3 * compliance.chosen.stiffness_n_per_m:g} N/mm."
    )


def _point(problem: DesignProblem, known: Compliance, stiffness: float, seed: int) -> CompliancePoint:
    """Search at one stiffness, from the nearest result on; where that finds nothing, from nowhere."""
    limit, here = _without_limit(problem)
    here = known.on(here, stiffness)
    neighbour, missed = known.nearest(stiffness), math.inf
    for begin in dict.fromkeys((neighbour is not None, False)):
        try:
            found = solve_design(here, seed=seed, neighbour=neighbour if begin else None)
        except InfeasibleError as error:
            missed = min(missed, error.missed)
            continue
        peak = max(each.peak_contact_force_n for each in found.evaluation.peaks)
        over = 0.0 if limit is None else max(0.0, peak / limit - 1.0)
        return CompliancePoint(stiffness_n_per_m=stiffness, found=found, missed=over)
    return CompliancePoint(stiffness_n_per_m=stiffness, found=None, missed=missed)


def _without_limit(problem: DesignProblem) -> tuple[float | None, DesignProblem]:
    """Return the limit of the peak and the problem without it, where the least peak shows whether it can be met.

    So the table has a peak also where it is too high. Where something else is minimised, the limit stays in.
    """
    asked = problem.requirements
    limit = asked.max_peak_force_n
    if limit is None or asked.soft_n or not isinstance(problem.objective, ContactForce):
        return None, problem
    return limit, replace(problem, requirements=replace(asked, max_peak_force_n=None))


def _point_tree(point: CompliancePoint) -> Mapping[str, Any]:
    evaluation = None if point.found is None else point.found.evaluation
    has_price = evaluation is not None and bool(evaluation.soft_cost_n)
    return {
        "environment_stiffness_n_per_m": point.stiffness_n_per_m,
        **_objective_tree(point),
        **({"objective_n": _digits(evaluation.cost, 6)} if evaluation is not None and has_price else {}),
        "meets_all": point.missed == 0.0,
    }


def _objective_tree(point: CompliancePoint) -> Mapping[str, Any]:
    """Return the worst peak, and the objective by its name where that is another number."""
    if point.found is None:
        return {"peak_force_n": None}
    evaluation, objective = point.found.evaluation, point.found.problem.objective
    force = force_of(objective)
    tree = {"peak_force_n": _digits(max(map(force.of_peak, evaluation.peaks)), 6)}
    if force is not objective:
        tree[objective.name] = _digits(float(objective.value(evaluation.objective_cost)), 6)
    return tree


def _grid(bounds: Interval) -> tuple[float, ...]:
    """Return values by equal ratios, the bounds as they were given and the others with few digits."""
    low, high = bounds
    steps = min(_GRID - 1, math.ceil(math.log(high / low) / math.log(1.0 + RESOLUTION)))
    inner = (_digits(low * (high / low) ** (i / steps), _DIGITS) for i in range(1, steps))
    return tuple(dict.fromkeys((low, *inner, high)))


def _asked(spec: ProblemSpec) -> ComplianceSpec:
    if spec.compliance is None:
        raise UsageError("problem.yaml does not make environment_stiffness_n_per_m free.")
    return spec.compliance


def _digits(value: float, count: int) -> float:
    return float(f"{value:.{count}g}")


@contextmanager
def named_compliance(name: str, compliance: Compliance | None) -> Iterator[None]:
    """Say of a search without a result on which of the compliances it was."""
    try:
        yield
    except InfeasibleError as error:
        if compliance is None:
            raise
        bare = str(error).removeprefix(f"Axis {name}: ")
        raise InfeasibleError(
            f"{infeasible_message(name, compliance)} {bare}", error.relaxations, suggestion=error.suggestion
        ) from error
