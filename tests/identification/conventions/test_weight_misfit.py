"""How a sensor is mounted, from forces alone, and what it leaves."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from identification.conventions.weight_misfit import HYPOTHESES, FreeMounting, _mount_freely

MASS_KG = 12.0


def mounted(scatter_n: float) -> tuple[FreeMounting, Rotation]:
    rng, turn = np.random.default_rng(5), Rotation.from_euler("xyz", [0.3, -0.2, 0.5])
    gravity = 9.80665 * Rotation.random(12, random_state=3).apply([0.0, 0.0, -1.0])
    force = MASS_KG * turn.inv().apply(gravity) + [1.0, -2.0, 3.0] + scatter_n * rng.standard_normal((12, 3))
    return _mount_freely(np.broadcast_to(gravity, (len(HYPOTHESES), 12, 3)), force), turn


def test_the_turn_of_a_mounting_is_found_and_nothing_is_left() -> None:
    found, turn = mounted(0.0)
    assert found.sign == 1.0
    assert (found.turn * turn.inv()).magnitude() < 1e-7
    assert found.force_n2 < 1e-20 * 12


def test_what_is_left_is_the_sum_of_squares_of_the_scatter() -> None:
    """Of 36 numbers the turn, the mass and the bias take 7; twice the scatter leaves four times as much."""
    once, twice = (mounted(scatter)[0].force_n2 for scatter in (0.01, 0.02))
    assert twice == pytest.approx(4.0 * once, rel=1e-3)
    # χ² of 29 degrees of freedom: 11.4 to 56 hold all but 2e-3.
    assert 11.4 < once / 0.01**2 < 56.0
