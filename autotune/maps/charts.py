"""Charts of a map over two parameters, and of stable intervals along one."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np

from autotune.charts.chart import Area, Chart, Element, Heat, Line, Panel, Points, Region, Role, Scale
from problems.contact.transient import Approach
from problems.maps.maps import MapAxis, MapPoint, MapResult, distance_at_boundary
from problems.maps.parameters import MAP_PARAMETERS, MapParameter, MapQuantity
from problems.maps.search import IntervalRequest, IntervalResult, StableInterval
from problems.model.axis_kind import for_people

from .setup import MapSetup
from .text import WHERE, approach_text, number, shown, with_unit

Column = Sequence[StableInterval]
Point = tuple[float, float]

# Beyond this multiple of what nearly all points have, a value would only take the colours from the others.
_OUTLYING, _NEARLY_ALL = 1.5, 97.0
_WIDE = 8.0
_FAR = 1.0
_ON_THE_EDGE = 1e-15
_ROOM = 1.25
_LINE_LENGTH = 112
_LETTERS = {"ω": r"\omega", "ζ": r"\zeta", "P̂": r"\hat{P}"}
_ROLES: tuple[Role, ...] = ("measured", "after", "model", "target", "residual", "other", "bad", "before")


def map_chart(setup: MapSetup, result: MapResult, design: MapPoint | None) -> Chart:
    """Describe values or stability, the boundary, and the design if it lies inside the ranges."""
    request, quantity = result.request, result.request.quantity
    elements: list[Element] = []
    any_stable = bool(np.any(result.is_stable))
    if quantity is not MapQuantity.STABILITY and np.any(result.is_stable & np.isfinite(result.values)):
        elements.append(_heat(setup, result))
    if any_stable and not np.all(result.is_stable):
        elements.append(_unstable_region(result))
    if design is not None:
        label = _design_label(setup, quantity, design)
        elements.append(
            Points(x=np.array([design.x]), y=np.array([design.y]), label=label, role="model", marker="star")
        )
    title = f"{quantity.label.capitalize()} {WHERE[request.where]}"
    if quantity.is_peak:
        title = f"{quantity.label.capitalize()} of the transient"
    panel = Panel(
        x=_scale(request.x, axis_label(setup, request.x.parameter)),
        y=_scale(request.y, axis_label(setup, request.y.parameter)),
        elements=tuple(elements),
        ground="unstable" if not any_stable else "stable" if quantity is MapQuantity.STABILITY else "plain",
        note="" if any_stable else "unstable everywhere",
    )
    return Chart(
        key="map",
        title=title,
        alternative=f"{title} over {request.x.parameter.label} and {request.y.parameter.label}.",
        caption=fixed_text(setup, request.approach if quantity.is_peak else None),
        panels=(_in_shown_units(setup, panel, request.x.parameter, request.y.parameter),),
        live=False,
    )


def _in_shown_units(setup: MapSetup, panel: Panel, x: MapParameter, y: MapParameter) -> Panel:
    """Return a panel over two parameters, of SI numbers, in the units of its labels."""
    return panel.in_units(*(for_people(setup.unit(each))[0] for each in (x, y)))


def shown_unit(setup: MapSetup, quantity: MapQuantity) -> tuple[float, str]:
    """Return factor and unit in which a picture shows a quantity: delays in milliseconds."""
    return for_people(quantity.unit_of(rotational=setup.source.is_rotational))


def _heat(setup: MapSetup, result: MapResult) -> Heat:
    """Return the values as colours: a peak or delay that varies much by its logarithm, margins from 0."""
    request, quantity = result.request, result.request.quantity
    factor, unit = shown_unit(setup, quantity)
    values = np.where(result.is_stable, result.values * factor, np.nan)
    usual = values[np.isfinite(values)]
    low, high = float(np.min(usual)), float(np.max(usual))
    most = float(np.percentile(usual, _NEARLY_ALL))
    high = most if high > _OUTLYING * most else high
    is_log = quantity.is_peak and low > 0.0 and high > _WIDE * low
    if quantity is MapQuantity.DELAY and high > 0.0:
        is_log, low = True, float(np.percentile(usual, 100.0 - _NEARLY_ALL))
    elif not quantity.is_peak:
        low = 0.0
    if not high > low:
        high = low + (abs(low) or 1.0) * 1e-3
    return Heat(
        x=request.x.values(),
        y=request.y.values(),
        values=values,
        label=quantity.label + (f" [{unit}]" if unit else ""),
        limits=(low, high),
        spacing="log" if is_log else "linear",
        smooth=True,
        descending=quantity.is_peak,
    )


def _unstable_region(result: MapResult) -> Region:
    """Return where the loop is unstable, by its signed distance from the limit of stability."""
    distance = distance_at_boundary(result)
    far = np.where(result.is_stable, -_FAR, _FAR)
    # A loop on the edge itself must still lie on one side of it.
    near = np.copysign(np.maximum(np.abs(distance), _ON_THE_EDGE), far)
    return Region(
        x=result.request.x.values(),
        y=result.request.y.values(),
        values=np.where(np.isnan(distance), far, near),
        label="unstable",
        edge_label="limit of stability",
    )


def _design_label(setup: MapSetup, quantity: MapQuantity, design: MapPoint) -> str:
    if not design.is_stable:
        return "design: unstable"
    if quantity is MapQuantity.STABILITY:
        return "design: stable"
    factor, unit = shown_unit(setup, quantity)
    return (
        with_unit(f"design: {number(design.value * factor)}", unit) if np.isfinite(design.value) else "design: no limit"
    )


def interval_chart(setup: MapSetup, result: IntervalResult) -> Chart:
    """Describe the stable values of one parameter along another, and the design.

    One line per case where every stable set goes on to the end of the range, else one panel per case.
    """
    request, searched = result.request, _visible(setup, result)
    where, lines_only = WHERE[request.where], has_lower_limits_only(result)
    x = _scale(request.along, axis_label(setup, request.along.parameter))
    label = axis_label(setup, searched.parameter)
    if lines_only:
        title = f"Smallest stable {searched.parameter.label} {where}"
        panels: tuple[Panel, ...] = (_lines_panel(setup, result, x, label),)
    else:
        title, several = f"Stable {searched.parameter.label} {where}", len(result.intervals) > 1
        panels = tuple(
            Panel(
                title=_pretty(name) if several else "",
                x=x,
                y=_scale(searched, label),
                ground="unstable",
                elements=(*_stable_areas(request, result.intervals[name]), *_design(setup, request, [name])),
            )
            for name in result.intervals
        )
    return Chart(
        key="intervals",
        title=title,
        alternative=f"{title} along {request.along.parameter.label}.",
        caption=fixed_text(setup),
        panels=tuple(_in_shown_units(setup, panel, request.along.parameter, searched.parameter) for panel in panels),
        beside=not lines_only,
        linked=True,
        live=False,
    )


def has_lower_limits_only(result: IntervalResult) -> bool:
    """Whether every stable set goes on to the end of the range, so that one line per case shows all."""
    columns = [column for case in result.intervals.values() for column in case]
    return any(columns) and all(len(column) <= 1 and all(each.upper_is_bound for each in column) for column in columns)


def _lines_panel(setup: MapSetup, result: IntervalResult, x: Scale, label: str) -> Panel:
    along = result.request.along.values()
    lines: list[Element] = [
        Line(x=along, y=result.smallest(name), label=_pretty(name), role=role, dashed=i % 2 == 1, wide=True)
        for i, (name, role) in enumerate(zip(result.intervals, _ROLES, strict=False))
    ]
    design = _design(setup, result.request, list(result.intervals))
    return Panel(
        x=x, y=_scale(_visible(setup, result), f"smallest stable {label}"), elements=(*lines, *list(design)[:1])
    )


def _stable_areas(request: IntervalRequest, columns: Sequence[Column]) -> Iterator[Element]:
    pieces = list(_pieces(request.along, columns))
    yield Area(polygons=tuple(np.array(area) for area, _ in pieces), label="stable", role="stable")
    gap = (math.nan, math.nan)
    edges = np.array([point for _, lines in pieces for line in lines for point in (*line, gap)]).reshape(-1, 2)
    yield Line(x=edges[:, 0], y=edges[:, 1], role="edge")


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
    meeting = [0.5 * (one.upper + two.lower) for one, two in pairwise(side)]
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


def _visible(setup: MapSetup, result: IntervalResult) -> MapAxis:
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
    ends += [place[1] for name in result.intervals if (place := _design_place(setup, result.request, name)) is not None]
    high = min(searched.high, _ROOM * max(ends))
    low = searched.low if searched.spacing == "linear" else max(searched.low, min(ends) / _ROOM)
    return MapAxis(name=searched.name, low=low, high=high, count=searched.count, spacing=searched.spacing)


def _design(setup: MapSetup, request: IntervalRequest, names: Sequence[str]) -> Iterator[Points]:
    """Yield the mark of the design for the cases that have its own values."""
    for place in (_design_place(setup, request, name) for name in names):
        if place is not None:
            yield Points(x=np.array(place[:1]), y=np.array(place[1:]), label="design", role="model", marker="star")


def _design_place(setup: MapSetup, request: IntervalRequest, name: str) -> Point | None:
    """Return where the design lies, if that is inside and the case has the design's own values."""
    if setup.design is None:
        return None
    x, y = setup.design[request.along.name], setup.design[request.searched.name]
    own = request.cases[name].fixed
    # The last of a family of controllers is the whole one; curves of a parameter share theirs.
    whole = list(request.cases.values())[-1].controller
    same = request.cases[name].controller == whole and all(
        np.isclose(own[key], value) for key, value in setup.design.items() if key in own
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


def symbol(parameter: MapParameter) -> str:
    """Return the symbol for a picture, with its index set low."""
    letter, _, index = parameter.symbol.partition("_")
    letter = _LETTERS.get(letter, letter)
    return f"${letter}_{{{index}}}$" if index else f"${letter}$"


def axis_label(setup: MapSetup, parameter: MapParameter) -> str:
    """Return name, symbol and unit of a parameter, as people read it."""
    _, unit = for_people(setup.unit(parameter))
    return f"{parameter.label} {symbol(parameter)}" + (f" [{unit}]" if unit else "")


def fixed_text(setup: MapSetup, approach: Approach | None = None) -> str:
    """Return in lines for a title what is fixed; what is off, or filters that nothing passes, are left out."""
    parts = [(each := f"{setup.source.path.name}, axis {setup.source.axis}", each)]
    for name, value in setup.fixed.items():
        if value > 0.0 and not _is_idle(setup, name):
            parameter = MAP_PARAMETERS[name]
            ending = f" = {shown(value, setup.unit(parameter))}"
            parts.append((parameter.symbol + ending, symbol(parameter) + ending))
    parts.append((each := f"h = {shown(setup.source.sample_time_s, 's')}", f"$h${each.removeprefix('h')}"))
    if approach is not None:
        parts.append((each := approach_text(approach, rotational=setup.source.is_rotational), each))
    return _lines(parts)


def _is_idle(setup: MapSetup, name: str) -> bool:
    """Whether a filter is in no path: a parameter that varies is not fixed, and counts as used."""
    compensates = setup.fixed.get("compensation_mass", 1.0) > 0.0
    if name == "acceleration_filter_rad_per_s":
        return not compensates
    return name == "velocity_filter_rad_per_s" and not (compensates or setup.fixed.get("feedback_damping_s", 1.0) > 0.0)


def _lines(parts: Sequence[tuple[str, str]]) -> str:
    """Join parts, (as counted, as written), into lines that fit above a picture."""
    lines: list[list[str]] = [[]]
    length = 0
    for plain, pretty in parts:
        if length + len(plain) > _LINE_LENGTH:
            lines.append([])
            length = 0
        lines[-1].append(pretty)
        length += len(plain) + 3
    return "\n".join(" · ".join(line) for line in lines)


def _scale(axis: MapAxis, label: str) -> Scale:
    return Scale(label=label, spacing=axis.spacing, limits=(axis.low, axis.high))
