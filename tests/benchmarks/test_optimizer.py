"""The optimizer's benchmark: its peers solve the problem that they say, its judge can reject, its pages can miss."""

import itertools
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.signal import impulse

from autotune.tuning.bounds import Box
from benchmarks import optimizer_page
from benchmarks.optimizer_authors import contact_loop, h2_squared, pade, routh_column
from benchmarks.optimizer_judge import Incumbent, Trace, judge, judge_trace, ranked_costs, screen_of
from benchmarks.optimizer_reference import check_densely, evolve_long, random_scenarios
from benchmarks.optimizer_scaling import Growth, draw_growth
from benchmarks.tuning_problems import draw_problem, paper_cell
from problems.contact.transient import transient_from
from problems.design.evaluation import build_scenarios

# What is asked of the cell leaves little room: the first meets it, by 0.3 %; the second does not; the third is unstable
# (docs/method.md, erratum 4).
GENTLE, LIGHT, UNSTABLE = (
    np.array([5.0, 1017.0, 0.02005, 0.0294]),
    np.array([5.0, 700.0, 0.02, 0.03]),
    np.array([10.0, 1000.0, 0.0, 0.0]),
)


def polynomial(roots: np.ndarray[Any, Any]) -> list[float]:
    return [float(c) for c in np.poly(roots).real[::-1]]


def test_pade_is_a_delay() -> None:
    above, below = pade(2.8e-3, 4)
    sigma = 1j * np.array([0.05, 0.5, 1.5])
    ratio = np.polyval(above[::-1], sigma) / np.polyval(below[::-1], sigma)
    # Of order 4 the first term that differs is (4!)²/(8!·9!)·(T s)⁹, here at most 2e-11.
    assert ratio == pytest.approx(np.exp(-sigma * 0.28), abs=1e-10)


@pytest.mark.parametrize("seed", range(8))
def test_routh_agrees_with_the_roots(seed: int) -> None:
    rng = np.random.default_rng(seed)
    pairs = rng.uniform(-1.0, 0.3, 3) + 1j * rng.uniform(0.2, 2.0, 3)
    roots = np.concatenate([pairs, pairs.conj(), -rng.uniform(0.1, 2.0, 2)])
    assert (min(routh_column(polynomial(roots))) > 0.0) == bool(np.max(roots.real) < 0.0)


def test_the_norm_is_the_energy_of_the_impulse_response() -> None:
    roots = np.array([-0.3 + 1j, -0.3 - 1j, -0.5, -1.2, -2.0])
    below, above = polynomial(roots), [0.7, -1.3, 0.4, 2.0, -0.6]
    time, y = impulse((above[::-1], below[::-1]), T=np.linspace(0.0, 80.0, 40_001))
    # The trapezoidal rule at this step errs by about 1e-6.
    assert h2_squared(below, above) == pytest.approx(np.trapezoid(y**2, time), rel=1e-5)


def test_the_authors_loop_has_the_peaks_of_the_sampled_one() -> None:
    """The continuous contact, delay by Padé, and the exact sampled one are two ways to the same force."""
    problem = paper_cell()
    prepared = build_scenarios(problem, problem.scenarios(2, 2))
    for scenario, pair in zip(prepared.scenarios, prepared.pairs, strict=True):
        closed, error = contact_loop(problem, scenario, [float(value) for value in GENTLE])
        below, above = np.array(closed, dtype=float)[::-1], np.array(error, dtype=float)[::-1]
        _, y = impulse((above / below[0], below / below[0]), T=np.linspace(0.0, 60.0, 6001))
        run = transient_from(pair, problem.controller(GENTLE), problem.approach)
        # The force at rest is the approach's; half a sample for the hold is good to a percent (docs/method.md).
        assert np.max(y) + 30.0 == pytest.approx(run.peak_contact_force_n, rel=0.01)


def test_the_costs_put_feasible_before_infeasible_before_unstable() -> None:
    problem = paper_cell()
    screen, box = screen_of(problem, (3, 2)), Box(paper_cell())
    units = np.array([box.unit(each) for each in (GENTLE, LIGHT, UNSTABLE)])
    costs = ranked_costs(screen, box)(units)
    assert judge(screen, GENTLE).is_feasible
    assert not judge(screen, LIGHT).is_feasible
    assert not judge(screen, UNSTABLE).is_stable
    assert costs[0] == judge(screen, GENTLE).objective_n
    assert costs[0] < costs[1] < costs[2]


def test_a_run_stands_by_feasible_designs_only() -> None:
    problem = paper_cell()
    screen = screen_of(problem, (3, 2))
    best = judge(screen, GENTLE).objective_n
    trace = Trace(problem=problem, budget_s=1.0)
    trace.incumbents = [
        Incumbent(seconds=1.0, design=LIGHT, objective_n=best),
        Incumbent(seconds=2.0, design=GENTLE, objective_n=0.9 * best),
    ]
    outcome = judge_trace(trace, screen, best)
    assert outcome.to_one_percent_s == 2.0
    assert outcome.final is not None
    assert outcome.final.objective_n == best
    assert judge_trace(trace, screen, 0.98 * best).to_one_percent_s == np.inf


def test_the_denser_grid_rejects() -> None:
    problem = paper_cell()
    checks = [check_densely(problem, each, seed=0, denser=1) for each in (GENTLE, LIGHT, UNSTABLE)]
    assert [check.holds for check in checks] == [True, False, False]
    assert [check.unstable > 0 for check in checks] == [False, False, True]
    assert checks[1].worst > 1.0


def test_random_scenarios_stay_in_their_ranges_and_hold_the_corners() -> None:
    problem = paper_cell()
    drawn = random_scenarios(problem, 200, 3)
    assert set(problem.scenarios(2, 2)) <= set(drawn)
    assert len(set(drawn)) == 204
    assert all(
        2e4 <= each.environment_stiffness_n_per_m <= 5e5 and 8.0 <= each.payload_mass_kg <= 24.0 for each in drawn
    )


def test_the_long_evolution_is_no_worse_than_a_sweep_of_its_own_scenarios() -> None:
    problem = paper_cell((1e5, 1e5), (16.0, 16.0))
    scenarios = problem.scenarios(2, 2)
    found = evolve_long(problem, scenarios, seeds=1, population=40, generations=40)
    screen, box = screen_of(problem, (2, 2)), Box(problem)
    shares = np.linspace(0.0, 1.0, 7)
    swept = ranked_costs(screen, box)(np.array(list(itertools.product([0.0, 0.1], shares, shares, shares))))
    assert found.objective_n <= np.min(swept)
    assert judge(screen, found.design).objective_n == pytest.approx(found.objective_n, rel=1e-12)


def test_drawn_problems_are_the_same_again_and_differ() -> None:
    drawn = [draw_problem(seed) for seed in range(30)]
    assert drawn[7] == draw_problem(7)
    samples = [each.plants.nominal.robot.delay_s / each.sample_time_s for each in drawn]
    whole = [abs(each - round(each)) < 1e-9 for each in samples]
    assert 1.0 <= min(samples) + 1e-9 < max(samples) <= 5.0 + 1e-9
    assert {*whole} == {True, False}
    assert {each.plants.nominal.robot.order for each in drawn} == {1, 2}
    assert {each.objective.name for each in drawn} == {"contact_force", "sensor_force"}
    assert {each.approach.force_n is None for each in drawn} == {True, False}


PROBLEM = {
    "part": "problem",
    "seed": 4,
    "refused": "",
    "gap": 0.001,
    "unstable": 0,
    "worst": 0.99,
    "worst_name": "modulus_margin",
    "cpu_s": 1.0,
}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({}, None),
        ({"gap": 0.0051}, "0.51 % above"),
        ({"gap": None}, None),
        ({"unstable": 2}, "2 unstable"),
        ({"worst": 1.001}, "modulus_margin 1.001"),
        ({"cpu_s": 2.1}, "2.1 s"),
        ({"refused": "No controller", "rival_holds": True, "reference_n": 40.0}, "refused"),
        ({"refused": "No controller", "rival_holds": False, "reference_n": 40.0}, None),
    ],
)
def test_a_missed_target_is_reported(change: dict[str, Any], message: str | None) -> None:
    missed = optimizer_page.misses([{**PROBLEM, **change}])
    assert (missed == []) if message is None else (len(missed) == 1 and message in missed[0])


def test_different_bytes_are_reported() -> None:
    assert optimizer_page.misses([{"part": "bits", "sha256": ["a", "a"]}]) == []
    assert len(optimizer_page.misses([{"part": "bits", "sha256": ["a", "b"]}])) == 1


def test_the_page_is_written_between_its_markers() -> None:
    page = f"before\n{optimizer_page.BEGIN}\nold\n{optimizer_page.END}\nafter\n"
    written = optimizer_page.put_between(page, "new")
    assert written == f"before\n{optimizer_page.BEGIN}\n\nnew\n{optimizer_page.END}\nafter\n"
    assert optimizer_page.put_between(written, "new") == written
    with pytest.raises(ValueError, match="no <!--"):
        optimizer_page.put_between("no markers", "new")


def test_the_figure_has_the_same_bytes_again(tmp_path: Path) -> None:
    growth = [
        Growth(
            scenarios=count,
            exchange_s=1.0 + 0.01 * count,
            exchange_n=70.0,
            active=6,
            rounds=1,
            at_once_s=0.5 * count,
            at_once_n=None,
            is_projected=count > 10,
        )
        for count in (1, 10, 100, 1000)
    ]
    draw_growth(growth, tmp_path / "a.svg")
    draw_growth(growth, tmp_path / "b.svg")
    assert (tmp_path / "a.svg").read_bytes() == (tmp_path / "b.svg").read_bytes()
