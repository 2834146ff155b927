"""The step of a held command beside a tick: two readings of one force, and what that costs."""

from dataclasses import dataclass, replace

import numpy as np

from .problem import Point, Problem
from .solve import cost, minimise

_NEAR_SAMPLES = 0.05
_BESIDE_SAMPLES = 0.0005
_STEPS = 6
_FAST, _GONE = 0.5, 20.0


@dataclass(frozen=True, kw_only=True)
class Rival:
    """Another minimum of nearly the same depth; `share` (0 to 1) is what it has of the likelihood of both."""

    point: Point
    share: float


def either_side(problem: Problem, point: Point) -> tuple[Point, Rival | None]:
    """Return the better minimum of those on both sides of a delay of whole samples, and the other one.

    The velocity of a robot with one pole jumps with every step of its command, and the damping of the coupling turns
    that into a jump of the force. A delay just below a whole number of samples puts the step just before the tick, one
    just above it behind: the same force at all other times, but another one in the log. No slope tells of that jump.
    Of a robot with two poles the rival is that of one pole, where the second pole is fast.
    """
    layout, period = problem.layout, problem.signals.period_s
    if layout.robot_order == 2:
        return point, _one_pole(problem, point)
    if layout.robot_order != 1:
        return point, None
    index = layout.robot.stop - 1
    delay = float(point.values[index]) / period
    whole = float(np.round(delay))
    if abs(delay - whole) > _NEAR_SAMPLES or whole < 1.0:
        return point, None
    beside = whole + (_BESIDE_SAMPLES if delay <= whole else -_BESIDE_SAMPLES)
    held = replace(problem, fixed=(*problem.fixed, index))
    here, (there, there_cost) = point, minimise(held, _at(point, index, beside * period), _STEPS)
    here_cost = cost(problem, here)
    if there_cost < here_cost:
        here, there, here_cost, there_cost = there, here, there_cost, here_cost
    ratio = float(np.exp(-0.5 * min(there_cost - here_cost, 200.0)))
    return here, Rival(point=there, share=ratio / (1.0 + ratio))


def _one_pole(problem: Problem, point: Point) -> Rival | None:
    """Return the robot of one pole beside one whose second pole is so fast that it could be a delay 1/p as well."""
    robot, period = problem.layout.robot, problem.signals.period_s
    omega, zeta, delay = (float(v) for v in point.values[robot])
    if zeta <= 1.0:
        return None
    root = float(np.sqrt(zeta**2 - 1.0))
    slow, fast = omega / (zeta + root), omega * (zeta + root)
    if fast * period < _FAST:
        return None
    values = point.values.copy()
    gone = _GONE / period
    values[robot] = np.sqrt(slow * gone), 0.5 * (slow + gone) / np.sqrt(slow * gone), delay + 1.0 / fast
    # The place of the second pole is what is compared.
    held = replace(problem, fixed=(*problem.fixed, robot.start + 1))
    other, there = minimise(held, replace(point, values=values), _STEPS)
    ratio = float(np.exp(-0.5 * np.clip(there - cost(problem, point), -200.0, 200.0)))
    return Rival(point=other, share=ratio / (1.0 + ratio))


def _at(point: Point, index: int, delay_s: float) -> Point:
    values = point.values.copy()
    values[index] = delay_s
    return replace(point, values=values)
