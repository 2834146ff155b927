"""Maps around a design: the smallest modulus margin over the plants that matter, two parameters at a time."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from autotune.charts.chart import Chart, Element, Heat, Line, Panel, Points, Scale
from problems.maps.maps import MapAxis, MapRequest, compute_map
from problems.maps.parameters import MapQuantity, find_parameter
from problems.model.plant import Plant

from .axis_design import AxisDesign

FloatArray = NDArray[np.float64]

_COUNT = 40
_LESS, _MORE = 0.4, 2.5
_LEAST_LEAD_S, _LEAST_FEEDBACK_S = 0.02, 0.01
_BEYOND = 3.0


@dataclass(frozen=True, kw_only=True)
class _Grid:
    x: FloatArray
    y: FloatArray
    margin: FloatArray


def map_chart(design: AxisDesign) -> Chart:
    """Draw the smallest modulus margin over two pairs of gains, with the design in them."""
    plants = _plants(design)
    law, rotational = design.law, design.units.force != "N"
    pairs = (
        (
            MapAxis(
                name="damping",
                low=_LESS * law.damping_n_s_per_m,
                high=_MORE * law.damping_n_s_per_m,
                count=_COUNT,
            ),
            MapAxis(name="lead_s", low=0.0, high=max(_MORE * law.lead_s, _LEAST_LEAD_S), count=_COUNT),
            (law.damping_n_s_per_m, law.lead_s),
        ),
        (
            MapAxis(name="mass", low=_LESS * law.mass_kg, high=_MORE * law.mass_kg, count=_COUNT),
            MapAxis(
                name="feedback_damping_s",
                low=0.0,
                high=max(_MORE * law.feedback_damping_s, _LEAST_FEEDBACK_S),
                count=_COUNT,
            ),
            (law.mass_kg, law.feedback_damping_s),
        ),
    )
    grids = [_smallest(design, plants, x, y) for x, y, _ in pairs]
    highest = max(float(np.nanmax(grid.margin, initial=design.margins.modulus)) for grid in grids)
    panels = tuple(
        _panel(design, x, y, grid, (0.0, highest), point, rotational=rotational)
        for (x, y, point), grid in zip(pairs, grids, strict=True)
    )
    shares = [100.0 * float(np.mean(np.isfinite(grid.margin))) for grid in grids]
    return Chart(
        key=f"{design.name}-map",
        title="Where the gains are stable",
        alternative=f"Two maps of the smallest modulus margin, over damping and lead gain ({shares[0]:.0f} % of it "
        f"stable) and over mass and feedback damping ({shares[1]:.0f} % stable), with the design marked at "
        f"{design.margins.modulus:.3f}.",
        caption=f"Colour: the smallest modulus margin over {len(plants)} plants, the ends of the domain and its worst "
        "case, free space included. Grey: unstable.",
        panels=panels,
        beside=True,
    )


def _plants(design: AxisDesign) -> tuple[Plant, ...]:
    worst = design.worst_plant()
    return tuple(dict.fromkeys((*design.corners(), *(() if worst is None else (worst,)))))


def _smallest(design: AxisDesign, plants: Sequence[Plant], x: MapAxis, y: MapAxis) -> _Grid:
    found = np.full((y.count, x.count), np.inf)
    for plant in plants:
        request = MapRequest(
            plant=plant,
            controller=design.law,
            sample_time_s=design.sample_time_s,
            x=x,
            y=y,
            quantity=MapQuantity.MODULUS,
            where="free_space" if plant.environment.is_free_space else "both",
        )
        found = np.minimum(found, compute_map(request).values)
    return _Grid(x=x.values(), y=y.values(), margin=found)


def _panel(
    design: AxisDesign,
    x: MapAxis,
    y: MapAxis,
    grid: _Grid,
    colours: tuple[float, float],
    point: tuple[float, float],
    *,
    rotational: bool,
) -> Panel:
    elements: list[Element] = [
        Heat(x=grid.x, y=grid.y, values=grid.margin, label="smallest modulus margin", limits=colours)
    ]
    if design.modulus_asked is not None:
        edge = _crossings(grid, design.modulus_asked)
        if len(edge[0]):
            elements.append(Line(x=edge[0], y=edge[1], label="margin as asked", role="bad", dashed=True))
    star = np.array([point[0]]), np.array([point[1]])
    elements.append(Points(x=star[0], y=star[1], label="the design", role="bad", marker="star", names=("the design",)))
    sides = []
    for axis in (x, y):
        told = find_parameter(axis.name)
        unit = told.unit_of(rotational=rotational)
        label = f"{told.label} {told.symbol} [{unit}]" if unit else f"{told.label} {told.symbol}"
        sides.append(Scale(label=label, spacing=axis.spacing))
    return Panel(x=sides[0], y=sides[1], elements=tuple(elements), height=1.35)


def _crossings(grid: _Grid, level: float) -> tuple[FloatArray, FloatArray]:
    """Return short strokes where a margin passes `level`, each ended by NaN: one per cell that the level cuts."""
    over = np.nan_to_num(grid.margin, nan=0.0) - level
    xs: list[float] = []
    ys: list[float] = []
    for i in range(len(grid.y) - 1):
        for j in range(len(grid.x) - 1):
            ends = _cuts(grid, over, i, j)
            if len(ends) >= 2:
                xs += [ends[0][0], ends[-1][0], np.nan]
                ys += [ends[0][1], ends[-1][1], np.nan]
    return np.array(xs), np.array(ys)


def _cuts(grid: _Grid, over: FloatArray, i: int, j: int) -> list[tuple[float, float]]:
    """Return where the level passes the sides of one cell, by linear interpolation."""
    around = ((i, j), (i, j + 1), (i + 1, j + 1), (i + 1, j), (i, j))
    found = []
    for (a, b), (c, d) in pairwise(around):
        start, stop = over[a, b], over[c, d]
        if (start < 0.0) != (stop < 0.0):
            share = start / (start - stop)
            x = grid.x[b] + share * (grid.x[d] - grid.x[b])
            found.append((float(x), float(grid.y[a] + share * (grid.y[c] - grid.y[a]))))
    return found
