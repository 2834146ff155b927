"""The slope of the log-Cholesky parameters against finite differences, and the nearest tensor against a bound."""

import numpy as np
import pytest

from identification.payload import pseudo_inertia
from identification.payload.pseudo_inertia import is_consistent, nearest_consistent


@pytest.mark.parametrize("seed", range(5))
def test_the_slope_of_the_free_numbers_is_that_of_finite_differences(seed: int) -> None:
    free, step = np.random.default_rng(seed).normal(size=10), 1e-6
    told = [
        (
            pseudo_inertia.parameters_of(pseudo_inertia._unfold(free + change))
            - pseudo_inertia.parameters_of(pseudo_inertia._unfold(free - change))
        )
        / (2.0 * step)
        for change in step * np.eye(10)
    ]
    # Central differences of numbers of size 10: steps squared, and rounding over the step.
    np.testing.assert_allclose(pseudo_inertia._unfold_slope(free), np.array(told).T, rtol=1e-7, atol=2e-8)


def test_parameters_and_matrix_are_each_others_inverse() -> None:
    parameters = np.array([3.0, 0.1, -0.2, 0.3, 0.5, 0.6, 0.4, 0.01, -0.02, 0.03])
    found = pseudo_inertia.parameters_of(pseudo_inertia.pseudo_inertia(parameters))
    # A sum and a difference of numbers below 1.
    np.testing.assert_allclose(found, parameters, rtol=0.0, atol=1e-15)


def test_a_moment_that_is_not_known_is_filled_consistently_at_no_cost() -> None:
    # 20 kg at 0.1 m along z turn about x and y; nothing turned about z, whose moment is a guess of the fit.
    told = np.array([20.0, 0.0, 0.0, 2.0, 0.6, 0.55, -40.0, 0.0, 0.0, 0.0])
    std = np.array([0.01, 0.01, 0.01, 0.01, 2e-3, 2e-3, 100.0, 1e-3, 1e-3, 1e-3])
    found, distance = nearest_consistent(told, np.diag(std**2))
    assert is_consistent(found)
    # A consistent moment about z lies within 0.41 standard deviations of the guess, and costs nothing else.
    assert distance < 0.41**2
    np.testing.assert_allclose(found[[0, 3, 4, 5]], told[[0, 3, 4, 5]], rtol=0.0, atol=1e-3)
