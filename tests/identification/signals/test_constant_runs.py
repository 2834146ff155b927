"""The step between the levels of a signal, and how often its samples repeat."""

import numpy as np
import pytest

from identification.signals.constant_runs import quantum, repeated_share

NOISE = np.random.default_rng(4).standard_normal(2000)


@pytest.mark.parametrize("step", [0.25, 0.1, 3.0])
def test_the_step_of_rounded_values_is_found(step: float) -> None:
    assert quantum(step * np.round(2.0 * NOISE)) == pytest.approx(step, rel=1e-9)
    # An offset leaves it as it is; of levels that are left out the smallest step must divide all others.
    assert quantum(7.0 + step * np.array([0.0, 2.0, 4.0, 10.0] * 40)) == pytest.approx(2.0 * step, rel=1e-9)
    assert quantum(7.0 + step * np.array([0.0, 2.0, 5.0, 9.0] * 40)) == 0.0


@pytest.mark.parametrize(
    "values",
    [
        pytest.param(NOISE, id="continuum"),
        pytest.param(np.zeros(50), id="one level"),
        pytest.param(np.repeat(NOISE[:20], 40), id="held continuum"),
        pytest.param(1.0 + 1e-17 * np.arange(50), id="rounding of one level"),
        pytest.param(np.tile([1.0, np.nextafter(1.0, 2.0)], 30), id="rounding of two"),
    ],
)
def test_a_continuum_has_no_step(values: np.ndarray) -> None:
    assert quantum(values) == 0.0


def test_samples_repeat_by_themselves_only_in_coarse_steps() -> None:
    moving = NOISE[:1000, None] * np.ones(3)
    assert repeated_share(moving) == 0.0
    held = np.repeat(moving[:500], 2, axis=0)
    assert repeated_share(held) == pytest.approx(0.5, abs=0.02)
    assert repeated_share(np.round(held)) == 0.0
    assert repeated_share(moving[:1]) == 0.0
