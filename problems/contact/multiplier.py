"""Multipliers for a contact spring: what a monotone law of force over travel without memory cannot gain from."""

import math
from dataclasses import dataclass

import numpy as np

from .._checks import non_negative
from ..arrays import ComplexArray, FloatArray
from ..errors import ParameterError


@dataclass(frozen=True, kw_only=True)
class Multiplier:
    """M(s) = η s + Σ c (1 − e^{−sτ}) + Σ b s/(s + λ), causal and without a negative coefficient, and κ.

    `rate_s` is η [s], Popov's term; `shifts_s` are the τ [s] and `shift_weights` their c; `fading_per_s` are the
    λ [1/s] and `fading_weights` their b, each a mixture of shifts whose weight decays (Zames and Falb, *SIAM Journal on
    Control* 6(1), 1968; O'Shea, *IEEE Transactions on Automatic Control* 12(6), 1967). M(0) = 0, so that it takes out
    the integrator of free space. `damper_s` is κ [s], the weight of the surface's damper, 0 where there is none.
    Raises ParameterError for a coefficient below 0, a τ or λ that is not above 0, and where no b is above 0.
    """

    rate_s: float
    shifts_s: tuple[float, ...]
    shift_weights: tuple[float, ...]
    fading_per_s: tuple[float, ...]
    fading_weights: tuple[float, ...]
    damper_s: float

    def __post_init__(self) -> None:
        for places, weights in (("shifts_s", "shift_weights"), ("fading_per_s", "fading_weights")):
            where, found = getattr(self, places), getattr(self, weights)
            if not all(0.0 < each < math.inf for each in where):
                raise ParameterError(f"multiplier.{places}", where, "above 0")
            if len(where) != len(found) or not all(0.0 <= each < math.inf for each in found):
                raise ParameterError(f"multiplier.{weights}", found, f"one number from 0 for each of {places}")
        for name in ("rate_s", "damper_s"):
            non_negative(f"multiplier.{name}", getattr(self, name))
        if not sum(self.fading_weights) > 0.0:
            raise ParameterError("multiplier.fading_weights", self.fading_weights, "at least one above 0")

    @property
    def shifts(self) -> tuple[tuple[float, float], ...]:
        """Pairs of τ and c."""
        return tuple(zip(self.shifts_s, self.shift_weights, strict=True))

    @property
    def fading(self) -> tuple[tuple[float, float], ...]:
        """Pairs of λ and b."""
        return tuple(zip(self.fading_per_s, self.fading_weights, strict=True))

    @property
    def weight(self) -> float:
        """A bound of |M(jω) − jωη|: 2 Σ c + Σ b."""
        return 2.0 * sum(self.shift_weights) + sum(self.fading_weights)

    def least_real(self, frequency_rad_per_s: float) -> float:
        """Return a lower bound of Re M from a frequency on: what the fading part has there."""
        square = frequency_rad_per_s**2
        return sum(weight * square / (square + rate**2) for rate, weight in self.fading)

    def response(self, frequency_rad_per_s: FloatArray) -> ComplexArray:
        """Return M(jω) at the frequencies (n,)."""
        s = 1j * np.asarray(frequency_rad_per_s, dtype=np.float64)
        out = self.rate_s * s
        for shift, weight in self.shifts:
            out = out - weight * np.expm1(-s * shift)
        for rate, weight in self.fading:
            out = out + weight * s / (s + rate)
        return np.asarray(out, dtype=np.complex128)
