"""A result that proof or bouncing refutes is not the end: what refuted it joins the search."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from autotune.errors import CertificateError, InfeasibleError
from autotune.formats.identified import read_identified
from autotune.formats.problem import read_problem
from autotune.tuning import optimize as tuning_optimize
from autotune.tuning import settle as tuning
from autotune.tuning.optimize import optimize
from autotune.tuning.record import build_domain
from autotune.tuning.scenario_exchange import NOTHING, Counterexamples, ImpactTest
from autotune.tuning.search import solve_design
from autotune.tuning.settle import prove_search, settle
from autotune.validation import bouncing
from autotune.validation.axis_proof import ProofOptions
from autotune.validation.bouncing import RefutedError
from autotune.validation.report import Check, ValidationReport
from problems.design.uncertainty import Scenario
from tests.autotune.tuning.cases import FAST_SPEC, fast_optimized, in_memory_plant
from tests.autotune.validation.bouncing_cases import bouncing_problem
from tests.problems.contact.test_bouncing import BOUNCY, K_E, M_P

PLANT = Scenario(environment_stiffness_n_per_m=K_E, payload_mass_kg=M_P)


@pytest.fixture
def few_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    """At the edge of bouncing every impact takes long to follow; a sixteenth of them shows the same."""
    monkeypatch.setattr(bouncing, "RUNS", 64)


@pytest.mark.slow
@pytest.mark.usefixtures("few_runs")
def test_the_best_design_bounces_and_the_search_goes_on_to_one_that_does_not() -> None:
    problem = bouncing_problem(lead_s=(0.03, BOUNCY.lead_s))
    first = solve_design(problem)
    with pytest.raises(RefutedError) as refuted:
        prove_search("x", first, ProofOptions())
    assert refuted.value.scenario == PLANT
    settled = settle("x", first, ProofOptions(), seed=0)
    assert settled.counterexamples.impacts
    assert settled.search.evaluation.cost > first.evaluation.cost
    assert settled.search.evaluation.is_feasible
    assert 0.03 < settled.search.design[2] < BOUNCY.lead_s
    found = bouncing.search_bouncing(
        "x", build_domain(problem), problem.controller(settled.search.design), problem.sample_time_s
    )
    assert found.passed


def test_where_every_design_bounces_the_refusal_says_so() -> None:
    problem = bouncing_problem()
    with pytest.raises(InfeasibleError, match=r"touched at .* Searched again with that: .* bounce for ever"):
        settle("x", solve_design(problem), ProofOptions(), seed=0)


def test_the_shared_case_is_refused(shared_data: Path) -> None:
    folder = shared_data / "cases" / "bounce"
    if not folder.is_dir():
        pytest.skip("needs the cases in ../shared/data")
    with pytest.raises(InfeasibleError, match="bounces for ever"):
        optimize(read_identified(folder / "identified.yaml"), read_problem(folder / "problem.yaml"))


def test_a_plant_where_the_proof_fails_joins_the_scenarios(monkeypatch: pytest.MonkeyPatch) -> None:
    found, plant = fast_optimized().searches["x"], Scenario(environment_stiffness_n_per_m=1.1e5, payload_mass_kg=16.0)
    refused: list[object] = []

    def once(name: str, search: object, asked: object) -> object:
        if not refused:
            refused.append(search)
            raise RefutedError("Axis x: not proved", axis="x", scenario=plant)
        return prove_search(name, search, asked)  # type: ignore[arg-type]

    monkeypatch.setattr(tuning, "prove_search", once)
    settled = settle("x", found, ProofOptions(), seed=0)
    assert settled.counterexamples == Counterexamples(scenarios=(plant,))
    assert plant in settled.search.active.scenarios


def test_a_plant_that_refutes_again_ends_the_search(monkeypatch: pytest.MonkeyPatch) -> None:
    found, plant = fast_optimized().searches["x"], Scenario(environment_stiffness_n_per_m=1.1e5, payload_mass_kg=16.0)
    asked: list[object] = []

    def always(*arguments: object) -> None:
        asked.append(arguments)
        raise RefutedError("Axis x: not proved", axis="x", scenario=plant)

    monkeypatch.setattr(tuning, "prove_search", always)
    with pytest.raises(CertificateError, match="not proved"):
        settle("x", found, ProofOptions(), seed=0)
    assert len(asked) == 2


def test_a_plant_that_validation_refutes_joins_the_scenarios(monkeypatch: pytest.MonkeyPatch) -> None:
    plant = Scenario(environment_stiffness_n_per_m=1.1e5, payload_mass_kg=16.0)
    missed = Check(axis="x", name="requirements", passed=False, message="modulus_margin is missed", refuted_at=plant)
    reports = [ValidationReport(checks=(missed,)), ValidationReport(checks=())]
    monkeypatch.setattr(tuning_optimize, "validate_controller", lambda *_, **__: reports.pop(0))
    found = optimize(in_memory_plant(), FAST_SPEC, seed=1)
    assert not reports
    assert plant in found.searches["x"].active.scenarios


def test_a_plant_that_validation_refutes_again_and_again_ends_the_search(monkeypatch: pytest.MonkeyPatch) -> None:
    plant = Scenario(environment_stiffness_n_per_m=1.1e5, payload_mass_kg=16.0)
    missed = Check(axis="x", name="requirements", passed=False, message="modulus_margin is missed", refuted_at=plant)
    monkeypatch.setattr(tuning_optimize, "validate_controller", lambda *_, **__: ValidationReport(checks=(missed,)))
    with pytest.raises(RefutedError, match=r"^Axis x, requirements: modulus_margin is missed$"):
        optimize(in_memory_plant(), FAST_SPEC, seed=1)


def test_a_gap_to_the_reference_is_searched_again_from_there() -> None:
    """A result that is 2 % worse than the best, as a search may leave one, ends at the best."""
    best = fast_optimized().searches["x"]
    worse = replace(
        best,
        design=best.design * np.array([1.0, 1.0, 0.9, 1.0]),
        evaluation=replace(
            best.evaluation, objective=tuple(replace(row, cost=1.02 * row.cost) for row in best.evaluation.objective)
        ),
    )
    settled = settle("x", worse, ProofOptions(), seed=0)
    # The search's own tolerance: six digits of each variable.
    assert settled.search.evaluation.cost == pytest.approx(best.evaluation.cost, rel=1e-4)
    assert settled.optimality.gap < 1e-3


def test_walking_back_stops_where_the_contact_comes_to_rest() -> None:
    problem = bouncing_problem(lead_s=(0.03, BOUNCY.lead_s))
    impacts = ImpactTest(problem, Counterexamples(impacts=((PLANT, 24.0),)))
    calm, bouncy = (
        np.array([BOUNCY.mass_kg, BOUNCY.damping_n_s_per_m, lead, BOUNCY.feedback_damping_s])
        for lead in (0.03, BOUNCY.lead_s)
    )
    assert impacts.passes(calm)
    assert not impacts.passes(bouncy)
    edge = impacts.walk_back(calm, bouncy)
    assert impacts.passes(edge)
    assert calm[2] < edge[2] < bouncy[2]
    assert not ImpactTest(problem, NOTHING)
