"""Draw a chart with matplotlib, on given axes or as a figure of its own: the only use of matplotlib in the product."""

import io
import math
import textwrap
from collections.abc import Callable, Sequence
from functools import singledispatch
from typing import Any, Literal

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection, QuadMesh
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Rectangle
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullFormatter
from numpy.typing import NDArray

from .chart import Area, Band, Bars, Chart, Heat, Limit, Line, Panel, Points, Region, Scale, Stretch
from .palette import COLOURS, FURNITURE, MAP_COLOURS, ONE_SIDED, TWO_SIDED

Labels = Literal["beside", "above"]

POINTS_PER_INCH = 72.0
TEXT_LINE_INCHES = 0.18
"""Height of a line of text above a panel whose labels are written there."""
_ONE_INCHES, _PANEL_INCHES, _AROUND_INCHES = (7.6, 5.6), (3.4, 2.5), (1.0, 1.6)
_PNG_DOTS_PER_INCH = 160
_LINE_LENGTH, _TITLE_TOP = 112, 0.985
_LEVELS = 7
_CROWDED_INCHES, _FEW_DECADES, _FEW_DECADES_CROWDED = 4.0, 2.2, 1.5
_MOST_POINTS, _FEW_POINTS = 1400, 60
_MARKERS = {"dot": "o", "star": "*", "diamond": "D"}
_MOST_VECTOR_CELLS = 400
# Where a logarithmic side shows fewer than two decades.
_WITHIN_A_DECADE = (1.0, 1.5, 2.0, 3.0, 5.0, 7.0)


def draw(
    chart: Chart,
    axes: Axes | Sequence[Axes] | None = None,
    *,
    legend: bool = True,
    make: Callable[..., Figure] = Figure,
) -> Figure:
    """Draw a chart and return the figure that holds it.

    Parameters
    ----------
    chart
        What is to be drawn; its scales carry the units.
    axes
        One axes for each panel of the chart, a single one for a single panel; None for a new figure, with title and
        caption above the panels.
    legend
        Whether the named lines, bands and markers are listed: per axes where they are given, else below the panels.
    make
        What makes the new figure; with `matplotlib.pyplot.figure` it is one that `matplotlib.pyplot.show` shows.

    Raises
    ------
    ValueError
        The number of axes is not the number of panels.

    """
    panels = chart.panels
    given = _new_axes(chart, make) if axes is None else [axes] if isinstance(axes, Axes) else list(axes)
    if len(given) != len(panels):
        raise ValueError(f"{chart.title!r} has {len(panels)} panels and needs as many axes, found {len(given)}.")
    figure = given[0].get_figure(root=True)
    if figure is None:
        raise ValueError("The axes belong to no figure.")
    for each, panel in zip(given, panels, strict=True):
        draw_panel(each, panel)
        add_colour_bar(figure, panel, each)
        if panel.equal:
            each.set_aspect("equal", adjustable="box")
        handles = _legend_handles(each, panel)
        if legend and axes is not None and handles:
            each.legend(handles=handles, fontsize="small")
    if axes is None:
        _finish_figure(figure, chart, given, legend=legend)
    return figure


def render(chart: Chart, suffix: str, *, mark: str) -> bytes:
    """Return the bytes of a picture, PNG or SVG by `suffix`; the same chart gives the same bytes.

    `mark` is written into the file as the program that made it.
    """
    kind = suffix.lower().removeprefix(".")
    stream = io.BytesIO()
    with mpl.rc_context():
        mpl.rcdefaults()
        mpl.rc("font", size=10.0)
        # Ids and outlines that depend neither on the run nor on the fonts of whoever looks.
        mpl.rc("svg", hashsalt="autotune", fonttype="path")
        mpl.rc("hatch", linewidth=0.6)
        metadata = {"Software": mark} if kind == "png" else {"Date": None, "Creator": mark}
        draw(chart).savefig(stream, format=kind, dpi=_PNG_DOTS_PER_INCH, metadata=metadata)
    return stream.getvalue()


def _columns(chart: Chart) -> int:
    count = len(chart.panels)
    return {1: 1, 2: 2, 4: 2}.get(count, 3) if chart.beside else 1


def _new_axes(chart: Chart, make: Callable[..., Figure]) -> list[Axes]:
    """Return the axes of a new figure, in rows as the chart says."""
    count, columns = len(chart.panels), _columns(chart)
    rows = math.ceil(count / columns)
    size = (_PANEL_INCHES[0] * columns + _AROUND_INCHES[0], _PANEL_INCHES[1] * rows + _AROUND_INCHES[1])
    figure = make(figsize=_ONE_INCHES if count == 1 else size, layout="constrained")
    is_grid = chart.linked and chart.beside
    grid = figure.subplots(rows, columns, squeeze=False, sharex=chart.linked, sharey=is_grid)
    for unused in grid.flat[count:]:
        unused.set_visible(False)
    return list(grid.flat[:count])


def _finish_figure(figure: Figure, chart: Chart, axes: Sequence[Axes], *, legend: bool) -> None:
    """Name shared axes at the rim only, then add the legend below and the title above."""
    columns = _columns(chart)
    for i, each in enumerate(axes if chart.linked else ()):
        # A panel with nothing below it is at the rim, too.
        is_lowest = i + columns >= len(axes)
        each.tick_params(labelbottom=is_lowest)
        each.set_xlabel(each.get_xlabel() if is_lowest else "")
        each.set_ylabel(each.get_ylabel() if i % columns == 0 else "")
    found = {
        str(handle.get_label()): handle
        for each, panel in zip(axes, chart.panels, strict=True)
        for handle in _legend_handles(each, panel)
    }
    if legend and found:
        place: dict[str, Any] = {"loc": "outside lower center", "ncols": min(len(found), 4)}
        figure.legend(handles=list(found.values()), frameon=False, fontsize=9.0, **place)
    caption = chart.caption if "$" in chart.caption else textwrap.fill(chart.caption, _LINE_LENGTH)
    # The blank lines hold the place of the title, for which the layout would not make room by itself.
    small = figure.suptitle("\n\n" + caption, ha="left", fontsize=8.0, color="0.3", linespacing=1.5)
    figure.draw_without_rendering()
    left = float(axes[0].get_position().x0)
    small.set_x(left)
    figure.text(left, _TITLE_TOP, chart.title, ha="left", va="top", fontsize=12.0, fontweight="bold")


def _legend_handles(axes: Axes, panel: Panel) -> list[Any]:
    """Return the artists of a legend: those of the ground and of regions first."""
    handles: list[Any] = []
    regions = [each for each in panel.elements if isinstance(each, Region)]
    if panel.ground == "stable":
        handles.append(Patch(facecolor=MAP_COLOURS["stable"], edgecolor="0.6", label="stable"))
    if panel.ground == "unstable" or regions:
        hatched: dict[str, Any] = {"facecolor": MAP_COLOURS["unstable"], "edgecolor": MAP_COLOURS["hatch"]}
        label = regions[0].label if regions else "unstable"
        handles.append(Patch(**hatched, hatch="////", linewidth=0.0, label=label))
    handles += [
        Line2D([], [], color=MAP_COLOURS["edge"], linewidth=1.4, label=each.edge_label)
        for each in regions
        if each.edge_label
    ]
    return [*handles, *axes.get_legend_handles_labels()[0]]


def add_colour_bar(figure: Figure, panel: Panel, axes: Axes, cax: Axes | None = None) -> None:
    """Draw the scale of colours of a panel's map, if it has one, beside its axes or into `cax`."""
    heat = next((each for each in panel.elements if isinstance(each, Heat)), None)
    mesh = next((each for each in axes.collections if isinstance(each, QuadMesh)), None)
    if heat is None or mesh is None:
        return
    place: dict[str, Any] = {"ax": axes, "pad": 0.02} if cax is None else {"cax": cax}
    bar = figure.colorbar(mesh, **place)
    bar.set_label(heat.label, labelpad=None if cax is None else 2.0)
    if heat.spacing == "log":
        _set_log_ticks(bar.ax, "y")
        bar.minorticks_off()


def draw_panel(axes: Axes, panel: Panel, *, labels: Labels = "beside") -> None:
    """Draw one panel on `axes`; with `labels` "above", title and y label are above the left corner."""
    _draw_ground(axes, panel)
    if panel.ground == "plain" and not any(isinstance(each, Heat) for each in panel.elements):
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
            _set_log_ticks(axes, which)


def _draw_ground(axes: Axes, panel: Panel) -> None:
    if panel.ground != "plain":
        axes.set_facecolor(MAP_COLOURS[panel.ground])
    if panel.ground == "unstable":
        axes.patch.set(hatch="////", edgecolor=MAP_COLOURS["hatch"], linewidth=0.0)
    if panel.note:
        axes.text(0.5, 0.5, panel.note, transform=axes.transAxes, ha="center", backgroundcolor="white")


def _write_above(axes: Axes, lines: Sequence[str]) -> None:
    """Write lines above the left corner: a label there is read without turning the head, and as long as the panel."""
    for i, text in enumerate(reversed(lines)):
        place: dict[str, Any] = {"textcoords": "offset points", "xycoords": "axes fraction", "annotation_clip": False}
        weight = "bold" if i else "normal"
        axes.annotate(text, (0.0, 1.0), (0.0, 4.5 + i * TEXT_LINE_INCHES * POINTS_PER_INCH), weight=weight, **place)


def _set_log_ticks(axes: Axes, which: str) -> None:
    """Set numbered ticks: powers of ten where many are shown, else also parts of a decade."""
    low, high = sorted(getattr(axes, f"get_{which}lim")())
    if low <= 0.0:
        return  # axes that hold something else on a linear scale already
    figure, side = axes.get_figure(root=True), axes.xaxis if which == "x" else axes.yaxis
    inches = math.inf if figure is None else axes.get_position().width * figure.get_figwidth()
    decades = math.log10(high / low)
    below, above = math.floor(math.log10(low)), math.ceil(math.log10(high))
    if sum(low <= 10.0**power <= high for power in range(below, above + 1)) < 2:
        side.set_major_locator(LogLocator(subs=_WITHIN_A_DECADE))
    elif decades < (_FEW_DECADES_CROWDED if inches < _CROWDED_INCHES else _FEW_DECADES):
        side.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0), numticks=30))
    side.set_major_formatter(FuncFormatter(_tick_text))
    side.set_minor_formatter(NullFormatter())


def _set_scale(axes: Axes, which: str, scale: Scale) -> None:
    getattr(axes, f"set_{which}scale")(scale.spacing)
    if scale.limits is not None:
        getattr(axes, f"set_{which}lim")(*scale.limits)
    if scale.counts:
        getattr(axes, f"{which}axis").set_major_locator(MaxNLocator(integer=True, min_n_ticks=1))


def _tick_text(value: float, _place: int | None) -> str:
    """Return a tick of a logarithmic scale without mathematics to set, which took a third of the time."""
    if 1e-3 <= value < 1e5:
        return f"{value:g}"
    digits, power = f"{value:.1e}".split("e")
    return f"{digits.removesuffix('.0')}e{int(power)}"


def _colour(role: str) -> str:
    return COLOURS[role] if role in COLOURS else MAP_COLOURS[role]


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
        color=_colour(line.role),
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
def _(region: Region, axes: Axes) -> None:
    with mpl.rc_context({"hatch.color": MAP_COLOURS["hatch"]}):
        fill: dict[str, Any] = {"levels": [0.0, np.inf], "colors": [MAP_COLOURS["unstable"]], "hatches": ["////"]}
        axes.contourf(region.x, region.y, region.values, **fill)
    axes.contour(region.x, region.y, region.values, levels=[0.0], colors=MAP_COLOURS["edge"], linewidths=1.4)


@draw_element.register
def _(area: Area, axes: Axes) -> None:
    colour = _colour(area.role)
    look: dict[str, Any] = {"facecolor": colour, "edgecolor": colour, "linewidth": 0.5, "label": area.label or None}
    axes.add_collection(PolyCollection(list(area.polygons), **look))


@draw_element.register
def _(heat: Heat, axes: Axes) -> None:
    if heat.smooth:
        _draw_smooth(heat, axes)
        return
    low, high = heat.span()
    colours = TWO_SIDED if heat.is_two_sided else ONE_SIDED
    # A map is a picture within the picture: as vectors its cells alone would outweigh the page.
    many = heat.values.size > _MOST_VECTOR_CELLS
    hole: dict[str, Any] = {"transform": axes.transAxes, "color": FURNITURE["hole"], "linewidth": 0.0, "zorder": 0.0}
    values: Any = np.asarray(heat.values)
    label = heat.hole if heat.hole and np.any(np.isnan(values)) else None
    axes.add_patch(Rectangle((0.0, 0.0), 1.0, 1.0, label=label, **hole))
    axes.pcolormesh(heat.x, heat.y, values, vmin=low, vmax=high, cmap=colours, shading="nearest", rasterized=many)
    if heat.names is not None:
        axes.set_xticks(heat.x, heat.names[0], rotation=60.0, ha="right", rotation_mode="anchor")
        axes.set_yticks(heat.y, heat.names[1])
        axes.invert_yaxis()
    for x, y, text, is_dark in heat.writings():
        axes.text(x, y, text, ha="center", va="center", fontsize=6.0, color="white" if is_dark else "#222222")


def _draw_smooth(heat: Heat, axes: Axes) -> None:
    """Draw colours that run on between the cells, and lines of equal value with their numbers."""
    low, high = heat.span()
    is_below, is_above = bool(np.any(heat.values < low)), bool(np.any(heat.values > high))
    colours = mpl.colormaps[f"{ONE_SIDED}_r" if heat.descending else ONE_SIDED].copy()
    ends = {(False, False): "neither", (True, False): "min", (False, True): "max", (True, True): "both"}
    colours.colorbar_extend = ends[is_below, is_above]  # type: ignore[assignment] # a text, whatever the stubs say
    is_log = heat.spacing == "log"
    norm = LogNorm(low, high) if is_log else Normalize(low, high)
    clipped = np.clip(_filled(heat.values), low, high)
    axes.pcolormesh(heat.x, heat.y, clipped, norm=norm, cmap=colours, shading="gouraud", rasterized=True)
    locator = LogLocator(subs=(1.0, 2.0, 5.0)) if is_log else MaxNLocator(_LEVELS)
    levels = np.asarray(locator.tick_values(low, high))
    usual = heat.values[np.isfinite(heat.values)]
    inside = levels[(levels > np.min(usual)) & (levels < min(float(np.max(usual)), high))]
    if len(inside):
        look: dict[str, Any] = {"colors": "white", "linewidths": 0.7, "alpha": 0.75}
        lines = axes.contour(heat.x, heat.y, np.ma.masked_invalid(heat.values), levels=inside, **look)
        axes.clabel(lines, fontsize=7.5, fmt=lambda value: f"{value:.3g}")


def _filled(values: NDArray[np.floating[Any]]) -> NDArray[np.float64]:
    """Replace NaN by the nearest number: what lies over it hides it, and the colours meet its edge."""
    from scipy.ndimage import distance_transform_edt  # noqa: PLC0415 - a report draws no such map

    _, nearest = distance_transform_edt(np.isnan(values), return_indices=True)
    return np.asarray(values[tuple(nearest)])
