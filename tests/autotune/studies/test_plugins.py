"""Objectives and requirements: found by entry points, held to a contract, and right where theory tells the number."""

import os
import subprocess
import sys
import tomllib
from collections.abc import Callable
from dataclasses import replace
from importlib.metadata import EntryPoint
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest

from autotune import plugins
from autotune.errors import UsageError
from autotune.formats.identified import IdentifiedFile
from autotune.studies.contract import (
    ContractError,
    check_objective,
    check_requirement,
    sample_designs,
    sample_problem,
)
from autotune.studies.objectives import PassiveBand
from autotune.studies.plugins import (
    REQUIREMENTS,
    Direction,
    Objective,
    ObjectiveLimit,
    Requirement,
    load_demands,
    load_objectives,
    registered,
)
from autotune.tuning.optimize import optimize
from problems.design.evaluation import Evaluation, build_scenarios
from problems.design.objectives import BUILT_IN, Admittance, CommandNoise, HandForce, PeakForce, SensorForce
from problems.design.problem import AdmittanceTarget, DesignProblem, Requirements
from problems.errors import ParameterError
from problems.model.controller import AdmittanceController
from problems.stability.noise import command_speed_gain
from problems.stability.passivity import prepare_port
from tests.autotune.tuning.cases import FAST_PROBLEM_YAML, FAST_SPEC, identified_plant, write_plant
from tests.conftest import ROOT
from tests.next_step import is_next_alone

RunCli = Callable[..., "subprocess.CompletedProcess[str]"]


def test_the_built_in_requirement_is_registered_as_anyones_are(repository: Path) -> None:
    project = tomllib.loads((repository / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    registered_here = {PassiveBand.name: f"{PassiveBand.__module__}:{PassiveBand.__qualname__}"}
    assert project["entry-points"] == {REQUIREMENTS: registered_here}
    assert registered_here.items() <= {name: entry.value for name, entry in registered(REQUIREMENTS).items()}.items()


@pytest.mark.parametrize("name", BUILT_IN)
def test_the_built_in_objectives_are_found_by_name_and_keep_the_contract(name: str) -> None:
    (found,) = load_objectives((name,))
    assert found is BUILT_IN[name]
    check_objective(type(found))


def test_the_built_in_requirement_keeps_the_contract() -> None:
    check_requirement(PassiveBand)


# --- the numbers --------------------------------------------------------------------------------------------------


def test_a_slow_hand_feels_the_dampings_and_a_fast_one_more() -> None:
    """Far below the loop's bandwidth F_h/V_p = B_a + B_p; what accelerates comes on top.

    The held command makes the flange's speed jump at each tick, by at most ω_b h of it, and B_s feels that jump.
    """
    slow = Requirements(free_space_admittance=AdmittanceTarget(min_m_s_per_n=1e-4, band_hz=(0.01, 0.02)))
    problem = sample_problem()
    for design in sample_designs(problem):
        steady = design.controller.damping_n_s_per_m + problem.plants.nominal.payload.drag_n_s_per_m
        assert HandForce().worst(slow, design) == pytest.approx(steady, abs=150.0 * 20.0 * problem.sample_time_s)
        assert HandForce().worst(problem.requirements, design) > steady


def test_admittance_is_what_the_requirement_is_measured_by() -> None:
    problem = sample_problem()
    target = problem.requirements.free_space_admittance
    assert target is not None
    prepared = build_scenarios(problem, problem.scenarios(3, 2))
    for design in sample_designs(problem):
        achieved = (
            target.min_m_s_per_n / prepared.evaluate_stable(design).evaluation.requirements["free_space_admittance"]
        )
        assert Admittance().worst(problem.requirements, design) == pytest.approx(achieved, rel=1e-12)
        assert PeakForce().worst(problem.requirements, design) == max(p.peak_contact_force_n for p in design.peaks)


def test_the_peak_force_of_a_front_is_the_one_that_the_problem_minimises() -> None:
    problem = sample_problem()
    at_sensor = PeakForce().beside(SensorForce())
    assert at_sensor.name == PeakForce.name
    for design in sample_designs(problem):
        assert at_sensor.worst(problem.requirements, design) == max(p.peak_sensor_force_n for p in design.peaks)
    assert PeakForce().beside(BUILT_IN["robustness"]) == PeakForce()


def test_noise_is_the_worst_of_contact_and_free_space() -> None:
    problem = sample_problem()
    for design in sample_designs(problem):
        law = design.controller
        free = [command_speed_gain(p, law) for p in design.prepared.free]
        assert CommandNoise().worst(problem.requirements, design) >= max(free)
        # Tustin's first answer of the speed to a force is about K_l/(2 M_a); the later ones add to it.
        assert CommandNoise().worst(problem.requirements, design) > 0.95 * law.lead_s / (2.0 * law.mass_kg)


def test_a_port_that_stays_passive_beyond_the_band_has_room() -> None:
    for design in sample_designs(sample_problem()):
        fails = prepare_port(design.prepared.free[0]).fails_above_hz(design.controller)
        assert fails is not None
        assert PassiveBand().achieved(1.0, design, 0) == pytest.approx(2.0 / fails)


def test_a_limit_is_required_over_achieved_in_either_direction() -> None:
    problem = sample_problem()
    design = sample_designs(problem)[0]
    most, least = load_demands(("peak_force=100", "admittance=1e-4"))
    assert isinstance(most, ObjectiveLimit)
    assert isinstance(least, ObjectiveLimit)
    assert most.ratio(problem, design) == max(p.peak_contact_force_n for p in design.peaks) / 100.0
    assert least.ratio(problem, design) == 1e-4 / Admittance().worst(problem.requirements, design)
    assert (most.name, least.name) == ("peak_force_limit", "admittance_limit")


# --- what is refused ----------------------------------------------------------------------------------------------


class Highest(Objective):
    """The peak at the contact, as another package would write it."""

    name: ClassVar[str] = "highest"
    unit: ClassVar[str] = "N"
    direction: ClassVar[Direction] = "minimize"

    def __call__(self, controller: AdmittanceController, problem: DesignProblem, evaluation: Evaluation) -> float:
        return max(peak.peak_contact_force_n for peak in evaluation.peaks)


class Drifting(Highest):
    """Counts its calls, which no objective may."""

    name: ClassVar[str] = "drifting"

    def __init__(self) -> None:
        self.calls = 0

    def __call__(self, *arguments: Any) -> float:
        self.calls += 1
        return super().__call__(*arguments) + self.calls


class Endless(Highest):
    name: ClassVar[str] = "endless"

    def __call__(self, *_: Any) -> float:
        return float("inf")


class Missing(Highest):
    name: ClassVar[str] = "missing"

    def __call__(self, *_: Any) -> float:
        return float("nan")


class Negative(Highest):
    name: ClassVar[str] = "negative"

    def __call__(self, *_: Any) -> float:
        return -1.0


class Failing(Highest):
    name: ClassVar[str] = "failing"

    def __call__(self, *_: Any) -> float:
        raise ZeroDivisionError("no settling found")


class NegativeRatio(Requirement):
    name: ClassVar[str] = "negative_ratio"

    def __call__(self, *_: Any) -> float:
        return -0.5


class Undirected(Highest):
    name: ClassVar[str] = "undirected"
    direction: ClassVar[Any] = "up"


class Abstract(Objective):
    name: ClassVar[str] = "abstract"


def entries(*pairs: tuple[str, str]) -> Callable[..., tuple[EntryPoint, ...]]:
    return lambda group: tuple(EntryPoint(name=name, value=value, group=group) for name, value in pairs)


HERE = "tests.autotune.studies.test_plugins"


@pytest.mark.parametrize("kind", [Drifting, Endless, Undirected])
def test_the_contract_refuses(kind: type[Highest], monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ContractError, match="must be the entry point"):
        check_objective(kind)
    monkeypatch.setattr(plugins, "entry_points", entries((kind.name, f"{kind.__module__}:{kind.__qualname__}")))
    monkeypatch.setitem(sys.modules, kind.__module__, sys.modules[__name__])
    with pytest.raises(ContractError) as refused:
        check_objective(kind)
    assert "must be the entry point" not in str(refused.value)
    assert kind.__qualname__ in str(refused.value)


@pytest.mark.parametrize(
    ("objective", "found"),
    [
        (Missing(), "nan"),
        (Negative(), "-1.0"),
        (Endless(), "inf"),
        (Failing(), "ZeroDivisionError('no settling found')"),
    ],
)
def test_a_search_ends_at_a_number_of_an_objective_that_cannot_be_compared(objective: Objective, found: str) -> None:
    plant = IdentifiedFile(result=identified_plant(), provenance={}, path=Path("p.yaml"), sha256="0" * 64)
    with pytest.raises(ParameterError) as refused:
        optimize(plant, replace(FAST_SPEC, objective=objective))
    assert f"objective {objective.name} must be" in str(refused.value)
    assert f"found {found}" in str(refused.value)


def test_a_ratio_below_0_is_not_taken_for_one_that_is_met() -> None:
    design = sample_designs(sample_problem())[0]
    with pytest.raises(ParameterError, match=r"requirement negative_ratio must be .*, found -0\.5"):
        NegativeRatio().achieved(1.0, design, 0)


@pytest.mark.parametrize(
    ("pairs", "message"),
    [
        ((("mine", "no_such_module:Mine"),), "cannot be loaded: No module named"),
        ((("mine", "problems.design.objectives:PeakForce"),), "whose name is 'mine'"),
        ((("mine", "autotune.studies.objectives:PassiveBand"),), "must be a subclass of"),
        ((("mine", "math:pi"),), "must be a subclass of"),
        ((("mine", "a:A"), ("mine", "b:B")), "Two installed packages register mine"),
        ((), "there are: admittance, command_noise"),
    ],
)
def test_a_plugin_that_cannot_be_used_is_refused(
    pairs: tuple[tuple[str, str], ...], message: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(plugins, "entry_points", entries(*pairs))
    with pytest.raises(UsageError, match=message):
        load_objectives(("mine",))


@pytest.mark.parametrize(
    "reported", [("nothing",), ("peak_force=0",), ("peak_force=x",), ("passive_band", "passive_band")]
)
def test_a_demand_that_says_nothing_is_refused(reported: tuple[str, ...]) -> None:
    with pytest.raises(UsageError):
        load_demands(reported)


# --- one of one's own ---------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_the_example_package_is_installed_keeps_the_contract_and_joins_a_study(
    tmp_path: Path, run_cli: RunCli, monkeypatch: pytest.MonkeyPatch
) -> None:
    site = tmp_path / "site"
    source = ROOT / "examples" / "plugin"
    copy = tmp_path / "plugin"  # the build leaves files beside its sources
    copy.mkdir()
    for path in source.iterdir():
        if path.is_file():
            (copy / path.name).write_bytes(path.read_bytes())
    install = ["pip", "install", "--quiet", "--no-deps", "--no-build-isolation", "--no-index", "--target", str(site)]
    subprocess.run([sys.executable, "-m", *install, str(copy)], check=True, capture_output=True)
    own = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", str(copy / "test_plugin.py")],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), str(site)])},
        capture_output=True,
        text=True,
        check=False,
    )
    assert own.returncode == 0, own.stdout + own.stderr
    assert "2 passed" in own.stdout
    monkeypatch.syspath_prepend(site)
    write_plant(tmp_path)
    (tmp_path / "problem.yaml").write_text(FAST_PROBLEM_YAML, encoding="utf-8")
    wish = ("--objectives", "peak_force,time_to_peak", "--require", "time_to_react", "--trials", "12")
    done = run_cli("optimize", "identified.yaml", "--problem", "problem.yaml", "--pareto", *wish)
    assert done.returncode == 0
    assert is_next_alone(done.stderr)
    assert "front of peak_force and time_to_peak" in done.stdout
    assert "time_to_react" in (tmp_path / "pareto.yaml").read_text(encoding="utf-8")


def test_samples_are_stable_and_differ() -> None:
    designs = sample_designs(sample_problem())
    assert len({each.controller for each in designs}) == 3
    assert all(
        np.max(each.radii) < 1.0 and np.all(np.isfinite([p.peak_contact_force_n for p in each.peaks]))
        for each in designs
    )


@pytest.mark.parametrize(("fails_hz", "share"), [(None, 0.0), (0.5, 20.0), (20.0, 0.5), (0.0, np.inf)])
def test_the_share_of_a_passive_band_is_its_end_over_where_passivity_fails(
    fails_hz: float | None, share: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Port:
        def fails_above_hz(self, controller: object) -> float | None:
            return fails_hz

    monkeypatch.setattr("autotune.studies.objectives.prepare_port", lambda _: Port())
    assert PassiveBand._share(None, None, 10.0) == share  # type: ignore[arg-type]
