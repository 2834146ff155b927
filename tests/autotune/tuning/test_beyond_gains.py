"""Problems that four gains in their bounds do not meet: freer structures that do, and what is said of them."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from autotune.errors import InfeasibleError
from autotune.formats.problem import ProblemSpec, Structure
from autotune.tuning.scenario_exchange import WholeSet
from autotune.tuning.search import SearchResult, solve_design
from autotune.tuning.structure import StructureSearch, choose_structure, equal_noise, nearest_gains
from autotune.tuning.structure_choice import StructureChoice
from benchmarks.tuning_problems import draw_problem
from identification.result import Identified
from problems.design.hand import HandImpedance
from problems.design.problem import BIQUAD_VARIABLES, DEFAULT_BOUNDS, DesignProblem, NoiseLimit
from problems.design.requirements import HeldByHand
from problems.model.response import loop_response
from problems.model.sampled import build_sampled_plant
from tests.autotune.tuning.cases import identified_plant, known

HAND = HandImpedance()
ASKED = NoiseLimit(max_speed_rms_m_s=2e-2, force_noise_rms_n=1.0)


def refused() -> DesignProblem:
    """A drawn problem of which four gains miss a few per cent."""
    return draw_problem(9)


def limited() -> DesignProblem:
    """Another with a limit of the noise that leaves room."""
    return replace(draw_problem(7), requirements=replace(draw_problem(7).requirements, command_noise=ASKED))


@cache
def nearest() -> SearchResult:
    found = nearest_gains(refused(), 0)
    assert found is not None
    return found


@cache
def freer() -> tuple[SearchResult, StructureChoice]:
    return choose_structure(nearest(), "biquad", HAND, seed=0)


def test_the_nearest_gains_are_stable_in_their_bounds_and_miss_something_that_no_search_meets() -> None:
    with pytest.raises(InfeasibleError) as refusal:
        solve_design(refused())
    found = nearest()
    assert found.evaluation.is_stable
    # Of several requirements, no more than the best design of the search misses of one.
    assert 0.0 < found.evaluation.violation < 0.1
    assert refusal.value.missed > 0.0
    for name, value in zip(refused().variables, found.design.tolist(), strict=True):
        low, high = DEFAULT_BOUNDS[name]
        assert low <= value <= high


def test_a_biquad_meets_over_the_whole_set_what_four_gains_do_not_at_no_more_noise() -> None:
    found, choice = freer()
    exact, _ = WholeSet(found.problem).evaluate_design(found.design)
    assert exact.is_feasible
    assert choice.taken == "biquad"
    assert choice.costs["gains"] is None
    assert choice.noise_m_s_per_n == equal_noise(nearest())
    assert equal_noise(found) <= choice.noise_m_s_per_n * (1.0 + 1e-5)
    asked, before = found.problem.requirements, refused().requirements
    # All that was asked is asked, and a hand and a start from rest beside.
    assert {name: asked.asked()[name] for name in before.asked()} == dict(before.asked())
    held = asked.asked()["held_by_hand"]
    assert isinstance(held, HeldByHand)
    assert before.modulus_margin is not None
    assert held.min_modulus == pytest.approx(0.9 * before.modulus_margin)
    assert asked.asked()["admittance_peak"] == 1.05


def test_its_modulus_is_that_of_the_frequency_response_of_drawn_plants() -> None:
    """By another road: |1 + L| over a fine grid, of plants that the search did not pick."""
    found, _ = freer()
    law, rng = found.problem.controller(found.design), np.random.default_rng(3)
    (low, high), (light, heavy) = (
        refused().plants.ranges[n] for n in ("environment_stiffness_n_per_m", "payload_mass_kg")
    )
    grid = np.geomspace(0.1, 0.999 * np.pi / refused().sample_time_s, 4000)
    scenario, asked = refused().scenarios(2, 2)[0], refused().requirements.modulus_margin
    assert asked is not None
    for _ in range(12):
        at = replace(
            scenario,
            environment_stiffness_n_per_m=float(rng.uniform(low, high)),
            payload_mass_kg=float(rng.uniform(light, heavy)),
        )
        plant = build_sampled_plant(refused().plant(at), refused().sample_time_s)
        least = float(np.min(np.abs(1.0 + loop_response(plant, law, grid).at_command)))
        assert least >= asked * (1.0 - 1e-4)


def test_what_is_said_of_it_names_no_peak_of_four_gains() -> None:
    found, choice = freer()
    assert choice.message("x", found.problem).startswith(
        "Axis x: no design with four gains in their bounds, no design with the noise of the command of those that come "
        "nearest (0.883 mm/s per N) in the place of these bounds, peak sensor force 49.92 N with a biquad too. Taken: "
        "the biquad, the only design; margins, admittance and a hand (|1 + L| ≥ 0.530888 "
    )


def test_at_the_noise_that_is_asked_four_gains_without_bounds_are_enough() -> None:
    with pytest.raises(InfeasibleError):
        solve_design(limited())
    start = nearest_gains(limited(), 0)
    assert start is not None
    found, choice = choose_structure(start, "noise", HAND, seed=0)
    assert (choice.taken, choice.is_asked, choice.noise_m_s_per_n) == ("noise", True, 2e-2)
    assert found.evaluation.is_feasible
    assert equal_noise(found) <= 2e-2 * (1.0 + 1e-5)
    law = found.problem.controller(found.design)
    low, high = DEFAULT_BOUNDS["mass"][0], DEFAULT_BOUNDS["lead_s"][1]
    assert law.mass_kg < low or law.lead_s > high
    assert law.mass_kg >= limited().sample_time_s * law.damping_n_s_per_m


def search(structure: Structure | None, plant: Identified | None = None) -> StructureSearch:
    return StructureSearch(ProblemSpec(structure=structure), plant or identified_plant(), 0)


def test_a_structure_that_is_not_asked_is_suggested_with_its_peak_and_one_that_is_is_taken() -> None:
    usual = search(None)
    assert usual.beyond_gains("x", refused()) is None
    assert not usual.choices
    assert usual.suggestion("x") == {"structure": "biquad"}
    assert usual.suggestion_message("x").startswith(
        "All of it is met with a second-order section in the path of the force, peak sensor force 4"
    )
    assert usual.suggestion_message("x").endswith(
        " N, which --structure biquad asks for, or this line in problem.yaml: structure: biquad"
    )
    asked = search("biquad")
    found = asked.beyond_gains("x", refused())
    assert found is not None
    assert BIQUAD_VARIABLES[0] in found.problem.variables
    assert asked.choices["x"].taken == "biquad"
    assert not asked.suggested
    # What was found is not searched again.
    assert asked.searched({"x": found}) == {"x": found}


def test_nothing_is_looked_for_beyond_gains_that_are_asked_or_that_nothing_weighs() -> None:
    gains = search("gains")
    assert gains.beyond_gains("x", refused()) is None
    plant = identified_plant()
    silent = replace(plant.sensor.force_noise_rms_n, value=None)
    sensor = replace(plant.sensor, position_noise_rms_m=known(2e-6), force_noise_rms_n=silent)
    unweighed = search("biquad", replace(plant, sensor=sensor))
    assert unweighed.beyond_gains("x", refused()) is None
    assert not gains.suggested
    assert not unweighed.suggested


@pytest.mark.parametrize(
    ("structure", "force", "position", "may"),
    [
        ("gains", 0.1, 2e-6, True),
        ("gains", None, None, True),
        ("gains", None, 2e-6, False),
        ("gains", 0.0, None, False),
        ("gains", 0.0, 2e-6, False),
        ("noise", 0.1, 2e-6, False),
    ],
)
def test_a_limit_of_the_noise_is_proposed_where_it_was_not_asked_and_there_is_noise_to_weigh(
    structure: Structure, force: float | None, position: float | None, may: bool
) -> None:
    plant = identified_plant()
    of_force = replace(plant.sensor.force_noise_rms_n, value=force)
    of_pose = None if position is None else known(position)
    sensor = replace(plant.sensor, position_noise_rms_m=of_pose, force_noise_rms_n=of_force)
    found = search(structure, replace(plant, sensor=sensor)).noise_limitable({"x": refused()})
    assert found == ({"x"} if may else set())


def test_where_no_structure_meets_it_that_is_an_infeasible_problem() -> None:
    start = nearest_gains(draw_problem(12), 0)
    assert start is not None
    with pytest.raises(InfeasibleError, match=r"^No design was found with more freedom, up to noise, either\.$"):
        choose_structure(start, "noise", HAND, seed=0)
