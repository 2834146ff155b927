"""How far the robot gives way to the payload's force and to dry friction of its joints, beside its answer r(s)."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.linalg import expm

from problems.arrays import FloatArray
from problems.compiled import compiled

from .path import given_way, path_slope
from .solve import Point, Problem, minimise, sizes_of

_ROUNDS, _STEPS, _PIECE_S, _CLEAR_STDS = 4, 4, 0.5, 5.0
# How well each way is known at best: a spring is a spring, but the law of dry friction is another one in every joint.
_LAW_KNOWN = np.array([0.0, 0.2])
_FIRST_M, _LEAST_M, _FAR = 5e-6, 1e-9, 20.0


@dataclass(frozen=True, kw_only=True)
class _Amounts:
    """Size of each way, (w,), and its deviation by pieces of half a second."""

    values: FloatArray
    stds: FloatArray


def with_yielding_robot(problem: Problem, point: Point) -> tuple[Problem, Point]:
    """Return problem and minimum with a robot that gives way, as they are where the pose does not show it clearly.

    A force F moves a robot of stiffness k by r(s) F/k, and dry friction f of its joints holds it back by f/k and less:
    micrometres, of which a filter for the pose's noise keeps a part only, and which K_s turns into a force. Poles and
    these moves change each other: they are fitted in turns.
    """
    amounts = _amounts(problem, point, _ways(problem, point, np.full(2, _FIRST_M), (0, 1), terms=1))
    shown = np.flatnonzero(amounts.values > _CLEAR_STDS * amounts.stds).tolist()
    total = amounts.values.copy()
    for step in range(_ROUNDS if shown else 0):
        known = total[shown] if step else np.zeros(len(shown))
        more = _more(problem, point, total, shown, known)
        total[shown] = np.maximum(known + more.values, 0.0)
        # What the deviations move is asked for at the end only.
        stds = np.hypot(more.stds, (_LAW_KNOWN * total)[shown]) if step == _ROUNDS - 1 else None
        problem = _yielding(problem, _ways(problem, point, total, shown), total[shown], stds)
        point, _ = minimise(problem, point, _STEPS)
    return problem, point


def _more(problem: Problem, point: Point, total: FloatArray, shown: Sequence[int], known: FloatArray) -> _Amounts:
    """Return what the poses show of the ways beyond what is known of them."""
    ways = _ways(problem, point, total, shown)
    return _amounts(_yielding(problem, ways, known), point, ways)


def _yielding(problem: Problem, ways: FloatArray, amounts: FloatArray, stds: FloatArray | None = None) -> Problem:
    """Return the problem with so much of the ways (w, n, 4), which become what their deviations move where given."""
    yielded = np.tensordot(amounts, ways, axes=1)
    if stds is not None:
        ways *= stds[:, None, None]
    moved = () if stds is None else tuple(ways)
    return replace(problem, signals=replace(problem.signals, yielded=yielded, yielded_stds=moved))


def _ways(problem: Problem, point: Point, amounts: FloatArray, shown: Sequence[int], terms: int = 4) -> FloatArray:
    """Return where forces move the robot, per 1/k [m/N] (0) and per f/k [m] (1), about these amounts (2,).

    (w, n, terms) are the first columns of `given_way` for those that are `shown`.
    """
    signals, robot = problem.signals, point.values[problem.layout.robot]
    ways = np.empty((len(shown), len(signals.force_n), terms))
    for way, k in zip(ways, shown, strict=True):
        force = _friction(problem, point, float(amounts[1])) if k else signals.force_n
        way[:] = given_way(robot, force, signals.period_s)[:, :terms]
    return ways


def _friction(problem: Problem, point: Point, held_back_m: float) -> FloatArray:
    """Return the dry friction (n,) per f, where it holds the robot back by so much."""
    path, held_back_m = problem.path(point.values), max(held_back_m, _LEAST_M)
    if path.run is None:
        raise ValueError("A path without a command has no robot that gives way.")
    speed = np.gradient(path.run.states(0, len(problem.signals.position_m))[:, 0])
    return rubbing_of(point.values[problem.layout.robot], speed, held_back_m, problem.signals.period_s) / held_back_m


def rubbing_of(robot: FloatArray, speed: FloatArray, held_back_m: float, period_s: float) -> FloatArray:
    """Return the dry friction (n,) of joints over the robot's stiffness [m], `held_back_m` where it slides.

    `speed` (n,) is the robot's without friction [m per sample]. Over a sample friction takes the value that brings the
    robot to rest at its end (Moreau 1999), with d'' = ω² (φ − d) − 2 ζ ω d' for what it moves.
    """
    omega, zeta = float(robot[0]) * period_s, float(robot[1])
    if len(robot) == 2:  # one pole: another one far above the sampling rate
        omega, zeta = np.sqrt(omega * _FAR), 0.5 * (omega + _FAR) / np.sqrt(omega * _FAR)
    a = np.zeros((3, 3))
    a[0, 1], a[1] = 1.0, (-(omega**2), -2.0 * zeta * omega, omega**2)
    to_position, to_speed = (_Gains(*row) for row in expm(a)[:2].tolist())
    return _rubbing(to_position, to_speed, np.append(speed[1:], speed[-1]), held_back_m)


class _Gains(NamedTuple):
    """What position, speed and friction at the beginning of a sample add to a number at its end."""

    position: float
    speed: float
    friction: float


@compiled
def _rubbing(to_position: _Gains, to_speed: _Gains, arriving: FloatArray, limit: float) -> FloatArray:
    """Return the friction (n,) that stops what `arriving` (n,) is at the end of each sample, exact for the sample."""
    out, position, speed = np.empty(len(arriving)), 0.0, 0.0
    for k in range(len(arriving)):
        free = to_speed.position * position + to_speed.speed * speed
        friction = min(max(-(arriving[k] + free) / to_speed.friction, -limit), limit)
        position = to_position.position * position + to_position.speed * speed + to_position.friction * friction
        speed = free + to_speed.friction * friction
        out[k] = friction
    return out


def _amounts(problem: Problem, point: Point, ways: FloatArray) -> _Amounts:
    """Return what the poses show of each way (w, n, 4) beside what is known of it; the robot's parameters follow."""
    signals, robot = problem.signals, problem.layout.robot
    values, path = point.values[robot], problem.path(point.values)
    sizes = sizes_of(point.values, problem.layout, signals.period_s)[robot]
    derivatives = [path_slope(path, values, i, signals.period_s) for i in range(len(values))]
    rows, pieces = [], 0
    for span in map(signals.at_poses, problem.pose_spans):
        moved = [s.misfit(span) * -size for s, size in zip(derivatives, sizes, strict=True)]
        lines = np.column_stack([*ways[:, span, 0], *moved, path.misfit(span)])
        rows.append(lines - np.mean(lines, axis=0))
        pieces += max(1, round(len(lines) * span.step * signals.period_s / _PIECE_S))
    stacked = np.concatenate(rows)
    units = np.maximum(np.linalg.norm(stacked[:, :-1], axis=0), 1e-300)
    columns, misfit = stacked[:, :-1] / units, stacked[:, -1]
    found = np.linalg.lstsq(columns, misfit, rcond=None)[0]
    left = misfit - columns @ found
    stds = [_deviation(columns, i, left, pieces) for i in range(len(ways))]
    return _Amounts(values=found[: len(ways)] / units[: len(ways)], stds=np.array(stds) / units[: len(ways)])


def _deviation(columns: FloatArray, index: int, left: FloatArray, pieces: int) -> float:
    """Return the deviation of a column's coefficient, the residual's scores taken piece by piece."""
    others = np.delete(columns, index, axis=1)
    alone = columns[:, index] - others @ np.linalg.lstsq(others, columns[:, index], rcond=None)[0]
    square = max(float(alone @ alone), 1e-300)
    scores = [float(np.sum(part)) for part in np.array_split(alone * left, pieces)]
    # Few pieces hold the resonance, and what the fit takes of their scores is missing: white noise counts beside them.
    return float(np.sqrt(np.sum(np.square(scores)) / square**2 + np.mean(left**2) / square))
