"""Draw a chart as vector graphics that need nothing else: the only door of reports to matplotlib."""

import io
import math
import re
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from .charts import Band, Bars, Chart, Element, Heat, Limit, Line, Panel, Points, Scale, Stretch
from .decimate import decimate
from .palette import COLOURS, ONE_SIDED, TWO_SIDED

_WIDTH_INCHES, _PANEL_INCHES = 8.8, 2.0
_MOST_POINTS = 1400
_MARKERS = {"dot": "o", "star": "*", "diamond": "D"}
_MOST_WRITTEN = 400
# A hundredth of a point is no width on any paper, and the digits after it were a third of the file.
# What stands between tags is text for people, and stays.
_LONG_NUMBER = re.compile(rb">[^<]*<|(\d\.\d\d)\d+")
# Where a logarithmic side shows fewer than two decades.
_WITHIN_A_DECADE = (1.0, 1.5, 2.0, 3.0, 5.0, 7.0)


def draw_svg(chart: Chart) -> bytes:
    """Return the chart as SVG; the same chart gives the same bytes."""
    stream = io.BytesIO()
    with mpl.rc_context():
        mpl.rcdefaults()
        mpl.rc("font", size=9.5, family="sans-serif")
        mpl.rc("axes", linewidth=0.6, edgecolor="#7a7f85", labelcolor="#333333", titlesize=10.0)
        mpl.rc("svg", hashsalt="autotune", fonttype="none")
        mpl.rc("path", simplify=True)
        _draw(chart).savefig(stream, format="svg", metadata={"Date": None, "Creator": None}, transparent=True)
    return _LONG_NUMBER.sub(lambda match: match[1] or match[0], stream.getvalue())


def _draw(chart: Chart) -> Figure:
    """Lay out in inches: the library's own layout measures every text twice, which took longer than the drawing."""
    panels, count = chart.panels, len(chart.panels)
    named = any(isinstance(each, Heat) and each.names for panel in panels for each in panel.elements)
    left, bottom, top = 0.72, 0.95 if named else 0.5, 0.28 if any(panel.title for panel in panels) else 0.1
    right = 0.15 if chart.beside else 1.75
    if chart.beside:
        height = _PANEL_INCHES * max(panel.height for panel in panels) + bottom + top
        shape: dict[str, Any] = {"nrows": 1, "ncols": count, "wspace": 0.36}
    else:
        gap = 0.12 if chart.linked and not any(panel.title for panel in panels) else 0.62
        heights = [_PANEL_INCHES * panel.height for panel in panels]
        height = sum(heights) + bottom + top + gap * (count - 1)
        shape = {"nrows": count, "ncols": 1, "hspace": gap * count / sum(heights), "height_ratios": heights}
    figure = Figure(figsize=(_WIDTH_INCHES, height))
    shape |= {"left": left / _WIDTH_INCHES, "right": 1.0 - right / _WIDTH_INCHES}
    grid = figure.add_gridspec(bottom=bottom / height, top=1.0 - top / height, **shape)
    named_before: list[str] = []
    for i, panel in enumerate(panels):
        axes = figure.add_subplot(grid[0, i] if chart.beside else grid[i, 0])
        _draw_panel(figure, axes, panel)
        labels = [each.label for each in panel.elements if each.label]
        if labels != named_before:
            _draw_legend(axes, is_beside=chart.beside)
        named_before = labels
        if chart.linked and not chart.beside and i < count - 1:
            axes.set_xlabel("")
            axes.tick_params(labelbottom=False)
    if chart.linked:
        low, high = (pick(axes.get_xlim()[i] for axes in figure.axes) for i, pick in ((0, min), (1, max)))
        for axes in figure.axes:
            axes.set_xlim(low, high)
    return figure


def _draw_panel(figure: Figure, axes: Axes, panel: Panel) -> None:
    if not any(isinstance(each, Heat) for each in panel.elements):
        axes.grid(linewidth=0.4, color="#d9dde1")
    axes.set_axisbelow(True)
    _set_scale(axes, "x", panel.x)
    _set_scale(axes, "y", panel.y)
    if panel.title:
        axes.set_title(panel.title, loc="left")
    if panel.equal:
        axes.set_aspect("equal", adjustable="datalim")
    for element in panel.elements:
        _draw_element(figure, axes, element)
    for which, scale in (("x", panel.x), ("y", panel.y)):
        if scale.spacing == "log":
            _fill_decade(axes, which)


def _fill_decade(axes: Axes, which: str) -> None:
    """Give a logarithmic side without two decades' ticks more of them: ticks without numbers say nothing."""
    low, high = getattr(axes, f"get_{which}lim")()
    below, above = math.floor(math.log10(low)), math.ceil(math.log10(high))
    if sum(low <= 10.0**power <= high for power in range(below, above + 1)) < 2:
        side = axes.xaxis if which == "x" else axes.yaxis
        side.set_major_locator(LogLocator(subs=_WITHIN_A_DECADE))


def _draw_legend(axes: Axes, *, is_beside: bool) -> None:
    handles, labels = axes.get_legend_handles_labels()
    if handles:
        once = dict(zip(labels, handles, strict=True))
        place: dict[str, Any] = {"loc": "upper left", "bbox_to_anchor": (1.005, 1.0), "borderaxespad": 0.0}
        if is_beside:
            place = {"loc": "upper right"}
        axes.legend(list(once.values()), list(once), frameon=is_beside, framealpha=0.7, fontsize=8.0, **place)


def _set_scale(axes: Axes, which: str, scale: Scale) -> None:
    getattr(axes, f"set_{which}scale")(scale.spacing)
    getattr(axes, f"set_{which}label")(scale.label)
    if scale.spacing == "log":
        side = axes.xaxis if which == "x" else axes.yaxis
        side.set_major_formatter(FuncFormatter(_plain))
        side.set_minor_formatter(NullFormatter())
    if scale.limits is not None:
        getattr(axes, f"set_{which}lim")(*scale.limits)


def _plain(value: float, _place: int | None) -> str:
    """Write a tick of a logarithmic scale without mathematics to set, which took a third of the time."""
    if 1e-3 <= value < 1e5:
        return f"{value:g}"
    digits, power = f"{value:.1e}".split("e")
    return f"{digits.removesuffix('.0')}e{int(power)}"


def _draw_element(figure: Figure, axes: Axes, element: Element) -> None:
    if isinstance(element, Heat):
        _draw_heat(figure, axes, element)
        return
    colour = COLOURS[element.role]
    label = element.label or None
    if isinstance(element, Line):
        x, y = decimate(element.x, element.y, _MOST_POINTS)
        drawn = "steps-post" if element.steps else "default"
        style = "--" if element.dashed else "-"
        axes.plot(x, y, style, color=colour, label=label, linewidth=1.0, drawstyle=drawn)
    elif isinstance(element, Band):
        axes.fill_between(element.x, element.low, element.high, color=colour, alpha=0.22, linewidth=0.0, label=label)
    elif isinstance(element, Points):
        size = 9.0 if element.marker == "star" else 5.0
        mark: dict[str, Any] = {"zorder": 4, "linestyle": "none", "markeredgecolor": "white", "markeredgewidth": 0.5}
        axes.plot(element.x, element.y, _MARKERS[element.marker], color=colour, label=label, markersize=size, **mark)
    elif isinstance(element, Bars):
        axes.stairs(element.heights, element.edges, fill=True, color=colour, alpha=0.75, label=label)
    elif isinstance(element, Stretch):
        axes.axvspan(element.low, element.high, color=colour, alpha=0.16, linewidth=0.0, label=label)
    elif isinstance(element, Limit):
        across = axes.axhline if element.along == "y" else axes.axvline
        across(element.value, color=colour, linewidth=1.0, linestyle=":", label=label)


def _draw_heat(figure: Figure, axes: Axes, heat: Heat) -> None:
    low, high = heat.limits or (float(np.nanmin(heat.values)), float(np.nanmax(heat.values)))
    two_sided = heat.limits is not None and low == -high
    colours = TWO_SIDED if two_sided else ONE_SIDED
    # A map is a picture within the picture: as vectors its cells alone would outweigh the page.
    many = heat.values.size > _MOST_WRITTEN
    mesh = axes.pcolormesh(
        heat.x, heat.y, heat.values, vmin=low, vmax=high, cmap=colours, shading="nearest", rasterized=many
    )
    figure.colorbar(mesh, ax=axes, pad=0.015).set_label(heat.label)
    if heat.names is not None:
        axes.set_xticks(heat.x, heat.names[0], rotation=60.0, ha="right", rotation_mode="anchor")
        axes.set_yticks(heat.y, heat.names[1])
        axes.invert_yaxis()
    if heat.written:
        for i, row in enumerate(heat.values):
            for j, value in enumerate(row):
                if np.isfinite(value):
                    dark = abs(value) > 0.6 * max(abs(low), abs(high))
                    text = f"{value:.2f}".replace("-0.", "−.").replace("0.", ".")
                    axes.text(
                        heat.x[j],
                        heat.y[i],
                        text,
                        ha="center",
                        va="center",
                        fontsize=6.5,
                        color="white" if dark else "#333333",
                    )
