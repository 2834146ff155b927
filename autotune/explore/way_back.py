"""The nearest design that meets everything, of those on the way to another design and those of a map."""

from dataclasses import dataclass

import numpy as np

from autotune.tuning.bounds import Box
from autotune.tuning.search import presentable
from problems.arrays import FloatArray

from .view import DesignMap, PreparedView

_STEPS = 40


@dataclass(frozen=True, kw_only=True)
class WayBack:
    """A design (n,) that meets every requirement on the plants of the view, and `found`, where it was found."""

    design: FloatArray
    found: str


def find_way_back(
    prepared: PreparedView, design: FloatArray, start: FloatArray, around: DesignMap | None
) -> WayBack | None:
    """Return the feasible design nearest to `design` (n,), None where neither the line nor the map has one.

    Sought on the straight line to `start` (n,), in the bounds as a unit cube, and among the middles of the cells of
    `around`. Nearest by the distance in that cube.
    """
    box, problem = Box(prepared.problem), prepared.problem
    here, there = box.unit(design), box.unit(start)
    shares = np.linspace(0.0, 1.0, _STEPS + 1)[1:]
    found = [(here + share * (there - here), f"{share:.0%} of the way to the start") for share in shares]
    if around is not None:
        found += [(box.unit(each), "the nearest feasible cell of the map") for each in _cells(prepared, design, around)]
    for unit, where in sorted(found, key=lambda each: float(np.linalg.norm(each[0] - here))):
        candidate = presentable(problem, box.design(unit))
        if prepared.screen.prepared.evaluate(candidate).is_feasible:
            return WayBack(design=candidate, found=where)
    return None


def _cells(prepared: PreparedView, design: FloatArray, around: DesignMap) -> list[FloatArray]:
    """Return the designs at the middles of the feasible cells."""
    window, names = around.window, prepared.problem.variables
    x, y = np.meshgrid(window.x_values(), window.y_values())
    cells = []
    for at_x, at_y in zip(x[around.is_feasible], y[around.is_feasible], strict=True):
        cell = np.array(design)
        cell[names.index(window.x)], cell[names.index(window.y)] = at_x, at_y
        cells.append(cell)
    return cells
