"""The damping ratio of the slowest oscillation: closed form, both ways to assemble the loop, and a design problem."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from problems.design.evaluation import build_scenarios
from problems.design.requirements import Requirements
from problems.design.requirements.damping_ratio import DampingRatio, slowest_damping_ratio
from problems.design.stable_design import StableDesign
from problems.errors import ParameterError
from problems.model.sampled import build_sampled_plant
from tests.autotune.tuning.cases import design_problem
from tests.problems.axes import LAW, PERIOD_S, linear_controller, paper_plant

GOOD, RINGING = (6.0, 1500.0, 0.02, 0.005), (8.0, 1600.0, 0.01, 0.0)


@LAW
@given(ratio=st.floats(0.01, 0.99), omega=st.floats(1.0, 1000.0), faster=st.floats(1.01, 3.0))
def test_a_sampled_oscillator_has_the_damping_ratio_of_the_continuous_one(
    ratio: float, omega: float, faster: float
) -> None:
    pole = omega * complex(-ratio, math.sqrt(1.0 - ratio**2))
    # A faster oscillation and a slower real pole beside it do not count.
    beside = [faster * pole.real + 0.5j * omega, 0.1 * pole.real]
    z = np.exp(PERIOD_S * np.array([pole, pole.conjugate(), *beside]))
    # ω h is at most 0.8, far from where ln z would be of another turn; rounding of a logarithm near z = 1 is 1e-9.
    assert slowest_damping_ratio(z) == pytest.approx(ratio, rel=1e-6)


def test_what_alternates_from_tick_to_tick_oscillates_and_what_only_decays_does_not() -> None:
    assert slowest_damping_ratio(np.array([0.9, 0.5])) == math.inf
    # ln(−r) = ln r + jπ.
    decay = -math.log(0.8)
    assert slowest_damping_ratio(np.array([0.9, -0.8])) == pytest.approx(decay / math.hypot(decay, math.pi), rel=1e-12)


@pytest.mark.parametrize("size", [0.9, 1e-3, 1e-6])
@pytest.mark.parametrize(("angle", "oscillates"), [(1e-5, True), (1e-9, False)])
def test_rounding_of_a_double_real_pole_is_no_oscillation_however_fast_it_decays(
    size: float, angle: float, oscillates: bool
) -> None:
    z = size * np.exp(1j * np.array([angle, -angle]))
    expected = -math.log(size) / math.hypot(math.log(size), angle) if oscillates else math.inf
    assert slowest_damping_ratio(z) == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize("stiffness", [0.0, 5e4, 5e5])
@pytest.mark.parametrize("design", [GOOD, RINGING])
def test_both_ways_to_assemble_the_loop_agree(stiffness: float, design: tuple[float, ...]) -> None:
    problem = design_problem()
    sampled, law = build_sampled_plant(paper_plant(stiffness=stiffness), PERIOD_S), problem.controller(design)
    requirement, prepared = DampingRatio(), build_scenarios(problem, problem.scenarios(2, 2))
    second = requirement.verified(0.1, sampled, law)
    # Eigenvalues of matrices of a dozen states agree to 1e-9; the law as a matrix is the same law.
    assert requirement.verified(0.1, sampled, linear_controller(law, PERIOD_S)) == pytest.approx(second, rel=1e-8)
    rows = requirement.ratios(0.1, StableDesign(prepared, law))
    again = [0.1 / requirement.verified(0.1, plant.sampled, law) for plant in prepared.plants]
    assert rows == pytest.approx(again, rel=1e-8)


def test_it_is_asked_of_every_loop_in_contact_and_in_free_space() -> None:
    asked = Requirements(further={"min_damping_ratio": 0.3})
    problem = design_problem(requirements=asked)
    prepared = build_scenarios(problem, problem.scenarios(3, 2))
    found = prepared.evaluate(GOOD, peaks_if_missed=True)
    law = problem.controller(GOOD)
    worst = min(DampingRatio().verified(0.3, plant.sampled, law) for plant in prepared.plants)
    assert found.requirements["min_damping_ratio"] == pytest.approx(0.3 / worst, rel=1e-8)
    assert not found.is_feasible


@pytest.mark.parametrize("value", [0.0, 1.0, math.nan])
def test_a_ratio_outside_of_zero_and_one_is_refused(value: float) -> None:
    with pytest.raises(ParameterError, match="min_damping_ratio"):
        Requirements(further={"min_damping_ratio": value})
