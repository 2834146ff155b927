"""A problem of two free numbers, quick to judge, with plans and a worker process of a study."""

from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from autotune.studies.storage import open_storage
from autotune.studies.study import StudyPlan, run_study
from autotune.tuning.search import SearchResult, solve_design
from problems.design.objectives import Admittance, PeakForce
from problems.design.problem import DesignProblem
from tests.autotune.own_process import OwnProcess
from tests.autotune.tuning.cases import FAST_REQUIREMENTS, FAST_SPEC, design_problem


def small_problem() -> DesignProblem:
    return design_problem(
        bounds=FAST_SPEC.bounds, requirements=FAST_REQUIREMENTS, mass=(16.0, 16.0), stiffness=(1e5, 1.2e5)
    )


@cache
def small_search() -> SearchResult:
    return solve_design(small_problem(), seed=1)


START: NDArray[np.float64] = np.array([6.0, 1290.0, 0.02, 0.005])
"""A design of the small problem that meets every requirement."""


def small_plan(trials: int, seed: int = 3, choices: tuple[str, ...] = ()) -> StudyPlan:
    return StudyPlan(objectives=(PeakForce(), Admittance()), trials=trials, seed=seed, choices=choices)


def start_worker(folder: Path, url: str, trials: int, heartbeat_s: int = 1) -> OwnProcess:
    """Run the study `shared` in a process of its own."""
    return OwnProcess(folder, _study, url, trials, heartbeat_s)


def _study(url: str, trials: int, heartbeat_s: int) -> None:
    storage = open_storage(url, Path("unused.db"), heartbeat_s=heartbeat_s)
    front = run_study(small_problem(), small_plan(trials), storage, start=START, name="shared")
    print(len(front.points))
