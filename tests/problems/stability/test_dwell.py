"""Dwell times: shared coordinates that have the loop's poles, closed forms of two matrices, changes slow and fast."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from problems.arrays import FloatArray
from problems.errors import ParameterError
from problems.model.sampled import build_loop, build_sampled_plant, stability_matrix
from problems.stability.dwell import common_loop, dwell_samples, without_translation
from tests.problems.axes import PERIOD_S, admittance, one_pole, paper_plant


def poles(matrix: FloatArray, least: float) -> FloatArray:
    found = np.abs(np.linalg.eigvals(matrix))
    return np.sort(found[found > least])


@pytest.mark.parametrize("stiffness", [0.0, 1e5])
@pytest.mark.parametrize("samples", [3.0, 2.4])
@pytest.mark.parametrize(("feedback_s", "compensation_kg"), [(0.0, 0.0), (0.02, 8.0)])
def test_the_shared_coordinates_have_the_poles_of_the_loop(
    stiffness: float, samples: float, feedback_s: float, compensation_kg: float
) -> None:
    plant = paper_plant(stiffness=stiffness, coupling_damping=50.0, robot=one_pole(samples * PERIOD_S))
    law = replace(admittance(12.0, 1200.0, 0.015), feedback_damping_s=feedback_s, compensation_mass_kg=compensation_kg)
    sampled = build_sampled_plant(plant, PERIOD_S)
    found = common_loop(sampled, law)
    if stiffness == 0.0:
        found = without_translation(found, sampled)
    expected = poles(stability_matrix(build_loop(sampled, law)), 0.2)
    shared = poles(found, 0.2).tolist()
    # Filters that nothing reads are modes beside those of the loop; the slow poles are simple, so to 1e-6.
    for each in expected:
        assert min(abs(each - other) for other in shared) < 1e-6
    assert max(shared) == pytest.approx(float(expected[-1]), abs=1e-6)


def test_two_loops_of_one_lyapunov_function_may_change_at_any_time() -> None:
    """Rotations that shrink share I: P is a multiple of it for both."""
    turn = np.array([[0.6, -0.8], [0.8, 0.6]])
    assert dwell_samples([[0.9 * turn], [0.9 * turn.T]]) <= 1
    # P = I/(1 − ρ²): of 0.5 and 0.9 they are 1.333 and 5.263, and 0.5^(2N) · 5.263 < 1.333 from N = 1 on.
    assert dwell_samples([[0.5 * turn], [0.9 * turn]]) == 1
    assert dwell_samples([[0.9 * turn]]) == 0
    # 0.2^(2N) P' < P with P' = 1/(1 − 0.99²) = 50.25, P = 1/(1 − 0.2²) = 1.0417: N = 2; 0.6: P = 1.5625, N = 4.
    assert dwell_samples([[0.2 * turn], [0.99 * turn]]) == 2
    assert dwell_samples([[0.6 * turn], [0.99 * turn]]) == 4


def test_loops_that_grow_when_they_change_too_fast_need_the_time_they_are_given() -> None:
    """The textbook's pair: each is stable, and changing every quarter of a turn the state grows."""
    one = np.array([[0.995, 0.05], [-0.5, 0.995]]) * 0.985
    two = np.array([[0.995, 0.5], [-0.05, 0.995]]) * 0.985
    needed = dwell_samples([[one], [two]])
    assert needed > 5
    growth = {}
    for period in (10, needed):
        product = np.linalg.matrix_power(two, period) @ np.linalg.matrix_power(one, period)
        growth[period] = float(np.max(np.abs(np.linalg.eigvals(product))))
    assert growth[10] > 1.0
    assert growth[needed] < 1.0


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 10_000))
def test_no_sequence_that_waits_grows_from_change_to_change(seed: int) -> None:
    rng = np.random.default_rng(seed)
    plants = [build_sampled_plant(paper_plant(stiffness=each), PERIOD_S) for each in (2e4, 1e5)]
    laws = [admittance(float(rng.uniform(8.0, 20.0)), float(rng.uniform(900.0, 2000.0)), 0.015) for _ in range(2)]
    modes = [[common_loop(plant, law) for plant in plants] for law in laws]
    try:
        needed = max(1, dwell_samples(modes))
    except ParameterError:
        # Drawn gains may be unstable.
        return
    state, sizes = rng.standard_normal(len(modes[0][0])), []
    for number in range(40):
        loop = modes[number % 2][int(rng.integers(2))]
        state = np.linalg.matrix_power(loop, needed + int(rng.integers(0, 50))) @ state
        sizes.append(float(np.linalg.norm(state)))
    # The bound is on a Lyapunov function: over a few changes what is left is smaller in any norm.
    assert sizes[-1] < sizes[0]
    assert sum(later < before for before, later in pairwise(sizes)) > 20


def test_an_unstable_loop_has_none() -> None:
    with pytest.raises(ParameterError, match="loops that are stable"):
        dwell_samples([[1.01 * np.eye(2)], [0.5 * np.eye(2)]])
