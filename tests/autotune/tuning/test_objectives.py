"""Any registered objective is searched, certified, validated and written, by the command line too."""

from collections.abc import Callable
from dataclasses import replace
from importlib.metadata import EntryPoint
from pathlib import Path
from subprocess import CompletedProcess

import numpy as np
import pytest

from autotune import plugins
from autotune.errors import UsageError
from autotune.formats.identified import IdentifiedFile
from autotune.formats.problem import ProblemSpec, read_problem
from autotune.formats.schedule import ScheduleClass
from autotune.formats.yaml12 import load_yaml
from autotune.tuning.optimize import optimize
from autotune.tuning.schedule import tune_schedule
from autotune.tuning.search import solve_design
from problems.design.evaluation import build_scenarios
from problems.design.objectives import BUILT_IN
from tests.autotune.tuning.cases import (
    FAST_PROBLEM_YAML,
    FAST_REQUIREMENTS,
    FAST_SPEC,
    design_problem,
    fast_optimized,
    identified_plant,
    write_plant,
)
from tests.next_step import is_next_alone

RunCli = Callable[..., "CompletedProcess[str]"]
OTHERS = ("admittance", "hand_force", "command_noise", "robustness")


@pytest.mark.parametrize("name", OTHERS)
def test_no_design_of_a_lattice_that_meets_everything_is_better(name: str) -> None:
    """The search against plain evaluation of designs over both free variables, one by one."""
    objective = BUILT_IN[name]
    problem = replace(
        design_problem(
            bounds=FAST_SPEC.bounds, requirements=FAST_REQUIREMENTS, mass=(16.0, 16.0), stiffness=(1e5, 1.2e5)
        ),
        objective=objective,
    )
    found = solve_design(problem, seed=1)
    assert found.evaluation.is_feasible
    prepared = build_scenarios(problem, problem.scenarios(2, 2))
    lattice = [
        np.array([6.0, damping, lead, 0.005])
        for damping in np.linspace(1150.0, 1340.0, 10)
        for lead in np.linspace(0.01, 0.022, 7)
    ]
    seen = [each for each in map(prepared.evaluate, lattice) if each.is_feasible]
    assert len(seen) > 9
    # The lattice sees two plants, the search 33: it may be that much worse.
    assert found.evaluation.cost <= (1.0 + 1e-3) * min(each.cost for each in seen)
    assert objective.value(found.evaluation.cost) == pytest.approx(
        objective.worst(
            problem.requirements,
            build_scenarios(problem, problem.scenarios(33, 2)).stable(problem.controller(found.design)),
        ),
        rel=1e-6,
    )


def test_robustness_is_maximised_certified_and_reported_by_the_command(run_cli: RunCli, tmp_path: Path) -> None:
    write_plant(tmp_path)
    (tmp_path / "problem.yaml").write_text(f"{FAST_PROBLEM_YAML}\nobjective: robustness\n", encoding="utf-8")
    asked = ("optimize", "identified.yaml", "--problem", "problem.yaml", "--report", "page.html")
    done = run_cli(*asked)
    assert done.returncode == 0
    assert is_next_alone(done.stderr)
    tree = load_yaml(tmp_path / "controller.yaml")
    reached = tree["certificate"]["margins"]["x"]["modulus"]
    assert f"objective robustness: least modulus margin {reached:.4g}\n" in done.stdout
    assert "makes the objective" in done.stdout
    assert "is the most that was found" in done.stdout
    said = tree["provenance"]["optimality"]["x"]
    assert said["objective"] == {"name": "robustness", "unit": "", "direction": "maximize"}
    # Of exact gradients: the modulus margin's own, at frequencies that are found again.
    assert said["kkt_residual"] < 1e-4
    assert said["gap_against"]["best"] == pytest.approx(reached, rel=1e-4)
    page = (tmp_path / "page.html").read_text(encoding="utf-8")
    assert "what holds the robustness back is free-space admittance" in page
    assert run_cli("validate", "controller.yaml").returncode == 0


EXAMPLE = "tests.autotune.studies.test_plugins:Highest"


def test_an_objective_of_another_package_is_optimized_and_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Written as one function of the evaluation, the peak at the contact leads to the same design as the built-in."""
    known = EntryPoint(name="highest", value=EXAMPLE, group=plugins.OBJECTIVES)
    monkeypatch.setattr(plugins, "entry_points", lambda group: [known] if group == plugins.OBJECTIVES else [])
    (tmp_path / "problem.yaml").write_text(f"{FAST_PROBLEM_YAML}\nobjective: highest\n", encoding="utf-8")
    spec = read_problem(tmp_path / "problem.yaml")
    assert spec.objective.name == "highest"
    plant = IdentifiedFile(result=identified_plant(), provenance={}, path=Path("identified.yaml"), sha256="0" * 64)
    own, built_in = optimize(plant, spec, seed=1), fast_optimized()
    assert own.searches["x"].evaluation.cost == pytest.approx(built_in.searches["x"].evaluation.cost, rel=1e-4)
    assert own.optimality_reports["x"].optimality.exact_share < 1.0
    assert own.controller.provenance["optimality"]["x"]["objective"]["name"] == "highest"
    monkeypatch.setattr(plugins, "entry_points", lambda **_: [])
    with pytest.raises(UsageError, match=r"objective .*contact_force"):
        read_problem(tmp_path / "problem.yaml")


def test_a_schedule_of_something_else_than_a_force_is_refused() -> None:
    plant = IdentifiedFile(result=identified_plant(), provenance={}, path=Path("identified.yaml"), sha256="0" * 64)
    spec = ProblemSpec(objective=BUILT_IN["robustness"])
    with pytest.raises(UsageError, match=r"compares peak forces, and objective in problem\.yaml is robustness"):
        tune_schedule(plant, spec, [ScheduleClass(payload_mass_kg=(15.0, 16.0))])
