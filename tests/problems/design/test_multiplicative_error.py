"""The modulus beside a relative error against every plant that the error allows, and its own closed form."""

import math
from dataclasses import replace

import numpy as np
import pytest

from problems.design.requirements import ErrorRequirement, MultiplicativeError
from problems.design.stable_design import StableLoop
from problems.errors import ParameterError
from problems.model.controller import AdmittanceController
from problems.model.plant import FREE_SPACE
from problems.model.response import loop_response
from problems.model.sampled import build_sampled_plant
from tests.problems.axes import PERIOD_S, paper_plant

H = PERIOD_S
CELL = paper_plant(stiffness=1e5)
LAW = AdmittanceController(mass_kg=14.0, damping_n_s_per_m=1200.0, lead_s=0.01, feedback_damping_s=0.004)
REQUIREMENT = ErrorRequirement()
POINTS = ((1.0, 0.1), (5.0, 0.4), (14.0, 0.9), (40.0, 0.3))
ASKED = MultiplicativeError(min_modulus=0.3, points=POINTS)
FREE = build_sampled_plant(CELL.in_contact_with(FREE_SPACE), H)


def test_it_is_the_least_modulus_of_all_plants_that_the_error_allows() -> None:
    achieved = REQUIREMENT.of_loop(ASKED, StableLoop(sampled=FREE, controller=LAW))
    frequency, share = np.array(POINTS).T
    loop = loop_response(FREE, LAW, 2.0 * math.pi * frequency).at_force
    turns = np.exp(2j * math.pi * np.linspace(0.0, 1.0, 721))
    every = np.abs(1.0 + loop[:, None] * (1.0 + share[:, None] * turns))
    assert achieved == pytest.approx(np.min(every), rel=1e-4)
    assert achieved <= np.min(every) + 1e-12


def test_a_loop_in_contact_and_no_points_have_no_limit() -> None:
    contact = StableLoop(sampled=build_sampled_plant(CELL, H), controller=LAW)
    assert REQUIREMENT.of_loop(ASKED, contact) == math.inf
    nothing = replace(ASKED, points=())
    assert REQUIREMENT.of_loop(nothing, StableLoop(sampled=FREE, controller=LAW)) == math.inf
    assert REQUIREMENT.ratio(ASKED, math.inf) == 0.0


@pytest.mark.parametrize("achieved", [0.9, 0.3, 0.075, 0.0, -2.0])
def test_what_is_missed_has_a_finite_share_from_which_it_follows(achieved: float) -> None:
    ratio = REQUIREMENT.ratio(ASKED, achieved)
    assert (ratio <= 1.0) == (achieved >= 0.3)
    assert REQUIREMENT.achieved_at(ASKED, ratio) == pytest.approx(achieved, abs=1e-12)
    # No corner where the tangent begins.
    assert REQUIREMENT.ratio(ASKED, 0.075 - 1e-9) == pytest.approx(REQUIREMENT.ratio(ASKED, 0.075 + 1e-9), rel=1e-6)


@pytest.mark.parametrize(
    ("points", "modulus", "sentence"),
    [
        (((2.0, 0.1), (1.0, 0.1)), 0.3, "rows of ascending frequencies"),
        (((2.0, -0.1),), 0.3, "not below 0|0 or more|at least 0"),
        (((2.0, 0.1, 0.2),), 0.3, "rows of frequency"),
        (((2.0, 0.1),), 1.0, "below 1"),
        (((0.0, 0.1),), 0.5, "above 0|positive"),
    ],
)
def test_points_that_are_none_are_refused(
    points: tuple[tuple[float, float], ...], modulus: float, sentence: str
) -> None:
    with pytest.raises(ParameterError, match=sentence):
        MultiplicativeError(min_modulus=modulus, points=points)


def test_a_point_beyond_the_nyquist_frequency_is_refused() -> None:
    with pytest.raises(ParameterError, match="below half the sampling rate"):
        REQUIREMENT.check_sampling(replace(ASKED, points=((700.0, 0.1),)), H)
