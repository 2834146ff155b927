"""A multiplier and its bounds, against its parts in closed form."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from problems.contact.multiplier import Multiplier

FREQUENCIES = np.geomspace(1e-2, 1e4, 401)
RATE = st.floats(0.1, 1e3)
WEIGHT = st.floats(0.0, 10.0)


def multiplier(
    rate_s: float = 0.0,
    shifts: tuple[tuple[float, float], ...] = (),
    fading: tuple[tuple[float, float], ...] = ((1.0, 1.0),),
) -> Multiplier:
    """Return the multiplier of pairs of τ and c, and of λ and b."""
    return Multiplier(
        rate_s=rate_s,
        shifts_s=tuple(place for place, _ in shifts),
        shift_weights=tuple(weight for _, weight in shifts),
        fading_per_s=tuple(place for place, _ in fading),
        fading_weights=tuple(weight for _, weight in fading),
        damper_s=0.0,
    )


@given(st.tuples(RATE, st.floats(0.1, 10.0)), st.tuples(RATE, WEIGHT))
def test_what_fades_has_its_least_real_part_at_the_frequency_itself(
    first: tuple[float, float], second: tuple[float, float]
) -> None:
    of = multiplier(rate_s=0.3, fading=(first, second))
    real = of.response(FREQUENCIES).real
    np.testing.assert_allclose([of.least_real(each) for each in FREQUENCIES[::40]], real[::40], rtol=1e-9)
    # From there on it only grows.
    assert bool(np.all(np.diff(real) >= -1e-12 * of.weight))


@given(st.tuples(st.floats(1e-3, 1.0), WEIGHT), st.tuples(RATE, st.floats(0.1, 10.0)))
def test_bounds_hold_and_nothing_is_active(shift: tuple[float, float], fading: tuple[float, float]) -> None:
    of = multiplier(rate_s=0.2, shifts=(shift,), fading=(fading,))
    found = of.response(FREQUENCIES)
    assert all(bool(np.all(found.real[i:] >= of.least_real(FREQUENCIES[i]) - 1e-9)) for i in range(0, 401, 40))
    assert bool(np.all(np.abs(found - 0.2j * FREQUENCIES) <= of.weight * (1.0 + 1e-9)))


def test_the_bound_of_the_size_is_reached_by_a_shift_of_half_a_period_far_above_what_fades() -> None:
    of = multiplier(shifts=((np.pi / 1e4, 0.7),), fading=((1e-3, 0.4),))
    (found,) = of.response(np.array([1e4]))
    assert found == pytest.approx(of.weight, rel=1e-6)
    assert of.weight == pytest.approx(2.0 * 0.7 + 0.4)
