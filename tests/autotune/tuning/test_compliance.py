"""The stiffness of a compliance: which one is chosen, what is told beside it, and that the rest is as always."""

import math
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from autotune.errors import InfeasibleError, UsageError
from autotune.formats.controller import read_controller, write_controller
from autotune.formats.identified import IdentifiedFile
from autotune.formats.problem import ComplianceSpec, ProblemSpec
from autotune.tuning import compliance as module
from autotune.tuning import optimize as optimize_module
from autotune.tuning.causes import Explanation
from autotune.tuning.compliance import (
    RESOLUTION,
    Compliance,
    build_compliance_problems,
    certified_range,
    choose_compliance,
    compliance_tree,
)
from autotune.tuning.optimize import Optimized, optimize
from autotune.tuning.problems import build_problems
from autotune.tuning.relax import Relaxation
from autotune.tuning.scenario_exchange import moved_scenario
from autotune.tuning.schedule import build_classes, tune_schedule
from autotune.tuning.search import solve_design
from autotune.validation.domain import check_domain
from autotune.validation.validate import validate_controller
from problems.design.problem import DesignProblem, Requirements
from problems.design.uncertainty import Scenario
from tests.autotune.tuning.cases import (
    BARE_SPEC,
    FAST_REQUIREMENTS,
    ROOM,
    design_problem,
    identified_axis,
    identified_plant,
    known,
    with_axis,
)
from tests.autotune.tuning.turning import two_axes

BOUNDS = (2e4, 5e5)
# Two searches of one problem from different starts end within this of each other; the gap that they tell is as large.
SAME = 3e-3
Curve = Callable[[float], float]


# --- on curves whose best stiffness is known in closed form -------------------------------------------------------


@pytest.fixture
def on_curve(monkeypatch: pytest.MonkeyPatch) -> Callable[..., tuple[Compliance, list[float]]]:
    """Choose on a curve of the least worst peak over K_e; where it is negative, that share of something is missed."""

    def choose(
        curve: Curve, bounds: tuple[float, float] = BOUNDS, limit: float | None = None
    ) -> tuple[Compliance, list[float]]:
        asked: list[float] = []

        def solve(problem: Any, *, neighbour: Any, **_: int) -> Any:
            stiffness = problem.plants.environment_stiffness_n_per_m[1] / 1.2
            if neighbour is None or not asked or asked[-1] != stiffness:
                asked.append(stiffness)
            peak = curve(stiffness)
            if peak < 0.0:
                raise InfeasibleError("nothing", missed=-peak)
            return SimpleNamespace(
                evaluation=evaluation_of(peak), problem=problem, at=stiffness, begun_at=neighbour and neighbour.at
            )

        monkeypatch.setattr(module, "solve_design", solve)
        problem = design_problem(requirements=Requirements(max_peak_force_n=limit))
        return choose_compliance(problem, ComplianceSpec(bounds=bounds)), asked

    return choose


def evaluation_of(peak: float) -> SimpleNamespace:
    peaks = [SimpleNamespace(peak_contact_force_n=peak)]
    return SimpleNamespace(cost=peak, objective_cost=peak, soft_cost_n={}, peaks=peaks)


def valley(best: float) -> Curve:
    return lambda stiffness: 40.0 + 10.0 * math.log(stiffness / best) ** 2


def is_found_at(reported: float, edge: float) -> bool:
    """Whether the stiffest of those tried up to an edge is told, the next one lying at most the resolution above."""
    return reported <= edge < reported * (1.0 + RESOLUTION) * (1.0 + 1e-3)


@pytest.mark.parametrize("best", [2.6e4, 7.3e4, 4.1e5])
def test_a_valley_between_the_bounds_is_found(on_curve: Any, best: float) -> None:
    found, asked = on_curve(valley(best))
    least = found.chosen.cost
    assert 40.0 <= least < 40.1
    assert is_found_at(found.nearly_as_good.stiffness_n_per_m, best * math.exp(math.sqrt((1.01 * least - 40.0) / 10.0)))
    assert (found.active_bound, found.stiffest.stiffness_n_per_m) == (None, BOUNDS[1])
    assert len(asked) <= 24


def test_of_as_good_ones_the_stiffest_is_chosen(on_curve: Any) -> None:
    found, _ = on_curve(lambda stiffness: max(30.0, 30.0 * (stiffness / 1e5) ** 0.3))
    assert is_found_at(found.chosen.stiffness_n_per_m, 1e5 * 1.001 ** (1.0 / 0.3))


@pytest.mark.parametrize(("sign", "side", "chosen"), [(1.0, "lower", BOUNDS[0]), (-1.0, "upper", BOUNDS[1])])
def test_a_bound_that_holds_the_choice_is_reported(on_curve: Any, sign: float, side: str, chosen: float) -> None:
    found, _ = on_curve(lambda stiffness: 50.0 * (stiffness / 1e5) ** (0.3 * sign))
    assert (found.active_bound, found.chosen.stiffness_n_per_m) == (side, chosen)


def test_a_stiffness_that_is_given_is_taken_and_no_bound_is_active(on_curve: Any) -> None:
    found, asked = on_curve(valley(7e4), bounds=(3e4, 3e4))
    assert (asked, found.chosen.stiffness_n_per_m, found.active_bound) == ([3e4], 3e4, None)


def test_the_stiffest_that_meets_everything_is_reported(on_curve: Any) -> None:
    found, _ = on_curve(lambda stiffness: 30.0 + stiffness * 1e-4 if stiffness <= 1.3e5 else 1.3e5 / stiffness - 1.0)
    assert is_found_at(found.stiffest.stiffness_n_per_m, 1.3e5)
    reported = {each["environment_stiffness_n_per_m"]: each for each in compliance_tree(found)["tried"]}
    assert reported[BOUNDS[1]] == {
        "environment_stiffness_n_per_m": BOUNDS[1],
        "peak_force_n": None,
        "meets_all": False,
    }


def test_a_limit_of_the_peak_leaves_the_table_whole(on_curve: Any) -> None:
    """30 + K 1e-4 N meets 45 N up to 1.5e5 N/m; what lies above is shown, and not chosen."""
    found, _ = on_curve(lambda stiffness: 30.0 + 1e-4 * stiffness, limit=45.0)
    assert is_found_at(found.stiffest.stiffness_n_per_m, 1.5e5)
    last = compliance_tree(found)["tried"][-1]
    assert (last["peak_force_n"], last["meets_all"]) == (80.0, False)
    assert found.points[-1].missed == pytest.approx(80.0 / 45.0 - 1.0)


def test_a_window_narrower_than_the_grid_is_found(on_curve: Any) -> None:
    """Something is missed below 1.1e5 N/m, and the same something above 1.25e5 N/m, less the nearer."""
    found, _ = on_curve(lambda stiffness: 50.0 if 1.1e5 <= stiffness <= 1.25e5 else -abs(math.log(stiffness / 1.17e5)))
    assert 1.1e5 <= found.chosen.stiffness_n_per_m <= 1.25e5
    assert found.chosen.cost == 50.0


def test_where_nothing_is_stable_the_grid_is_all_that_is_tried(on_curve: Any) -> None:
    found, asked = on_curve(lambda _: -math.inf)
    assert len(asked) == 9
    assert {point.found for point in found.points} == {None}


def test_every_search_begins_at_the_nearest_result(on_curve: Any) -> None:
    found, asked = on_curve(valley(7e4))
    by_stiffness = {point.stiffness_n_per_m: point.found for point in found.points}
    assert by_stiffness[asked[0]].begun_at is None
    for index, stiffness in enumerate(asked[1:], 1):
        nearest = min(asked[:index], key=lambda each: abs(math.log(each / stiffness)))
        assert by_stiffness[stiffness].begun_at == nearest


def test_what_a_short_search_misses_a_whole_one_may_find(monkeypatch: pytest.MonkeyPatch) -> None:
    """Begun at a neighbour a search looks around less, so it does not decide that there is nothing."""

    def solve(_: DesignProblem, *, neighbour: Any, **__: int) -> Any:
        if neighbour is not None:
            raise InfeasibleError("nothing near", missed=0.1)
        return SimpleNamespace(evaluation=evaluation_of(40.0))

    monkeypatch.setattr(module, "solve_design", solve)
    found = choose_compliance(design_problem(), ComplianceSpec(bounds=BOUNDS))
    assert {point.missed for point in found.points} == {0.0}


def test_a_scenario_keeps_its_share_of_the_range() -> None:
    old, new = design_problem(stiffness=(8e4, 1.2e5)), design_problem(stiffness=(1.6e5, 2.4e5))
    for before, after in ((8e4, 1.6e5), (1e5, 2e5), (1.2e5, 2.4e5)):
        scenario = Scenario(environment_stiffness_n_per_m=before, payload_mass_kg=16.0, drag_n_s_per_m=300.0)
        moved = moved_scenario(scenario, old, new)
        assert moved == replace(scenario, environment_stiffness_n_per_m=moved.environment_stiffness_n_per_m)
        assert moved.environment_stiffness_n_per_m == pytest.approx(after, rel=1e-12)
    exact = design_problem(stiffness=(1e5, 1e5))
    same = moved_scenario(Scenario(environment_stiffness_n_per_m=1e5, payload_mass_kg=16.0), exact, exact)
    assert same.environment_stiffness_n_per_m == 1e5


# --- on a cell ----------------------------------------------------------------------------------------------------

ASKED = ComplianceSpec(bounds=(8e4, 9.2e4), tolerance=0.1)
SPEC = ProblemSpec(bounds=ROOM, requirements=FAST_REQUIREMENTS, compliance=ASKED).with_options(
    payload_mass=(16.0, 16.0)
)


def plant() -> IdentifiedFile:
    return IdentifiedFile(result=identified_plant(), provenance={}, path=Path("identified.yaml"), sha256="0" * 64)


@cache
def tuned() -> Optimized:
    return optimize(plant(), SPEC, seed=1)


def ordinary(stiffness: float) -> float:
    """The least worst peak of the ordinary problem, searched from nowhere."""
    given = replace(SPEC, compliance=None, environment_stiffness=certified_range(stiffness, ASKED.tolerance))
    return solve_design(build_problems(identified_plant(), given)["x"], seed=1).evaluation.cost


def test_the_table_is_what_ordinary_searches_find() -> None:
    for point in (tuned().compliance["x"].points[1], tuned().compliance["x"].points[-1]):
        assert point.cost == pytest.approx(ordinary(point.stiffness_n_per_m), rel=SAME)


@pytest.mark.parametrize("stiffness", [8.17e4, 9.05e4])
def test_no_other_stiffness_beats_the_chosen_one(stiffness: float) -> None:
    assert tuned().compliance["x"].chosen.cost <= (1.0 + SAME) * ordinary(stiffness)


def test_what_is_certified_is_an_ordinary_problem_over_the_tolerance(tmp_path: Path) -> None:
    found, chosen = tuned(), tuned().compliance["x"].chosen
    given = replace(SPEC, compliance=None, environment_stiffness=(7.2e4, 8.8e4))
    problem, solved = build_problems(identified_plant(), given)["x"], found.searches["x"].problem
    assert solved.plants.environment_stiffness_n_per_m == problem.plants.environment_stiffness_n_per_m
    assert solved.requirements == problem.requirements
    assert found.controller.certificate.domain["x"].environment_stiffness_n_per_m == (7.2e4, 8.8e4)
    assert chosen.cost == found.searches["x"].evaluation.cost
    write_controller(tmp_path / "controller.yaml", found.controller)
    read = read_controller(tmp_path / "controller.yaml").controller
    reported = read.provenance["compliance"]["x"]
    assert reported == compliance_tree(found.compliance["x"])
    assert (reported["chosen_n_per_m"], reported["active_bound"]) == (8e4, "lower")
    assert validate_controller(read).passed


@pytest.mark.parametrize(("stiffness", "fits"), [(7.3e4, True), (8.7e4, True), (9e4, False), (1.1e5, False)])
def test_the_built_compliance_is_held_against_the_tolerance(stiffness: float, fits: bool) -> None:
    axis = identified_axis()
    surface = replace(axis.environments[0], stiffness_n_per_m=known(stiffness, 500.0))
    checks = check_domain(tuned().controller, with_axis(replace(axis, environments=(surface,))))
    assert all(check.passed for check in checks) is fits


def test_no_compliance_at_all_shows_the_nearest_and_what_would_have_to_be_eased(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The relaxations are those of the ordinary problem on the compliance that misses least."""

    def explained(_: str, problem: DesignProblem, **_options: Any) -> Explanation:
        low, high = problem.plants.environment_stiffness_n_per_m
        eased = Relaxation(name="max_peak_force_n", asked=30.5, possible=0.5e-3 * (low + high))
        return Explanation(relaxations=(eased,))

    monkeypatch.setattr(optimize_module, "explain", explained)
    asked = replace(FAST_REQUIREMENTS, max_peak_force_n=30.5)
    spec = replace(SPEC, bounds=BARE_SPEC.bounds, requirements=asked, compliance=ComplianceSpec(bounds=(6e4, 6.3e4)))
    with pytest.raises(InfeasibleError, match="Axis x: none of 2 compliances from 60 to 63 N/mm") as caught:
        optimize(plant(), spec, seed=1)
    assert "nearest to one is that of 60 N/mm. No controller within the bounds" in str(caught.value)
    assert caught.value.relaxations == (("max_peak_force_n", 30.5, 60.0),)


# --- what is refused ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("axes", "stiffness", "message"),
    [
        (("x",), (1e4, 2e4), "both say the surface"),
        (None, None, r"one axis at a time only; .*\(to be tuned: x, ry\)"),
        (("ry",), None, "is in N/m, and ry turns"),
    ],
)
def test_a_compliance_that_cannot_be_is_refused(
    axes: tuple[str, ...] | None, stiffness: tuple[float, float] | None, message: str
) -> None:
    with pytest.raises(UsageError, match=message):
        build_compliance_problems(two_axes(), replace(SPEC, axes=axes).with_options(environment_stiffness=stiffness))


def test_what_takes_a_range_takes_no_choice() -> None:
    with pytest.raises(UsageError, match="is chosen by optimize for one controller"):
        build_problems(identified_plant(), SPEC)
    with pytest.raises(UsageError, match="a schedule has many controllers"):
        tune_schedule(plant(), SPEC, build_classes([(16.0, 16.0)], []))
