"""Which way a front is traced: by the solver for the two usual objectives, by a study for everything else."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from autotune.errors import UsageError
from autotune.tuning.bounds import Box
from autotune.tuning.search import SearchResult, presentable

from .front import trace_front
from .plugins import Demand, Objective, load_demands, load_objectives
from .points import Front
from .structures import check_choices, design_of

if TYPE_CHECKING:
    from .study import Storage

FloatArray = NDArray[np.float64]

USUAL = ("peak_force", "admittance")
DEFAULT_TRIALS = 200
_SEED_POINTS = 5
_SEED_SHARE = 0.2


@dataclass(frozen=True, kw_only=True)
class FrontRequest:
    """What was asked: how many points, and for a study its objectives, demands, choices, storage, name and trials.

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
        """Return what decides the result, for the provenance of a file; the storage does not, and may hold a secret."""
        told: dict[str, Any] = {"points": self.points, "seed": self.seed}
        if self.wants_study:
            told |= {
                "objectives": list(self.objectives),
                "require": list(self.demands),
                "choose": list(self.choices),
                "trials": self.trials or DEFAULT_TRIALS,
                "sampler": self.sampler or "tpe",
            }
        return told


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
        from .study import open_storage  # noqa: PLC0415 - slow to import, and the usual front does without

        storage = open_storage(request.storage, beside)
    return PreparedFronts(request=request, objectives=objectives, demands=demands, storage=storage)


def trace_fronts(
    prepared: PreparedFronts, searches: Mapping[str, SearchResult], progress: Callable[[float], None] | None = None
) -> dict[str, Front]:
    """Return the front of every axis; `progress` is told the share of the work done since the last call.

    Raises UsageError and InfeasibleError as `run_study` does.
    """
    report = progress if progress is not None else _silent

    def advance(done: float) -> None:
        report(done / len(searches))

    try:
        return {name: _trace(prepared, name, search, advance) for name, search in searches.items()}
    finally:
        if prepared.storage is not None:
            from .study import close_storage  # noqa: PLC0415 - slow to import, and the usual front does without

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


def _silent(_: float) -> None:
    return None
