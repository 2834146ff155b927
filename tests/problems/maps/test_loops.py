"""The compiled way from plants to polynomials, held to the one that every other module takes."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from problems.design.batch_evaluation import are_stable
from problems.errors import ParameterError
from problems.maps.loops import build_plant_loops, designs_around
from problems.model.controller import AdmittanceController
from problems.model.plant import PayloadDynamics, Plant
from problems.model.sampled import build_sampled_plant
from problems.stability.margins import loop_polynomials
from tests.problems.axes import LAW, PERIOD_S, admittance, controllers, one_pole, paper_plant, plants


@LAW
@given(plants())
def test_the_polynomials_are_those_of_the_sampled_plant(plant: Plant) -> None:
    # A second plant with a longer delay makes room behind the first one's powers.
    other = replace(plant, robot=replace(plant.robot, delay_s=plant.robot.delay_s + 2.5 * PERIOD_S))
    found, sizes, first = build_plant_loops([plant, other], PERIOD_S).loops
    for k, each in enumerate((plant, other)):
        expected = loop_polynomials(build_sampled_plant(each, PERIOD_S))
        assert sizes[k] == expected.shape[1]
        assert first[k] == (0 if each.environment.is_anchored else 1)
        # Two forms of the same steps: 1e-10 of the largest coefficient of each polynomial.
        scale = np.max(np.abs(expected), axis=1, keepdims=True)
        assert np.all(np.abs(found[k, :, : sizes[k]] - expected) <= 1e-10 * scale)
        assert np.all(found[k, :, sizes[k] :] == 0.0)


@LAW
@given(st.lists(plants(), min_size=1, max_size=1), st.lists(controllers(), min_size=1, max_size=4))
def test_verdicts_are_those_of_the_batch(some: list[Plant], laws: list[AdmittanceController]) -> None:
    more = [replace(some[0], payload=PayloadDynamics(mass_kg=mass, drag_n_s_per_m=200.0)) for mass in (3.0, 30.0)]
    loops = build_plant_loops([*some, *more], PERIOD_S)
    expected = are_stable([build_sampled_plant(each, PERIOD_S) for each in (*some, *more)], laws)
    for i, law in enumerate(laws):
        verdicts = loops.stable(designs_around(law, {}))
        assert np.array_equal(verdicts[0], expected[i])
        for j in range(3):
            assert loops.only(j).stable(designs_around(law, {}))[0, 0] == expected[i, j]


def test_a_plant_whose_motion_overflows_is_refused() -> None:
    with pytest.raises(ParameterError, match="finite"):
        build_plant_loops([paper_plant(coupling=1e300)], PERIOD_S)


def test_a_plant_can_be_had_sampled() -> None:
    plant = paper_plant(robot=one_pole(1.7e-3))
    sampled = build_plant_loops([paper_plant(), plant], PERIOD_S).sampled(1)
    assert (sampled.plant, sampled.whole_delay) == (plant, math.floor(1.7e-3 / PERIOD_S))
    assert build_plant_loops([plant], PERIOD_S).stable(designs_around(admittance(), {})).shape == (1, 1)
