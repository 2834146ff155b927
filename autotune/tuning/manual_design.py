"""A design that somebody chose by hand, held against the whole uncertainty as a search holds its own."""

import numpy as np
from numpy.typing import NDArray

from autotune.errors import InfeasibleError
from problems.design.evaluation import build_scenarios
from problems.design.problem import DesignProblem
from problems.stability.margins import UnstableLoopError

from .bounds import bounds_of
from .search import SearchResult, presentable
from .worst import WholeSet

FloatArray = NDArray[np.float64]


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
