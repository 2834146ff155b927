"""Margins from characteristic polynomials: another road than the frequency responses that the optimizer uses."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from problems.arrays import ComplexArray, FloatArray
from problems.design.uncertainty import PlantSet
from problems.model.plant import FREE_SPACE, Plant
from problems.model.sampled import Controller, SampledPlant, build_cut_loop, build_sampled_plant
from problems.stability.margins import LARGEST_GAIN_DB, frequency_grid, margins_on_grid

_GRID_POINTS = 6000
# In half-widths of a mode, finer towards its middle.
_MODE_POINTS = 8.0 * np.linspace(-1.0, 1.0, 81) ** 3


@dataclass(frozen=True, kw_only=True)
class SweptMargins:
    """The smallest margins over the swept plants; `worst` is the plant of each."""

    values: Mapping[str, float]
    worst: Mapping[str, Plant]
    plants: int
    largest_radius: float


def sweep_margins(
    plants: PlantSet,
    controller: Controller,
    sample_time_s: float,
    *,
    stiffness: int,
    mass: int,
    others: Sequence[Plant] = (),
) -> SweptMargins:
    """Return the smallest margins over a grid of the set and over free space, at both break points.

    `others` are further plants in contact, each of which is looked at in free space too.
    """
    values: dict[str, float] = {}
    worst: dict[str, Plant] = {}
    radius, count = 0.0, 0
    low, high = plants.environment_stiffness_n_per_m
    masses = np.unique(np.linspace(*plants.payload_mass_kg, mass))
    # Clipped, since the spacing by equal ratios may leave the interval by a rounding error.
    stiffnesses = np.unique(np.clip(np.geomspace(low, high, stiffness), low, high))
    grid = [(float(m), float(k)) for m in masses for k in stiffnesses]
    swept = [plants.at(m, k) for m, k in [*grid, *((float(m), 0.0) for m in masses)]]
    for plant in [*swept, *others, *dict.fromkeys(other.in_contact_with(FREE_SPACE) for other in others)]:
        found, largest = _margins(build_sampled_plant(plant, sample_time_s), controller)
        radius, count = max(radius, largest), count + 1
        for name, value in found.items():
            if value < values.get(name, np.inf):
                values[name], worst[name] = value, plant
    for name in ("gain_db", "phase_deg", "delay_s"):
        values.setdefault(name, np.inf)
    return SweptMargins(values=values, worst=worst, plants=count, largest_radius=radius)


def _margins(sampled: SampledPlant, controller: Controller) -> tuple[dict[str, float], float]:
    """Return the margins of one loop from 1 + L = ∏(z − λ_closed)/∏(z − λ_cut), and its largest |λ_closed| but 1.

    The loop is cut at the force or at the command; both polynomials are monic, and only a loop without delay has a
    factor before them.
    """
    cut = build_cut_loop(sampled, controller)
    closed = _eigenvalues(cut.closed_at(cut.command, cut.force))
    grid = _around_modes(frequency_grid(sampled, _GRID_POINTS), closed, sampled.sample_time_s)
    z = np.exp(1j * grid * sampled.sample_time_s)
    loops, whole = [], _product(z, closed)
    for signal, other in ((cut.force, cut.command), (cut.command, cut.force)):
        opened = cut.closed_at(other)
        loops.append((1.0 - opened[signal, signal]) * (whole / _product(z, _eigenvalues(opened))) - 1.0)
    both = margins_on_grid(grid, np.array(loops))
    smallest = {name: float(np.min(values)) for name, values in both._asdict().items()}
    if smallest["gain_db"] >= LARGEST_GAIN_DB:
        smallest["gain_db"] = np.inf
    if not sampled.plant.environment.is_anchored:
        closed = np.delete(closed, int(np.argmin(np.abs(closed - 1.0))))
    return smallest, float(np.max(np.abs(closed)))


def _around_modes(grid: FloatArray, closed: ComplexArray, sample_time_s: float) -> FloatArray:
    """Add points around the modes of the closed loop, where |1 + L| has its narrow minima."""
    extra = [grid]
    for value in closed[closed.imag > 0.0]:
        centre, width = np.angle(value) / sample_time_s, max(-np.log(np.abs(value)), 1e-9) / sample_time_s
        extra.append(centre + width * _MODE_POINTS)
    whole = np.concatenate(extra)
    return np.unique(whole[(whole >= grid[0]) & (whole <= grid[-1])])


def _eigenvalues(matrix: FloatArray) -> ComplexArray:
    """Return the eigenvalues of the states' part: two rows of outputs and three columns of inputs are around it."""
    return np.linalg.eigvals(matrix[:-2, :-3]).astype(np.complex128)


def _product(z: ComplexArray, roots: ComplexArray) -> ComplexArray:
    out = np.ones_like(z)
    for root in roots:
        out *= z - root
    return out
