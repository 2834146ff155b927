import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from identification.touches.peak import bound_peak


@given(
    peak=st.floats(10.0, 500.0), width_s=st.floats(0.02, 0.5), step_s=st.floats(1e-3, 9e-3), phase=st.floats(0.0, 1.0)
)
@settings(max_examples=200, deadline=None)
def test_the_peak_of_half_a_sine_lies_in_its_interval(peak: float, width_s: float, step_s: float, phase: float) -> None:
    time = (np.arange(-3, int(width_s / step_s) + 4) + phase) * step_s
    force = peak * np.sin(np.pi * time / width_s) * ((time > 0.0) & (time < width_s))
    onset = int(np.argmax(force > 1e-9))
    low, high, rise = bound_peak(force, onset, int(np.argmax(force)))
    assert low == np.max(force)
    assert low <= peak * (1.0 + 1e-9)
    assert high >= peak * (1.0 - 1e-9)
    assert rise == pytest.approx((0.5 - np.arcsin(0.1) / np.pi) * width_s / step_s, abs=1.5)


def test_a_well_sampled_peak_is_known() -> None:
    force = 40.0 * np.sin(np.pi * np.linspace(0.0, 1.0, 201))
    low, high, _ = bound_peak(force, 1, 100)
    assert high / low == pytest.approx(1.0, abs=2e-4)


def test_a_peak_of_one_sample_may_be_twice_as_high() -> None:
    assert bound_peak(np.array([0.0, 0.0, 30.0, 0.0, 0.0]), 2, 2) == (30.0, 60.0, 1)
