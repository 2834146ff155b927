"""The worst contact with each point of a payload, of contacts that are given."""

from types import SimpleNamespace
from typing import Any, cast

import pytest

from autotune.formats.coupled_record import PointContact
from autotune.validation.coupled_failure import TouchedPoint
from autotune.validation.coupled_points import Touching

POINTS = ((0.0, 0.0, 0.2), (0.1, 0.0, 0.2))
ALONE_N = {(10.0, 2e4): 20.0, (10.0, 5e5): 50.0, (22.0, 2e4): 30.0, (22.0, 5e5): 80.0}
TIMES_S = {2e4: 0.1, 5e5: 0.02}


def contacts(harder: dict[tuple[float, float], float], leaves: dict[tuple[float, float], int]) -> list[PointContact]:
    """Return the contacts where each plant's peak is so many times that of the axis alone."""

    def end(at: TouchedPoint) -> SimpleNamespace:
        plant = at.mass_kg, at.stiffness_n_per_m
        return SimpleNamespace(
            peak_contact_force_n=harder[plant] * ALONE_N[plant],
            time_of_peak_s=TIMES_S[at.stiffness_n_per_m],
            leaves=leaves.get(plant, 0),
        )

    touching = SimpleNamespace(name="x", points=lambda: POINTS, plants=tuple(ALONE_N), alone_n=ALONE_N, end=end)
    return cast(list[PointContact], list(Touching.contacts(cast(Any, touching))))


def test_the_largest_peak_is_named_with_its_plant_and_the_largest_ratio_with_none() -> None:
    # The softest and lightest plant is hardest beside what it is alone, and still presses less than the stiffest.
    harder = {(10.0, 2e4): 1.5, (10.0, 5e5): 1.1, (22.0, 2e4): 1.0, (22.0, 5e5): 0.9}
    found = contacts(harder, {(22.0, 2e4): 3, (10.0, 5e5): 1})
    assert [each.point_m for each in found] == list(POINTS)
    for each in found:
        assert each.peak_contact_force_n == pytest.approx(0.9 * 80.0)
        assert (each.payload_mass_kg, each.environment_stiffness_n_per_m) == (22.0, 5e5)
        assert each.time_of_peak_s == TIMES_S[5e5]
        assert each.largest_ratio == pytest.approx(1.5)
        assert each.leaves == 3.0
