"""The stable response Q of the command to the force signal as a sum, and the controller that has it.

Every controller C that is stable in contact with a stable plant −N has one stable Q = C/(1 + N C), and every stable Q
has one C = Q/(1 − N Q) (Youla, Jabr and Bongiorno 1976; Boyd and Barratt 1991): all that the loop does in contact is
affine in Q. Q is a finite impulse response (straight between knots that lie further apart later on), a few real
exponentials, and what a given design has.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.linalg import block_diag

from problems.arrays import ComplexArray, FloatArray
from problems.model.linear_controllers import LinearController
from problems.model.sampled import SampledLoop

from .signals import OpenPlant

# Ticks up to which the knots of the finite response are so many ticks apart, and beyond.
_SPACING, _LAST_SPACING = ((24, 1), (60, 2)), 4
# Commands are micrometres per newton: coefficients near 1.
_SCALE_M_PER_N = 1e-6


@dataclass(frozen=True, kw_only=True, eq=False)
class YoulaBasis:
    """Q = Σ_j θ_j Q_j, each a state-space system of one input, the force signal, and one output, the command.

    A finite response of `taps` ticks comes first, by its values at the knots, then the exponentials with `decays`
    (e^(−h/τ) each), then the design's own Q, the `loop` from F^d to x^d in contact.
    """

    taps: int
    decays: FloatArray
    loop: SampledLoop

    @property
    def count(self) -> int:
        """The number of coefficients θ."""
        return int(self._knots.shape[1]) + len(self.decays) + 1

    @cached_property
    def _knots(self) -> FloatArray:
        """What one at each knot, and zero at the others, is at the ticks (taps, knots)."""
        knots, tick = list[int](), 0
        while tick < self.taps - 1:
            knots.append(tick)
            tick += next((step for end, step in _SPACING if tick < end), _LAST_SPACING)
        knots.append(self.taps - 1)
        ticks = np.arange(self.taps)
        return np.column_stack([np.interp(ticks, knots, row) for row in np.eye(len(knots))])

    @property
    def _own_scale(self) -> float:
        return float(np.max(np.abs(self._own_pulse(self.taps))))

    def start(self) -> FloatArray:
        """Return the coefficients (count,) of the design."""
        theta = np.zeros(self.count)
        theta[-1] = self._own_scale / _SCALE_M_PER_N
        return theta

    def _own_pulse(self, ticks: int) -> FloatArray:
        out, state = np.empty(ticks), self.loop.b
        out[0] = self.loop.d_command
        for k in range(1, ticks):
            out[k] = self.loop.c_command @ state
            state = self.loop.a @ state
        return out

    def pulses(self, ticks: int) -> FloatArray:
        """Return the impulse responses [m/N] of every Q_j (ticks, count)."""
        out, k, n = np.zeros((ticks, self.count)), np.arange(ticks), self._knots.shape[1]
        out[: self.taps, :n] = self._knots[:ticks]
        out[:, n:-1] = self.decays[None, :] ** k[:, None]
        out[:, -1] = self._own_pulse(ticks) / self._own_scale
        return _SCALE_M_PER_N * out

    def response(self, z: ComplexArray) -> ComplexArray:
        """Return every Q_j [m/N] at the points `z` (k,): (k, count)."""
        out, n = np.empty((len(z), self.count), dtype=np.complex128), self._knots.shape[1]
        out[:, :n] = z[:, None] ** -np.arange(self.taps) @ self._knots
        out[:, n:-1] = 1.0 / (1.0 - self.decays[None, :] / z[:, None])
        loop = self.loop
        states = np.linalg.solve(z[:, None, None] * np.eye(len(loop.a)) - loop.a, loop.b[:, None])[..., 0]
        out[:, -1] = (states @ loop.c_command + loop.d_command) / self._own_scale
        return _SCALE_M_PER_N * out

    def at_rest(self) -> tuple[FloatArray, FloatArray]:
        """Return Q_j(1) and dQ_j/dz at z = 1, each (count,)."""
        loop = self.loop
        away = np.eye(len(loop.a)) - loop.a
        once = np.linalg.solve(away, loop.b)
        twice = np.linalg.solve(away, once)
        share = 1.0 / (1.0 - self.decays)
        value = np.concatenate(
            [np.sum(self._knots, axis=0), share, [(loop.c_command @ once + loop.d_command) / self._own_scale]]
        )
        pulses = -np.arange(self.taps) @ self._knots
        slope = np.concatenate([pulses, -self.decays * share**2, [-(loop.c_command @ twice) / self._own_scale]])
        return _SCALE_M_PER_N * value, _SCALE_M_PER_N * slope

    def controller(self, theta: FloatArray, plant: OpenPlant, sample_time_s: float) -> LinearController:
        """Return C = Q/(1 − N Q), a law of the force alone that holds Q and a model of the `plant` in contact.

        Q must have N Q = 1 at z = 1, so that C integrates; raises ParameterError where it has not.
        """
        a, b, c, d = self._states(theta)
        # x^d = Q w with w = e − F of the model; a direct share of both is solved for.
        share = 1.0 / (1.0 + d * plant.d)
        n, m = len(a), len(plant.a)
        rows = np.zeros((n + m + 1, n + m + 2))
        command = rows[-1]
        command[:n], command[n : n + m], command[n + m] = share * c, -share * d * plant.c, share * d
        signal = -plant.d * command
        signal[n : n + m] -= plant.c
        signal[n + m] += 1.0
        rows[:n] = np.outer(b, signal)
        rows[:n, :n] += a
        rows[n:-1] = np.outer(plant.b, command)
        rows[n:-1, n : n + m] += plant.a
        # At rest at one metre the model shows what the plant would, and Q is driven by the opposite of it.
        model = np.linalg.solve(np.eye(m) - plant.a, plant.b)
        driven = np.linalg.solve(np.eye(n) - a, b) * -(plant.c @ model + plant.d)
        rest = np.concatenate([driven, model])
        # In units in which nothing at rest is large, so that no digits are lost beside the integrator.
        scale = np.maximum(np.abs(rest), 1.0)
        rows[:-1] /= scale[:, None]
        rows[:, :-2] *= scale
        return LinearController(matrix=rows, rest=rest / scale, sample_time_s=sample_time_s)

    def _states(self, theta: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, float]:
        """Return Q as one system (a, b, c, d) from the force signal to the command."""
        scaled, loop, ones = _SCALE_M_PER_N * theta, self.loop, np.ones(len(self.decays))
        n = self._knots.shape[1]
        pulses, slow, own = self._knots @ scaled[:n], scaled[n:-1], scaled[-1] / self._own_scale
        first = np.zeros(self.taps - 1)
        first[0] = 1.0
        a = block_diag(np.eye(self.taps - 1, k=-1), np.diag(self.decays), loop.a)
        b = np.concatenate([first, ones, loop.b])
        c = np.concatenate([pulses[1:], slow * self.decays, own * loop.c_command])
        return a, b, c, float(pulses[0] + np.sum(slow) + own * loop.d_command)
