"""The search: deterministic, never infeasible, and not beaten by simpler searches on the same evaluator."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import OptimizeResult, minimize

from autotune.errors import InfeasibleError
from autotune.tuning import scenario_exchange as joining
from autotune.tuning import search as search_module
from autotune.tuning.bounds import Box, presentable
from autotune.tuning.optimality_report import find_reference
from autotune.tuning.search import Search, solve_design
from benchmarks.tuning_problems import draw_problem, paper_cell
from problems.arrays import FloatArray
from problems.contact.transient import Approach
from problems.design.evaluation import PreparedScenarios, build_scenarios
from problems.design.problem import VARIABLES, AdmittanceTarget, DesignProblem, Requirements
from problems.design.uncertainty import PlantSet, Scenario
from problems.model.robot import RobotModel
from tests.autotune.tuning.cases import MASS, ROOM, STIFFNESS, design_problem, solved
from tests.problems.axes import LAW

# Two free variables and an admittance with room: found even by a small population.
NARROW = {**ROOM, "mass": (6.0, 6.0), "feedback_damping_s": (0.005, 0.005)}
EASY = Requirements(free_space_admittance=AdmittanceTarget(min_m_s_per_n=5.5e-4))
# Requirements are held on a grid of plants; between its points a margin dips by less than this.
BETWEEN_GRID_POINTS = 1e-3


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    """A smaller population, where the point is not how good the result is."""
    monkeypatch.setattr(search_module, "_POPULATION", 5)
    monkeypatch.setattr(search_module, "_GENERATIONS", 15)


@pytest.fixture(scope="module")
def evaluator() -> PreparedScenarios:
    problem = design_problem()
    return build_scenarios(problem, problem.scenarios(3, 2))


# --- the result ---------------------------------------------------------------------------------------------------


def test_the_design_is_feasible_on_a_random_grid_twenty_times_as_dense() -> None:
    found = solved()
    rng = np.random.default_rng(11)
    count = 20 * 33
    scenarios = [
        Scenario(environment_stiffness_n_per_m=float(k), payload_mass_kg=float(m))
        for k, m in zip(
            np.exp(rng.uniform(np.log(STIFFNESS[0]), np.log(STIFFNESS[1]), count)),
            rng.uniform(*MASS, count),
            strict=True,
        )
    ]
    problem = found.problem
    radius, largest = 0.0, 0.0
    worst: dict[str, float] = {}
    for batch in np.array_split(np.arange(count), 20):
        prepared = build_scenarios(problem, [scenarios[i] for i in batch])
        seen = prepared.evaluate_exactly(problem.controller(found.design)).evaluation
        radius, largest = max(radius, seen.spectral_radius), max(largest, seen.cost)
        worst = {name: max(value, worst.get(name, 0.0)) for name, value in seen.requirements.items()}
    assert radius < 1.0
    assert set(worst) == set(found.evaluation.requirements)
    assert {name: value for name, value in worst.items() if value > 1.0 + BETWEEN_GRID_POINTS} == {}
    # The promised peak is the worst of all: nothing in between is higher by more than the search's own tolerance.
    assert largest <= found.evaluation.cost * (1.0 + 2.0 * joining._WORSE)


def test_the_result_lies_inside_the_bounds_and_is_what_people_type() -> None:
    found = solved()
    for value, name in zip(found.design, VARIABLES, strict=True):
        low, high = found.problem.bounds[name]
        assert low <= value <= high
        assert float(f"{value:.6g}") == value
    assert found.evaluation.is_feasible
    assert found.scenario_count == 33 * 3
    assert found.evaluations > 1000
    assert found.rounds >= 1
    assert found.evaluation.cost == pytest.approx(max(p.peak_contact_force_n for p in found.evaluation.peaks))


def cost(evaluator: PreparedScenarios, design: FloatArray) -> float:
    seen = evaluator.evaluate(design)
    return seen.cost if seen.is_feasible else np.inf


def test_two_thousand_random_designs_do_not_beat_it(evaluator: PreparedScenarios) -> None:
    """Half of them anywhere in the bounds, half around the result, where they have the best chance."""
    found, rng = solved(), np.random.default_rng(3)
    bounds = np.array([evaluator.problem.bounds[name] for name in VARIABLES])
    anywhere = rng.uniform(bounds[:, 0], bounds[:, 1], (1000, 4))
    around = np.clip(found.design * (1.0 + 0.03 * rng.normal(size=(1000, 4))), bounds[:, 0], bounds[:, 1])
    costs = np.array([cost(evaluator, design) for design in np.concatenate([anywhere, around])])
    assert np.count_nonzero(np.isfinite(costs)) > 50  # enough of them are rivals
    assert np.min(costs) > found.evaluation.cost * (1.0 - 0.005)


def test_a_plain_simplex_search_with_a_penalty_does_not_beat_it(evaluator: PreparedScenarios) -> None:
    """Nelder and Mead from several starts on the peak plus what is missed."""
    found = solved()
    bounds = [evaluator.problem.bounds[name] for name in VARIABLES]

    def penalised(design: FloatArray) -> float:
        seen = evaluator.evaluate(design, peaks_if_missed=True)
        if not seen.is_stable:
            return 1e6 * seen.spectral_radius
        return seen.cost * (1.0 + 20.0 * sum(max(0.0, v - 1.0) for v in seen.requirements.values()))

    rng = np.random.default_rng(8)
    low, high = np.array(bounds).T
    starts = sorted((rng.uniform(low, high) for _ in range(100)), key=penalised)[:4]
    best = min(
        minimize(penalised, start, method="Nelder-Mead", bounds=bounds, options={"maxfev": 500, "xatol": 1e-6}).fun
        for start in starts
    )
    assert found.evaluation.cost <= best * 1.01


@pytest.mark.usefixtures("small")
def test_the_same_seed_gives_the_same_bits_and_another_seed_the_same_peak() -> None:
    problem = design_problem(bounds=NARROW, requirements=EASY)
    first, again, other = (solve_design(problem, seed=seed) for seed in (4, 4, 5))
    assert first.design.tobytes() == again.design.tobytes()
    assert (first.evaluations, first.rounds) == (again.evaluations, again.rounds)
    assert first.evaluation == again.evaluation
    # Two free variables have one optimum; both seeds polish it to six digits.
    assert other.evaluation.cost == pytest.approx(first.evaluation.cost, rel=1e-3)


@pytest.mark.usefixtures("small")
def test_progress_adds_up_to_at_most_the_whole() -> None:
    shares: list[float] = []
    problem = design_problem(bounds=NARROW, requirements=EASY)
    solve_design(problem, progress=shares.append)
    assert all(share >= 0.0 for share in shares)
    assert 0.0 < sum(shares) <= 1.0 + 1e-9


@pytest.mark.usefixtures("small")
def test_bounds_that_leave_one_point_give_that_point() -> None:
    point: Mapping[str, tuple[float, float]] = {
        "mass": (6.0, 6.0), "damping": (1350.0, 1350.0), "lead_s": (0.02, 0.02), "feedback_damping_s": (0.0, 0.0)
    }  # fmt: skip
    easy = Requirements(modulus_margin=0.3, free_space_admittance=None)
    found = solve_design(design_problem(bounds=point, requirements=easy))
    np.testing.assert_array_equal(found.design, [6.0, 1350.0, 0.02, 0.0])


@pytest.mark.usefixtures("small")
def test_a_payload_and_a_surface_without_spread_are_one_scenario() -> None:
    problem = design_problem(bounds=NARROW, requirements=EASY, mass=(16.0, 16.0), stiffness=(1e5, 1e5))
    assert solve_design(problem).scenario_count == 1


# --- when there is none -------------------------------------------------------------------------------------------


@pytest.mark.usefixtures("small")
@pytest.mark.parametrize(
    ("requirements", "named"),
    [
        (Requirements(modulus_margin=0.99), "modulus_margin"),
        (Requirements(free_space_admittance=AdmittanceTarget(min_m_s_per_n=1e-2)), "free_space_admittance"),
        (Requirements(gain_margin_db=60.0), "gain_margin_db"),
        (Requirements(delay_margin_s=0.5), "delay_margin_s"),
        (Requirements(decay_rate_per_s=500.0), "decay_rate_per_s"),
        (Requirements(max_peak_force_n=31.0), "max_peak_force_n"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_what_cannot_be_met_is_named_with_its_number(requirements: Requirements, named: str) -> None:
    with pytest.raises(InfeasibleError, match=rf"{named} \(only [0-9.]+ % of what is asked\)"):
        solve_design(design_problem(requirements=requirements))


@pytest.mark.usefixtures("small")
def test_no_stable_design_within_the_bounds_is_said_so() -> None:
    """The printed example against a stiff wall (docs/method.md, erratum 4), with no room to leave it."""
    printed: Mapping[str, tuple[float, float]] = {
        "mass": (10.0, 10.0), "damping": (300.0, 400.0), "lead_s": (0.0, 0.0), "feedback_damping_s": (0.0, 0.0)
    }  # fmt: skip
    with pytest.raises(InfeasibleError, match=r"stable in every scenario \(closest: largest \|z\| = 1\.\d+\)"):
        solve_design(design_problem(bounds=printed, stiffness=(5e5, 5e5)))


# --- the parts ----------------------------------------------------------------------------------------------------


@LAW
@given(share=st.lists(st.floats(0.0, 1.0), min_size=4, max_size=4))
def test_the_unit_cube_maps_to_the_bounds_and_back(share: list[float]) -> None:
    box = Box(design_problem(bounds={}))
    unit = np.array(share)
    design = box.design(unit)
    assert np.all(design >= box.low * (1.0 - 1e-12))
    assert np.all(design <= box.high * (1.0 + 1e-12))
    np.testing.assert_allclose(box.unit(design), unit, rtol=0.0, atol=1e-9)


def test_bounds_that_coincide_map_to_themselves() -> None:
    point = {"mass": (6.0, 6.0), "damping": (1350.0, 1350.0), "lead_s": (0.02, 0.02), "feedback_damping_s": (0.0, 0.0)}
    box = Box(design_problem(bounds=point))
    np.testing.assert_allclose(box.design(np.full(4, 0.7)), [6.0, 1350.0, 0.02, 0.0], rtol=1e-15)
    np.testing.assert_array_equal(box.unit(np.array([6.0, 1350.0, 0.02, 0.0])), np.zeros(4))


def test_a_design_is_rounded_to_six_digits_but_not_out_of_its_bounds() -> None:
    third = 1000.0 / 3.0
    problem = design_problem(bounds={"damping": (third, 1000.0)})
    rounded = presentable(problem, np.array([12.3456789, third, 0.01234567891, 5e-5]))
    # B_fb below 1e-4 s is none at all (docs/method.md, erratum 2).
    np.testing.assert_array_equal(rounded, [12.3457, third, 0.0123457, 0.0])


@pytest.mark.parametrize(
    ("approach", "limit"),
    [
        (Approach(force_n=1000.0), None),  # the loop is linear: a larger force makes nothing infeasible
        (Approach(force_n=30.0), 60.0),  # the best of this problem peaks well below
    ],
)
def test_a_feasible_problem_is_not_called_infeasible(approach: Approach, limit: float | None) -> None:
    asked = Requirements(max_peak_force_n=limit)
    found = solve_design(replace(design_problem(requirements=asked), approach=approach))
    assert found.evaluation.is_feasible
    assert found.evaluation.requirements.get("max_peak_force_n", 0.0) <= 1.0


def test_a_population_that_ends_beside_the_feasible_set_is_led_into_it() -> None:
    # The paper's cell over all its surfaces and payloads: with this seed all generations pass beside the set.
    problem = paper_cell()
    scenarios, search = problem.scenarios(3, 2), Search(problem, seed=2)
    design = search.box.design(search.explore(scenarios, lambda _share: None))
    found = build_scenarios(problem, scenarios).evaluate(design, peaks_if_missed=True)
    assert found.violation <= 1e-3
    assert found.is_stable


def test_a_valley_that_holds_over_the_rest_is_looked_for_before_anything_is_refused() -> None:
    """What is best over the corners of K_e and M_p has no B_fb, and no way to the designs that hold over B_s too."""
    problem = DesignProblem(
        plants=PlantSet.of(
            RobotModel.from_bandwidth(bandwidth_rad_per_s=28.3, delay_s=2.4e-3),
            coupling_stiffness_n_per_m=1.8e5,
            coupling_damping_n_s_per_m=150.0,
            drag_n_s_per_m=250.0,
            environment_stiffness_n_per_m=(3.7e4, 1.24e5),
            payload_mass_kg=(9.7, 12.8),
            further={
                "coupling_stiffness_n_per_m": (1.48e5, 2.1e5),
                "coupling_damping_n_s_per_m": (20.0, 300.0),
                "drag_n_s_per_m": (145.0, 350.0),
            },
        ),
        sample_time_s=1e-3,
        requirements=Requirements(
            free_space_admittance=AdmittanceTarget(min_m_s_per_n=7e-4, band_hz=(0.1, 1.5)),
        ),
    )
    found = solve_design(problem)
    assert found.evaluation.is_feasible
    assert found.design[3] > 0.01


def test_the_valley_without_lead_and_feedback_is_not_left_for_good() -> None:
    """A light drag and small margins: of six seeds the populations of four end in a valley a third higher."""
    problem = DesignProblem(
        plants=PlantSet.of(
            RobotModel(numerator=np.array([2991.5]), denominator=np.array([1.0, 109.07, 2991.5]), delay_s=4.66e-3),
            environment_stiffness_n_per_m=(16370.0, 80030.0),
            payload_mass_kg=(14.217, 19.632),
            coupling_stiffness_n_per_m=2e5,
            coupling_damping_n_s_per_m=79.3,
            drag_n_s_per_m=12.1,
        ),
        sample_time_s=2e-3,
        approach=Approach(force_n=30.0),
        bounds={
            "mass": (5.0, 100.0),
            "damping": (100.0, 1e4),
            "lead_s": (0.0, 0.03),
            "feedback_damping_s": (0.0, 0.05),
        },
        requirements=Requirements(
            modulus_margin=0.134,
            gain_margin_db=1.61,
            phase_margin_deg=8.08,
            delay_margin_s=2.69e-4,
            free_space_admittance=AdmittanceTarget(min_m_s_per_n=1.88e-4, band_hz=(0.1, 1.8)),
        ),
    )
    peaks = [solve_design(problem, seed=seed).evaluation.cost for seed in range(6)]
    assert max(peaks) < 1.001 * min(peaks)


def test_what_a_scenario_asks_when_it_joins_is_not_asked_of_all_others_too() -> None:
    """Where it was, this problem's design kept a delay margin of 0.14 % in hand, and lay 0.05 % above the best."""
    found = solve_design(draw_problem(17))
    assert found.rounds > 1
    assert find_reference(found).gap(found.evaluation.cost) < 1e-4
    assert found.evaluation.requirements["delay_margin_s"] > 1.0 - 2e-4


def test_more_is_asked_where_a_scenario_that_is_known_misses_and_not_where_another_one_does() -> None:
    problem = draw_problem(17)
    found = solve_design(problem)
    longer = found.design * np.array([1.0, 1.0, 1.0005, 1.0])
    exact = joining.WholeSet(problem).evaluate(problem.controller(longer))
    assert exact.evaluation.requirements["delay_margin_s"] > 1.0
    # The plant that misses it joined in the second round.
    assert "delay_margin_s" in joining.missed_elsewhere(exact.evaluation, exact.margins, problem.scenarios(3, 2))
    assert joining.missed_elsewhere(exact.evaluation, exact.margins, found.active.scenarios) == ()


def test_a_population_that_finds_nothing_leaves_the_designs_that_were_given(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where what is asked has hardly any room, as a limit that every law just meets, only what is known may hold."""
    known = solved()
    cost = known.evaluation.cost

    def lost(_search: Search, costs: object, **_: object) -> OptimizeResult:
        del costs
        return OptimizeResult(x=np.full(len(known.problem.variables), 0.5), fun=1.5e12)

    monkeypatch.setattr(Search, "_evolve", lost)
    again = solve_design(known.problem, others=[known.design])
    assert again.evaluation.is_feasible
    assert again.evaluation.cost <= cost * (1.0 + 1e-4)
