from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from identification.touches.peak import bound_peak
from problems.arrays import FloatArray


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
    assert high is None or high >= peak * (1.0 - 1e-9)
    # Seven samples or more of half a sine: at least three of them reach half of it.
    assert high is not None or width_s < 7.0 * step_s
    assert rise == pytest.approx((0.5 - np.arcsin(0.1) / np.pi) * width_s / step_s, abs=1.5)


def test_a_well_sampled_peak_is_known() -> None:
    force = 40.0 * np.sin(np.pi * np.linspace(0.0, 1.0, 201))
    low, high, _ = bound_peak(force, 1, 100)
    assert high is not None
    assert high / low == pytest.approx(1.0, abs=2e-4)


SHAPES: dict[str, Callable[[FloatArray], FloatArray]] = {
    # Half a sine of 66 ms, and a force that rises within 4 ms and dies out within 22 ms: the highest is 1.
    "half a sine": lambda time: np.sin(np.pi * time / 0.066) * (time < 0.066),
    "exponential": lambda time: 1.7174 * (np.exp(-time / 0.022) - np.exp(-time / 0.0037)),
}


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("noise", [0.02, 0.15, 0.5])
@pytest.mark.parametrize("rate_hz", [100.0, 250.0, 1000.0])
def test_the_peak_without_the_noise_lies_in_its_interval(shape: str, noise: float, rate_hz: float) -> None:
    """Of 100 peaks of 30 N, at any phase between the samples; three deviations leave out less than one in twenty."""
    rng = np.random.default_rng(5)
    dense = np.linspace(0.0, 0.1, 100_001)
    highest = 30.0 * float(np.max(SHAPES[shape](dense)))
    held = 0
    for _ in range(100):
        time = (np.arange(-round(0.5 * rate_hz), round(0.3 * rate_hz)) + rng.random()) / rate_hz
        force = np.where(time > 0.0, 30.0 * SHAPES[shape](np.maximum(time, 0.0)), 0.0)
        force += noise * rng.standard_normal(len(time))
        onset = int(np.flatnonzero((time > 0.0) & (force > 2.0))[0])
        low, high, _ = bound_peak(force, onset, int(np.argmax(force)), quiet=force[: onset - 2])
        held += low <= highest and (high is None or highest <= high)
    assert held >= 95


def test_a_wide_peak_is_known_better_than_its_samples() -> None:
    rng = np.random.default_rng(2)
    time = np.arange(-1000, 1000) * 1e-3
    force = np.where(time > 0.0, 40.0 * np.sin(np.pi * time), 0.0) + 0.2 * rng.standard_normal(2000)
    low, high, _ = bound_peak(force, 1020, int(np.argmax(force)), quiet=force[:1000])
    assert high is not None
    assert low <= 40.0 <= high
    assert high - low < 0.4 < float(np.max(force)) - 40.0 + 0.1


def test_noise_whose_neighbours_go_together_is_not_averaged_away() -> None:
    rng = np.random.default_rng(3)
    slow = np.repeat(0.3 * rng.standard_normal(100), 20)
    white = 0.3 * rng.standard_normal(2000)
    arc = np.concatenate([np.zeros(1000), 40.0 * np.sin(np.pi * np.linspace(0.0, 1.0, 1000))])
    widths = []
    for noise in (slow, white):
        force = arc + noise
        low, high, _ = bound_peak(force, 1030, int(np.argmax(force)), quiet=force[:1000])
        assert high is not None
        assert low <= 40.0 <= high
        widths.append(high - low)
    assert widths[0] > widths[1]


@pytest.mark.parametrize("beside", [0.0, 14.0, 29.0])
def test_a_peak_of_one_or_two_samples_has_no_upper_end(beside: float) -> None:
    """30 ms of a blow at 40 Hz: one sample is hit, at any phase, or two."""
    assert bound_peak(np.array([0.0, 0.0, 30.0, beside, 0.0]), 2, 2) == (30.0, None, 1)


def test_an_upper_end_that_is_stated_holds_of_narrow_peaks() -> None:
    """Bells, triangles and half sines of one to eight samples, at any phase: 95 of 100, or no end is stated."""
    rng = np.random.default_rng(4)
    shapes: tuple[Callable[[FloatArray], FloatArray], ...] = (
        lambda u: np.sin(np.pi * u),
        lambda u: 1.0 - np.abs(2.0 * u - 1.0),
        lambda u: np.exp(-(((u - 0.5) / 0.18) ** 2)),
    )
    stated = held = 0
    for width in np.linspace(1.0, 8.0, 15):
        for shape in shapes:
            for _ in range(20):
                u = (np.arange(-20, 20) + rng.random()) / width
                force = np.where((u > 0.0) & (u < 1.0), 50.0 * shape(u), 0.0) + 0.2 * rng.standard_normal(len(u))
                touched = np.flatnonzero(force > 3.0)
                if touched.size:
                    peak = int(np.argmax(force))
                    _, high, _ = bound_peak(force, int(touched[0]), peak, quiet=force[:18], noise=0.2)
                    stated += high is not None
                    held += high is not None and high >= 50.0
    assert stated > 200
    assert held >= 0.95 * stated
