"""Noise models: spectra at rest, autoregressive whitening, Wiener smoothing, and tests of whiteness."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy
from scipy.special import chdtrc, fdtri, ndtr

from problems.arrays import FloatArray

_ORDERS = (0, 1, 2, 4, 8, 16, 24)
# Neighbouring bins of a spectrum that are averaged; a window is worth so many squares of normal numbers then.
_SMOOTHED_BINS, _FREEDOMS = 5, 6.0
# In standard deviations of a normal law. With fewer windows at rest than enough, so many more bins are averaged.
_CHANCES, _ENOUGH = 4.5, 4.0
_WINDOW_S = 0.2
_LAGS = 40
_SPLINE_HALF_WIDTH = 24


@dataclass(frozen=True, kw_only=True)
class Whitener:
    """e_k = (r_k + a_1 r_(k−1) + … )/σ: `coefficients` is (1, a_1, …), `rms` is σ."""

    coefficients: FloatArray
    rms: float

    @property
    def order(self) -> int:
        """Return how many samples of the past are used."""
        return len(self.coefficients) - 1

    def apply(self, columns: FloatArray) -> FloatArray:
        """Whiten along the first axis; the samples without a past are left out."""
        return np.asarray(scipy.signal.lfilter(self.coefficients / self.rms, [1.0], columns, axis=0)[self.order :])


def fit_whitener(residuals: Sequence[FloatArray]) -> Whitener:
    """Fit an autoregression to residuals (Yule–Walker, Levinson's recursion); the order is chosen by the BIC."""
    longest = max(_ORDERS)
    used = [r for r in residuals if len(r) > 2 * longest]
    count = sum(len(r) for r in used)
    if count < 20 * longest:
        flat = np.concatenate(residuals) if residuals else np.zeros(1)
        return Whitener(coefficients=np.ones(1), rms=max(float(np.sqrt(np.mean(flat**2))), 1e-12))
    lags = np.array([sum(float(r[: len(r) - k] @ r[k:]) for r in used) for k in range(longest + 1)]) / count
    variance, best = max(float(lags[0]), 1e-24), np.ones(1)
    chosen, lowest = (best, variance), count * np.log(variance)
    for order in range(1, longest + 1):
        reflection = -float(best @ lags[order:0:-1]) / variance
        best = np.append(best, 0.0) + reflection * np.append(best, 0.0)[::-1]
        variance *= max(1.0 - reflection**2, 1e-12)
        criterion = count * np.log(variance) + order * np.log(count)
        if order in _ORDERS and criterion < lowest:
            chosen, lowest = (best.copy(), variance), criterion
    return Whitener(coefficients=chosen[0], rms=float(np.sqrt(chosen[1])))


@dataclass(frozen=True, kw_only=True)
class Smoother:
    """A symmetric filter that keeps what exceeds the noise; `taps` None keeps nothing but the mean.

    The taps give the coefficients of the cubic spline through the smoothed values at once.
    """

    taps: FloatArray | None

    @property
    def half_width(self) -> int:
        """How many values on each side a coefficient depends on."""
        return 0 if self.taps is None else len(self.taps) // 2

    def spline(self, values: FloatArray, mean: float) -> FloatArray:
        """Return the B-spline coefficients of the part of `values` that is no noise, `half_width` fewer on each side.

        `mean` is that of all values, of which these (n,) may be some.
        """
        if self.taps is None:
            return np.full(len(values), mean)
        return np.asarray(scipy.signal.oaconvolve(values - mean, self.taps, mode="valid") + mean)


def fit_smoother(moving: Sequence[FloatArray], resting: Sequence[FloatArray], period_s: float) -> Smoother:
    """Build Wiener's filter W = 1 − S_rest/S_moving from the spectra of both.

    What it leaves out is orthogonal to what it keeps, so a model driven by the result is not biased by the noise.
    """
    length = 2 * round(_WINDOW_S / period_s)
    noise, noise_count = _spectrum(resting, length, period_s)
    signal, signal_count = _spectrum(moving, length, period_s)
    if min(noise_count, signal_count) < 1.0:
        return Smoother(taps=None)
    few = noise_count < _ENOUGH
    bins = 2 * round(0.5 * _SMOOTHED_BINS * _ENOUGH / noise_count) + 1 if few else _SMOOTHED_BINS
    ratio = _smoothed(signal, _SMOOTHED_BINS) / np.maximum(_smoothed(noise, bins), 1e-300)
    if few:
        # A bin of so few windows may well be small by chance: the ratio of two spectra of one noise follows F.
        least = fdtri(_FREEDOMS * signal_count, _FREEDOMS * _ENOUGH, ndtr(_CHANCES))
    else:
        least = 1.0 + _CHANCES * np.sqrt(2.0 * (1.0 / noise_count + 1.0 / signal_count) / _FREEDOMS)
    keep = np.where(ratio > least, 1.0 - 1.0 / np.maximum(ratio, 1e-300), 0.0)
    if not np.any(keep > 0.0):
        return Smoother(taps=None)
    taps = np.fft.fftshift(np.fft.irfft(keep, length))
    taps = np.append(taps, taps[0])
    taps *= np.hanning(len(taps) + 2)[1:-1]
    taps = taps / np.sum(taps) if keep[1] > 0.9 else taps  # a slow motion is kept as it is
    # The spline's coefficients c answer to (c_(k−1) + 4 c_k + c_(k+1))/6 = value, whose inverse is √3 (√3 − 2)^|k|.
    distance = np.abs(np.arange(-_SPLINE_HALF_WIDTH, _SPLINE_HALF_WIDTH + 1))
    return Smoother(taps=np.convolve(taps, np.sqrt(3.0) * (np.sqrt(3.0) - 2.0) ** distance))


def _spectrum(spans: Sequence[FloatArray], length: int, period_s: float) -> tuple[FloatArray, float]:
    """Return the mean spectrum of windows of `length` samples, and how many independent windows there were."""
    long = [s for s in spans if len(s) >= length]
    if not long:
        return np.empty(0), 0.0
    parts = [scipy.signal.welch(s, 1.0 / period_s, nperseg=length, detrend="linear")[1] for s in long]
    weights = np.array([len(s) // length for s in long], dtype=float)
    return np.average(parts, axis=0, weights=weights), float(np.sum(weights))


def _smoothed(values: FloatArray, bins: int) -> FloatArray:
    half = bins // 2
    # The lowest bin is the detrended one: its neighbour speaks for it.
    padded = np.pad(np.concatenate([values[1:2], values[1:]]), half, mode="reflect")
    return np.convolve(padded, np.full(bins, 1.0 / bins), mode="valid")


def whiteness(residuals: Sequence[FloatArray]) -> float:
    """Return the probability of a residual at least as coloured if it were white (Ljung and Box 1978, 40 lags)."""
    used = [r for r in residuals if len(r) > 2 * _LAGS]
    count = sum(len(r) for r in used)
    if count == 0:
        return 1.0
    lags = np.array([sum(float(r[: len(r) - k] @ r[k:]) for r in used) for k in range(_LAGS + 1)])
    share = lags[1:] / max(lags[0], 1e-300)
    statistic = count * (count + 2.0) * float(np.sum(share**2 / (count - np.arange(1, _LAGS + 1))))
    return float(chdtrc(_LAGS, statistic))
