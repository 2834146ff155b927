"""A payload of which a part may swing on a coupling with dry friction, in steps of 25 µs under a flange that sweeps."""

from dataclasses import dataclass

import numpy as np
from scipy.signal import lfilter

from problems.arrays import FloatArray
from problems.compiled import compiled

PERIOD_S, FINER = 1e-3, 40
STIFFNESS, DAMPING, DRAG, MASS = 3e5, 140.0, 120.0, 14.0


@compiled
def _rubbed_and_swung(
    x: FloatArray, v: FloatArray, dt: float, numbers: tuple[float, float, float, float, float]
) -> FloatArray:
    """Return the coupling's force (n,) for a flange at x with the speed v."""
    heavy, light, k_2, b_2, friction = numbers
    x_p = x_2 = x[0]
    v_p = v_2 = 0.0
    out = np.empty(len(x))
    for i in range(len(x)):
        slip = v_p - v[i]
        elastic = STIFFNESS * (x_p - x[i]) + DAMPING * slip
        pulled = k_2 * (x_2 - x_p) + b_2 * (v_2 - v_p)
        # What would bring the coupling to rest in this step, and no more than friction can.
        stop = heavy * slip / dt - elastic - DRAG * v_p + pulled
        rubbed = min(max(stop, -friction), friction)
        out[i] = elastic + rubbed
        v_p += dt * (pulled - elastic - rubbed - DRAG * v_p) / heavy
        v_2 -= dt * pulled / light if light > 0.0 else 0.0
        x_p, x_2 = x_p + dt * v_p, x_2 + dt * v_2
    return out


@dataclass(frozen=True, kw_only=True)
class Cell:
    """Payload on a spring with a part of it on another, and Coulomb friction beside the first, in steps of 25 µs."""

    share: float = 0.0
    part_hz: float = 38.0
    ratio: float = 0.03
    friction_n: float = 0.0
    filter_hz: float | None = None

    def run(self, x: FloatArray) -> FloatArray:
        """Return the coupling's force (n,) under a flange's path given FINER times a sample, semi-implicit Euler."""
        dt, v = PERIOD_S / FINER, np.gradient(x, PERIOD_S / FINER)
        light, heavy = self.share * MASS, (1.0 - self.share) * MASS
        k_2 = light * (2.0 * np.pi * self.part_hz) ** 2
        b_2 = 2.0 * self.ratio * 2.0 * np.pi * self.part_hz * light
        out = _rubbed_and_swung(x, v, dt, (heavy, light, k_2, b_2, self.friction_n))
        if self.filter_hz is None:
            return out
        kept = float(np.exp(-2.0 * np.pi * self.filter_hz * dt))
        return np.asarray(lfilter([1.0 - kept], [1.0, -kept], out))


def sweep(duration_s: float = 9.0, rest_s: float = 2.0) -> FloatArray:
    """Return a sweep of the flange from 0.5 to 55 Hz between two rests, FINER times a sample."""
    t = np.arange(0.0, duration_s, PERIOD_S / FINER)
    rate = np.log(110.0) / duration_s
    frequency = 0.5 * np.exp(rate * t)
    edge = np.clip(np.minimum(t, duration_s - t) / 0.4, 0.0, 1.0)
    way = 0.012 / (2.0 * np.pi * frequency) * edge**2 * (3.0 - 2.0 * edge)
    rest = np.zeros(round(rest_s / PERIOD_S) * FINER)
    return np.concatenate([rest, way * np.sin(2.0 * np.pi * 0.5 * (np.exp(rate * t) - 1.0) / rate), rest])
