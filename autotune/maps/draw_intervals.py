"""The picture of stable intervals: one panel per case, or one line per case where a lower limit says it all."""

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from numpy.typing import NDArray

from problems.maps.maps import MapAxis
from problems.maps.parameters import MAP_PARAMETERS
from problems.maps.search import IntervalRequest, IntervalResult, StableInterval

from .plan import MapPlan
from .style import (
    DESIGN_COLOUR,
    HATCH_COLOUR,
    STABLE_COLOUR,
    UNSTABLE_COLOUR,
    axis_label,
    set_axis,
    symbol,
    title,
    told,
)
from .text import WHERE

FloatArray = NDArray[np.float64]
Column = Sequence[StableInterval]
Point = tuple[float, float]

# Okabe and Ito's colours, which people with any colour vision can tell apart; dashes help in print.
_COLOURS = ("#000000", "#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#8c8c8c")
_DASHES = ("-", "--", "-.", ":")
_LINES_INCHES, _PANEL_INCHES, _AROUND_INCHES = (7.6, 5.6), (3.4, 2.5), (1.0, 1.6)
_COLUMNS = {1: 1, 2: 2, 4: 2}
_ROOM = 1.25
_DESIGN: dict[str, Any] = {
    "marker": "o",
    "markersize": 8.0,
    "markerfacecolor": DESIGN_COLOUR,
    "markeredgecolor": "white",
}


def draw_intervals(plan: MapPlan, result: IntervalResult) -> Figure:
    """Draw the stable values of one parameter along another, and the design."""
    if has_lower_limits_only(result):
        return _draw_lines(plan, result.request, result)
    return _draw_panels(plan, result.request, result)


def has_lower_limits_only(result: IntervalResult) -> bool:
    """Whether every stable set goes on to the end of the range, so that one line per case tells all."""
    columns = [column for case in result.intervals.values() for column in case]
    return any(columns) and all(len(column) <= 1 and all(each.upper_is_bound for each in column) for column in columns)


def _draw_lines(plan: MapPlan, request: IntervalRequest, result: IntervalResult) -> Figure:
    figure = Figure(figsize=_LINES_INCHES, layout="constrained")
    axes = figure.add_subplot()
    along, searched = request.along, _visible(plan, result)
    set_axis(axes, "x", along, axis_label(plan, along.parameter))
    set_axis(axes, "y", searched, f"smallest stable {axis_label(plan, searched.parameter)}")
    x = along.values()
    for (name, colour), dash in zip(
        zip(result.intervals, _COLOURS, strict=False), itertools.cycle(_DASHES), strict=False
    ):
        axes.plot(x, result.smallest(name), color=colour, linestyle=dash, linewidth=1.8, label=_pretty(name))
    axes.grid(visible=True, color="0.9", linewidth=0.6)
    axes.set_axisbelow(True)
    place = next(filter(None, (_design(plan, request, name) for name in result.intervals)), None)
    if place is not None:
        axes.plot(*place, linestyle="none", label="design", zorder=5, **_DESIGN)
    figure.legend(loc="outside lower center", ncols=3, frameon=False, fontsize=9.0)
    title(figure, f"Smallest stable {searched.parameter.label} {WHERE[request.where]}", told(plan))
    return figure


def _draw_panels(plan: MapPlan, request: IntervalRequest, result: IntervalResult) -> Figure:
    names = list(result.intervals)
    columns = _COLUMNS.get(len(names), 3)
    rows = math.ceil(len(names) / columns)
    size = (_PANEL_INCHES[0] * columns + _AROUND_INCHES[0], _PANEL_INCHES[1] * rows + _AROUND_INCHES[1])
    figure = Figure(figsize=_LINES_INCHES if len(names) == 1 else size, layout="constrained")
    grid = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
    searched, marked = _visible(plan, result), False
    for i, axes in enumerate(grid.flat):
        if i >= len(names):
            axes.set_visible(False)
            continue
        # Labels stand at the rim; a panel with nothing below it is at the rim, too.
        at_rim = i + columns >= len(names)
        axes.tick_params(labelbottom=at_rim)
        label = axis_label(plan, request.along.parameter) if at_rim else ""
        set_axis(axes, "x", request.along, label, crowded=columns > 1)
        set_axis(axes, "y", searched, axis_label(plan, searched.parameter) if i % columns == 0 else "")
        _draw_stable(axes, request, result.intervals[names[i]])
        if len(names) > 1:
            box = {"facecolor": "white", "edgecolor": "0.7", "boxstyle": "round,pad=0.3"}
            axes.text(0.03, 0.95, _pretty(names[i]), transform=axes.transAxes, va="top", fontsize=9.5, bbox=box)
        place = _design(plan, request, names[i])
        if place is not None:
            axes.plot(*place, linestyle="none", zorder=5, **_DESIGN)
            marked = True
    handles: list[Any] = [
        Patch(facecolor=STABLE_COLOUR, edgecolor="0.6", label="stable"),
        Patch(facecolor=UNSTABLE_COLOUR, edgecolor=HATCH_COLOUR, hatch="////", linewidth=0.0, label="unstable"),
    ]
    if marked:
        handles.append(Line2D([], [], linestyle="none", label="design", **_DESIGN))
    figure.legend(handles=handles, loc="outside lower center", ncols=3, frameon=False, fontsize=9.0)
    title(figure, f"Stable {searched.parameter.label} {WHERE[request.where]}", told(plan))
    return figure


def _draw_stable(axes: Axes, request: IntervalRequest, columns: Sequence[Column]) -> None:
    axes.set_facecolor(UNSTABLE_COLOUR)
    axes.patch.set_hatch("////")
    areas: list[list[Point]] = []
    edges: list[list[Point]] = []
    for area, lines in _pieces(request.along, columns):
        areas.append(area)
        edges += lines
    axes.add_collection(PolyCollection(areas, facecolor=STABLE_COLOUR, edgecolor=STABLE_COLOUR, linewidth=0.5))
    axes.add_collection(LineCollection(edges, color="black", linewidth=1.3, capstyle="round"))


def _pieces(along: MapAxis, columns: Sequence[Column]) -> Iterator[tuple[list[Point], list[list[Point]]]]:
    """Yield the stable area between neighbouring columns, with the edges that are limits of stability.

    Where the intervals of two columns continue each other one by one, straight lines join them. Half way between,
    intervals that begin or end come to a tip, and so does the gap between intervals that meet.
    """
    x = along.values()
    middles = np.sqrt(x[:-1] * x[1:]) if along.spacing == "log" else 0.5 * (x[:-1] + x[1:])
    for k, middle in enumerate(map(float, middles)):
        for here, there in _groups(columns[k], columns[k + 1]):
            if len(here) == len(there) == 1:
                yield _strip(float(x[k]), here[0], float(x[k + 1]), there[0])
                continue
            for place, side, other in ((float(x[k]), here, there), (float(x[k + 1]), there, here)):
                for one, end in zip(side, _half_way(side, other), strict=True):
                    yield _strip(place, one, middle, end)


def _groups(here: Column, there: Column) -> list[tuple[list[StableInterval], list[StableInterval]]]:
    """Return which intervals of two columns belong together because they overlap, directly or by way of others."""
    groups: list[tuple[list[StableInterval], list[StableInterval]]] = []
    for side, column in enumerate((here, there)):
        for each in column:
            mates = [group for group in groups if any(_overlap(each, other) for other in group[1 - side])]
            joined: tuple[list[StableInterval], list[StableInterval]] = ([], [])
            for group in mates:
                joined[0].extend(group[0])
                joined[1].extend(group[1])
                groups.remove(group)
            joined[side].append(each)
            groups.append(joined)
    return groups


def _half_way(side: Column, other: Column) -> list[StableInterval]:
    """Return what the intervals of one column have become half way to the other: a tip, or parts that touch."""
    if not other:
        tips = [0.5 * (each.lower + each.upper) for each in side]
        return [replace(each, lower=tip, upper=tip) for each, tip in zip(side, tips, strict=True)]
    meeting = [0.5 * (one.upper + two.lower) for one, two in itertools.pairwise(side)]
    lower = [0.5 * (side[0].lower + other[0].lower), *meeting] if side else []
    upper = [*meeting, 0.5 * (side[-1].upper + other[-1].upper)] if side else []
    return [replace(each, lower=low, upper=high) for each, low, high in zip(side, lower, upper, strict=True)]


def _strip(x1: float, one: StableInterval, x2: float, two: StableInterval) -> tuple[list[Point], list[list[Point]]]:
    """Return the area between two intervals, and those of its edges that are limits of stability."""
    area = [(x1, one.lower), (x2, two.lower), (x2, two.upper), (x1, one.upper)]
    edges = []
    if not (one.lower_is_bound and two.lower_is_bound):
        edges.append(area[:2])
    if not (one.upper_is_bound and two.upper_is_bound):
        edges.append(area[2:])
    return area, edges


def _overlap(one: StableInterval, other: StableInterval) -> bool:
    return one.lower <= other.upper and other.lower <= one.upper


def _visible(plan: MapPlan, result: IntervalResult) -> MapAxis:
    """Return the part of the searched range in which something changes, or the design lies."""
    searched = result.request.searched
    ends = [
        value
        for case in result.intervals.values()
        for column in case
        for each in column
        for value, is_bound in ((each.lower, each.lower_is_bound), (each.upper, each.upper_is_bound))
        if not is_bound
    ]
    if not ends:
        return searched
    ends += [place[1] for name in result.intervals if (place := _design(plan, result.request, name)) is not None]
    high = min(searched.high, _ROOM * max(ends))
    low = searched.low if searched.spacing == "linear" else max(searched.low, min(ends) / _ROOM)
    return MapAxis(name=searched.name, low=low, high=high, count=searched.count, spacing=searched.spacing)


def _design(plan: MapPlan, request: IntervalRequest, name: str) -> Point | None:
    """Return where the design lies, if that is inside and the case has the design's own values."""
    if plan.design is None:
        return None
    x, y = plan.design[request.along.name], plan.design[request.searched.name]
    own = request.cases[name].fixed
    # The last of a family of controllers is the whole one; curves of a parameter share theirs.
    whole = list(request.cases.values())[-1].controller
    same = request.cases[name].controller == whole and all(
        np.isclose(own[key], value) for key, value in plan.design.items() if key in own
    )
    inside = _is_inside(x, request.along) and _is_inside(y, request.searched)
    return (x, y) if same and inside else None


def _is_inside(value: float, axis: MapAxis) -> bool:
    return axis.low <= value <= axis.high


def _pretty(name: str) -> str:
    """Return the name of a case with its symbol as in the labels."""
    letter, equals, rest = name.partition(" = ")
    found = [each for each in MAP_PARAMETERS.values() if each.symbol == letter]
    return f"{symbol(found[0])} = {rest}" if equals and found else name
