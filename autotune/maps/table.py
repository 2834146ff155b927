"""The data of a map: CSV with a header that says what is fixed, or JSON."""

import json
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from autotune.version import __version__
from problems.maps.maps import MapAxis, MapResult
from problems.maps.parameters import MAP_PARAMETERS, MapParameter, MapQuantity
from problems.maps.search import IntervalResult

from .setup import MapSetup
from .text import WHERE, approach_text, with_unit

FORMAT, VERSION = "autotune/map", 1


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
        tree |= {"x": _axis_tree(setup, result.request.x), "y": _axis_tree(setup, result.request.y)}
        tree["is_stable"] = result.is_stable.tolist()
        if quantity is not MapQuantity.STABILITY:
            # JSON knows neither NaN (unstable) nor infinity (stable, and nothing limits the margin).
            tree["values"] = [
                [value if math.isfinite(value) else None for value in row] for row in result.values.tolist()
            ]
        return tree
    return tree | {
        "show": "stable intervals",
        "searched": _axis_tree(setup, result.request.searched, values=False),
        "tolerance": result.request.tolerance,
        "along": _axis_tree(setup, result.request.along),
        "intervals": {
            name: [
                [
                    {
                        "lower": each.lower,
                        "upper": each.upper,
                        "lower_is_bound": each.lower_is_bound,
                        "upper_is_bound": each.upper_is_bound,
                    }
                    for each in column
                ]
                for column in columns
            ]
            for name, columns in result.intervals.items()
        },
    }


def _axis_tree(setup: MapSetup, axis: MapAxis, *, values: bool = True) -> dict[str, Any]:
    tree: dict[str, Any] = {"name": axis.name, "unit": setup.unit(axis.parameter), "spacing": axis.spacing}
    return tree | (
        {"values": axis.values().tolist()} if values else {"low": axis.low, "high": axis.high, "count": axis.count}
    )


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
