"""One call from the request to the picture and its data on disk."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from autotune.formats.atomic import check_target, write_atomic
from autotune.formats.replaceable import check_kind
from problems.maps.maps import MapAxis, MapPoint, MapRequest, MapResult, compute_map, evaluate_point
from problems.maps.search import IntervalRequest, IntervalResult, find_stable_intervals

from .ask import MapAsk, check_targets
from .plan import MapPlan, build_plan
from .source import read_source
from .table import table_text


@dataclass(frozen=True, kw_only=True)
class MadeMap:
    """What was computed, drawn and written; `design` is the design's own point of a map, if it has one.

    `replaced` says in words which earlier map was replaced.
    """

    ask: MapAsk
    plan: MapPlan
    result: MapResult | IntervalResult
    design: MapPoint | None
    replaced: tuple[str, ...] = ()


def make_map(ask: MapAsk, progress: Callable[[float], None] | None = None) -> MadeMap:
    """Read, compute, draw and write; `progress` is told the share of the computing done since the last call.

    Both files are made before either is written. Raises as `read_source`, `build_plan` and `write_atomic` do.
    """
    check_targets(ask)
    for path in (ask.picture, ask.table):
        check_target(path)
    _replaced(ask)
    plan = build_plan(ask, read_source(ask.source, axis=ask.axis, controller=ask.controller))
    made = _made(ask, plan, progress)
    picture, table = _picture(made), table_text(plan, made.result, ask.table)
    replaced = _replaced(ask)
    write_atomic(ask.table, table)
    write_atomic(ask.picture, picture)
    return replace(made, replaced=replaced)


def _replaced(ask: MapAsk) -> tuple[str, ...]:
    """Say what the two files will replace; raises UsageError where it is no earlier map."""
    data = "-o" if ask.data is None else "--data"
    asked = ((ask.picture, "picture", "-o"), (ask.table, "map", data))
    found = [(path, check_kind(path, kind, option=option)) for path, kind, option in asked]
    return tuple(f"{path}: replaced {was}." for path, was in found if was)


def summary_tree(made: MadeMap) -> dict[str, Any]:
    """Return what was found, in short, and where the files are."""
    plan, request = made.plan, made.result.request
    tree: dict[str, Any] = {
        "source": str(made.ask.source),
        "checksums": dict(plan.source.checksums),
        "axis": plan.source.axis,
        "show": made.ask.show,
        "where": request.where,
        "fixed": dict(plan.fixed),
        "sample_time_s": plan.source.sample_time_s,
    }
    found = (
        _map_summary(made, made.result) if isinstance(made.result, MapResult) else _interval_summary(plan, made.result)
    )
    return {**tree, **found, "picture": str(made.ask.picture), "data": str(made.ask.table)}


def _made(ask: MapAsk, plan: MapPlan, progress: Callable[[float], None] | None) -> MadeMap:
    request = plan.request
    if isinstance(request, IntervalRequest):
        return MadeMap(ask=ask, plan=plan, result=find_stable_intervals(request, progress=progress), design=None)
    result, design = compute_map(request, progress=progress), None
    if plan.design is not None:
        x, y = plan.design[request.x.name], plan.design[request.y.name]
        if request.x.low <= x <= request.x.high and request.y.low <= y <= request.y.high:
            design = evaluate_point(request, x, y)
    return MadeMap(ask=ask, plan=plan, result=result, design=design)


def _picture(made: MadeMap) -> bytes:
    # matplotlib takes half a second to import; whoever asks for something impossible hears so before that.
    from .draw import draw_map  # noqa: PLC0415
    from .draw_intervals import draw_intervals  # noqa: PLC0415
    from .style import render  # noqa: PLC0415

    result, plan = made.result, made.plan
    if isinstance(result, MapResult):
        return render(lambda: draw_map(plan, result, made.design), made.ask.picture.suffix)
    return render(lambda: draw_intervals(plan, result), made.ask.picture.suffix)


def _map_summary(made: MadeMap, result: MapResult) -> dict[str, Any]:
    request = result.request
    tree: dict[str, Any] = {
        "x": _axis_tree(made.plan, request.x),
        "y": _axis_tree(made.plan, request.y),
        "points": int(result.is_stable.size),
        "stable_share": float(np.mean(result.is_stable)),
    }
    finite = np.isfinite(result.values)
    if np.any(finite):
        tree["unit"] = request.quantity.unit_of(rotational=made.plan.source.is_rotational)
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


def _interval_summary(plan: MapPlan, result: IntervalResult) -> dict[str, Any]:
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
    return {"x": _axis_tree(plan, along), "searched": _axis_tree(plan, searched), "cases": cases}


def _axis_tree(plan: MapPlan, axis: MapAxis) -> dict[str, Any]:
    return {
        "name": axis.name,
        "low": axis.low,
        "high": axis.high,
        "count": axis.count,
        "spacing": axis.spacing,
        "unit": plan.unit(axis.parameter),
    }
