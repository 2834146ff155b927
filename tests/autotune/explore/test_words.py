"""The verdict on the page: how much of each missed requirement is met."""

import math
from types import SimpleNamespace
from typing import Any, cast

import pytest

from autotune.explore import words
from autotune.explore.view import View


def view(missed: dict[str, float], *, radius: float = 0.9, is_stable: bool = True) -> View:
    """A view of which only what the verdict reads is there."""
    evaluation = SimpleNamespace(is_stable=is_stable, spectral_radius=1.25)
    return cast("View", cast("Any", SimpleNamespace(missed=missed, radius=radius, evaluation=evaluation)))


@pytest.mark.parametrize(
    ("ratio", "share"),
    [
        # Required over achieved of 1.25: four fifths of what is required is achieved.
        (1.25, "80\u00a0% of it"),
        (2.0, "50\u00a0% of it"),
        (3.0, "33.3\u00a0% of it"),
        # What is missed is never called whole, however little is missing.
        (1.0004, "99.9\u00a0% of it"),
        (math.inf, "none of it"),
    ],
)
def test_a_missed_requirement_is_given_with_the_share_that_is_met(ratio: float, share: str) -> None:
    said = words.verdict(view({"gain_margin_db": ratio}), 7)
    assert said == f'<p class="warn">Stable, but misses gain margin ({share}), worst of 7 plants.</p>'


def test_the_verdict_names_the_largest_root_of_an_unstable_plant_and_where_it_is() -> None:
    here = words.verdict(view({}, radius=1.125, is_stable=False), 7)
    assert "on the plant that you look at (largest |z| = 1.1250)" in here
    elsewhere = words.verdict(view({}, is_stable=False), 7)
    assert "on another plant of the range (largest |z| = 1.2500)" in elsewhere
    assert words.verdict(view({}), 7) == '<p class="good">Meets every requirement on all 7 plants of the map.</p>'
