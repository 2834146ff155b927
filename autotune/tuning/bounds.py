"""The bounds of a design problem as a unit cube, and wider ones."""

import math
from collections.abc import Collection, Iterable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from problems.arrays import FloatArray
from problems.design.problem import BIQUAD_VARIABLES, FURTHER_VARIABLES, DesignProblem
from problems.model.controller import SMALLEST_FEEDBACK_DAMPING_S

LINEAR_VARIABLES = frozenset({"lead_s", "feedback_damping_s", "compensation_mass_kg"})
"""Variables that may be zero: counted by the width of their bounds, the others by their logarithm."""
# How much longer those bounds become that stand for the sensor's noise where nothing else limits it.
_LONGER = {"mass": 3.0, "lead_s": 10.0, "feedback_damping_s": 4.0}
# Laws without lead and feedback are looked at on so many M_a and B_a.
_GRID, _OF_LEAD = (5, 9), ("lead_s", "feedback_damping_s")
# Beside its bounds a value this small is none.
_NOTHING = 1e-7
# How much further a bound that holds a design is proposed.
_WIDER = 2.0
# The longest lead and feedback damping of a controller file.
_LONGEST_S = 1.0


def bounds_of(problem: DesignProblem) -> FloatArray:
    """Return the bounds (n, 2) of the free variables."""
    return np.array([problem.bounds[name] for name in problem.variables])


def linear_variables(problem: DesignProblem) -> NDArray[np.bool_]:
    """Return which free variables (n,) are counted by the width of their bounds."""
    return np.array([name in LINEAR_VARIABLES for name in problem.variables])


def wider_bounds(problem: DesignProblem, names: Iterable[str], *, turning: bool) -> dict[str, Any]:
    """Return the part of `problem.yaml` that makes room beyond bounds, such as "lower bound of mass"."""
    tree: dict[str, Any] = {}
    for name in names:
        side, _, variable = name.partition(" bound of ")
        if variable in BIQUAD_VARIABLES:
            # They follow from h and the band of the admittance, and problem.yaml has no place for them.
            continue
        low, high = problem.bounds[variable]
        ends = (low / _WIDER, high) if side == "lower" else (low, high * _WIDER)
        if variable in _OF_LEAD:
            ends = ends[0], min(ends[1], _LONGEST_S)
        below = tree.setdefault("free" if variable in FURTHER_VARIABLES else "bounds", {})
        below[variable] = [float(f"{end:.6g}") for end in ends]
    return {"rotational": tree} if turning and tree else tree


def presentable(problem: DesignProblem, design: FloatArray) -> FloatArray:
    """Return the design with six digits, inside its bounds: what is certified is what people read and type."""
    rounded = np.array([float(f"{value:.6g}") for value in design])
    if rounded[3] < SMALLEST_FEEDBACK_DAMPING_S and problem.bounds["feedback_damping_s"][0] == 0.0:
        rounded[3] = 0.0
    bounds = bounds_of(problem)
    # What is nothing beside its bounds is meant as none: a compensation of 1e-16 kg would only be another structure.
    nothing = linear_variables(problem) & (rounded < _NOTHING * bounds[:, 1])
    rounded = np.where(nothing, 0.0, rounded)
    return np.asarray(np.clip(rounded, bounds[:, 0], bounds[:, 1]))


def loosened_bounds(problem: DesignProblem, said: Collection[str] = ()) -> dict[str, tuple[float, float]]:
    """Return the bounds with a lighter mass, more lead and feedback damping, for where the noise is limited.

    M_a goes down to h B_a at the least B_a (the search holds it to its own). What is fixed stays, and what somebody
    `said`.
    """
    bounds = dict(problem.bounds)
    lightest = problem.sample_time_s * bounds["damping"][0]
    for name, longer in _LONGER.items():
        low, high = bounds[name]
        if low < high and name not in said:
            bounds[name] = min(low, lightest) if name == "mass" else low, high * longer
    return bounds


class Box:
    """Maps the unit cube to the bounds: what may be zero by equal steps, the others by equal ratios."""

    def __init__(self, problem: DesignProblem) -> None:
        bounds = bounds_of(problem)
        self.low, self.high = bounds[:, 0], bounds[:, 1]
        self.logarithmic = ~linear_variables(problem)

    def design(self, unit: FloatArray) -> FloatArray:
        """Return the design of a point in the unit cube."""
        share = np.clip(unit, 0.0, 1.0)
        with np.errstate(divide="ignore", invalid="ignore"):
            geometric = self.low * (self.high / np.where(self.low > 0.0, self.low, 1.0)) ** share
        return np.where(self.logarithmic, geometric, self.low + share * (self.high - self.low))

    def unit(self, design: FloatArray) -> FloatArray:
        """Return the point of the unit cube that `design` comes from; 0 where the bounds coincide."""
        span = np.where(self.high > self.low, self.high - self.low, 1.0)
        floor = np.where(self.logarithmic, self.low, 1.0)
        ratio = np.where(self.high > self.low, np.log(np.where(self.logarithmic, self.high, math.e) / floor), 1.0)
        geometric = np.log(np.where(self.logarithmic, design, 1.0) / floor) / np.where(ratio > 0.0, ratio, 1.0)
        return np.clip(np.where(self.logarithmic, geometric, (design - self.low) / span), 0.0, 1.0)


def spread_out(units: Iterable[FloatArray], distance: float, count: int) -> list[FloatArray]:
    """Return the first few points (n,) of the unit cube that lie this far apart."""
    kept: list[FloatArray] = []
    for unit in units:
        if all(np.linalg.norm(unit - other) > distance for other in kept):
            kept.append(unit)
        if len(kept) == count:
            break
    return kept


def without_lead(names: Sequence[str], unit: FloatArray) -> FloatArray:
    """Return points (m, n) of the unit cube like one, with K_l and B_fb at their least, on a grid of M_a and B_a.

    These laws are a valley of their own, which a population may leave altogether.
    """
    masses, dampings = (grid.ravel() for grid in np.meshgrid(*(np.linspace(0.0, 1.0, count) for count in _GRID)))
    of_grid = {"mass": masses, "damping": dampings, **dict.fromkeys(_OF_LEAD, np.zeros_like(masses))}
    columns = [of_grid.get(name, np.full_like(masses, at)) for name, at in zip(names, unit.tolist(), strict=True)]
    return np.stack(columns, axis=1)
