"""The stable response Q of the command to the force signal as a sum, and the controller that has it.

Every controller C that is stable in contact with a stable plant −N has one stable Q = C/(1 + N C), and every stable Q
has one C = Q/(1 − N Q) (Youla, Jabr and Bongiorno 1976; Boyd and Barratt 1991): all that the loop does in contact is
affine in Q. Q is a sum of delayed pulses (a finite impulse response), of a few real exponentials, and of what a given
design has.
"""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import block_diag

from problems.arrays import ComplexArray, FloatArray
from problems.model.linear_controllers import LinearController
from problems.model.sampled import SampledLoop

from .signals import OpenPlant

# Commands are micrometres per newton: coefficients near 1.
_SCALE_M_PER_N = 1e-6


@dataclass(frozen=True, kw_only=True, eq=False)
class YoulaBasis:
    """Q = Σ_j θ_j Q_j, each a state-space system of one input, the force signal, and one output, the command.

    `taps` delayed pulses come first, then the exponentials with `decays` (e^(−h/τ) each), then the design's own Q, the
    `loop` from F^d to x^d in contact.
    """

    taps: int
    decays: FloatArray
    loop: SampledLoop

    @property
    def count(self) -> int:
        """The number of coefficients θ."""
        return self.taps + len(self.decays) + 1

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
        out, k = np.zeros((ticks, self.count)), np.arange(ticks)
        same = min(ticks, self.taps)
        out[:same, :same] = np.eye(same)
        out[:, self.taps : -1] = self.decays[None, :] ** k[:, None]
        out[:, -1] = self._own_pulse(ticks) / self._own_scale
        return _SCALE_M_PER_N * out

    def response(self, z: ComplexArray) -> ComplexArray:
        """Return every Q_j [m/N] at the points `z` (k,): (k, count)."""
        out = np.empty((len(z), self.count), dtype=np.complex128)
        out[:, : self.taps] = z[:, None] ** -np.arange(self.taps)
        out[:, self.taps : -1] = 1.0 / (1.0 - self.decays[None, :] / z[:, None])
        loop = self.loop
        states = np.linalg.solve(z[:, None, None] * np.eye(len(loop.a)) - loop.a, loop.b[:, None])[..., 0]
        out[:, -1] = (states @ loop.c_command + loop.d_command) / self._own_scale
        return _SCALE_M_PER_N * out

    def at_rest(self) -> tuple[FloatArray, FloatArray]:
        """Return Q_j(1) and dQ_j/dz at z = 1, each (count,)."""
        loop, taps = self.loop, np.arange(self.taps)
        away = np.eye(len(loop.a)) - loop.a
        once = np.linalg.solve(away, loop.b)
        twice = np.linalg.solve(away, once)
        share = 1.0 / (1.0 - self.decays)
        value = np.concatenate(
            [np.ones(self.taps), share, [(loop.c_command @ once + loop.d_command) / self._own_scale]]
        )
        slope = np.concatenate([-taps, -self.decays * share**2, [-(loop.c_command @ twice) / self._own_scale]])
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
        pulses, slow, own = scaled[: self.taps], scaled[self.taps : -1], scaled[-1] / self._own_scale
        first = np.zeros(self.taps - 1)
        first[0] = 1.0
        a = block_diag(np.eye(self.taps - 1, k=-1), np.diag(self.decays), loop.a)
        b = np.concatenate([first, ones, loop.b])
        c = np.concatenate([pulses[1:], slow * self.decays, own * loop.c_command])
        return a, b, c, float(pulses[0] + np.sum(slow) + own * loop.d_command)
