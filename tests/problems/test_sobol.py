"""Points of a Sobol' sequence beside those of scipy, whose scrambling takes a slow import."""

import numpy as np
import pytest
from scipy.optimize import differential_evolution
from scipy.stats import qmc

from problems.arrays import FloatArray
from problems.sobol import sobol_points


@pytest.mark.parametrize("seed", [None, 0, 7])
@pytest.mark.parametrize("width", [1, 2, 4, 11, 24, 25])
def test_the_points_are_those_of_scipy(width: int, seed: int | None) -> None:
    rng = None if seed is None else np.random.default_rng(seed)
    expected = qmc.Sobol(width, scramble=seed is not None, rng=rng).random(256)

    np.testing.assert_array_equal(sobol_points(width, 256, seed=seed), expected)
    for count in (0, 1, 2, 8):
        np.testing.assert_array_equal(sobol_points(width, count, seed=seed), expected[:count])


def test_every_elementary_interval_holds_one_point() -> None:
    units = sobol_points(2, 64, seed=3)

    for of_first in range(7):
        cells = np.floor(units * [2**of_first, 2 ** (6 - of_first)]).astype(int)
        assert len({tuple(cell) for cell in cells}) == 64


def test_a_population_of_them_evolves_as_one_that_scipy_draws() -> None:
    def costs(units: FloatArray) -> FloatArray:
        return np.asarray(np.sum((units - 0.3) ** 2, axis=0) + 0.1 * np.sin(20.0 * units[0]))

    seen = []
    for of_scipy in (True, False):
        rng = np.random.default_rng(5)
        init = "sobol" if of_scipy else sobol_points(3, 32, seed=rng)
        seen.append(
            differential_evolution(
                costs,
                [(0.0, 1.0)] * 3,
                popsize=10,
                maxiter=8,
                init=init,
                rng=rng,
                polish=False,
                vectorized=True,
                updating="deferred",
            )
        )

    np.testing.assert_array_equal(seen[0].population, seen[1].population)
