"""What differs between parts of a log, on signals of which that is known."""

import numpy as np
import pytest
from scipy.signal import butter, sosfilt

from identification.robot.admittance_robot import spread_of_parts
from problems.arrays import FloatArray

STEP_S, PART_S = 0.01, 10.0
NOISE = 0.05


def velocity(seconds: float, seed: int) -> tuple[FloatArray, FloatArray]:
    """Return stamps and a lively velocity of variance 1."""
    time = np.asarray(np.arange(round(seconds / STEP_S)) * STEP_S, dtype=np.float64)
    drawn = np.random.default_rng(seed).standard_normal(len(time))
    moved = np.asarray(sosfilt(butter(2, 2.0, fs=1.0 / STEP_S, output="sos"), drawn))
    return time, moved / float(np.std(moved))


def test_parts_that_differ_by_noise_alone_have_hardly_a_spread() -> None:
    time, predicted = velocity(60.0, 1)
    noise = NOISE * np.random.default_rng(2).standard_normal(len(time))
    found = spread_of_parts(0.8 * predicted + noise, predicted, time)
    # White noise on 500 samples a part: a deviation of NOISE/√500 of the gain, of which chance leaves a part.
    assert found.gain < 2.0 * NOISE / np.sqrt(500.0)


def test_the_spread_of_gains_and_lags_is_found() -> None:
    time, predicted = velocity(120.0, 3)
    rng = np.random.default_rng(4)
    gains, lags = 0.8 + 0.05 * rng.standard_normal(12), 0.02 * rng.standard_normal(12)
    part = np.minimum((time / PART_S).astype(int), 11)
    late = np.interp(time - lags[part], time, predicted)
    found = spread_of_parts(gains[part] * late, predicted, time)
    # A tenth of the lag is lost where the derivative stands for a shift; 12 draws know their spread to a fifth.
    assert found.gain == pytest.approx(float(np.std(gains, ddof=1)), rel=0.2)
    assert found.lag_s == pytest.approx(0.8 * float(np.std(lags, ddof=1)), rel=0.35)


def test_a_short_log_has_no_parts() -> None:
    time, predicted = velocity(8.0, 5)
    found = spread_of_parts(predicted, predicted, time)
    assert (found.gain, found.lag_s) == (0.0, 0.0)
