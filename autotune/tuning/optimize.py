"""From identified parameters to a validated controller: search, prove, write down, verify."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from autotune import __version__
from autotune.files.controller_record import Controller
from autotune.files.identified import IdentifiedFile
from autotune.files.problem import ProblemSpec
from autotune.validation.validate import ValidationReport, prove_axis, validate_controller

from .explain import Active, explain
from .problems import Wishes, build_problems, runtime_mass_kg
from .record import build_controller, build_domain
from .search import SearchResult, solve_design

_SEARCH_SHARE, _PROOF_SHARE = 0.7, 0.1


@dataclass(frozen=True, kw_only=True)
class Optimized:
    """A controller that passed validation, the searches behind it, what each rests on, and the checks it passed."""

    controller: Controller
    searches: Mapping[str, SearchResult]
    active: Mapping[str, tuple[Active, ...]]
    report: ValidationReport


def optimize(
    identified: IdentifiedFile,
    spec: ProblemSpec,
    wishes: Wishes,
    *,
    seed: int = 0,
    problem_path: Path | None = None,
    progress: Callable[[float], None] | None = None,
) -> Optimized:
    """Tune every axis and return a controller that the independent validation has passed.

    `progress` is told the share of the work done since the last call. Raises InfeasibleError when nothing meets the
    requirements, CertificateError when a claim cannot be proved or verified, EstimateError for a missing parameter.
    """
    report = progress if progress is not None else _silent
    problems = build_problems(identified.result, spec, wishes)
    # Asked before the search, because it may refuse.
    runtime_mass_kg(identified.result, next(iter(problems.values())).payload_mass_kg)
    share = 1.0 / len(problems)
    searches = {
        name: solve_design(problem, seed=seed, progress=lambda done: report(_SEARCH_SHARE * share * done))
        for name, problem in problems.items()
    }
    active = {name: explain(search) for name, search in searches.items()}
    proofs = {
        name: prove_axis(
            build_domain(search.problem),
            search.problem.controller(search.design),
            search.problem.sample_time_s,
            name,
        )
        for name, search in searches.items()
    }
    report(_PROOF_SHARE)
    controller = build_controller(
        searches, identified.result, proofs, _provenance(identified, wishes, seed, problem_path)
    )
    checked = validate_controller(controller, lambda done: report((1.0 - _SEARCH_SHARE - _PROOF_SHARE) * done))
    checked.require()
    return Optimized(controller=controller, searches=searches, active=active, report=checked)


def _silent(_: float) -> None:
    return None


def _provenance(identified: IdentifiedFile, wishes: Wishes, seed: int, problem_path: Path | None) -> dict[str, Any]:
    mass, stiffness = wishes.payload_mass_kg, wishes.environment_stiffness_n_per_m
    return {
        "tool": f"autotune {__version__}",
        "identified": {"path": str(identified.path), "sha256": identified.sha256},
        "options": {
            "problem": None if problem_path is None else str(problem_path),
            "payload_mass_kg": None if mass is None else list(mass),
            "environment_stiffness_n_per_m": None if stiffness is None else list(stiffness),
            "seed": seed,
        },
    }
