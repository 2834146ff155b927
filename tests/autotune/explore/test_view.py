"""What the page shows is what the ground floor says, one design and one plant at a time."""

from dataclasses import replace

import numpy as np
import pytest

from autotune.explore.design_map import build_window, compute_map, map_pairs
from autotune.explore.sliders import nominal_values, scenario_at
from autotune.explore.view import PreparedView, compute_view, prepare_view
from problems.contact.transient import build_sampled_contact, simulate_contact
from problems.design.evaluation import build_scenarios
from problems.errors import ParameterError
from problems.model.plant import FREE_SPACE
from problems.model.response import free_space_admittance, loop_response
from problems.model.sampled import build_sampled_plant
from problems.stability.margins import find_margins
from tests.autotune.explore.start import DESIGN, roomy_problem, small_exploration
from tests.autotune.tuning.cases import design_problem

PAIR = ("damping", "lead_s")


def prepared(**values: float) -> PreparedView:
    start = small_exploration().axes["x"]
    scenario = scenario_at(start.problem, {**nominal_values(start.problem), **values})
    return prepare_view(start.problem, scenario, start.scenarios)


def test_a_view_is_what_single_questions_answer() -> None:
    problem = roomy_problem()
    ready = prepared(environment_stiffness_n_per_m=3e5, payload_mass_kg=12.0, coupling_stiffness_n_per_m=2e5)
    view, law = compute_view(ready, DESIGN), problem.controller(DESIGN)
    plant = ready.scenario.plant(problem.plants.nominal)
    assert plant.coupling.stiffness_n_per_m == 2e5
    contact = build_sampled_plant(plant, problem.sample_time_s)
    free = build_sampled_plant(plant.in_contact_with(FREE_SPACE), problem.sample_time_s)
    run = simulate_contact(build_sampled_contact(contact), law, problem.approach)
    assert view.transient is not None
    assert view.margins is not None
    np.testing.assert_array_equal(view.transient.contact_force_n, run.contact_force_n)
    margins = find_margins(contact, law), find_margins(free, law)
    assert view.margins.modulus == min(each.modulus for each in margins)
    assert view.margins.delay_s == min(each.delay_s for each in margins)
    assert view.radius == max(each.spectral_radius for each in margins)
    loop = loop_response(contact, law, 2.0 * np.pi * view.frequency_hz)
    # Next to the Nyquist frequency the loop is nothing but rounding.
    np.testing.assert_allclose(view.at_force, loop.at_force, rtol=1e-12, atol=1e-15)
    np.testing.assert_allclose(view.at_command, loop.at_command, rtol=1e-12, atol=1e-15)
    gain = np.abs(free_space_admittance(free, law, 2.0 * np.pi * view.admittance_hz))
    np.testing.assert_allclose(view.admittance_m_s_per_n, gain, rtol=1e-12)


def test_requirements_are_judged_on_the_plants_around_and_the_one_that_is_looked_at() -> None:
    ready = prepared()
    start = small_exploration().axes["x"]
    assert set(ready.scenarios) == {*start.scenarios, ready.scenario}
    said = build_scenarios(start.problem, ready.scenarios).evaluate(DESIGN, peaks_if_missed=True)
    view = compute_view(ready, DESIGN)
    assert dict(view.ratios) == dict(said.requirements)
    assert view.evaluation.cost == said.cost


def test_a_plant_that_is_not_nominal_moves_the_plants_around() -> None:
    ready = prepared(drag_n_s_per_m=100.0)
    assert {each.drag_n_s_per_m for each in ready.scenarios} == {100.0}
    assert len(ready.scenarios) == 5


def test_an_unstable_loop_has_no_peak_no_margin_and_no_requirement() -> None:
    view = compute_view(prepared(), np.array([6.0, 300.0, 0.0, 0.0]))
    assert view.radius > 1.0
    assert view.transient is None
    assert view.margins is None
    assert not view.ratios
    assert np.all(np.isfinite(view.at_force))


def test_a_plant_that_cannot_be_sampled_is_refused() -> None:
    with pytest.raises(ParameterError, match="swings"):
        prepared(environment_stiffness_n_per_m=1e12)


def test_the_map_shows_of_each_design_what_an_evaluation_shows() -> None:
    ready = prepared()
    window = build_window(ready.problem, DESIGN, PAIR, columns=7, rows=5)
    found = compute_map(ready.screen, DESIGN, window)
    assert 0 < np.sum(found.is_feasible) < found.is_feasible.size
    for j, damping in enumerate(window.x_values()):
        for i, lead in enumerate(window.y_values()):
            said = ready.screen.prepared.evaluate(np.array([DESIGN[0], damping, lead, DESIGN[3]]))
            assert found.is_stable[i, j] == said.is_stable
            assert found.is_feasible[i, j] == said.is_feasible
            if said.is_feasible:
                assert found.peak_n[i, j] == pytest.approx(said.cost, rel=1e-9)


def test_a_window_lies_around_the_design_and_inside_the_bounds() -> None:
    problem = replace(design_problem(), bounds={})
    for design in (DESIGN, np.array([5.0, 100.0, 0.0, 0.0]), np.array([100.0, 10000.0, 0.03, 0.05])):
        for pair in map_pairs(problem):
            window = build_window(problem, design, pair, columns=3, rows=3)
            values = [float(design[problem.variables.index(name)]) for name in pair]
            assert window.holds(*values)
            for name, (low, high) in zip(pair, (window.x_ends, window.y_ends), strict=True):
                assert problem.bounds[name][0] <= low < high <= problem.bounds[name][1]
    assert window.finer(2).columns == 6


def test_a_map_is_over_what_can_be_turned() -> None:
    assert len(map_pairs(design_problem())) == 4
    held = replace(design_problem(), bounds={"mass": (6.0, 6.0), "feedback_damping_s": (0.0, 0.0)})
    assert map_pairs(held) == (PAIR,)
