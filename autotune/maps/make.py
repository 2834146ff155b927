"""One call from the request to the picture of a map and its data on disk, as CSV or JSON."""

import json
import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from autotune.formats.atomic import check_target, write_atomic
from autotune.formats.kinds import PICTURE_MARK, check_replaced
from autotune.version import __version__
from problems.maps.maps import MapAxis, MapPoint, MapRequest, MapResult, compute_map, evaluate_point
from problems.maps.parameters import MAP_PARAMETERS, MapParameter, MapQuantity
from problems.maps.search import IntervalRequest, IntervalResult, find_stable_intervals
from problems.progress import Progress

from .charts import interval_chart, map_chart
from .options import MapOptions, check_targets
from .setup import MapSetup, build_setup
from .source import read_source
from .text import WHERE, approach_text, with_unit

FORMAT, VERSION = "autotune/map", 1


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
    found = [(path, check_replaced(path, kind, option=option)) for path, kind, option in asked]
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


def _axis_tree(setup: MapSetup, axis: MapAxis, *, values: bool = False) -> dict[str, Any]:
    """Return an axis by its ends and count, or with `values` by its values."""
    ends = {"low": axis.low, "high": axis.high, "count": axis.count}
    span: dict[str, Any] = {"values": axis.values().tolist()} if values else ends
    return {"name": axis.name, **span, "spacing": axis.spacing, "unit": setup.unit(axis.parameter)}


def table_text(setup: MapSetup, result: MapResult | IntervalResult, path: Path) -> str:
    """Return the text of a data file, CSV or JSON by the suffix of `path`."""
    if path.suffix.lower() == ".json":
        return json.dumps(_tree(setup, result), ensure_ascii=False, allow_nan=False) + "\n"
    lines = [f"# {line}" for line in _header(setup, result)]
    rows = _map_rows(result) if isinstance(result, MapResult) else _interval_rows(result)
    return "\n".join([*lines, *rows]) + "\n"


def _header(setup: MapSetup, result: MapResult | IntervalResult) -> Iterator[str]:
    source, request = setup.source, result.request
    yield f"{FORMAT} version {VERSION}, autotune {__version__}"
    yield f"source: {source.path.name}, axis {source.axis}"
    if isinstance(result, MapResult):
        quantity = result.request.quantity
        yield f"shown: {quantity.label} {WHERE[request.where]}"
        if quantity.is_peak:
            yield approach_text(result.request.approach, rotational=source.is_rotational)
        axes = [result.request.x, result.request.y]
    else:
        yield f"shown: stable intervals of {result.request.searched.parameter.label} {WHERE[request.where]}"
        yield f"searched: {_range(setup, result.request.searched)}"
        yield f"ends known within {result.request.tolerance:g} of that range{_logarithmic(result.request.searched)}"
        axes = [result.request.along]
    for name, value in setup.fixed.items():
        yield f"fixed: {_entry(setup, MAP_PARAMETERS[name], value)}"
    yield f"fixed: sample time h = {source.sample_time_s!r} s"
    if setup.source.robot.order > 1:
        numerator, denominator = (list(map(float, each)) for each in (source.robot.numerator, source.robot.denominator))
        yield f"fixed: robot r(s) = {numerator} / {denominator}, descending powers of s"
    for axis in axes:
        yield f"varied: {_range(setup, axis)}"
    yield f"columns: {', '.join(_columns(setup, result))}"
    if isinstance(result, MapResult):
        yield "a value is empty where the loop is unstable, inf where nothing limits the margin"
    else:
        yield "an interval that ends at a bound of the search goes on beyond it; interval 0 says that nothing is stable"


def _columns(setup: MapSetup, result: MapResult | IntervalResult) -> list[str]:
    if isinstance(result, MapResult):
        request = result.request
        columns = [_named(setup, request.x.parameter), _named(setup, request.y.parameter), "is_stable (1 or 0)"]
        if request.quantity is not MapQuantity.STABILITY:
            unit = request.quantity.unit_of(rotational=setup.source.is_rotational)
            columns.append(f"{request.quantity.label}" + (f" [{unit}]" if unit else ""))
        return columns
    searched = _named(setup, result.request.searched.parameter)
    ends = [f"lower and upper end of {searched}", "whether they are a bound of the search (1 or 0)"]
    return ["case", _named(setup, result.request.along.parameter), "number of the interval", *ends]


def _map_rows(result: MapResult) -> Iterator[str]:
    request = result.request
    with_value = request.quantity is not MapQuantity.STABILITY
    value_name = request.quantity.value.replace("-", "_")
    yield ",".join([request.x.name, request.y.name, "is_stable", *([value_name] if with_value else [])])
    x = [repr(float(each)) for each in request.x.values()]
    for y, stable, values in zip(request.y.values(), result.is_stable, result.values, strict=True):
        row = repr(float(y))
        if with_value:
            texts = ["" if math.isnan(value) else repr(value) for value in map(float, values)]
            yield from (f"{a},{row},{int(b)},{c}" for a, b, c in zip(x, stable, texts, strict=True))
        else:
            yield from (f"{a},{row},{int(b)}" for a, b in zip(x, stable, strict=True))


def _interval_rows(result: IntervalResult) -> Iterator[str]:
    request = result.request
    yield f"case,{request.along.name},interval,lower,upper,lower_is_bound,upper_is_bound"
    for name, columns in result.intervals.items():
        for value, column in zip(request.along.values(), columns, strict=True):
            if not column:
                yield f"{name},{float(value)!r},0,,,,"
            for i, each in enumerate(column, start=1):
                flags = f"{int(each.lower_is_bound)},{int(each.upper_is_bound)}"
                yield f"{name},{float(value)!r},{i},{each.lower!r},{each.upper!r},{flags}"


def _tree(setup: MapSetup, result: MapResult | IntervalResult) -> dict[str, Any]:
    source, request = setup.source, result.request
    tree: dict[str, Any] = {
        "format": FORMAT,
        "version": VERSION,
        "tool": f"autotune {__version__}",
        "source": source.path.name,
        "axis": source.axis,
        "where": request.where,
        "sample_time_s": source.sample_time_s,
        "robot": {"numerator": source.robot.numerator.tolist(), "denominator": source.robot.denominator.tolist()},
        "fixed": {
            name: {"value": value, "unit": setup.unit(MAP_PARAMETERS[name])} for name, value in setup.fixed.items()
        },
    }
    if isinstance(result, MapResult):
        quantity = result.request.quantity
        unit = quantity.unit_of(rotational=source.is_rotational)
        tree |= {"show": quantity.value, "unit": unit}
        if quantity.is_peak:
            approach = result.request.approach
            tree["approach"] = {"force_n": approach.force_n, "speed_m_s": approach.speed_m_s}
        tree |= {name: _axis_tree(setup, getattr(result.request, name), values=True) for name in ("x", "y")}
        tree["is_stable"] = result.is_stable.tolist()
        if quantity is not MapQuantity.STABILITY:
            # JSON knows neither NaN (unstable) nor infinity (stable, and nothing limits the margin).
            tree["values"] = [
                [value if math.isfinite(value) else None for value in row] for row in result.values.tolist()
            ]
        return tree
    return tree | {
        "show": "stable intervals",
        "searched": _axis_tree(setup, result.request.searched),
        "tolerance": result.request.tolerance,
        "along": _axis_tree(setup, result.request.along, values=True),
        "intervals": {
            name: [[vars(each) for each in column] for column in columns] for name, columns in result.intervals.items()
        },
    }


def _range(setup: MapSetup, axis: MapAxis) -> str:
    ends = with_unit(f"{axis.low!r} to {axis.high!r}", setup.unit(axis.parameter))
    return f"{axis.name} ({axis.parameter.symbol}) from {ends}, {axis.count} values, {axis.spacing} spacing"


def _logarithmic(axis: MapAxis) -> str:
    return " in the logarithm" if axis.spacing == "log" else ""


def _entry(setup: MapSetup, parameter: MapParameter, value: float) -> str:
    return with_unit(f"{parameter.name} ({parameter.symbol}) = {value!r}", setup.unit(parameter))


def _named(setup: MapSetup, parameter: MapParameter) -> str:
    unit = setup.unit(parameter)
    return parameter.name + (f" [{unit}]" if unit else "")
