"""Draw a chart that can be zoomed and asked for numbers: the only door of reports to Bokeh."""

import json
import re
from collections.abc import Sequence
from functools import singledispatch
from typing import Any

import numpy as np
from bokeh.core.json_encoder import serialize_json
from bokeh.document import Document
from bokeh.layouts import gridplot
from bokeh.models import BasicTicker, ColumnDataSource, HoverTool, LinearColorMapper, Range1d
from bokeh.models.annotations import ColorBar, Legend, LegendItem, Span
from bokeh.plotting import figure
from bokeh.resources import INLINE

from .charts import Band, Bars, Chart, Heat, Limit, Line, Panel, Points, Stretch
from .decimate import decimate
from .palette import COLOURS

_PANEL_PIXELS, _BESIDE_PIXELS = 210, 240
_MOST_POINTS = 2800
_TOOLS = "xpan,xwheel_zoom,box_zoom,reset"
_ROUND_TOOLS = "pan,wheel_zoom,box_zoom,reset"
_MARKERS = {"dot": "circle", "star": "star", "diamond": "diamond"}
_MODEL_ID = re.compile(r'"p\d{4,}"')


def engine() -> str:
    """Return the script that draws live charts: it comes with the installed package and asks the net for nothing."""
    return "\n".join(INLINE.js_raw[:1])


def draw_live(chart: Chart) -> dict[str, Any]:
    """Return what the engine needs to draw the chart: its document and the id of its root.

    The same chart gives the same text: the ids that the library counts up are counted anew for each chart.
    """
    plots = [_draw_panel(panel, len(chart.panels) > 1 and chart.beside) for panel in chart.panels]
    if chart.linked:
        for plot in plots[1:]:
            plot.x_range = plots[0].x_range
    rows = [plots] if chart.beside else [[plot] for plot in plots]
    document = Document()
    document.add_root(gridplot(rows, sizing_mode="stretch_width", merge_tools=False, toolbar_location=None))
    told = serialize_json(document.to_json(deferred=False))
    found = dict.fromkeys(_MODEL_ID.findall(told))
    names = {old: f'"{chart.key}-{i}"' for i, old in enumerate(found)}
    renamed = json.loads(_MODEL_ID.sub(lambda match: names[match.group()], told))
    return {"document": renamed, "root": renamed["roots"][0]["id"]}


def _draw_panel(panel: Panel, is_beside: bool) -> Any:
    height = int((_BESIDE_PIXELS if is_beside else _PANEL_PIXELS) * panel.height)
    ranges: dict[str, Any] = {}
    if panel.x.limits is not None:
        ranges["x_range"] = Range1d(start=panel.x.limits[0], end=panel.x.limits[1])
    if panel.y.limits is not None:
        ranges["y_range"] = Range1d(start=panel.y.limits[0], end=panel.y.limits[1])
    plot = figure(
        frame_height=height,
        sizing_mode="stretch_width",
        title=panel.title or None,
        x_axis_type=panel.x.spacing,
        y_axis_type=panel.y.spacing,
        x_axis_label=panel.x.label,
        y_axis_label=panel.y.label,
        tools=_ROUND_TOOLS if panel.equal else _TOOLS,
        match_aspect=panel.equal,
        background_fill_alpha=0.0,
        border_fill_alpha=0.0,
        outline_line_color="#7a7f85",
        **ranges,
    )
    plot.toolbar.logo = None
    plot.toolbar_location = "above"
    items: list[LegendItem] = []
    _draw_stretches([element for element in panel.elements if isinstance(element, Stretch)], plot)
    for element in panel.elements:
        drawn = None if isinstance(element, Stretch) else _draw_element(element, plot)
        if drawn is not None and element.label:
            items.append(LegendItem(label=element.label, renderers=[drawn]))
    if items:
        plot.add_layout(
            Legend(
                items=items,
                orientation="horizontal",
                spacing=12,
                location="left",
                label_text_font_size="11px",
                click_policy="hide",
                border_line_alpha=0.0,
                background_fill_alpha=0.0,
                margin=0,
            ),
            "below",
        )
    return plot


@singledispatch
def _draw_element(element: object, plot: Any) -> Any:
    """Draw one element and return what a legend may show of it, or None."""
    raise TypeError(f"{plot!r} cannot hold {element!r}")


@_draw_element.register
def _(line: Line, plot: Any) -> Any:
    x, y = decimate(line.x, line.y, _MOST_POINTS)
    source = ColumnDataSource({"x": _short(x), "y": _short(y)})
    look: dict[str, Any] = {
        "color": COLOURS[line.role],
        "line_width": 1.4,
        "line_dash": "dashed" if line.dashed else "solid",
    }
    if line.steps:
        drawn = plot.step("x", "y", source=source, mode="after", **look)
    else:
        drawn = plot.line("x", "y", source=source, **look)
    plot.add_tools(_hover(drawn, [(line.label or "value", "@y{0.0000}"), ("at", "@x{0.0000}")]))
    return drawn


@_draw_element.register
def _(band: Band, plot: Any) -> Any:
    source = ColumnDataSource({"x": _short(band.x), "low": _short(band.low), "high": _short(band.high)})
    return plot.varea("x", "low", "high", source=source, color=COLOURS[band.role], alpha=0.22)


@_draw_element.register
def _(points: Points, plot: Any) -> Any:
    columns: dict[str, Any] = {"x": _short(points.x), "y": _short(points.y)}
    tips = [(points.label or "value", "@y{0.0000}"), ("at", "@x{0.0000}")]
    if points.names:
        columns["name"] = list(points.names)
        tips.insert(0, ("", "@name"))
    drawn = plot.scatter(
        "x",
        "y",
        source=ColumnDataSource(columns),
        color=COLOURS[points.role],
        line_color="white",
        size=13 if points.marker == "star" else 8,
        marker=_MARKERS[points.marker],
    )
    plot.add_tools(_hover(drawn, tips))
    return drawn


@_draw_element.register
def _(bars: Bars, plot: Any) -> Any:
    return plot.quad(
        left=_short(bars.edges[:-1]),
        right=_short(bars.edges[1:]),
        bottom=0,
        top=_short(bars.heights),
        color=COLOURS[bars.role],
        alpha=0.75,
    )


def _draw_stretches(stretches: Sequence[Stretch], plot: Any) -> None:
    """Draw all stretches of a role as one glyph: a long log has hundreds, and each model of the library costs."""
    for role in dict.fromkeys(stretch.role for stretch in stretches):
        mine = [stretch for stretch in stretches if stretch.role == role]
        ends = {
            "low": _short(np.array([stretch.low for stretch in mine])),
            "high": _short(np.array([stretch.high for stretch in mine])),
        }
        look: dict[str, Any] = {"fill_color": COLOURS[role], "fill_alpha": 0.16, "line_alpha": 0.0}
        plot.vstrip("low", "high", source=ColumnDataSource(ends), **look)


@_draw_element.register
def _(limit: Limit, plot: Any) -> None:
    look: dict[str, Any] = {"line_color": COLOURS[limit.role], "line_dash": "dotted", "line_width": 1.5}
    plot.add_layout(Span(location=limit.value, dimension="width" if limit.along == "y" else "height", **look))


@_draw_element.register
def _draw_heat(heat: Heat, plot: Any) -> None:
    low, high = heat.limits or (float(np.nanmin(heat.values)), float(np.nanmax(heat.values)))
    palette = "RdBu11" if heat.limits is not None and low == -high else "Viridis256"
    mapper = LinearColorMapper(palette=palette, low=low, high=high, nan_color="rgba(0,0,0,0)")
    left, right = _cells(heat.x, plot.x_scale.__class__.__name__ == "LogScale")
    bottom, top = _cells(heat.y, plot.y_scale.__class__.__name__ == "LogScale")
    columns, rows = len(heat.x), len(heat.y)
    source = ColumnDataSource(
        {
            "left": _short(np.tile(left, rows)),
            "right": _short(np.tile(right, rows)),
            "bottom": _short(np.repeat(bottom, columns)),
            "top": _short(np.repeat(top, columns)),
            "value": _short(heat.values.reshape(-1)),
        }
    )
    drawn = plot.quad(
        "left",
        "right",
        "bottom",
        "top",
        source=source,
        line_color=None,
        fill_color={"field": "value", "transform": mapper},
    )
    tips = [(heat.label, "@value{0.0000}")]
    if heat.names is not None:
        source.data["name"] = [f"{a}, {b}" for b in heat.names[1] for a in heat.names[0]]
        tips.insert(0, ("", "@name"))
        _name(plot.xaxis[0], heat.x, heat.names[0])
        _name(plot.yaxis[0], heat.y, heat.names[1])
        plot.xaxis[0].major_label_orientation = 1.0
        plot.y_range.flipped = True
    plot.add_tools(_hover(drawn, tips))
    plot.add_layout(
        ColorBar(color_mapper=mapper, ticker=BasicTicker(), title=heat.label, width=12, background_fill_alpha=0.0),
        "right",
    )


def _name(axis: Any, places: np.ndarray, names: tuple[str, ...]) -> None:
    axis.ticker = [float(place) for place in places]
    axis.major_label_overrides = {float(place): name for place, name in zip(places, names, strict=True)}


def _cells(middles: np.ndarray, is_log: bool) -> tuple[np.ndarray, np.ndarray]:
    """Return the left and right ends of cells around their middles."""
    on = np.log(middles) if is_log else middles
    half = 0.5 * (on[1] - on[0]) if len(on) > 1 else 0.5
    ends = on - half, on + half
    return (np.exp(ends[0]), np.exp(ends[1])) if is_log else ends


def _hover(renderer: Any, tips: list[tuple[str, str]]) -> HoverTool:
    return HoverTool(renderers=[renderer], tooltips=tips, visible=False, mode="mouse")


def _short(values: np.ndarray) -> np.ndarray:
    """Return single precision: no screen shows more, and the page is half as long."""
    return np.asarray(values, dtype=np.float32)
