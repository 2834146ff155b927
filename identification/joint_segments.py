"""Spans of the log that one payload on one spring explains, and the force that the model predicts there."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from .joint_kernel import returns_at_once, run_contact, run_free
from .joint_model import Layout, body, payload_step, swing_step
from .joint_path import FlangePath

FloatArray = NDArray[np.float64]

_NO_SURFACE = np.zeros(3)
_STEP_SHARE = 1e-6
_OWN_SIZES = (1.0, 1.0, 1.0, 1e-3)
_OFFSET = 2
_DOMINATED = 0.2
FREE = -1


@dataclass(frozen=True, kw_only=True)
class Segment:
    """Samples `start` up to `stop`; `surface` is what is touched on the way, `FREE` for nothing.

    `sign` is +1 when pressing towards +axis. Nuisance parameters: the payload's offset and speed against the flange
    at the start, counted in N of the coupling, the force's offset [N], and the wall's place x_w [m] in a contact.
    """

    start: int
    stop: int
    surface: int = FREE
    sign: int = 1

    @property
    def slice(self) -> slice:
        """The samples as an index."""
        return slice(self.start, self.stop)

    @property
    def is_contact(self) -> bool:
        """Whether something is touched."""
        return self.surface != FREE

    @property
    def nuisance_count(self) -> int:
        """Parameters that only this span has."""
        return 4 if self.is_contact else 3

    def __len__(self) -> int:
        return self.stop - self.start


def predict_force(
    values: FloatArray, nuisance: FloatArray, segment: Segment, path: FlangePath, layout: Layout, period_s: float
) -> FloatArray:
    """Return F (n,) of a segment; `values` as `Layout` orders them, `nuisance` as `Segment` does.

    F = K_s (x_p − x) + B_s (v_p − v) + offset, with F_e = M_e dv_p/dt + B_e v_p + K_e (x_p − x_w) ≥ 0 in contact.
    """
    cut, sign = path.cut(segment.slice), float(segment.sign)
    surface = values[layout.surface(segment.surface)] if segment.is_contact else _NO_SURFACE
    of = body(values[:4], surface, period_s)
    wall = float(sign * nuisance[3] if segment.is_contact else cut.ends[0, 0])
    x, v = sign * float(cut.ends[0, 0]) - wall, sign * float(cut.ends[0, 1])
    start, place = (x + float(nuisance[0]) / of[0], v + float(nuisance[1]) / of[0]), (sign, wall)
    phi, gamma = payload_step(of, path.robot, path.hold.fraction, touching=False)
    if segment.is_contact:
        touched = payload_step(of, path.robot, path.hold.fraction, touching=True)
        swing = swing_step(of, back_at_once=returns_at_once(of))
        modes = np.stack([phi, touched[0]]), np.stack([gamma, touched[1]])
        force = run_contact(*modes, swing, cut.drive, cut.ends, of, place, start)
    else:
        force = run_free(phi, gamma, cut.drive, cut.ends, of, place, start)
    return np.asarray(sign * force + nuisance[2])


def shared_indices(segment: Segment, layout: Layout, *, through_robot: bool) -> NDArray[np.intp]:
    """Return which shared parameters a segment's force depends on."""
    robot = np.arange(layout.robot.start, layout.robot.stop if through_robot else layout.robot.start)
    surface = np.arange(*layout.surface(segment.surface).indices(len(layout))) if segment.is_contact else np.empty(0)
    return np.concatenate([np.arange(4), robot, surface]).astype(np.intp)


def force_jacobian(
    values: FloatArray,
    sizes: FloatArray,
    nuisance: FloatArray,
    segment: Segment,
    paths: Callable[[int, int], FlangePath],
    indices: NDArray[np.intp],
    layout: Layout,
    period_s: float,
) -> tuple[FloatArray, FloatArray]:
    """Return the prediction (n,) and its derivatives (p, n) by the shared parameters `indices`, then its nuisances.

    One-sided differences of an exact solution: `sizes` are the parameters' units, and the error of a difference is a
    millionth of the curvature. `paths(i, n)` is the flange's path with parameter i moved by n steps. A bounce that
    begins or ends at a tick makes the prediction jump there; a derivative that one sample dominates is therefore taken
    over the next step too, and the smaller one counts, sample by sample.
    """

    def shared(index: int, steps: int) -> FloatArray:
        there = values.copy()
        there[index] += steps * _STEP_SHARE * sizes[index]
        return predict_force(there, nuisance, segment, paths(index, steps), layout, period_s)

    def own(index: int, steps: int) -> FloatArray:
        there = nuisance.copy()
        there[index] += steps * _STEP_SHARE * _OWN_SIZES[index]
        return predict_force(values, there, segment, paths(0, 0), layout, period_s)

    base = predict_force(values, nuisance, segment, paths(0, 0), layout, period_s)
    rows = np.empty((len(indices) + segment.nuisance_count, len(base)))
    for row, i in zip(rows, indices, strict=False):
        row[:] = difference(partial(shared, int(i)), base, _STEP_SHARE * sizes[i])
    for index, row in enumerate(rows[len(indices) :]):
        step = _STEP_SHARE * _OWN_SIZES[index]
        row[:] = 1.0 if index == _OFFSET else difference(partial(own, index), base, step)
    return base, rows


def difference(predicted: Callable[[int], FloatArray], base: FloatArray, step: float) -> FloatArray:
    """Return the slope of what 1 and 2 steps predict, a jump in a few samples left out (see `force_jacobian`)."""
    once = predicted(1)
    slope = (once - base) / step
    return _smaller(slope, (predicted(2) - once) / step) if _is_jump(slope) else slope


def _is_jump(slope: FloatArray) -> bool:
    square = slope * slope
    return bool(np.max(square) > _DOMINATED * np.sum(square))


def _smaller(first: FloatArray, second: FloatArray) -> FloatArray:
    return np.where(np.abs(first) <= np.abs(second), first, second)


def robot_step(sizes: FloatArray, index: int) -> float:
    """Return by how much a robot parameter is moved for its derivative."""
    return _STEP_SHARE * float(sizes[index])
