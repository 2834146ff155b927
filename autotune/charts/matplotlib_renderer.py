"""Draw a chart with matplotlib, on given axes or as a figure of its own: the only use of matplotlib in the product."""

import math
from collections.abc import Sequence
from functools import singledispatch
from typing import Any, Literal

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from .chart import Band, Bars, Chart, Heat, Limit, Line, Panel, Points, Scale, Stretch
from .palette import COLOURS, FURNITURE, ONE_SIDED, TWO_SIDED

Labels = Literal["beside", "above"]

POINTS_PER_INCH = 72.0
TEXT_LINE_INCHES = 0.18
"""Height of a line of text above a panel whose labels are written there."""
_WIDTH_INCHES, _PANEL_INCHES = 7.0, 2.6
_MOST_POINTS, _FEW_POINTS = 1400, 60
_MARKERS = {"dot": "o", "star": "*", "diamond": "D"}
_MOST_VECTOR_CELLS = 400
# Where a logarithmic side shows fewer than two decades.
_WITHIN_A_DECADE = (1.0, 1.5, 2.0, 3.0, 5.0, 7.0)


def draw(chart: Chart, axes: Axes | Sequence[Axes] | None = None, *, legend: bool = True) -> Figure:
    """Draw a chart and return the figure that holds it.

    Parameters
    ----------
    chart
        What is to be drawn; its scales carry the units.
    axes
        One axes for each panel of the chart, a single one for a single panel; None for a new figure.
    legend
        Whether each panel lists its named lines, bands and markers.

    Raises
    ------
    ValueError
        The number of axes is not the number of panels.

    """
    panels = chart.panels
    given = _new_axes(chart) if axes is None else [axes] if isinstance(axes, Axes) else list(axes)
    if len(given) != len(panels):
        raise ValueError(f"{chart.title!r} has {len(panels)} panels and needs as many axes, found {len(given)}.")
    for each, panel in zip(given, panels, strict=True):
        draw_panel(each, panel)
        for heat in (element for element in panel.elements if isinstance(element, Heat)):
            each.figure.colorbar(each.collections[0], ax=each).set_label(heat.label)
        if panel.equal:
            each.set_aspect("equal", adjustable="datalim")
        if legend and each.get_legend_handles_labels()[1]:
            each.legend(fontsize="small")
    figure = given[0].get_figure(root=True)
    if figure is None:
        raise ValueError("The axes belong to no figure.")
    return figure


def _new_axes(chart: Chart) -> list[Axes]:
    """Return the axes of a new figure, beside or below each other as the chart says."""
    count = len(chart.panels)
    heights = [panel.height for panel in chart.panels]
    rows, columns = (1, count) if chart.beside else (count, 1)
    height = _PANEL_INCHES * (max(heights) if chart.beside else sum(heights)) + 0.6
    width = max(_WIDTH_INCHES, 3.6 * columns)
    figure = Figure(figsize=(width, height), layout="constrained")
    ratios: dict[str, Any] = {} if chart.beside else {"height_ratios": heights}
    grid = figure.subplots(rows, columns, squeeze=False, sharex=chart.linked, **ratios)
    figure.suptitle(chart.title, fontsize="medium")
    return list(grid.flat)


def draw_panel(axes: Axes, panel: Panel, *, labels: Labels = "beside") -> None:
    """Draw one panel on `axes`; with `labels` "above", title and y label stand above the left corner."""
    if not any(isinstance(each, Heat) for each in panel.elements):
        axes.grid(visible=True, linewidth=0.4, color=FURNITURE["grid"])
    axes.set_axisbelow(True)
    _set_scale(axes, "x", panel.x)
    _set_scale(axes, "y", panel.y)
    axes.set_xlabel(panel.x.label, labelpad=4.5)
    if labels == "above":
        _write_above(axes, [*([panel.title] if panel.title else []), panel.y.label])
    else:
        axes.set_ylabel(panel.y.label)
        axes.set_title(panel.title, fontsize="medium")
    for role, parts in panel.stretches().items():
        spans = [(each.low, each.high - each.low) for each in parts]
        look: dict[str, Any] = {"facecolors": COLOURS[role], "alpha": 0.16, "linewidth": 0.0}
        axes.broken_barh(spans, (0.0, 1.0), transform=axes.get_xaxis_transform(), label=parts[0].label or None, **look)
    for element in panel.elements:
        if not isinstance(element, Stretch):
            draw_element(element, axes)
    for which, scale in (("x", panel.x), ("y", panel.y)):
        if scale.spacing == "log":
            _add_ticks_within_a_decade(axes, which)


def _write_above(axes: Axes, lines: Sequence[str]) -> None:
    """Write lines above the left corner: a label there is read without turning the head, and as long as the panel."""
    for i, text in enumerate(reversed(lines)):
        place: dict[str, Any] = {"textcoords": "offset points", "xycoords": "axes fraction", "annotation_clip": False}
        weight = "bold" if i else "normal"
        axes.annotate(text, (0.0, 1.0), (0.0, 4.5 + i * TEXT_LINE_INCHES * POINTS_PER_INCH), weight=weight, **place)


def _add_ticks_within_a_decade(axes: Axes, which: str) -> None:
    """Add ticks to a logarithmic side that shows fewer than two powers of ten."""
    low, high = getattr(axes, f"get_{which}lim")()
    below, above = math.floor(math.log10(low)), math.ceil(math.log10(high))
    if sum(low <= 10.0**power <= high for power in range(below, above + 1)) < 2:
        side = axes.xaxis if which == "x" else axes.yaxis
        side.set_major_locator(LogLocator(subs=_WITHIN_A_DECADE))


def _set_scale(axes: Axes, which: str, scale: Scale) -> None:
    getattr(axes, f"set_{which}scale")(scale.spacing)
    if scale.spacing == "log":
        side = axes.xaxis if which == "x" else axes.yaxis
        side.set_major_formatter(FuncFormatter(_tick_text))
        side.set_minor_formatter(NullFormatter())
    if scale.limits is not None:
        getattr(axes, f"set_{which}lim")(*scale.limits)


def _tick_text(value: float, _place: int | None) -> str:
    """Return a tick of a logarithmic scale without mathematics to set, which took a third of the time."""
    if 1e-3 <= value < 1e5:
        return f"{value:g}"
    digits, power = f"{value:.1e}".split("e")
    return f"{digits.removesuffix('.0')}e{int(power)}"


@singledispatch
def draw_element(element: object, axes: Axes) -> None:
    """Draw one element of a panel."""
    raise TypeError(f"{axes!r} cannot hold {element!r}")


@draw_element.register
def _(line: Line, axes: Axes) -> None:
    x, y = line.thinned(_MOST_POINTS)
    axes.plot(
        x,
        y,
        "--" if line.dashed else "-",
        color=COLOURS[line.role],
        linewidth=2.0 if line.is_wide else 1.0,
        drawstyle="steps-post" if line.steps else "default",
        label=line.label or None,
    )


@draw_element.register
def _(band: Band, axes: Axes) -> None:
    look: dict[str, Any] = {"color": COLOURS[band.role], "alpha": 0.22, "linewidth": 0.0}
    axes.fill_between(band.x, band.low, band.high, label=band.label or None, **look)


@draw_element.register
def _(points: Points, axes: Axes) -> None:
    look: dict[str, Any] = {"zorder": 4, "linestyle": "none", "markeredgecolor": FURNITURE["paper"]}
    look |= {"color": COLOURS[points.role], "markersize": 9.0 if points.marker == "star" else 4.0}
    look |= {"markeredgewidth": 0.5 if len(points.x) < _FEW_POINTS else 0.0, "label": points.label or None}
    axes.plot(points.x, points.y, _MARKERS[points.marker], **look)


@draw_element.register
def _(bars: Bars, axes: Axes) -> None:
    axes.stairs(bars.heights, bars.edges, fill=True, color=COLOURS[bars.role], alpha=0.75, label=bars.label or None)


@draw_element.register
def _(limit: Limit, axes: Axes) -> None:
    across = axes.axhline if limit.along == "y" else axes.axvline
    across(limit.value, color=COLOURS[limit.role], linewidth=1.2, linestyle=":", label=limit.label or None)


@draw_element.register
def _(heat: Heat, axes: Axes) -> None:
    low, high = heat.span()
    colours = TWO_SIDED if heat.is_two_sided else ONE_SIDED
    # A map is a picture within the picture: as vectors its cells alone would outweigh the page.
    many = heat.values.size > _MOST_VECTOR_CELLS
    hole: dict[str, Any] = {"transform": axes.transAxes, "color": FURNITURE["hole"], "linewidth": 0.0, "zorder": 0.0}
    axes.add_patch(Rectangle((0.0, 0.0), 1.0, 1.0, **hole))
    values: Any = np.asarray(heat.values)
    axes.pcolormesh(heat.x, heat.y, values, vmin=low, vmax=high, cmap=colours, shading="nearest", rasterized=many)
    if heat.names is not None:
        axes.set_xticks(heat.x, heat.names[0], rotation=60.0, ha="right", rotation_mode="anchor")
        axes.set_yticks(heat.y, heat.names[1])
        axes.invert_yaxis()
    for x, y, text, is_dark in heat.writings():
        axes.text(x, y, text, ha="center", va="center", fontsize=6.0, color="white" if is_dark else "#222222")
