"""What the sensor makes of the force: a first-order low-pass, and a shift in time."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from .path import FlangePath

FloatArray = NDArray[np.float64]

_DIED_AWAY, _LONGEST_S = 6.0, 0.1


@dataclass(frozen=True, kw_only=True)
class Lateness:
    """The sensor shows F(t − delay) behind 1/(time_constant s + 1); a delay below zero is early."""

    time_constant_s: float = 0.0
    delay_s: float = 0.0

    def felt(self, forces: FloatArray, period_s: float) -> FloatArray:
        """Return what the sensor shows of forces (…, n) that are smooth between the samples, from rest at the first.

        The low-pass is exact for a force that is straight between samples; the shift is Lagrange's cubic.
        """
        if self.time_constant_s > 0.0:
            forces = low_passed(forces, self.time_constant_s, period_s)
        return forces if self.delay_s == 0.0 else _later(forces, self.delay_s / period_s)

    def shown(self, force: FloatArray, path: FlangePath, used: slice, damping: float, period_s: float) -> FloatArray:
        """Return what the sensor shows of a coupling's force (n,) at the ticks that jumps with a held command.

        A robot of one pole changes its speed with the command at once, `path.hold.fraction` of a sample after a tick,
        and the force with it by −B_s of that. Those steps are held, the rest of the force is smooth.
        """
        if self == Lateness():
            return force
        if path.robot is None or path.robot[0, -1] == 0.0:
            return self.felt(force, period_s)
        drive, order = path.cut(used).drive, len(path.robot)
        step = drive[:, order + 1] - drive[:, order]
        jumps = -damping / period_s * float(path.robot[0, -1].real) * step
        before = np.concatenate([[0.0], np.cumsum(jumps[:-1])])
        fraction = float(path.hold.fraction.real)
        return self.felt(force - before, period_s) + self._held(before, jumps, fraction, period_s)

    def _held(self, before: FloatArray, jumps: FloatArray, fraction: float, period_s: float) -> FloatArray:
        """Return what is shown of a staircase, `before` (n,) at the ticks, that jumps a fraction of a sample later."""
        if self.time_constant_s > 0.0:
            keep = math.exp(-period_s / self.time_constant_s)
            late = 1.0 - math.exp(-(1.0 - fraction) * period_s / self.time_constant_s)
            pushed = np.concatenate([[0.0], (1.0 - keep) * before[:-1] + late * jumps[:-1]])
            shown = np.asarray(lfilter([1.0], [1.0, -keep], pushed))
            return shown if self.delay_s == 0.0 else _later(shown, self.delay_s / period_s)
        ticks = np.arange(len(before)) - self.delay_s / period_s
        whole = np.floor(ticks)
        at = np.clip(whole.astype(np.intp), 0, len(before) - 1)
        return np.asarray(before[at] + np.where(ticks - whole >= fraction, jumps[at], 0.0) * (whole >= 0))

    def unknown(self, period_s: float) -> int:
        """Return how many samples of a span still show what was before it."""
        most = _DIED_AWAY * self.time_constant_s + max(self.delay_s, 0.0)
        return math.ceil(min(most, _LONGEST_S) / period_s)


def low_passed(forces: FloatArray, time_constant_s: float, period_s: float) -> FloatArray:
    """Return forces (…, n) behind 1/(τ s + 1), straight between the samples, steady before the first."""
    share = period_s / time_constant_s
    keep = math.exp(-share)
    newer = 1.0 - (1.0 - keep) / share
    b, a = np.array([newer, 1.0 - keep - newer]), np.array([1.0, -keep])
    # The state that makes the first value stand still.
    state = (b[1] + keep) * forces[..., :1]
    return np.asarray(lfilter(b, a, forces, axis=-1, zi=state)[0])


def _later(forces: FloatArray, samples: float) -> FloatArray:
    """Return forces (…, n) `samples` later; the ends stand still."""
    whole = math.floor(samples)
    u = 1.0 - (samples - whole)  # where between the older sample (0) and the newer one (1)
    weights = (
        -u * (u - 1.0) * (u - 2.0) / 6.0,
        (u + 1.0) * (u - 1.0) * (u - 2.0) / 2.0,
        -(u + 1.0) * u * (u - 2.0) / 2.0,
        (u + 1.0) * u * (u - 1.0) / 6.0,
    )
    last = forces.shape[-1] - 1
    ticks = np.arange(last + 1) - whole - 1
    return np.asarray(sum(weight * forces[..., np.clip(ticks + k - 1, 0, last)] for k, weight in enumerate(weights)))
