"""Spans of the log that one payload on one spring explains, and the force that the model predicts there."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .joint_force_kernel import Law, run_force
from .joint_kernel import TINY, returns_at_once
from .joint_model import Array, Layout, body, held, payload_step, robot_rate, swing_step
from .joint_path import Cut, FlangePath

FloatArray = NDArray[np.float64]

_NO_SURFACE = (0.0, 0.0, 0.0)
_OFFSET = 2
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
    law = _law(values, nuisance, segment, cut, layout, path.robot, path.hold.fraction, period_s)
    nothing = np.empty((0, *cut.drive.shape)), np.empty((0, *cut.ends.shape))
    none = _joined([], law)
    ways = cut.drive, cut.ends
    force = run_force(law, none, ways, nothing, np.empty(0, dtype=np.intp), sign, segment.is_contact)
    return np.asarray(sign * force[0] + nuisance[_OFFSET])


def _law(
    values: Sequence[complex] | FloatArray,
    nuisance: Sequence[complex] | FloatArray,
    segment: Segment,
    cut: Cut,
    layout: Layout,
    robot: Array | None,
    fraction: complex,
    period_s: float,
) -> tuple[Array, Array, Array, Array, Array]:
    """Return what `run_force` is moved by; one parameter may be complex, the path apart."""
    sign = segment.sign
    surface = values[layout.surface(segment.surface)] if segment.is_contact else _NO_SURFACE
    of = body(values[:4], surface, period_s)
    wall = sign * nuisance[3] if segment.is_contact else sign * cut.ends[0, 0]
    x, v = sign * cut.ends[0, 0] - wall + nuisance[0] / of[0], sign * cut.ends[0, 1] + nuisance[1] / of[0]
    free = payload_step(of, robot, fraction, touching=False)
    touched = payload_step(of, robot, fraction, touching=True) if segment.is_contact else free
    swing = swing_step(of, back_at_once=not segment.is_contact or returns_at_once(of))
    return np.stack([free[0], touched[0]]), np.stack([free[1], touched[1]]), swing, np.array(of), np.array([wall, x, v])


def shared_indices(segment: Segment, layout: Layout, *, through_robot: bool) -> NDArray[np.intp]:
    """Return which shared parameters a segment's force depends on."""
    robot = np.arange(layout.robot.start, layout.robot.stop if through_robot else layout.robot.start)
    surface = np.arange(*layout.surface(segment.surface).indices(len(layout))) if segment.is_contact else np.empty(0)
    return np.concatenate([np.arange(4), robot, surface]).astype(np.intp)


def force_jacobian(
    values: FloatArray,
    nuisance: FloatArray,
    segment: Segment,
    path: FlangePath,
    path_slopes: Callable[[int], FlangePath],
    indices: NDArray[np.intp],
    layout: Layout,
    period_s: float,
) -> tuple[FloatArray, FloatArray]:
    """Return the prediction (n,) and its derivatives (p, n) by the shared parameters `indices`, then its nuisances.

    Exact to rounding: the matrices of a sample are differentiated by complex steps, the ticks' states along with
    themselves (`run_force`). `path_slopes(i)` is the derivative of the flange's path by parameter i of the robot. A
    bounce that begins or ends at a tick, and the delay at whole samples, have a derivative on each side of them: a bounce
    has that of what happens here, the delay that of a longer one.
    """
    cut, sign = path.cut(segment.slice), float(segment.sign)
    robot = range(layout.robot.start, layout.robot.stop)
    through = [i for i in indices.tolist() if i in robot]
    cuts = [path_slopes(i).cut(segment.slice) for i in through]
    free = [i for i in range(segment.nuisance_count) if i != _OFFSET]

    def turned(shared: int | None, own: int | None) -> tuple[Array, ...]:
        here = [complex(v, TINY if i == shared else 0.0) for i, v in enumerate(values)]
        mine = [complex(v, TINY if i == own else 0.0) for i, v in enumerate(nuisance)]
        rows, fraction = path.robot, path.hold.fraction
        if shared in through:
            rows, fraction = robot_rate(here[layout.robot], period_s), held(here[robot.stop - 1], period_s).fraction
        return _law(here, mine, segment, cut, layout, rows, fraction, period_s)

    law = _law(values, nuisance, segment, cut, layout, path.robot, path.hold.fraction, period_s)
    turns = [turned(i, None) for i in indices.tolist()] + [turned(None, i) for i in free]
    slopes = _joined(turns, law)
    where = np.flatnonzero(np.isin(indices, through))
    for at, moved in zip(where, cuts, strict=True):
        # The payload starts on the flange; in free motion all is counted from there, too.
        wall = 0.0 if segment.is_contact else sign * moved.ends[0, 0]
        slopes[4][:, at] += wall, sign * moved.ends[0, 0] - wall, sign * moved.ends[0, 1]
    ways = _path_slopes(cut, cuts, 0 if path.robot is None else len(path.robot))
    found = run_force(law, slopes, (cut.drive, cut.ends), ways, where, sign, segment.is_contact)
    rows = np.insert(sign * found[1:], len(indices) + _OFFSET, 1.0, axis=0)
    return np.asarray(sign * found[0] + nuisance[_OFFSET]), rows


def _joined(turns: Sequence[tuple[Array, ...]], law: tuple[Array, ...]) -> Law:
    """Return the derivatives of a law by each parameter that was turned, their last axis."""
    parts = [np.empty((*each.shape, len(turns))) for each in law]
    for i, turn in enumerate(turns):
        for part, each in zip(parts, turn, strict=True):
            part[..., i] = each.imag / TINY
    return parts[0], parts[1], parts[2], parts[3], parts[4]


def _path_slopes(cut: Cut, cuts: Sequence[Cut], order: int) -> tuple[FloatArray, FloatArray]:
    """Return the derivatives of drive (r, n, m) and ends (r, n, 4); the commands have none.

    A cut of `joint_path.path_slope` drives with (s', s, commands, rest).
    """
    drive, ends = np.zeros((len(cuts), *cut.drive.shape)), np.empty((len(cuts), *cut.ends.shape))
    for i, each in enumerate(cuts):
        drive[i, :, :order], drive[i, :, -4:] = each.drive[:, :order], each.drive[:, -4:]
        ends[i] = each.ends
    return drive, ends
