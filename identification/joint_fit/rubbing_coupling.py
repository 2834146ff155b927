"""Force of a coupling with dry friction: the payload of `extended_payload` in steps far shorter than a sample.

    F = K_s (x_p − x) + B_s w + f,  w = v_p − v,  f = M (κ a + w/τ), F_c at most,

w being the slip and a what accelerates it without friction. κ = 1 and τ = 0 are Coulomb's law; what gives way before
it slides, as surfaces and regularised laws do, has a longer τ and a smaller κ. As long as f is below F_c, that leaves
dw/dt = (1 − κ) a − w/τ, which is stepped exactly; else f is F_c over the step, as Moreau (1999, Numerical aspects of
the sweeping process) does. When in a sample friction changes its sign decides what it does to a swing of a few samples.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.linalg import expm

from problems.arrays import FloatArray
from problems.compiled import compiled

from .extended_payload import TAYLOR, Extension, extended_step, first_state
from .force_kernel import V_END, V, X
from .kernel import PAYLOAD, SPEED
from .path import FlangePath

_LONGEST_STEP_S = 6.25e-5


@dataclass(frozen=True, kw_only=True)
class FinePath:
    """A span of the flange's path, `count` short steps a sample, time counted in them; else as `PathSegment`.

    `robot` and `fraction` are those of a `FlangePath` at this rate.
    """

    count: int
    drive: FloatArray
    ends: FloatArray
    robot: FloatArray | None
    fraction: float


def fine_path(path: FlangePath, used: slice, period_s: float) -> FinePath:
    """Return the path at the ticks of a span (n,) and between them."""
    cut, count = path.cut(used), max(1, math.ceil(period_s / _LONGEST_STEP_S))
    if path.robot is None:
        drive, fraction, robot = _shifted(cut.drive, count), 0.0, None
        arriving = drive @ np.array([0.0, 1.0, 2.0, 3.0])
        return FinePath(
            count=count, drive=drive, ends=_ends(drive[:, 0], drive[:, 1], arriving), robot=robot, fraction=fraction
        )
    rate, order = np.asarray(path.robot.real), len(path.robot)
    older, newer, rest = cut.drive[:, order], cut.drive[:, order + 1], _shifted(cut.drive[:, order + 2 :], count)
    begun, fraction = divmod(float(path.hold.fraction.real) * count, 1.0)
    generator = np.zeros((order + 1, order + 1))
    generator[:order] = rate / count
    first, second = expm(generator * fraction)[:order], expm(generator * (1.0 - fraction))[:order]
    state, slope = cut.drive[:, :order], generator[0]
    states, commands, speeds = [], [], []
    for step in range(count):
        acting = older if step <= begun else newer, older if step < begun else newer
        now = acting[0] if fraction > 0.0 else acting[1]
        half = state @ first[:, :order].T + np.outer(acting[0], first[:, order])
        following = half @ second[:, :order].T + np.outer(acting[1], second[:, order])
        states.append(state)
        commands.append(np.column_stack(acting))
        speeds.append(
            np.column_stack([each @ slope[:-1] + slope[-1] * c for each, c in ((state, now), (following, acting[1]))])
        )
        state = following
    # A speed is one per short step.
    units = np.array([1.0, 1.0 / count])[:order]
    stacked = _interleaved(states) * units
    speed = _interleaved(speeds)
    position = stacked[:, 0] + rest[:, 0]
    ends = _ends(position, speed[:, 0] + rest[:, 1], speed[:, 1] + rest @ np.array([0.0, 1.0, 2.0, 3.0]))
    fine = generator[:order] * np.append(1.0 / units, 1.0) * units[:, None]
    drive = np.concatenate([stacked, _interleaved(commands), rest], axis=1)
    return FinePath(count=count, drive=drive, ends=ends, robot=fine, fraction=fraction)


def _ends(position: FloatArray, velocity: FloatArray, arriving: FloatArray) -> FloatArray:
    following = np.append(position[1:], position[-1] + velocity[-1])
    return np.column_stack([position, velocity, following, arriving])


def _interleaved(columns: list[FloatArray]) -> FloatArray:
    """Return (n count, m) of `count` times (n, m), step by step within a sample."""
    stacked = np.stack(columns, axis=1)
    return stacked.reshape(-1, stacked.shape[2])


def _shifted(taylor: FloatArray, count: int) -> FloatArray:
    """Return Taylor coefficients (n count, 4) about every short step, of those (n, 4) about every tick."""
    out = []
    for at in np.arange(count) / count:
        c0, c1, c2, c3 = taylor.T
        value = c0 + at * (c1 + at * (c2 + at * c3))
        out.append(
            np.column_stack(
                [value, (c1 + at * (2.0 * c2 + 3.0 * at * c3)) / count, (c2 + 3.0 * at * c3) / count**2, c3 / count**3]
            )
        )
    return _interleaved(out)


class _Rubbing(NamedTuple):
    """One short step: `phi` (m, m), friction `rubbed` (m,) per N; K_s, B_s, and F_c.

    Below that, `keep` of the slip at its beginning and `gain` of what it gains without friction are left.
    """

    phi: FloatArray
    rubbed: FloatArray
    k_s: float
    b_s: float
    limit: float
    keep: float
    gain: float


@compiled
def run_rubbing(motion: _Rubbing, driven: FloatArray, ends: FloatArray, start: FloatArray) -> FloatArray:
    """Return F (n,) right before every short step: p_(k+1) = phi p_k + `driven`_k + rubbed f_k.

    `ends` (n, 4) are those of a `FinePath`; positions, `start` p_0 (m,) too, are counted from the first.
    """
    phi, rubbed, (count, size) = motion.phi, motion.rubbed, driven.shape
    force, now, following = np.empty(count), start.copy(), start.copy()
    friction = origin = 0.0
    for k in range(count):
        for i in range(size):
            total = driven[k, i]
            for j in range(size):
                total += phi[i, j] * now[j]
            following[i] = total
        slip = now[SPEED] - ends[k, V]
        free = following[SPEED] - ends[k, V_END]
        stopping = (motion.keep * slip + motion.gain * (free - slip) - free) / rubbed[SPEED]
        acting = min(max(stopping, -motion.limit), motion.limit)
        if k == 0:
            friction, origin = acting, ends[k, X]
        force[k] = motion.k_s * (now[PAYLOAD] - ends[k, X] + origin) + motion.b_s * slip + friction
        friction = acting
        for i in range(size):
            now[i] = following[i] + rubbed[i] * friction
    return force


def rubbed_force(
    coupling: FloatArray, extension: Extension, own: FloatArray, path: FinePath, period_s: float
) -> FloatArray:
    """Return F (n,) [N] of a span in free motion at every short step; `own` is that of `extended_force`."""
    short_s = period_s / path.count
    steps = extended_step(coupling, extension, path.robot, path.fraction, short_s)
    phi, gamma, rubbed = map(np.ascontiguousarray, steps)
    keep, gain = 0.0, 0.0
    if extension.stopping_s > 0.0:
        share = short_s / extension.stopping_s
        keep = math.exp(-share)
        gain = (1.0 - extension.prompt) * (1.0 - keep) / share
    k_s, b_s = float(coupling[0]), float(coupling[1]) / short_s
    motion = _Rubbing(phi, rubbed, k_s, b_s, extension.friction_n, keep, gain)
    driven = path.drive @ gamma.T - path.ends[0, 0] * gamma[:, -TAYLOR]
    start = first_state(own, k_s, len(phi))
    start[SPEED::2] /= path.count
    start[SPEED::2] += path.ends[0, 1]
    return np.asarray(run_rubbing(motion, driven, path.ends, start) + own[2])
