"""Noise that is not white: where in frequency it has its power, for sums over its spectrum and as what filters it."""

import math
from dataclasses import dataclass
from typing import Annotated

import numpy as np

from ..arrays import FloatArray
from ..errors import ParameterError
from ..frozen import Rule

# Frequencies at which a spectrum is summed: 0.45 % apart over four decades below the Nyquist frequency.
_NODES, _DECADES = 2048, 4.0
# Points of the circle at which the filter's logarithm is transformed.
_CIRCLE = 1 << 15


@dataclass(frozen=True, kw_only=True)
class RelativeSpectrum:
    """How the power of a noise is spread over frequency; its size is said by its RMS, so that any unit of density does.

    `relative_density` (k,), one-sided and above 0, at `frequency_hz` (k,), ascending, is interpolated between them and
    constant beyond. Raises ParameterError for anything else.
    """

    frequency_hz: Annotated[tuple[float, ...], Rule(items=Rule(minimum=0, maximum=1e6), minItems=2, maxItems=1000)]
    relative_density: Annotated[tuple[float, ...], Rule(items=Rule(exclusiveMinimum=0), minItems=2, maxItems=1000)]

    def __post_init__(self) -> None:
        for name in ("frequency_hz", "relative_density"):
            object.__setattr__(self, name, tuple(float(each) for each in getattr(self, name)))
        frequency, density = np.array(self.frequency_hz), np.array(self.relative_density)
        if not (len(frequency) >= 2 and np.all(np.isfinite(frequency)) and np.all(np.diff(frequency) > 0.0)):
            raise ParameterError("frequency_hz", self.frequency_hz, "two frequencies or more, ascending")
        if not (len(density) == len(frequency) and np.all(np.isfinite(density)) and np.all(density > 0.0)):
            raise ParameterError("relative_density", self.relative_density, "above 0, one for each frequency")

    def beside_white(self, frequency_hz: FloatArray, sample_time_s: float) -> FloatArray:
        """Return the density (n,) at frequencies [Hz] per that of white noise of this RMS, sampled with a period."""
        nyquist = 0.5 / sample_time_s
        known, density = np.array(self.frequency_hz), np.array(self.relative_density)
        corners = np.unique(np.concatenate([[0.0], known[(known > 0.0) & (known < nyquist)], [nyquist]]))
        mean = np.trapezoid(np.interp(corners, known, density), corners) / nyquist
        return np.asarray(np.interp(frequency_hz, known, density) / mean)

    def nodes(self, sample_time_s: float) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return frequencies ω (k,) [rad/s] below π/h, and the share of the noise's power that each stands for (k,).

        Then that of white noise (k,). The variance behind a filter H is the sum of share · |H(ω)|² per variance of the
        noise.
        """
        nyquist = 0.5 / sample_time_s
        edges = nyquist * np.geomspace(10.0**-_DECADES, 1.0, _NODES + 1)
        middles = np.sqrt(edges[1:] * edges[:-1])
        # What lies below all is as at the lowest.
        edges[0] = 0.0
        white = np.diff(edges) / nyquist
        return 2.0 * np.pi * middles, white * self.beside_white(middles, sample_time_s), white

    def pulse(self, sample_time_s: float, count: int) -> FloatArray:
        """Return the first ticks (count,) of the causal filter that makes this noise of white noise of its RMS.

        The one of minimum phase, by its cepstrum (Oppenheim and Schafer, *Discrete-Time Signal Processing*, 3rd ed.,
        section 13.5): with c the transform of the logarithm of its gain, n g_n = Σ k c_k g_(n−k).
        """
        frequency = np.arange(_CIRCLE // 2 + 1) / (_CIRCLE * sample_time_s)
        # The even transform holds each coefficient twice, and half of the power's logarithm is the gain's.
        cepstrum = np.fft.irfft(np.log(self.beside_white(frequency, sample_time_s)), _CIRCLE)[:count]
        pulse = np.zeros(count)
        pulse[0] = math.exp(0.5 * cepstrum[0])
        weighted = np.arange(count) * cepstrum
        for n in range(1, count):
            pulse[n] = weighted[1 : n + 1] @ pulse[n - 1 :: -1] / n
        return pulse
