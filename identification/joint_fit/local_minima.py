"""Other minima of the joint fit than the one that a descent reached."""

from dataclasses import replace

import numpy as np

from .problem import Point, Problem
from .solve import cost, information, linearise, minimise

_STEPS = 4
_DEEPER = 1.0
_KNOWN_SHARE, _OTHER_STIFFNESSES, _STEPS_FAR = 0.02, (0.15, 0.4, 2.5), 12
_OTHER_MASS_SHARE = 0.3


def deepest_stiffness(problem: Problem, point: Point) -> Point:
    """Return the deepest minimum over K_s, where it is not known to 2 %: a spring that hardly gives has several."""
    matrix, _ = information(linearise(problem, point), len(problem.layout))
    scale = 1.0 / np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    inverse = np.linalg.pinv(matrix * np.outer(scale, scale), hermitian=True) * np.outer(scale, scale)
    if inverse[0, 0] < _KNOWN_SHARE**2:
        return point
    best, here = point, cost(problem, point)
    for factor in _OTHER_STIFFNESSES:
        values = point.values.copy()
        values[0] *= factor
        values[1] *= min(factor, 1.0)
        other, there = minimise(problem, replace(point, values=values), _STEPS_FAR)
        if there < here - _DEEPER:
            best, here = other, there
    return best


def deepest_surfaces(problem: Problem, point: Point) -> tuple[Problem, Point]:
    """Return the point from which no other minimum of a surface (see `other_minima`) is deeper, all fitted again."""
    for i in range(problem.layout.surfaces):
        forces = forces_only(problem, point)
        here = cost(forces, point)
        for other, there in other_surfaces(forces, point, problem.layout.surface(i).start + 2):
            if there < here - _DEEPER:
                here, point = there, minimise(problem, other, _STEPS)[0]
    return problem, point


def forces_only(problem: Problem, point: Point) -> Problem:
    """Return the problem with the robot as it is at a point."""
    robot = tuple(range(problem.layout.robot.start, problem.layout.robot.stop))
    return replace(problem, pose_spans=(), fixed=robot, known_path=problem.path(point.values))


def other_surfaces(problem: Problem, point: Point, mass: int) -> list[tuple[Point, float]]:
    """Return minima beside this one and their depths: a surface, told by its M_e's index, without mass or with."""
    found = []
    if point.values[mass] > 0.0:
        massless = point.values.copy()
        massless[mass] = 0.0
        start = Point(values=massless, nuisances=point.nuisances)
        found.append(minimise(_fixing(problem, mass), start, _STEPS))
    heavy = point.values.copy()
    heavy[mass] = _OTHER_MASS_SHARE * point.values[3]
    heavy[mass - 1] = min(heavy[mass - 1], 0.05 * float(np.sqrt(heavy[mass - 2] * point.values[3])))
    found.append(minimise(problem, Point(values=heavy, nuisances=point.nuisances), _STEPS))
    return found


def _fixing(problem: Problem, index: int) -> Problem:
    return replace(problem, fixed=(*problem.fixed, index))
