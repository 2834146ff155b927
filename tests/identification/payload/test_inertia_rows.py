"""The equations of a rigid body against the point masses that it is made of."""

import numpy as np
import pytest

from identification.payload.inertia_rows import _newton_euler


@pytest.mark.parametrize("seed", range(5))
def test_force_and_torque_are_those_of_point_masses(seed: int) -> None:
    """Each has the acceleration a + α × r + ω × (ω × r), and what moves it is the robot, not the sensor."""
    rng = np.random.default_rng(seed)
    masses, places = rng.uniform(0.1, 2.0, 7), rng.uniform(-0.3, 0.3, (7, 3))
    linear, turning, rate = rng.standard_normal((3, 4, 3)) * np.array([2.0, 5.0, 1.5])[:, None, None]
    moment = masses @ places
    # About the origin: Σ m (|r|² 1 − r rᵀ).
    inertia = np.sum(masses * np.sum(places**2, axis=1)) * np.eye(3) - (places.T * masses) @ places
    parameters = np.array([masses.sum(), *moment, *np.diag(inertia), inertia[0, 1], inertia[0, 2], inertia[1, 2]])
    found = _newton_euler(linear, turning, rate) @ parameters
    for k in range(4):
        moved = linear[k] + np.cross(turning[k], places) + np.cross(rate[k], np.cross(rate[k], places))
        force = -masses[:, None] * moved
        expected = np.concatenate([force.sum(axis=0), np.cross(places, force).sum(axis=0)])
        assert found[k] == pytest.approx(expected, rel=1e-12, abs=1e-12)
