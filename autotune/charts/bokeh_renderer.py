"""Draw a chart with Bokeh, to be zoomed and asked for numbers in a browser: the only use of Bokeh in reports."""

import json
import re
from functools import singledispatch
from typing import Any

import numpy as np
from bokeh.core.json_encoder import serialize_json
from bokeh.document import Document
from bokeh.models import (
    BasicTicker,
    ColumnDataSource,
    CustomJSTickFormatter,
    DataRange1d,
    HoverTool,
    LinearColorMapper,
    NoOverlap,
    Range1d,
)
from bokeh.models.annotations import ColorBar, Span, Title
from bokeh.palettes import RdBu11, interp_palette
from bokeh.plotting import figure
from bokeh.resources import INLINE
from numpy.typing import ArrayLike

from .chart import MOST_POINTS, Band, Bars, Chart, Heat, Limit, Line, Panel, Points, Scale, Stretch
from .palette import COLOURS, FURNITURE

_PANEL_PIXELS, _BESIDE_PIXELS = 210, 240
_TOOLS = "xpan,xwheel_zoom,box_zoom,reset"
_ROUND_TOOLS = "pan,wheel_zoom,box_zoom,reset"
_MARKERS = {"dot": "circle", "star": "star", "diamond": "diamond"}
_MODEL_ID = re.compile(r'"p\d{4,}"')
_SHADES = 256
# Panels below each other have the same left edge, whatever their numbers are.
_LEFT_PIXELS = {True: 40, False: 62}
# The engine's own logarithmic numbers are powers with raised digits, or have seventeen places.
_PLAIN = """
const value = Number(tick.toPrecision(3));
return value >= 1e-3 && value < 1e5 ? String(value) : value.toExponential().replace("e+", "e");
"""


def engine() -> str:
    """Return the script that draws live charts: it comes with the installed package and asks the net for nothing."""
    return "\n".join(INLINE.js_raw[:1])


def draw_live(chart: Chart) -> dict[str, Any]:
    """Return what the engine needs to draw the chart: its document and the ids of its roots, one for each panel.

    The same chart gives the same text: the ids that the library counts up are counted anew for each chart.
    """
    plots = [draw_panel(panel, chart.beside) for panel in chart.panels]
    if chart.linked:
        for plot in plots[1:]:
            plot.x_range = plots[0].x_range
    document = Document()
    for plot in plots:
        document.add_root(plot)
    document_text = serialize_json(document.to_json(deferred=False))
    found = dict.fromkeys(_MODEL_ID.findall(document_text))
    names = {old: f'"{chart.key}-{i}"' for i, old in enumerate(found)}
    renamed = json.loads(_MODEL_ID.sub(lambda match: names[match.group()], document_text))
    return {"document": renamed, "roots": [root["id"] for root in renamed["roots"]]}


def draw_panel(panel: Panel, is_beside: bool) -> Any:
    """Return a plot of one panel."""
    height = int((_BESIDE_PIXELS if is_beside else _PANEL_PIXELS) * panel.height)
    ranges: dict[str, Any] = {}
    if not panel.equal:
        for name, scale in (("x_range", panel.x), ("y_range", panel.y)):
            if scale.limits is not None:
                ranges[name] = Range1d(start=scale.limits[0], end=scale.limits[1])
    plot = figure(
        frame_height=height,
        min_border_left=_LEFT_PIXELS[is_beside],
        min_border_right=12,
        sizing_mode="stretch_width",
        title=panel.title or None,
        x_axis_type=panel.x.spacing,
        y_axis_type=panel.y.spacing,
        x_axis_label=panel.x.label,
        tools=_ROUND_TOOLS if panel.equal else _TOOLS,
        match_aspect=panel.equal,
        # With a ground: without one the engine draws the outline on top of what it drew last, which stays on the paper.
        background_fill_color=FURNITURE["paper"],
        border_fill_alpha=0.0,
        outline_line_color=FURNITURE["frame"],
        **ranges,
    )
    plot.toolbar.logo = None
    plot.toolbar_location = "above"
    _dress(plot, panel)
    if panel.equal:
        _keep_round(plot, panel.x, panel.y)
    for role, parts in panel.stretches().items():
        ends = {"low": _short([each.low for each in parts]), "high": _short([each.high for each in parts])}
        look: dict[str, Any] = {"fill_color": COLOURS[role], "fill_alpha": 0.16, "line_alpha": 0.0}
        plot.vstrip("low", "high", source=ColumnDataSource(ends), **look)
    for element in panel.elements:
        if not isinstance(element, Stretch):
            _draw_element(element, plot)
    return plot


def _dress(plot: Any, panel: Panel) -> None:
    """Give what is not data the colours that the page knows how to turn for dark paper."""
    ink, frame = FURNITURE["ink"], FURNITURE["frame"]
    text: dict[str, Any] = {"text_color": ink, "text_font_size": "12px", "text_font": "sans-serif"}
    if panel.title:
        plot.title.update(**text)
    plot.add_layout(Title(text=panel.y.label, text_font_style="normal", **text), "above")
    for axis, scale in ((plot.xaxis[0], panel.x), (plot.yaxis[0], panel.y)):
        axis.axis_label_text_font_style = "normal"
        axis.axis_label_text_color = axis.major_label_text_color = ink
        axis.axis_line_color = axis.major_tick_line_color = axis.minor_tick_line_color = frame
        if scale.counts:
            axis.ticker = BasicTicker(min_interval=1.0, num_minor_ticks=0)
        if scale.spacing == "log":
            axis.formatter = CustomJSTickFormatter(code=_PLAIN)
            axis.major_label_policy = NoOverlap(min_distance=6)
    for grid in plot.grid:
        grid.grid_line_color = FURNITURE["grid"]


def _keep_round(plot: Any, x: Scale, y: Scale) -> None:
    """Fit the panel to its limits and not to its curves, with the same length per unit in both directions."""
    if x.limits is None or y.limits is None:
        return
    corners = ColumnDataSource({"x": list(x.limits), "y": list(y.limits)})
    frame = plot.scatter("x", "y", source=corners, alpha=0.0)
    plot.x_range, plot.y_range = DataRange1d(renderers=[frame]), DataRange1d(renderers=[frame])


@singledispatch
def _draw_element(element: object, plot: Any) -> Any:
    """Draw one element and return what a legend may show of it, or None."""
    raise TypeError(f"{plot!r} cannot hold {element!r}")


@_draw_element.register
def _(line: Line, plot: Any) -> Any:
    x, y = line.thinned(MOST_POINTS)
    source = ColumnDataSource({"x": _short(x), "y": _short(y)})
    look: dict[str, Any] = {
        "color": COLOURS[line.role],
        "line_width": 3.4 if line.is_wide else 1.5,
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
        line_color=FURNITURE["paper"],
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


@_draw_element.register
def _(limit: Limit, plot: Any) -> None:
    look: dict[str, Any] = {"line_color": COLOURS[limit.role], "line_dash": "dotted", "line_width": 1.5}
    plot.add_layout(Span(location=limit.value, dimension="width" if limit.along == "y" else "height", **look))


@_draw_element.register
def _draw_heat(heat: Heat, plot: Any) -> None:
    low, high = heat.span()
    palette = interp_palette(RdBu11, _SHADES) if heat.is_two_sided else "Viridis256"
    mapper = LinearColorMapper(palette=palette, low=low, high=high, nan_color="rgba(0,0,0,0)")
    plot.background_fill_color = FURNITURE["hole"]
    for grid in plot.grid:
        grid.visible = False
    for side in (plot.x_range, plot.y_range):
        if isinstance(side, DataRange1d):
            side.range_padding = 0.0
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
        # A line of the same colour, so that no ground is seen between cells.
        line_color={"field": "value", "transform": mapper},
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
    _write_numbers(plot, heat)
    text: dict[str, Any] = {"text_color": FURNITURE["ink"], "text_font_size": "12px", "text_font": "sans-serif"}
    bar = ColorBar(
        color_mapper=mapper,
        ticker=BasicTicker(),
        width=12,
        padding=6,
        background_fill_alpha=0.0,
        major_label_text_color=FURNITURE["ink"],
    )
    plot.add_layout(bar, "right")
    plot.add_layout(Title(text=heat.label, text_font_style="normal", align="center", **text), "right")


def _write_numbers(plot: Any, heat: Heat) -> None:
    for on_dark, colour in ((False, "#222222"), (True, "#ffffff")):
        found = [each for each in heat.writings() if each[3] == on_dark]
        if found:
            x, y, texts, _ = zip(*found, strict=True)
            source = ColumnDataSource({"x": x, "y": y, "text": texts})
            look: dict[str, Any] = {"text_align": "center", "text_baseline": "middle", "text_font_size": "9px"}
            plot.text("x", "y", text="text", source=source, text_color=colour, **look)


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


def _short(values: ArrayLike) -> np.ndarray:
    """Return single precision: no screen shows more, and the page is half as long."""
    return np.asarray(values, dtype=np.float32)
