"""Whitening, tests of whiteness, and a smoother that does not bias what is fitted to its output."""

import numpy as np
import pytest
from scipy.signal import lfilter

from identification.joint_fit.noise import Smoother, fit_smoother, fit_whitener, whiteness

RNG_SEED = 4


def test_an_autoregression_is_found_again() -> None:
    rng = np.random.default_rng(RNG_SEED)
    coloured = lfilter([0.3], [1.0, -1.5, 0.7], rng.standard_normal(40_000))
    found = fit_whitener([coloured])
    assert found.order >= 2
    # Coefficients are known to 1/√40000, five of that; the innovation to 1/√80000.
    np.testing.assert_allclose(found.coefficients[:3], [1.0, -1.5, 0.7], atol=0.03)
    assert found.rms == pytest.approx(0.3, rel=0.02)
    assert np.std(found.apply(coloured)) == pytest.approx(1.0, rel=0.02)


def test_white_noise_needs_no_past() -> None:
    rng = np.random.default_rng(RNG_SEED)
    assert fit_whitener([0.1 * rng.standard_normal(5000) for _ in range(3)]).order == 0


def test_whiteness_shows_white_from_coloured() -> None:
    rng = np.random.default_rng(RNG_SEED)
    chances = [whiteness([rng.standard_normal(800)]) for _ in range(200)]
    # Uniform on (0, 1): the share below 0.05 is within 0.05 ± 4·0.0154.
    assert 0.0 <= np.mean(np.array(chances) < 0.05) <= 0.112
    assert whiteness([lfilter([1.0], [1.0, -0.3], rng.standard_normal(2000))]) < 1e-6


def test_a_pose_without_motion_is_taken_for_noise() -> None:
    rng = np.random.default_rng(RNG_SEED)
    noise = [2e-6 * rng.standard_normal(6000) for _ in range(4)]
    assert fit_smoother(noise[:2], noise[2:], 1e-3).taps is None
    np.testing.assert_array_equal(Smoother(taps=None).spline(noise[0], 0.5), np.full(6000, 0.5))


def test_beside_one_short_rest_noise_is_taken_for_noise() -> None:
    """A window of 0.4 s has bins that are small by chance, beside which the same noise is no motion."""
    rng = np.random.default_rng(RNG_SEED)
    for _ in range(200):
        assert fit_smoother([rng.standard_normal(9000)], [rng.standard_normal(700)], 0.8e-3).taps is None


def test_what_is_smoothed_away_does_not_bias_a_slope() -> None:
    """Errors in the regressor pull a slope towards zero; with Wiener's filter they do not."""
    rng, slope = np.random.default_rng(RNG_SEED), 3.0
    motion = lfilter([0.02], [1.0, -1.9, 0.92], rng.standard_normal(60_000))
    spread = float(np.std(motion))
    noisy = motion + spread * rng.standard_normal(len(motion))
    resting = [spread * rng.standard_normal(4000) for _ in range(8)]
    smoother = fit_smoother([noisy], resting, 1e-3)
    c = smoother.spline(np.pad(noisy, smoother.half_width), float(np.mean(noisy)))
    kept = (np.roll(c, 1) + 4.0 * c + np.roll(c, -1))[500:-500] / 6.0
    force = slope * motion[500:-500]
    raw = noisy[500:-500]
    assert force @ raw / (raw @ raw) == pytest.approx(0.5 * slope, rel=0.1)
    # The spectra are known to a few percent where there is motion.
    assert force @ kept / (kept @ kept) == pytest.approx(slope, rel=0.03)
