"""Spectral radii found together are those that are found one by one, whatever sizes the loops have."""

import numpy as np

from problems.model.radii import spectral_radii
from problems.model.sampled import build_loop, spectral_radius
from tests.problems.random_loops import random_controller, random_plant, sampled_of


def test_radii_of_many_loops_are_those_of_each() -> None:
    rng = np.random.default_rng(23)
    loops = [build_loop(sampled_of(random_plant(rng)), random_controller(rng)) for _ in range(60)]
    assert len({len(loop.a) for loop in loops}) > 4
    assert {loop.is_anchored for loop in loops} == {True, False}
    radii = spectral_radii(loops)
    np.testing.assert_array_equal(radii, [spectral_radius(loop) for loop in loops])
    assert np.min(radii) < 1.0 < np.max(radii)


def test_of_no_loop_there_is_no_radius() -> None:
    assert spectral_radii([]).shape == (0,)
