"""What several tests explore: a small problem, the controller that solves it, and both as a source."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np

from autotune.explore.source import AxisStart, Exploration
from autotune.tuning.record import runtime_payload
from problems.design.problem import AdmittanceTarget, DesignProblem, Requirements
from tests.autotune.tuning.cases import FAST_REQUIREMENTS, design_problem, fast_optimized, identified_plant

DESIGN = np.array([6.0, 1250.0, 0.018, 0.005])


def roomy_problem() -> DesignProblem:
    """A problem with many feasible designs around `DESIGN`."""
    asked = Requirements(modulus_margin=0.4, free_space_admittance=AdmittanceTarget(min_m_s_per_n=6.5e-4))
    return design_problem(requirements=asked)


@cache
def small_exploration() -> Exploration:
    """Two axes of one problem with four free gains; the plants around are the ends of their ranges."""
    problem = roomy_problem()
    start = AxisStart(problem=problem, design=DESIGN, scenarios=problem.scenarios(2, 2))
    payload = runtime_payload(identified_plant(), 16.0, is_chosen=False)
    return Exploration(path=Path("identified.yaml"), axes={"x": start, "y": start}, payload=payload, provenance={})


@cache
def solved_exploration() -> Exploration:
    """The solution of `fast_optimized`, of which less modulus margin is asked, with two free gains."""
    found = fast_optimized()
    search = found.searches["x"]
    problem = replace(search.problem, requirements=replace(FAST_REQUIREMENTS, modulus_margin=0.45))
    start = AxisStart(problem=problem, design=search.design, scenarios=problem.scenarios(3, 2))
    return Exploration(
        path=Path("identified.yaml"),
        axes={"x": start},
        payload=found.controller.payload,
        provenance=found.controller.provenance,
    )
