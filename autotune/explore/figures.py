"""The figures of the page: drawn once, then given a new view, in one message, whenever a slider moves."""

import json
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from bokeh.core.properties import Any as Anything
from bokeh.core.properties import Dict, String
from bokeh.document import Document
from bokeh.events import DocumentReady
from bokeh.model import DataModel, Model
from bokeh.models import (
    BoxZoomTool,
    ColumnDataSource,
    CustomJS,
    CustomJSTickFormatter,
    DataRange1d,
    FactorRange,
    HoverTool,
    InlineStyleSheet,
    LinearColorMapper,
    LogTicker,
)
from bokeh.models.annotations import ColorBar, Span
from bokeh.palettes import Viridis256
from bokeh.plotting import figure
from bokeh.transform import transform

from autotune.charts.chart import decimate
from autotune.charts.palette import COLOURS
from autotune.formats.units import axis_units
from problems.arrays import RealArray
from problems.design.problem import DesignProblem
from problems.design.requirements import Requirements

from .design_map import DesignMap, MapWindow
from .sliders import SliderRange
from .view import View
from .words import requirement_title

KEYS = ("contact", "admittance", "nyquist", "requirements", "map")
_MOST_POINTS = 900
_HEIGHT, _MAP_HEIGHT = 300, 380
_TOOLS = "pan,wheel_zoom,box_zoom,reset"
# What misses a limit by more than this is drawn as if it missed by that much.
_LONGEST_BAR = 2.0
_NYQUIST_HEIGHT = 360
_NYQUIST = {"left": [-2.2], "right": [1.0], "bottom": [-1.6], "top": [1.2]}
# On light paper; the page has others on dark paper. Neither meets a colour of the cells, which leave out both ends.
_UNSTABLE, _MISSED = "#e3b7b2", "#edeae2"
_KEPT = "#8a8f95"
_CELLS = Viridis256[32:232]
# More than one number of two digits, so that no tick of less than a decade reads like another one.
_TICKS = "return Number(tick.toPrecision(3)).toExponential();"
_DRAWN_FROM = {
    "contact": ("contact", "sensor", "peak", "diverging", "ending", "kept"),
    "admittance": ("gain", "target"),
    "nyquist": ("force", "command", "circle"),
    "requirements": ("bars",),
    "map": ("map", "own"),
}
# Forces beyond so many times the largest of the start, or of what drives the contact, are cut off.
_CLIPPED_AT, _CLIPPED_AT_DRIVE = 3.0, 20.0
# A swing whose second half is this much larger than its first one grows.
_GROWS = 1.05
_EMPTY: Mapping[str, list[float]] = {"x": [], "y": []}

Changes = dict[str, dict[str, Any]]


class BatchedUpdate(DataModel):
    """One message to the browser for all that a slider changes: for each named model, properties and their values.

    Bokeh sends a message for every property that is set, two more for every array, and the browser draws between them.
    A script in the page hands on what is put into this one property: `text` is JSON, in which an array is
    {"numbers": [begin, shape]}, its place in the one array `numbers` (n,).
    """

    content: Any = Dict(String, Anything, default={})


def pack(changes: "Changes") -> dict[str, Any]:
    """Return changes as the content of a `BatchedUpdate`."""
    arrays: list[RealArray] = []
    begin = 0

    def place(array: RealArray) -> dict[str, Any]:
        nonlocal begin
        arrays.append(np.asarray(array, dtype=np.float64).reshape(-1))
        begin += array.size
        return {"numbers": [begin - array.size, list(array.shape)]}

    text = json.dumps(changes, default=place, allow_nan=False, ensure_ascii=False, separators=(",", ":"))
    return {"text": text, "numbers": np.concatenate([np.empty(0), *arrays])}


class Sender:
    """Collect what changes of named models, and send it together.

    Until a browser shows the document the models themselves are set, since they are what it begins with; from then on
    they change in the browser only.
    """

    def __init__(self, document: Document, models: Iterable[Model], carrier: Any) -> None:
        """Prepare to send to `models`; `carrier` is any model of the page, which brings the batched update along."""
        self._models = {str(model.name): model for model in models}
        self._changes: Changes = {}
        self._update = BatchedUpdate(name="batched-update")
        self._update.js_on_change("content", CustomJS(code="explore.handOn(cb_obj.content)"))
        self._is_shown = False
        carrier.tags = [self._update]
        document.on_event(DocumentReady, self._begin)

    def _begin(self, _event: object) -> None:
        self._is_shown = True

    def put(self, model: Model, **values: Any) -> None:
        """Note properties of one of the models."""
        self._changes.setdefault(str(model.name), {}).update(values)

    def send(self) -> None:
        """Send what was put since the last time."""
        changes, self._changes = self._changes, {}
        if self._is_shown:
            self._update.content = pack(changes)
            return
        for name, values in changes.items():
            self._models[name].update(**values)


@dataclass(frozen=True, kw_only=True)
class DrawnLine:
    """A line of a figure for its legend: what it shows, its colour, `kind`, solid or dashed, and its data's name."""

    label: str
    colour: str
    kind: str
    source: str


class Figures:
    """All figures by their key in `plots`, and what they are drawn from.

    `lines` are for legends that the page writes: one that the engine draws is drawn again at every turn.
    """

    def __init__(self) -> None:
        self.lines: dict[str, list[DrawnLine]] = {key: [] for key in KEYS}
        self.sources = {
            name: ColumnDataSource(dict(_EMPTY), name=f"data-{name}")
            for name in ("contact", "sensor", "begun", "peak", "gain", "target", "force", "command", "circle")
        }
        self.sources["bars"] = ColumnDataSource({"name": [], "right": [], "colour": [], "text": []}, name="data-bars")
        cells: dict[str, list[float]] = {"stable": [], "peak": [], "x": [], "y": [], "dw": [], "dh": []}
        self.sources["map"] = ColumnDataSource(cells, name="data-map")
        own: dict[str, list[float]] = {"x": [], "y": [], "left": [], "right": [], "bottom": [], "top": []}
        self.sources["own"] = ColumnDataSource({**own, "stable": [], "peak": []}, name="data-own")
        self.sources["diverging"] = ColumnDataSource(dict(_EMPTY), name="data-diverging")
        self.sources["ending"] = ColumnDataSource({**_EMPTY, "text": [], "align": []}, name="data-ending")
        curves: dict[str, list[float]] = {"xs": [], "ys": [], "x": [], "y": [], "text": []}
        self.sources["kept"] = ColumnDataSource(curves, name="data-kept")
        self.largest_n = math.inf
        self.colours = LinearColorMapper(palette=_CELLS, low=0.0, high=1.0, nan_color="rgba(0,0,0,0)", name="colours")
        self.mapped: tuple[float, float] | None = None
        # Of the map's x and y, from SI to the units of its axes.
        self.scales = 1.0, 1.0
        self.plots = {
            "contact": self._contact(),
            "admittance": self._admittance(),
            "nyquist": self._nyquist(),
            "requirements": self._requirements(),
            "map": self._map(),
        }
        # Each names the figure that it belongs to.
        for key, names in _DRAWN_FROM.items():
            for name in names:
                self.sources[name].tags = [key]
        self.colours.tags = self.bar.tags = ["map"]

    def _contact(self) -> Any:
        # Above the highest curve there is room for a word.
        plot = _plot("contact", "time after the contact [ms]", "force", y_range=DataRange1d(range_padding=0.2))
        kept = self.sources["kept"]
        plot.multi_line("xs", "ys", source=kept, color=_KEPT, line_width=1.0)
        self._word(plot, kept, _KEPT, align="center")
        self.lines["contact"].append(DrawnLine(label="kept, by number", colour=_KEPT, kind="solid", source="data-kept"))
        self._line(plot, self.sources["begun"], "before", "as begun", dashed=True)
        self._line(plot, self.sources["sensor"], "quiet", "at the sensor")
        self._line(plot, self.sources["contact"], "model", "at the contact")
        plot.scatter("x", "y", source=self.sources["peak"], color=COLOURS["model"], size=9, line_color="white")
        diverging = self.sources["diverging"]
        self._line(plot, diverging, "bad", "unstable")
        self._word(plot, self.sources["ending"], COLOURS["bad"], align="align")
        return plot

    def _word(self, plot: Any, source: ColumnDataSource, colour: str, *, align: str) -> None:
        """Write what a source has as `text` above its points, over all curves and on the ground of the paper."""
        look: dict[str, Any] = {"text_font_size": "12px", "text_baseline": "bottom", "y_offset": -5, "padding": 1}
        drawn = plot.text(
            "x", "y", text="text", source=source, text_color=colour, text_align=align, level="overlay", **look
        )
        drawn.glyph.update(name=f"words-{source.name}", background_fill_color="white")

    def _admittance(self) -> Any:
        plot = _plot("admittance", "frequency [Hz]", "|G|", x_axis_type="log", y_axis_type="log")
        plot.yaxis.ticker = LogTicker(mantissas=[1, 2, 5])
        plot.yaxis.formatter = CustomJSTickFormatter(code=_TICKS)
        self._line(plot, self.sources["target"], "target", "at least", dashed=True)
        self._line(plot, self.sources["gain"], "after", "|G|, free space")
        return plot

    def _nyquist(self) -> Any:
        # Circles stay circles: a box without colour is what must be seen; the ranges grow around it to equal scales.
        ends: dict[str, Any] = {"x_range": DataRange1d(range_padding=0.0), "y_range": DataRange1d(range_padding=0.0)}
        plot = _plot("nyquist", "real", "imaginary", height=_NYQUIST_HEIGHT, match_aspect=True, **ends)
        box = plot.quad(**_NYQUIST, fill_alpha=0.0, line_alpha=0.0)
        for each in ends.values():
            each.renderers = [box]
        for tool in plot.select(type=BoxZoomTool):
            tool.match_aspect = True
        self._line(plot, self.sources["circle"], "target", "margin asked", dashed=True)
        self._line(plot, self.sources["force"], "model", "at the force")
        self._line(plot, self.sources["command"], "after", "at the command")
        plot.scatter([-1.0], [0.0], marker="cross", size=14, line_width=2, color=COLOURS["bad"])
        return plot

    def _requirements(self) -> Any:
        plot = _plot(
            "requirements",
            "required / achieved: up to 1 is met",
            "",
            y_range=FactorRange(),
            x_range=(0.0, 1.2 * _LONGEST_BAR),
        )
        bars = self.sources["bars"]
        plot.hbar(y="name", right="right", height=0.6, color="colour", source=bars)
        limit = Span(location=1.0, dimension="height", line_color=COLOURS["target"], line_width=2, level="glyph")
        plot.add_layout(limit)
        # The numbers lie above the line, on a ground of their own.
        place: dict[str, Any] = {"x_offset": 4, "padding": 1, "text_font_size": "12px", "text_baseline": "middle"}
        texts = plot.text(x="right", y="name", text="text", source=bars, level="overlay", **place)
        texts.glyph.update(name="ratios", background_fill_color="white")
        return plot

    def _map(self) -> Any:
        ends: dict[str, Any] = {"x_range": (1.0, 2.0), "y_range": (0.0, 1.0)}
        plot = _plot("map", "", "", x_axis_type="log", height=_MAP_HEIGHT, **ends)
        # Few enough that none meets the next one on a narrow page.
        plot.xaxis.ticker.desired_num_ticks = 4
        box: dict[str, Any] = {"x": "x", "y": "y", "dw": "dw", "dh": "dh", "source": self.sources["map"]}
        two = LinearColorMapper(palette=[_UNSTABLE, _MISSED], low=0.0, high=1.0, name="grounds")
        plot.image(image="stable", color_mapper=two, **box)
        drawn = plot.image(image="peak", color_mapper=self.colours, **box)
        edges: dict[str, Any] = {key: key for key in ("left", "right", "bottom", "top")}
        own, colour = self.sources["own"], COLOURS["model"]
        for field, mapper in (("stable", two), ("peak", self.colours)):
            plot.quad(source=own, fill_color=transform(field, mapper), line_color=colour, **edges)
        plot.scatter("x", "y", source=own, marker="star", size=17, color=colour, line_color="white")
        plot.add_tools(HoverTool(renderers=[drawn], tooltips=[("worst peak", "@peak{0.0}")], visible=False))
        self.bar = ColorBar(
            color_mapper=self.colours, width=10, title="worst peak", background_fill_alpha=0.0, name="bar"
        )
        plot.add_layout(self.bar, "right")
        return plot

    def _line(self, plot: Any, source: ColumnDataSource, role: str, label: str, *, dashed: bool = False) -> None:
        kind = "dashed" if dashed else "solid"
        plot.line("x", "y", source=source, color=COLOURS[role], line_width=1.8, line_dash=kind)
        line = DrawnLine(label=label, colour=COLOURS[role], kind=kind, source=str(source.name))
        self.lines[plot.name].append(line)

    def changing(self) -> list[Model]:
        """Return what changes whenever a slider moves."""
        return [*self.sources.values(), self.colours, self.bar]

    def begin(self, problem: DesignProblem, axis: str, begun: View) -> None:
        """Show what does not change while one axis is explored: units, and the design to start from."""
        units, asked = axis_units(axis), problem.requirements
        self.plots["contact"].yaxis.axis_label = f"{units.force_name} [{units.force}]"
        self.plots["admittance"].yaxis.axis_label = f"|G| [{units.admittance}]"
        self.plots["requirements"].y_range.factors = [requirement_title(name) for name in asked.asked()][::-1]
        self.sources["begun"].data, self.largest_n = dict(_EMPTY), math.inf
        if begun.transient is not None:
            run = begun.transient
            self.sources["begun"].data = _over_time(run.time_s, run.contact_force_n)
            self.largest_n = _CLIPPED_AT * run.peak_contact_force_n
        self.bar.title = f"worst peak [{units.force}]"

    def show_limits(self, asked: Requirements, sender: Sender) -> None:
        """Show the least |G| and the circle of the modulus margin that are asked."""
        target = asked.free_space_admittance
        limit = _EMPTY if target is None else {"x": list(target.band_hz), "y": [target.min_m_s_per_n] * 2}
        sender.put(self.sources["target"], data=dict(limit))
        turn, radius = np.linspace(0.0, 2.0 * np.pi, 121), asked.modulus_margin or 0.0
        circle = {"x": radius * np.cos(turn) - 1.0, "y": radius * np.sin(turn)}
        sender.put(self.sources["circle"], data=circle)

    def show_kept(self, curves: Mapping[int, View], sender: Sender) -> None:
        """Show the contacts of kept designs by their numbers; an unstable one has none."""
        runs = {number: view.transient for number, view in curves.items()}
        drawn = {number: run for number, run in runs.items() if run is not None}
        lines = [_over_time(run.time_s, run.contact_force_n) for run in drawn.values()]
        data: dict[str, Any] = {"xs": [each["x"] for each in lines], "ys": [each["y"] for each in lines]}
        data["x"] = [1e3 * run.time_of_peak_s for run in drawn.values()]
        data |= {"y": [run.peak_contact_force_n for run in drawn.values()], "text": [str(number) for number in drawn]}
        sender.put(self.sources["kept"], data=data)

    def _show_diverging(self, view: View, sender: Sender) -> None:
        """Show how the force of an unstable contact begins, cut off where it leaves the picture."""
        run = view.diverging
        data: dict[str, Any] = dict(_EMPTY)
        ending: dict[str, Any] = {**_EMPTY, "text": [], "align": []}
        if run is not None:
            force, most = run.contact_force_n, min(self.largest_n, _CLIPPED_AT_DRIVE * run.driving_force_n)
            beyond = np.flatnonzero(~(np.abs(force) <= most))
            end, half = (int(beyond[0]) if beyond.size else len(force)), len(force) // 2
            grows = beyond.size or np.max(np.abs(force[half:])) > _GROWS * np.max(np.abs(force[:half]))
            data = _over_time(run.time_s[:end], force[:end])
            # A curve that ends early has its word on its right, so that the frame cuts none off.
            ending = {
                "x": data["x"][-1:],
                "y": data["y"][-1:],
                "text": ["diverges" if grows else "does not settle"],
                "align": ["left" if end < half else "right"],
            }
        sender.put(self.sources["ending"], data=ending)
        sender.put(self.sources["diverging"], data=data)

    def show(self, view: View, sender: Sender) -> None:
        """Show one view; an unstable loop has no transient and no requirement."""

        def put(name: str, **data: Any) -> None:
            sender.put(self.sources[name], data=data)

        run = view.transient
        self._show_diverging(view, sender)
        if run is None:
            for name in ("contact", "sensor", "peak"):
                put(name, **_EMPTY)
        else:
            put("contact", **_over_time(run.time_s, run.contact_force_n))
            put("sensor", **_over_time(run.time_s, run.sensor_force_n))
            put("peak", x=[1e3 * run.time_of_peak_s], y=[run.peak_contact_force_n])
        put("gain", x=view.admittance_hz, y=view.admittance_m_s_per_n)
        for name, loop in (("force", view.at_force), ("command", view.at_command)):
            near = np.abs(loop) < 20.0
            put(name, x=loop.real[near], y=loop.imag[near])
        ratios = view.ratios
        values = np.nan_to_num(np.array(list(ratios.values())), nan=_LONGEST_BAR, posinf=_LONGEST_BAR)
        bars: dict[str, Any] = {
            "name": [requirement_title(name) for name in ratios],
            "right": np.minimum(values, _LONGEST_BAR),
            "colour": [COLOURS["good" if value <= 1.0 else "bad"] for value in values],
            "text": [f"{value:.3f}" if value < _LONGEST_BAR else f"{value:.3g}" for value in ratios.values()],
        }
        sender.put(self.sources["bars"], data=bars)

    def show_map(self, found: DesignMap, sender: Sender) -> None:
        """Show which designs around are stable and feasible."""
        window = found.window
        left, right, bottom, top = self._edges(window)
        self.mapped = (
            (float(np.nanmin(found.peak_n)), float(np.nanmax(found.peak_n))) if found.is_feasible.any() else None
        )
        cells = {
            "stable": [found.is_stable.astype(np.float32)],
            "peak": [found.peak_n.astype(np.float32)],
            "x": [left],
            "y": [bottom],
            "dw": [right - left],
            "dh": [top - bottom],
        }
        sender.put(self.sources["map"], data=cells)

    def show_window(self, window: MapWindow, x: SliderRange, y: SliderRange) -> None:
        """Turn the map to a window of two ranges."""
        plot = self.plots["map"]
        plot.xaxis.axis_label, plot.yaxis.axis_label = x.title, y.title
        self.scales = x.scale, y.scale
        plot.x_range.start, plot.x_range.end, plot.y_range.start, plot.y_range.end = self._edges(window)

    def _edges(self, window: MapWindow) -> tuple[float, float, float, float]:
        """Return where the cells of a window begin and end, x then y, in the units of the axes."""
        x, y = self.scales
        return *_edges(x * window.x_values(), True), *_edges(y * window.y_values(), False)

    def show_own(self, view: View, place: tuple[float, float], window: MapWindow, sender: Sender) -> None:
        """Mark the design at `place`, in a cell of its own that is judged there; the colours reach its peak too."""
        x, y = (scale * each for scale, each in zip(self.scales, place, strict=True))
        ratio, step = np.exp(0.5 * _step(np.log(window.x_values()))), 0.5 * self.scales[1] * _step(window.y_values())
        own = view.evaluation
        peak = own.cost if own.is_feasible else math.nan
        cell: dict[str, Any] = {"left": x / ratio, "right": x * ratio, "bottom": y - step, "top": y + step}
        cell |= {"x": x, "y": y, "stable": float(own.is_stable), "peak": peak}
        sender.put(self.sources["own"], data={key: np.array([value], dtype=np.float64) for key, value in cell.items()})
        seen = [each for each in (*(self.mapped or ()), peak) if math.isfinite(each)]
        sender.put(self.bar, visible=bool(seen))
        if seen:
            low, high = min(seen), max(seen)
            sender.put(self.colours, low=low, high=high if high > low else low + 1.0)


def _plot(key: str, x: str, y: str, **more: Any) -> Any:
    options: dict[str, Any] = {
        "height": _HEIGHT,
        "sizing_mode": "stretch_width",
        "tools": _TOOLS,
        "x_axis_label": x,
        "y_axis_label": y,
        # With a ground: without one the engine draws the outline on top of what it drew last, which stays on the paper.
        "background_fill_color": "white",
        "border_fill_alpha": 0.0,
        "outline_line_color": "#7a7f85",
        "name": key,
        **more,
    }
    plot = figure(**options)
    plot.toolbar.logo = None
    plot.toolbar.stylesheets = [InlineStyleSheet(css=".bk-divider { background-color: var(--line); }")]
    # On a touch screen a finger on a figure scrolls the page, until a tool is chosen.
    plot.toolbar.active_drag = None
    plot.toolbar_location = "above"
    return plot


def _over_time(time_s: RealArray, force_n: RealArray) -> dict[str, Any]:
    x, y = decimate(1e3 * time_s, force_n, _MOST_POINTS)
    return {"x": x, "y": y}


def _edges(middles: RealArray, by_ratios: bool) -> tuple[float, float]:
    """Return where the first cell begins and the last one ends."""
    on = np.log(middles) if by_ratios else middles
    half = 0.5 * _step(on)
    ends = on[0] - half, on[-1] + half
    return (float(np.exp(ends[0])), float(np.exp(ends[1]))) if by_ratios else (float(ends[0]), float(ends[1]))


def _step(middles: RealArray) -> float:
    return float(middles[1] - middles[0])
