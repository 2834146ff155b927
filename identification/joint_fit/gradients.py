"""Derivatives of a span's predicted force by every parameter, exact to rounding."""

from collections.abc import Callable
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from problems.arrays import FloatArray

from .force_kernel import OFF, ON, TURNS, carry_contact, carry_free
from .kernel import TINY
from .model import ParameterLayout, body, held, robot_rate
from .path import FlangePath, PathSegment
from .segments import OFFSET, Run, Segment, SegmentModel, run, segment_model, steps_of, surface_of

_COUPLING = 4


def force_jacobian(
    values: FloatArray,
    nuisance: FloatArray,
    segment: Segment,
    path: FlangePath,
    path_gradients: Callable[[int], FlangePath],
    indices: NDArray[np.intp],
    layout: ParameterLayout,
    period_s: float,
) -> tuple[FloatArray, FloatArray]:
    """Return the prediction (n,) and its derivatives (p, n) by the shared parameters `indices`, then its nuisances.

    Nothing is a difference: the matrices of a sample are differentiated by complex steps (`model`), and a slope
    follows x'_(k+1) = phi x'_k + phi' x_k + gamma' w_k + gamma w'_k. The moment of a touch or release moves with the
    parameters, too (`switch_along`). `path_gradients(i)` is the derivative of the flange's path by parameter i, a
    robot's.

    Where the force has a corner there are two derivatives, and the one is taken that belongs to the run as it is: a
    bounce that begins or ends just at a tick; M_e = 0, by a larger one; a delay of whole samples, by a longer one.
    """
    cut, robot = path.cut(segment.slice), range(layout.robot.start, layout.robot.stop)
    # The first are those of the coupling, and a surface's are the last.
    moved = [path_gradients(i).cut(segment.slice) for i in indices.tolist() if i in robot]
    law = segment_model(values, nuisance, segment, path, layout, period_s)
    derivatives = step_derivatives(values, segment, path, layout, period_s, moves_robot=bool(moved))
    found = run(law, cut, segment)
    gradients = _carried(
        law, derivatives, cut, moved, found, segment, _places(law, nuisance, moved, segment, len(indices))
    )
    rows = np.empty((len(indices) + segment.nuisance_count, len(segment)))
    rows[len(indices) + OFFSET] = 1.0
    kept = np.arange(len(rows)) != len(indices) + OFFSET
    rows[kept] = segment.sign * gradients.T
    return np.asarray(segment.sign * found.force + nuisance[OFFSET]), rows


class StepDerivatives(NamedTuple):
    """The derivatives of a law by its parameters, which come last: the span's own ones, at the end, have none.

    `steps` (2, 2 + m, 2, p) are those of phi and gamma side by side, transposed, in free motion and contact; `swing`
    (2, 2, p); `body` (7, p).
    """

    steps: FloatArray
    swing: FloatArray
    body: FloatArray


def step_derivatives(
    values: FloatArray,
    segment: Segment,
    path: FlangePath,
    layout: ParameterLayout,
    period_s: float,
    *,
    moves_robot: bool,
) -> StepDerivatives:
    """Return the derivatives of a segment's law, those by the robot only if it moves, one complex step for each."""
    return _step_derivatives(
        tuple(values[:_COUPLING].tolist()),
        tuple(values[layout.robot].tolist()) if moves_robot else (),
        tuple(surface_of(values, segment, layout).tolist()),
        None if path.robot is None else tuple(map(tuple, path.robot.tolist())),
        path.hold.fraction.real,
        period_s,
        segment.is_contact,
    )


# All spans in free motion have the same, and all contacts with one surface.
@lru_cache(maxsize=16)
def _step_derivatives(
    coupling: tuple[float, ...],
    robot: tuple[float, ...],
    surface: tuple[float, ...],
    rows: tuple[tuple[float, ...], ...] | None,
    fraction: float,
    period_s: float,
    touches: bool,
) -> StepDerivatives:
    values = (*coupling, *robot, *(surface if touches else ()))
    count, last = len(values) + (3 if touches else 2), _COUPLING + len(robot)
    of_robot = None if rows is None else np.array(rows)
    width = 4 + (0 if of_robot is None else len(of_robot) + 2)
    out = StepDerivatives(np.zeros((2, 2 + width, 2, count)), np.zeros((2, 2, count)), np.zeros((7, count)))
    for i in range(len(values)):
        if of_robot is None and _COUPLING <= i < last:
            continue  # behind a smooth command the robot is in the path alone
        turned = [complex(value, TINY if i == j else 0.0) for j, value in enumerate(values)]
        of = body(turned[:_COUPLING], turned[last:] if touches else surface, period_s)
        rate, held_for = of_robot, complex(fraction)
        if _COUPLING <= i < last:
            rate, held_for = robot_rate(turned[_COUPLING:last], period_s), held(turned[last - 1], period_s).fraction
        phi, gamma, swing = steps_of(of, rate, held_for if held_for.imag else fraction, touches=touches)
        out.steps[:, :2, :, i] = phi.imag.swapaxes(1, 2) / TINY
        out.steps[:, 2:, :, i] = gamma.imag.swapaxes(1, 2) / TINY
        out.swing[..., i], out.body[:, i] = swing.imag / TINY, np.imag(of) / TINY
    for each in out:
        each.setflags(write=False)
    return out


def _places(
    law: SegmentModel, nuisance: FloatArray, moved: list[PathSegment], segment: Segment, shared: int
) -> FloatArray:
    """Return the derivatives of the wall and of the payload's place and velocity at first, (3, p)."""
    out, sign, k_s = np.zeros((3, shared + segment.nuisance_count - 1)), segment.sign, law.body.k_s.real
    out[1:, 0] = -nuisance[:2] / k_s**2
    out[1, shared] = out[2, shared + 1] = 1.0 / k_s
    for i, each in enumerate(moved, _COUPLING):
        # The payload starts on the flange; in free motion all is counted from there as well.
        out[1 if segment.is_contact else 0, i] = sign * each.ends[0, 0]
        out[2, i] = sign * each.ends[0, 1]
    if segment.is_contact:
        out[:2, -1] = sign, -sign
    return out


def _carried(
    law: SegmentModel,
    derivatives: StepDerivatives,
    cut: PathSegment,
    moved: list[PathSegment],
    found: Run,
    segment: Segment,
    places: FloatArray,
) -> FloatArray:
    """Return the derivatives (n, p) of the coupling's force in the direction of pressing."""
    sign, of, start = float(segment.sign), np.array(law.body), places[1:].copy()
    k_s, b_s = float(of[0]), float(of[1])
    pushed = _pushed(law, derivatives, cut, moved, found, sign, places[0])
    from_wall = law.wall * np.array([1.0, 0.0, 1.0, 0.0])
    if segment.is_contact:
        turns = np.flatnonzero(found.modes >= TURNS)
        ends = np.zeros((len(turns), 4, len(places[0])))
        ends[:, ::2] = -places[0]
        for i, each in enumerate(moved, _COUPLING):
            ends[:, :, i] += sign * each.ends[turns]
        way = sign * cut.ends[turns] - from_wall, ends
        swing, bodies = (law.swing, derivatives.swing), (of, derivatives.body)
        out = carry_contact(law.phi, swing, pushed, start, bodies, way, found.states, found.modes)
    else:
        out = carry_free(law.phi[0], pushed, start, k_s, b_s)
    out += (found.states[:, :2] - sign * cut.ends[:, :2] + from_wall[:2]) @ derivatives.body[:2] + k_s * places[0]
    for i, each in enumerate(moved, _COUPLING):
        out[:, i] -= sign * (each.ends[:, :2] @ of[:2])
    return out


def _pushed(
    law: SegmentModel,
    derivatives: StepDerivatives,
    cut: PathSegment,
    moved: list[PathSegment],
    found: Run,
    sign: float,
    walls: FloatArray,
) -> FloatArray:
    """Return what a sample adds to the derivatives of the payload's state, phi' x + gamma' w + gamma w', (n, 2, p)."""
    width, count = cut.drive.shape[1], len(walls)
    place, order = width - 4, max(width - 6, 0)
    seen = np.empty((len(cut.drive), 2 + width))
    seen[:, :2], seen[:, 2:] = found.states[:, :2], sign * cut.drive
    seen[:, 2 + place] -= law.wall
    out = np.empty((len(seen), 2, count))
    modes = found.modes % TURNS
    for mode in (OFF, ON):
        here = np.flatnonzero(modes == mode)
        if len(here) == 0:
            continue
        at: slice | NDArray[np.intp] = slice(None) if len(here) == len(modes) else here
        part = (seen[at] @ derivatives.steps[mode].reshape(2 + width, 2 * count)).reshape(-1, 2, count)
        part -= np.outer(law.gamma[mode, :, place], walls)
        gamma = sign * law.gamma[mode]
        for i, each in enumerate(moved, _COUPLING):
            # Such a cut drives with (s', s, commands, rest); the commands do not move.
            part[:, :, i] += each.drive[at, :order] @ gamma[:, :order].T
            part[:, :, i] += each.drive[at, -4:] @ gamma[:, place:].T
        out[at] = part
    return out
