"""One call from the request to the picture and its data on disk."""

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from autotune.formats.atomic import check_target, write_atomic
from autotune.formats.replaceable import PICTURE_MARK, check_kind
from problems.maps.maps import MapAxis, MapPoint, MapRequest, MapResult, compute_map, evaluate_point
from problems.maps.search import IntervalRequest, IntervalResult, find_stable_intervals
from problems.progress import Progress

from .charts import interval_chart, map_chart
from .options import MapOptions, check_targets
from .setup import MapSetup, build_setup
from .source import read_source
from .table import table_text


@dataclass(frozen=True, kw_only=True)
class MadeMap:
    """What was computed, drawn and written; `design` is the design's own point of a map, if it has one.

    `replaced` says in words which earlier map was replaced.
    """

    options: MapOptions
    setup: MapSetup
    result: MapResult | IntervalResult
    design: MapPoint | None
    replaced: tuple[str, ...] = ()


def make_map(options: MapOptions, progress: Progress | None = None) -> MadeMap:
    """Read, compute, draw and write; `progress` receives the share of the computing done since the last call.

    Both files are made before either is written. Raises as `read_source`, `build_setup` and `write_atomic` do.
    """
    check_targets(options)
    for path in (options.picture, options.table):
        check_target(path)
    _replaced(options)
    setup = build_setup(options, read_source(options.source, axis=options.axis, controller=options.controller))
    made = _made(options, setup, progress)
    picture, table = _picture(made), table_text(setup, made.result, options.table)
    replaced = _replaced(options)
    write_atomic(options.table, table)
    write_atomic(options.picture, picture)
    return replace(made, replaced=replaced)


def _replaced(options: MapOptions) -> tuple[str, ...]:
    """Say what the two files will replace; raises UsageError where it is no earlier map."""
    data = "-o" if options.data is None else "--data"
    asked = ((options.picture, "picture", "-o"), (options.table, "map", data))
    found = [(path, check_kind(path, kind, option=option)) for path, kind, option in asked]
    return tuple(f"{path}: replaced {was}." for path, was in found if was)


def summary_tree(made: MadeMap) -> dict[str, Any]:
    """Return what was found, in short, and where the files are."""
    setup, request = made.setup, made.result.request
    tree: dict[str, Any] = {
        "source": str(made.options.source),
        "checksums": dict(setup.source.checksums),
        "axis": setup.source.axis,
        "show": made.options.show,
        "where": request.where,
        "fixed": dict(setup.fixed),
        "sample_time_s": setup.source.sample_time_s,
    }
    found = (
        _map_summary(made, made.result) if isinstance(made.result, MapResult) else _interval_summary(setup, made.result)
    )
    return {**tree, **found, "picture": str(made.options.picture), "data": str(made.options.table)}


def _made(options: MapOptions, setup: MapSetup, progress: Progress | None) -> MadeMap:
    request = setup.request
    if isinstance(request, IntervalRequest):
        return MadeMap(
            options=options, setup=setup, result=find_stable_intervals(request, progress=progress), design=None
        )
    result, design = compute_map(request, progress=progress), None
    if setup.design is not None:
        x, y = setup.design[request.x.name], setup.design[request.y.name]
        if request.x.low <= x <= request.x.high and request.y.low <= y <= request.y.high:
            design = evaluate_point(request, x, y)
    return MadeMap(options=options, setup=setup, result=result, design=design)


def _picture(made: MadeMap) -> bytes:
    # matplotlib takes half a second to import; a request that is refused does without.
    from autotune.charts.matplotlib_renderer import render  # noqa: PLC0415

    result = made.result
    chart = (
        map_chart(made.setup, result, made.design)
        if isinstance(result, MapResult)
        else interval_chart(made.setup, result)
    )
    return render(chart, made.options.picture.suffix, mark=PICTURE_MARK)


def _map_summary(made: MadeMap, result: MapResult) -> dict[str, Any]:
    request = result.request
    tree: dict[str, Any] = {
        "x": _axis_tree(made.setup, request.x),
        "y": _axis_tree(made.setup, request.y),
        "points": int(result.is_stable.size),
        "stable_share": float(np.mean(result.is_stable)),
    }
    finite = np.isfinite(result.values)
    if np.any(finite):
        tree["unit"] = request.quantity.unit_of(rotational=made.setup.source.is_rotational)
        tree["smallest"] = _extreme(request, result, int(np.argmin(np.where(finite, result.values, math.inf))))
        tree["largest"] = _extreme(request, result, int(np.argmax(np.where(finite, result.values, -math.inf))))
    if made.design is not None:
        tree["design"] = _point_tree(request, made.design)
    return tree


def _extreme(request: MapRequest, result: MapResult, place: int) -> dict[str, Any]:
    i, j = divmod(place, request.x.count)
    x, y = float(request.x.values()[j]), float(request.y.values()[i])
    return _point_tree(request, MapPoint(x=x, y=y, is_stable=True, value=float(result.values[i, j])))


def _point_tree(request: MapRequest, point: MapPoint) -> dict[str, Any]:
    value = point.value if math.isfinite(point.value) else None
    return {request.x.name: point.x, request.y.name: point.y, "is_stable": point.is_stable, "value": value}


def _interval_summary(setup: MapSetup, result: IntervalResult) -> dict[str, Any]:
    cases = {}
    for name, columns in result.intervals.items():
        lower = [column[0].lower for column in columns if column]
        upper = [column[-1].upper for column in columns if column]
        cases[name] = {
            "stable_share": len(lower) / len(columns),
            "most_intervals": max(len(column) for column in columns),
            "smallest": [min(lower), max(lower)] if lower else None,
            "largest": [min(upper), max(upper)] if upper else None,
        }
    along, searched = result.request.along, result.request.searched
    return {"x": _axis_tree(setup, along), "searched": _axis_tree(setup, searched), "cases": cases}


def _axis_tree(setup: MapSetup, axis: MapAxis) -> dict[str, Any]:
    return {
        "name": axis.name,
        "low": axis.low,
        "high": axis.high,
        "count": axis.count,
        "spacing": axis.spacing,
        "unit": setup.unit(axis.parameter),
    }
