"""Force of a payload in free motion of which a part swings on the rest.

    M (1 − μ) dv_p/dt = −F − B_p v_p + F_2,   M μ dv_2/dt = −F_2,   F_2 = M μ (ω² (x_2 − x_p) + 2 ζ ω (v_2 − v_p)),
    F = K_s (x_p − x) + B_s (v_p − v), and beside it the dry friction of `rubbing_coupling`,

M as gravity shows it, x the flange's path between the ticks as in `model.payload_step`. Time is counted in samples.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.linalg import expm

from problems.arrays import FloatArray
from problems.compiled import compiled

from .force_kernel import V, X
from .kernel import PAYLOAD, SPEED
from .path import FlangePath

TAYLOR = 4
_FACTORIALS = np.array([1.0, 1.0, 2.0, 6.0])
# Own parameters of a span: the payload's offset and speed at first and the force's offset, then those of the part.
OWN, OWN_WITH_PART = 3, 5


@dataclass(frozen=True, kw_only=True)
class Extension:
    """What a payload has beside one mass on one spring: a part with a share of its mass, and friction F_c [N].

    The part swings freely at `frequency_hz`, 0 without one; κ and τ of friction's law are `prompt` and
    `stopping_s`.
    """

    mass_share: float = 0.0
    frequency_hz: float = 0.0
    damping_ratio: float = 0.0
    friction_n: float = 0.0
    prompt: float = 1.0
    stopping_s: float = 0.0

    @property
    def own_count(self) -> int:
        """Return how many parameters of its own a span has."""
        return OWN_WITH_PART if self.frequency_hz > 0.0 else OWN


class _Motion(NamedTuple):
    """One sample's step: `phi` (m, m) and `gamma` (m, k); K_s and B_s over a sample."""

    phi: FloatArray
    gamma: FloatArray
    k_s: float
    b_s: float


@compiled
def run_extended(motion: _Motion, drive: FloatArray, ends: FloatArray, start: FloatArray) -> FloatArray:
    """Return F (n,) at every tick under p_(k+1) = phi p_k + gamma drive_k.

    `drive` (n, k) and `ends` (n, 4) are those of a `PathSegment`, `start` p_0 (m,), positions against the first.
    """
    phi, gamma = motion.phi, motion.gamma
    count, width, size = drive.shape[0], drive.shape[1], len(start)
    force, now, following = np.empty(count), start.copy(), start.copy()
    origin = 0.0
    for k in range(count):
        x, v = ends[k, X], ends[k, V]
        if k == 0:
            origin = x
        force[k] = motion.k_s * (now[PAYLOAD] - x + origin) + motion.b_s * (now[SPEED] - v)
        for i in range(size):
            total = -origin * gamma[i, width - TAYLOR]
            for j in range(width):
                total += gamma[i, j] * drive[k, j]
            for j in range(size):
                total += phi[i, j] * now[j]
            following[i] = total
        for i in range(size):
            now[i] = following[i]
    return force


@compiled
def run_undriven(motion: _Motion, start: FloatArray, count: int) -> FloatArray:
    """Return F (n,) of a payload that is left to itself beside a flange at rest in 0."""
    phi, size = motion.phi, len(start)
    force, now, following = np.empty(count), start.copy(), start.copy()
    for k in range(count):
        force[k] = motion.k_s * now[PAYLOAD] + motion.b_s * now[SPEED]
        for i in range(size):
            total = 0.0
            for j in range(size):
                total += phi[i, j] * now[j]
            following[i] = total
        for i in range(size):
            now[i] = following[i]
    return force


def extended_step(
    coupling: Sequence[float] | FloatArray,
    extension: Extension,
    robot: FloatArray | None,
    fraction: float,
    period_s: float,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return phi (m, m), gamma (m, k) and what a friction of 1 N does (m,), over one sample, exactly.

    `coupling` is K_s, B_s, B_p, M_p (4,); `robot` and `fraction` are those of a `FlangePath`; gamma acts on its drive.
    """
    units = np.array([1.0, period_s, period_s, period_s**2])
    k_s, b_s, b_p, whole_mass = (np.asarray(coupling) / units).tolist()
    mass = whole_mass * (1.0 - extension.mass_share)
    order, size = 0 if robot is None else len(robot), 4 if extension.frequency_hz > 0.0 else 2
    held, rest = size + order, size + order + (1 if order else 0)
    a = np.zeros((rest + TAYLOR + 1, rest + TAYLOR + 1))
    a[0, 1] = 1.0
    a[1, :2] = -k_s / mass, -(b_s + b_p) / mass
    if size == 4:
        omega = 2.0 * np.pi * extension.frequency_hz * period_s
        spring = np.array([omega**2, 2.0 * extension.damping_ratio * omega, -(omega**2)])
        pulled = np.append(spring, -spring[1])
        a[2, 3] = 1.0
        a[3, :4] = pulled
        a[1, :4] -= extension.mass_share / (1.0 - extension.mass_share) * pulled
    a[1, rest : rest + 2] = k_s / mass, b_s / mass
    a[rest : rest + 3, rest + 1 : rest + 4] = np.eye(3)
    a[1, -1] = -1.0 / mass
    if robot is None:
        whole = expm(a)[:size]
        return whole[:, :size].copy(), whole[:, rest:-1] * _FACTORIALS, whole[:, -1].copy()
    a[size:held, size : held + 1] = robot
    a[1, size] += k_s / mass
    a[1, size : held + 1] += b_s / mass * robot[0]
    first, second = expm(a * fraction), expm(a * (1.0 - fraction))
    carry = second[:size].copy()
    carry[:, held] = 0.0
    whole = carry @ first
    columns = whole[:, size:held], whole[:, held], second[:size, held], whole[:, rest:-1] * _FACTORIALS
    return whole[:, :size].copy(), np.column_stack(columns), whole[:, -1].copy()


def extended_force(
    coupling: FloatArray, extension: Extension, own: FloatArray, path: FlangePath, used: slice, period_s: float
) -> FloatArray:
    """Return F (n,) [N] of a span in free motion, without friction.

    `own` (`extension.own_count`,) is the payload's offset and speed against the flange at first, counted in N of the
    coupling, the force's offset [N], and the part's offset and speed against the payload in the same way.
    """
    cut, motion = path.cut(used), _motion(coupling, extension, path, period_s)
    start = first_state(own, motion.k_s, len(motion.phi))
    start[SPEED::2] += cut.ends[0, 1]
    return np.asarray(run_extended(motion, cut.drive, cut.ends, start) + own[2])


def own_forces(
    coupling: FloatArray, extension: Extension, path: FlangePath, used: slice, period_s: float
) -> FloatArray:
    """Return what each of a span's own parameters adds to F (own, n) per unit; F is linear in them."""
    motion, count = _motion(coupling, extension, path, period_s), used.stop - used.start
    units = np.eye(extension.own_count)
    return np.array(
        [run_undriven(motion, first_state(unit, motion.k_s, len(motion.phi)), count) + unit[2] for unit in units]
    )


def _motion(coupling: FloatArray, extension: Extension, path: FlangePath, period_s: float) -> _Motion:
    """Return what happens over one sample."""
    robot = None if path.robot is None else np.asarray(path.robot.real)
    phi, gamma, _ = extended_step(coupling, extension, robot, float(path.hold.fraction.real), period_s)
    arrays = np.ascontiguousarray(phi), np.ascontiguousarray(gamma)
    return _Motion(*arrays, float(coupling[0]), float(coupling[1]) / period_s)


def first_state(own: FloatArray, k_s: float, size: int) -> FloatArray:
    """Return the state (size,) at a span's beginning against a flange at rest in 0."""
    start = own[:2] / k_s
    return start if size == 2 else np.concatenate([start, start + own[OWN:] / k_s])
