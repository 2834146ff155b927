"""Trace a front: by the solver for peak force against free-space admittance, by a study for everything else.

The solver makes one search per admittance target.
"""

from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from scipy.optimize import differential_evolution, minimize

from autotune.errors import InfeasibleError, UsageError
from autotune.tuning.bounds import Box, presentable
from autotune.tuning.search import SearchResult, solve_design
from problems.arrays import FloatArray
from problems.design.evaluation import Evaluation, PreparedScenarios, build_scenarios
from problems.design.objectives import Admittance, Objective, PeakForce, force_of
from problems.design.problem import AdmittanceTarget, DesignProblem
from problems.progress import no_progress

from .plugins import Demand, load_demands, load_objectives
from .points import Front, Judge, check_choices, design_of, index_of, undominated

if TYPE_CHECKING:
    from .storage import Storage


USUAL = ("peak_force", "admittance")
DEFAULT_TRIALS = 200
_SEED_POINTS = 5
_SEED_SHARE = 0.2
# The largest admittance is the end of a sweep, no certified number: a hundredth of a percent off changes no picture.
_POPULATION, _GENERATIONS = 8, 25
_UNSTABLE, _MISSED = 1e6, 1e3
_FIRST_RESERVE, _RESERVES = 1e-4, 6
_END_SHARE = 0.03


def trace_front(
    first: SearchResult, count: int, *, seed: int = 0, progress: Callable[[float], None] | None = None
) -> Front:
    """Sweep the admittance target from what `first` achieves to the largest feasible one, in `count` points.

    At each target the peak force (at the contact, where the problem minimises something else) is minimised by
    `solve_design`, started from the neighbour with more admittance
    (which meets this target too, so that the peak never falls from there on). Every point is judged over the dense
    grid, none is infeasible, and those that another one beats are left out. Deterministic for a seed. `progress` is
    called with the share of the work done since the last call.
    """
    report = progress or no_progress
    problem = replace(first.problem, objective=force_of(first.problem.objective))
    judge = Judge(problem, (PeakForce(), Admittance()))
    own = judge.judge(problem.controller(first.design))
    end, design = _most_admittance(problem, first.design, judge, seed)
    report(_END_SHARE)
    found = [own]
    if end > own.values["admittance"] and count > 1:
        found.append(judge.judge(problem.controller(design)))
        share = (1.0 - _END_SHARE) / (count - 1)
        for target in np.geomspace(own.values["admittance"], end, count)[:0:-1]:
            asked = _with_target(problem, float(target))
            # A feasible set as thin as this may be missed; the neighbour is a point of it all the same.
            with suppress(InfeasibleError):
                design = solve_design(asked, seed=seed, start=design, progress=lambda done: report(share * done)).design
                found.append(judge.judge(problem.controller(design)))
    points = undominated(found, judge.objectives)
    return Front(
        problem=problem,
        objectives=judge.objectives,
        points=points,
        scenario_count=judge.scenario_count,
        chosen=index_of(own.controller, points),
    )


def _with_target(problem: DesignProblem, least: float) -> DesignProblem:
    """Return the problem with at least this admittance [m/s/N] over the band that it looks at."""
    band = (problem.requirements.free_space_admittance or AdmittanceTarget()).band_hz
    target = AdmittanceTarget(min_m_s_per_n=least, band_hz=band)
    # Here the target is what is swept, whether it is soft or required.
    prices = {name: price for name, price in problem.requirements.soft_n.items() if name != "free_space_admittance"}
    return replace(problem, requirements=replace(problem.requirements, free_space_admittance=target, soft_n=prices))


def _most_admittance(problem: DesignProblem, start: FloatArray, judge: Judge, seed: int) -> tuple[float, FloatArray]:
    """Return the largest admittance [m/s/N] that meets every requirement on the dense grid, and its design.

    Requirements are first held with a reserve on a few scenarios; where the dense grid misses all the same, the
    reserve grows. Returns `start` where nothing better holds.
    """
    own = judge.judge(problem.controller(start)).values["admittance"]
    asked = _with_target(problem, own)
    prepared, box = build_scenarios(asked, asked.scenarios(3, 2)), Box(problem)
    unit = _explored(prepared, box, box.unit(start), seed)
    reserve = _FIRST_RESERVE
    for _ in range(_RESERVES):
        design = presentable(problem, box.design(_polished(prepared, box, unit, reserve)))
        seen = prepared.evaluate(design)
        if seen.is_stable:
            judged = judge.judge(problem.controller(design))
            if judged.is_feasible and judged.values["admittance"] > own:
                return judged.values["admittance"], design
        reserve *= 4.0
    return own, start


def _explored(prepared: PreparedScenarios, box: Box, start: FloatArray, seed: int) -> FloatArray:
    def cost(unit: FloatArray) -> float:
        seen = prepared.evaluate(box.design(unit))
        if not seen.is_stable:
            return _UNSTABLE * seen.spectral_radius
        missed = max(0.0, *(value - 1.0 for value in _others(seen).values()), 0.0)
        return min(_MISSED * (1.0 + missed), 0.9 * _UNSTABLE) if missed > 0.0 else _price(seen)

    found = differential_evolution(
        cost,
        [(0.0, 1.0)] * len(start),
        popsize=_POPULATION,
        maxiter=_GENERATIONS,
        init="sobol",
        x0=start,
        rng=np.random.default_rng(seed),
        polish=False,
    )
    return np.asarray(found.x)


def _polished(prepared: PreparedScenarios, box: Box, start: FloatArray, reserve: float) -> FloatArray:
    count = len(_others(prepared.evaluate(box.design(start), peaks_if_missed=True)))

    def both(unit: FloatArray) -> tuple[float, FloatArray]:
        seen = prepared.evaluate(box.design(unit), peaks_if_missed=True)
        if not seen.is_stable:
            return 10.0, np.full(count, -1.0)
        return _price(seen), 1.0 - reserve - np.array(list(_others(seen).values()))

    found = minimize(
        lambda unit: both(unit)[0],
        start,
        method="SLSQP",
        bounds=[(0.0, 1.0)] * len(start),
        constraints=[{"type": "ineq", "fun": lambda unit: both(unit)[1]}] if count else [],
        options={"maxiter": 60, "ftol": 1e-9, "eps": 1e-6},
    )
    return np.asarray(np.clip(found.x, 0.0, 1.0))


def _price(seen: Evaluation) -> float:
    """Return target/achieved of the admittance: small where there is much."""
    return seen.requirements["free_space_admittance"]


def _others(seen: Evaluation) -> dict[str, float]:
    return {name: value for name, value in seen.requirements.items() if name != "free_space_admittance"}


@dataclass(frozen=True, kw_only=True)
class FrontRequest:
    """A front asked for: how many points, and for a study its objectives, demands, choices, storage, name and trials.

    `demands` are as `load_demands` reads them. None leaves the choice to the program.
    """

    points: int = 7
    objectives: tuple[str, ...] = USUAL
    demands: tuple[str, ...] = ()
    choices: tuple[str, ...] = ()
    storage: str | None = None
    study: str | None = None
    trials: int | None = None
    sampler: Literal["tpe", "nsga2"] | None = None
    seed: int = 0

    @property
    def wants_study(self) -> bool:
        """Whether anything is asked that only a study can do."""
        asked = (self.demands, self.choices, self.storage, self.study, self.trials, self.sampler)
        return set(self.objectives) != set(USUAL) or any(asked)

    def options(self) -> dict[str, Any]:
        """Return what decides the result, for the provenance of a file: not the storage, which may hold a secret."""
        options: dict[str, Any] = {"points": self.points, "seed": self.seed}
        if self.wants_study:
            options |= {
                "objectives": list(self.objectives),
                "require": list(self.demands),
                "choose": list(self.choices),
                "trials": self.trials or DEFAULT_TRIALS,
                "sampler": self.sampler or "tpe",
            }
        return options


@dataclass(frozen=True, kw_only=True)
class PreparedFronts:
    """A request whose plugins are loaded and whose storage is open; None where the solver does it alone."""

    request: FrontRequest
    objectives: tuple[Objective, ...]
    demands: tuple[Demand, ...]
    storage: "Storage | None"


def prepare_fronts(request: FrontRequest, beside: Path) -> PreparedFronts:
    """Load the plugins and open the storage (by default the file `beside`), worth doing before a long search.

    Raises UsageError for whatever of it does not exist or contradicts itself.
    """
    if not request.objectives:
        raise UsageError("A front needs an objective; found none.")
    check_choices(request.choices)
    objectives, demands = load_objectives(request.objectives), load_demands(request.demands)
    storage = None
    if request.wants_study:
        from .storage import open_storage  # noqa: PLC0415 - slow to import, and the usual front does without

        storage = open_storage(request.storage, beside)
    return PreparedFronts(request=request, objectives=objectives, demands=demands, storage=storage)


def trace_fronts(
    prepared: PreparedFronts, searches: Mapping[str, SearchResult], progress: Callable[[float], None] | None = None
) -> dict[str, Front]:
    """Return the front of every axis; `progress` gets the share of the work done since the last call.

    Raises UsageError and InfeasibleError as `run_study` does.
    """
    report = progress or no_progress

    def advance(done: float) -> None:
        report(done / len(searches))

    try:
        return {name: _trace(prepared, name, search, advance) for name, search in searches.items()}
    finally:
        if prepared.storage is not None:
            from .storage import close_storage  # noqa: PLC0415 - as above

            close_storage(prepared.storage)


def _trace(prepared: PreparedFronts, axis: str, search: SearchResult, report: Callable[[float], None]) -> Front:
    request = prepared.request
    if prepared.storage is None:
        return trace_front(search, request.points, seed=request.seed, progress=report)
    from .study import StudyPlan, fingerprint, run_study  # noqa: PLC0415 - as above

    plan = StudyPlan(
        objectives=prepared.objectives,
        demands=prepared.demands,
        choices=request.choices,
        trials=request.trials or DEFAULT_TRIALS,
        sampler=request.sampler or "tpe",
        seed=request.seed,
    )
    own = fingerprint(search.problem, plan, search.design)[:12]
    asked = 0.0

    def seeds() -> list[FloatArray]:
        nonlocal asked
        asked = _SEED_SHARE
        return seed_designs(search, seed=request.seed, progress=lambda done: report(_SEED_SHARE * done))

    return run_study(
        search.problem,
        plan,
        prepared.storage,
        start=search.design,
        name=f"{own if request.study is None else request.study}.{axis}",
        points=request.points,
        seeds=seeds,
        progress=lambda done: report((1.0 - asked) * done),
    )


def seed_designs(
    search: SearchResult, *, seed: int = 0, progress: Callable[[float], None] | None = None
) -> list[FloatArray]:
    """Return designs for a study to begin with: those of a front by the solver, and one between each two neighbours."""
    front = trace_front(search, _SEED_POINTS, seed=seed, progress=progress)
    box = Box(search.problem)
    units = [box.unit(design_of(search.problem, point.controller)) for point in front.points]
    between = [0.5 * (one + other) for one, other in pairwise(units)]
    return [presentable(search.problem, box.design(unit)) for unit in (*units, *between)]
