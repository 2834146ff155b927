"""Signals made from the equations alone, by scipy: no code of the project takes part."""

from dataclasses import dataclass

import numpy as np
from scipy.integrate import solve_ivp
from scipy.interpolate import CubicSpline
from scipy.signal import StateSpace, chirp, lsim
from scipy.spatial.transform import Rotation

from problems.arrays import FloatArray


@dataclass(frozen=True, kw_only=True)
class Load:
    """K_s, B_s, B_p and M_p."""

    stiffness: float = 2.4e5
    damping: float = 120.0
    drag: float = 280.0
    mass: float = 14.0

    def vector(self) -> FloatArray:
        return np.array([self.stiffness, self.damping, self.drag, self.mass])


def ramp(samples: int) -> FloatArray:
    """Minimum jerk from 0 to 1."""
    t = np.linspace(0.0, 1.0, samples)
    return np.asarray(t**3 * (10.0 - 15.0 * t + 6.0 * t * t))


def tapered(samples: int, edge: int) -> FloatArray:
    window = np.ones(samples)
    window[:edge], window[-edge:] = ramp(edge), ramp(edge)[::-1]
    return window


def sweep(duration_s: float, rate_hz: float, *, low_hz: float = 0.5, high_hz: float = 50.0) -> FloatArray:
    """A sweep whose speed grows with frequency [m], from rest to rest, with 0.2 s of rest on both sides."""
    t = np.arange(round(duration_s * rate_hz)) / rate_hz
    frequency = low_hz * (high_hz / low_hz) ** (t / duration_s)
    speed = 0.01 * np.sqrt(1.0 + (frequency / 3.0) ** 2)
    moving = speed / (2.0 * np.pi * frequency) * chirp(t, low_hz, duration_s, high_hz, method="logarithmic", phi=-90.0)
    rest = np.zeros(round(0.2 * rate_hz))
    return np.concatenate([rest, moving * tapered(len(t), len(t) // 15), rest])


def felt_force(position: FloatArray, period_s: float, load: Load, hand: FloatArray | None = None) -> FloatArray:
    """F = K_s (x_p − x) + B_s (v_p − v) with M_p dv_p/dt = −F − B_p v_p + hand, linear between samples."""
    velocity = CubicSpline(np.arange(len(position)) * period_s, position)(np.arange(len(position)) * period_s, 1)
    pushed = np.zeros(len(position)) if hand is None else hand
    k, b, p, m = load.vector()
    system = StateSpace(
        np.array([[0.0, 1.0], [-k / m, -(b + p) / m]]),
        np.array([[0.0, 0.0, 0.0], [k / m, b / m, 1.0 / m]]),
        np.array([[k, b]]),
        np.array([[-k, -b, 0.0]]),
    )
    _, force, _ = lsim(system, np.column_stack([position, velocity, pushed]), np.arange(len(position)) * period_s)
    return np.asarray(force)


@dataclass(frozen=True, kw_only=True)
class Touch:
    """A contact from rest to hold on the clock of the log; pressing is towards +x: F < 0."""

    position_m: FloatArray
    force_n: FloatArray
    hold_start: int


def touch(load: Load, wall_stiffness: float, wall_damping: float, period_s: float, *, depth_m: float) -> Touch:
    """Drive the flange 8 mm up to a wall and `depth_m` further in 0.6 s, hold 0.8 s; scipy integrates the payload."""
    approach, rest = round(0.6 / period_s), round(0.8 / period_s)
    position = np.concatenate(
        [np.zeros(rest), (8e-3 + depth_m) * ramp(approach), np.full(rest, 8e-3 + depth_m)],
    )
    time = np.arange(len(position)) * period_s
    path = CubicSpline(time, position)
    speed = path.derivative()
    k, b, p, m = load.vector()

    def coupling(t: float, state: FloatArray) -> float:
        return float(k * (state[0] - path(t)) + b * (state[1] - speed(t)))

    def motion(t: float, state: FloatArray) -> list[float]:
        depth = state[0] - 8e-3
        wall = max(0.0, wall_stiffness * depth + wall_damping * state[1]) if depth > 0.0 else 0.0
        return [state[1], (-coupling(t, state) - p * state[1] - wall) / m]

    found = solve_ivp(motion, (0.0, time[-1]), [0.0, 0.0], t_eval=time, max_step=period_s, rtol=1e-8, atol=1e-12)
    force = np.array([coupling(t, state) for t, state in zip(time, found.y.T, strict=True)])
    return Touch(position_m=position, force_n=force, hold_start=rest + approach)


def tilted(count: int, largest_rad: float) -> Rotation:
    """Orientations tilted about axes that go round the circle, from a tool that points down."""
    angle = 2.399963 * np.arange(count)
    tilt = largest_rad * (0.5 + 0.5 * np.arange(count) / max(count - 1, 1))
    tilt[0] = 0.0
    turns = np.column_stack([tilt * np.cos(angle), tilt * np.sin(angle), np.zeros(count)])
    return Rotation.from_euler("x", np.pi) * Rotation.from_rotvec(turns)
