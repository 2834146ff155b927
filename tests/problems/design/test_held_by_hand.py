"""The requirement of a modulus while a hand holds the payload."""

import math
from dataclasses import replace

import pytest

from problems.design.evaluation import build_scenarios
from problems.design.hand import HandImpedance
from problems.design.requirements import HeldByHand
from problems.design.requirements.held_by_hand import HeldByHandRequirement
from problems.design.stable_design import StableDesign
from problems.errors import ParameterError
from problems.model.sampled import build_sampled_plant
from problems.stability.margins import find_margins
from tests.problems.axes import PERIOD_S, admittance, linear_controller, paper_problem

ASKED = HeldByHand(min_modulus=0.4)
KIND = HeldByHandRequirement()


def design_of(damping: float, hardest: float = 1e5, mass: float = 20.0, lead: float = 0.013) -> StableDesign:
    problem = paper_problem(environment_stiffness_n_per_m=(2e4, hardest), payload_mass_kg=(16.0, 16.0))
    return StableDesign(build_scenarios(problem, problem.plants.corners()), admittance(mass, damping, lead))


def test_it_is_the_least_modulus_over_the_hands_at_the_ends() -> None:
    design = design_of(3000.0)
    for row in range(KIND.count(design.prepared)):
        plant = design.prepared.plants[row].sampled.plant
        ends = [
            HandImpedance(mass_kg=m, damping_n_s_per_m=b, stiffness_n_per_m=k)
            for m in (0.0, 5.0)
            for b in (0.0, 50.0)
            for k in (0.0, 3000.0)
        ]
        moduli = [
            find_margins(build_sampled_plant(each.holding(plant), PERIOD_S), design.controller).modulus
            for each in ends[1:]
        ]
        assert KIND.achieved(ASKED, design, row) == pytest.approx(min(moduli), rel=1e-12)
        assert KIND.of_loop(ASKED, design.loop(row)) == pytest.approx(min(moduli), rel=1e-12)


def test_other_laws_are_read_on_the_grid_of_the_plant() -> None:
    """The same law as a matrix: its least |1 + L| lies between two points, and none of them can be lower."""
    design = design_of(3000.0)
    matrix = linear_controller(design.controller, PERIOD_S)
    for row in range(KIND.count(design.prepared)):
        loop = design.loop(row)
        exact = KIND.of_loop(ASKED, loop)
        assert exact * (1.0 - 1e-9) <= KIND.of_loop(ASKED, replace(loop, controller=matrix)) <= 1.0005 * exact


def test_a_loop_that_only_the_hand_makes_unstable_keeps_nothing() -> None:
    """The printed example without lead is stable on 20 N/mm and not on 500 (MODEL.md, errata 4): two springs add up."""
    design = design_of(1000.0, 2e4, mass=10.0, lead=0.0)
    assert max(design.radii) < 1.0
    heavy = HeldByHand(min_modulus=0.1, stiffness_n_per_m=4.8e5)
    assert min(KIND.achieved(heavy, design, row) for row in range(KIND.count(design.prepared))) == 0.0
    assert max(KIND.ratios(heavy, design)) == math.inf


def test_it_turns_with_the_lever_and_says_the_hand_in_words() -> None:
    turned = KIND.turned(ASKED, 0.2)
    assert turned == HeldByHand(min_modulus=0.4, mass_kg=0.2, damping_n_s_per_m=2.0, stiffness_n_per_m=120.0)
    assert KIND.describe(ASKED) == "0.4 with a hand of up to 5 kg, 50 N·s/m and 3 N/mm"
    assert "0.2 kg·m², 2 N·m·s/rad and 120 N·m/rad" in KIND.describe(turned, turning=True)
    assert KIND.relaxed(ASKED, 0.25).min_modulus == pytest.approx(0.3)


@pytest.mark.parametrize(
    "said",
    [{"min_modulus": 0.0}, {"min_modulus": 0.3, "stiffness_n_per_m": 0.0}, {"min_modulus": 0.3, "mass_kg": -1.0}],
)
def test_what_is_no_hand_is_refused(said: dict[str, float]) -> None:
    with pytest.raises(ParameterError):
        HeldByHand(**said)


def test_a_modulus_of_one_is_beyond_every_loop() -> None:
    with pytest.raises(ParameterError, match="below 1"):
        KIND.checked(HeldByHand(min_modulus=1.0))
