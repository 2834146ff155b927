"""Draw a chart as vector graphics that need nothing else: the only door of reports to matplotlib."""

import io
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from .charts import Band, Bars, Chart, Element, Heat, Limit, Line, Panel, Points, Scale
from .decimate import decimate
from .framing import fitted_limits
from .palette import COLOURS, FURNITURE, ONE_SIDED, TWO_SIDED, named_colours

_POINTS_PER_INCH = 72.0
_WIDTH_INCHES, _PANEL_INCHES, _NAMED_INCHES, _AROUND_NAMED_INCHES = 8.0, 1.85, 0.36, 1.6
_MOST_BESIDE = 3
_FONT, _GLYPH = 8.0, 0.62
_TEXT_LINE_INCHES, _BELOW_INCHES, _TICKS_INCHES, _RIGHT_INCHES = 0.18, 0.45, 0.2, 0.14
_BAR_GAP_INCHES, _BAR_INCHES, _BAR_TEXT_INCHES = 0.07, 0.11, 0.48
_MOST_POINTS, _CROWD = 1400, 60
_MARKERS = {"dot": "o", "star": "*", "diamond": "D"}
_MOST_WRITTEN = 400
# A hundredth of a point is no width on any paper, and the digits after it were a third of the file.
# What stands between tags is text for people, and stays.
_LONG_NUMBER = re.compile(r">[^<]*<|(\d\.\d\d)\d+")
_HEAD = re.compile(r'^.*?<svg [^>]*?viewBox="([^"]*)"[^>]*>\s*(?:<metadata>.*?</metadata>)?', re.DOTALL)
_STYLE = re.compile(r"<defs>\s*<style[^>]*>[^<]*</style>\s*</defs>")
# What the page's style sheet says of every text, and the air between elements.
_NEEDLESS = re.compile(r"font-size: 8px; |font-family: [^;]*; | transform=\"rotate\(-0 [^\"]*\)\"|(?<=>)\s+(?=<)")
_ID, _REFERENCE = re.compile(r' id="([^"]*)"'), re.compile(r'(url\(#|href="#)([^")]*)')
# Where a logarithmic side shows fewer than two decades.
_WITHIN_A_DECADE = (1.0, 1.5, 2.0, 3.0, 5.0, 7.0)


@dataclass(frozen=True, kw_only=True)
class Still:
    """A drawing as an SVG element that can stand within a page, and its own width [pt], where letters have 8 pt.

    One that `is_wide` loses more than half of it on a narrow screen, and has the room for larger letters there.
    """

    svg: str
    width_pt: float
    is_wide: bool


def draw_stills(chart: Chart) -> tuple[Still, ...]:
    """Return the chart as drawings: one per panel where panels stand beside each other, so that a page can wrap them.

    Colours are variables of the page's style sheet, `--draw-…`. The same chart gives the same text.
    """
    groups = [(panel,) for panel in chart.panels] if chart.beside else [chart.panels]
    width = _width_inches(chart)
    stills = []
    with mpl.rc_context():
        mpl.rcdefaults()
        ink, frame = FURNITURE["ink"], FURNITURE["frame"]
        mpl.rc("font", size=_FONT, family="sans-serif")
        mpl.rc("text", color=ink)
        mpl.rc("axes", linewidth=0.6, edgecolor=frame, labelcolor=ink, titlesize=_FONT, labelsize=_FONT, xmargin=0.02)
        mpl.rc("axes.formatter", useoffset=False, limits=(-5, 6))
        mpl.rc("xtick", color=frame, labelcolor=ink, labelsize=_FONT)
        mpl.rc("ytick", color=frame, labelcolor=ink, labelsize=_FONT)
        mpl.rc("svg", hashsalt="autotune", fonttype="none")
        mpl.rc("path", simplify=True)
        for i, panels in enumerate(groups):
            stream = io.StringIO()
            figure = _draw(panels, width, linked=chart.linked)
            figure.savefig(stream, format="svg", metadata={"Date": None, "Creator": None}, transparent=True)
            svg = _as_part_of_a_page(stream.getvalue(), f"{chart.key}-{i}")
            is_wide = not chart.beside and not _cells_of(chart)
            stills.append(Still(svg=svg, width_pt=_POINTS_PER_INCH * width, is_wide=is_wide))
    return tuple(stills)


def _width_inches(chart: Chart) -> float:
    if chart.beside:
        return _WIDTH_INCHES / min(len(chart.panels), _MOST_BESIDE)
    cells = _cells_of(chart)
    return min(_WIDTH_INCHES, _AROUND_NAMED_INCHES + _NAMED_INCHES * max(cells)) if cells else _WIDTH_INCHES


def _cells_of(chart: Chart) -> list[int]:
    """Return the numbers of columns of the tables of names."""
    return [len(each.x) for panel in chart.panels for each in panel.elements if isinstance(each, Heat) and each.names]


def _as_part_of_a_page(drawing: str, key: str) -> str:
    """Return the SVG element alone, with ids that no other drawing has, and the page's colours."""
    text = _STYLE.sub("", _HEAD.sub(r'<svg viewBox="\1" aria-hidden="true">', drawing, count=1))
    used = {name: f"{key}-{i}" for i, name in enumerate(dict.fromkeys(m[2] for m in _REFERENCE.finditer(text)))}
    text = _ID.sub(lambda m: f' id="{used[m[1]]}"' if m[1] in used else "", text)
    text = _REFERENCE.sub(lambda m: m[1] + used[m[2]], text)
    text = _NEEDLESS.sub("", _LONG_NUMBER.sub(lambda match: match[1] or match[0], text))
    return named_colours(text).strip()


def _draw(panels: Sequence[Panel], width: float, *, linked: bool) -> Figure:
    """Lay out in inches: the library's own layout measures every text twice, which took longer than the drawing."""
    close = [linked and i < len(panels) - 1 for i in range(len(panels))]
    above = [_TEXT_LINE_INCHES * (bool(panel.title) + bool(panel.y.label)) + 0.08 for panel in panels]
    below = [0.02 if shut else _below_inches(panel) for shut, panel in zip(close, panels, strict=True)]
    heights = [_PANEL_INCHES * panel.height for panel in panels]
    height = sum(above) + sum(below) + sum(heights)
    figure = Figure(figsize=(width, height))
    every, top = [], height
    for i, panel in enumerate(panels):
        top -= above[i] + heights[i]
        axes = figure.add_axes((0.1, top / height, 0.8, heights[i] / height))
        top -= below[i]
        _draw_panel(axes, panel)
        if close[i]:
            axes.set_xlabel("")
            axes.tick_params(labelbottom=False)
        every.append(axes)
    if linked:
        low, high = (pick(axes.get_xlim()[i] for axes in every) for i, pick in ((0, min), (1, max)))
        for axes in every:
            axes.set_xlim(low, high)
    _place(figure, panels, every, width)
    return figure


def _below_inches(panel: Panel) -> float:
    for element in panel.elements:
        if isinstance(element, Heat) and element.names:
            longest = max(len(name) for name in element.names[0])
            return 0.1 + longest * _GLYPH * _FONT * math.sin(math.radians(60.0)) / _POINTS_PER_INCH
    return _BELOW_INCHES if panel.x.label else _TICKS_INCHES


def _place(figure: Figure, panels: Sequence[Panel], every: Sequence[Axes], width: float) -> None:
    """Give the axes the width that their numbers leave, and the scale of colours what is beside them."""
    letters = max(_most_letters(axes.yaxis) for axes in every)
    left = (0.17 * _FONT * 10.0 / _POINTS_PER_INCH) + letters * _GLYPH * _FONT / _POINTS_PER_INCH
    mapped = any(isinstance(each, Heat) for panel in panels for each in panel.elements)
    right = _BAR_GAP_INCHES + _BAR_INCHES + _BAR_TEXT_INCHES if mapped else _RIGHT_INCHES
    for panel, axes in zip(panels, every, strict=True):
        box = axes.get_position()
        axes.set_position((left / width, box.y0, 1.0 - (left + right) / width, box.height))
        if panel.equal:
            shape = (width - left - right) / (_PANEL_INCHES * panel.height)
            x, y = fitted_limits(axes.get_xlim(), axes.get_ylim(), shape)
            axes.set_xlim(x)
            axes.set_ylim(y)
        for element in panel.elements:
            if isinstance(element, Heat):
                start = 1.0 - (right - _BAR_GAP_INCHES) / width
                beside = figure.add_axes((start, box.y0, _BAR_INCHES / width, box.height))
                figure.colorbar(axes.collections[0], cax=beside).set_label(element.label, labelpad=2.0)


def _most_letters(side: Axis) -> int:
    low, high = sorted(side.get_view_interval())
    places = [place for place in side.get_majorticklocs() if low <= place <= high]
    return max((len(text) for text in side.get_major_formatter().format_ticks(places)), default=1)


def _draw_panel(axes: Axes, panel: Panel) -> None:
    if not any(isinstance(each, Heat) for each in panel.elements):
        axes.grid(linewidth=0.4, color=FURNITURE["grid"])
    axes.set_axisbelow(True)
    _set_scale(axes, "x", panel.x)
    _set_scale(axes, "y", panel.y)
    axes.set_xlabel(panel.x.label, labelpad=4.5)
    # What a side shows stands above it: it can be read without turning the head, and is never longer than the side.
    lines = [*([panel.title] if panel.title else []), panel.y.label]
    for i, text in enumerate(reversed(lines)):
        place: dict[str, Any] = {"textcoords": "offset points", "xycoords": "axes fraction", "annotation_clip": False}
        weight = "bold" if i else "normal"
        axes.annotate(text, (0.0, 1.0), (0.0, 4.5 + i * _TEXT_LINE_INCHES * _POINTS_PER_INCH), weight=weight, **place)
    for role, parts in panel.stretches().items():
        spans = [(each.low, each.high - each.low) for each in parts]
        look: dict[str, Any] = {"facecolors": COLOURS[role], "alpha": 0.16, "linewidth": 0.0}
        axes.broken_barh(spans, (0.0, 1.0), transform=axes.get_xaxis_transform(), **look)
    for element in panel.elements:
        _draw_element(axes, element)
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


def _set_scale(axes: Axes, which: str, scale: Scale) -> None:
    getattr(axes, f"set_{which}scale")(scale.spacing)
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


def _draw_element(axes: Axes, element: Element) -> None:
    if isinstance(element, Heat):
        _draw_heat(axes, element)
        return
    colour = COLOURS[element.role]
    if isinstance(element, Line):
        x, y = decimate(element.x, element.y, _MOST_POINTS)
        drawn = "steps-post" if element.steps else "default"
        style = "--" if element.dashed else "-"
        thick = 2.0 if element.is_wide else 1.0
        axes.plot(x, y, style, color=colour, linewidth=thick, drawstyle=drawn)
    elif isinstance(element, Band):
        axes.fill_between(element.x, element.low, element.high, color=colour, alpha=0.22, linewidth=0.0)
    elif isinstance(element, Points):
        size = 9.0 if element.marker == "star" else 4.0
        edge = 0.5 if len(element.x) < _CROWD else 0.0
        mark: dict[str, Any] = {"zorder": 4, "linestyle": "none", "markeredgecolor": FURNITURE["paper"]}
        mark |= {"color": colour, "markersize": size, "markeredgewidth": edge}
        axes.plot(element.x, element.y, _MARKERS[element.marker], **mark)
    elif isinstance(element, Bars):
        axes.stairs(element.heights, element.edges, fill=True, color=colour, alpha=0.75)
    elif isinstance(element, Limit):
        across = axes.axhline if element.along == "y" else axes.axvline
        across(element.value, color=colour, linewidth=1.2, linestyle=":")


def _draw_heat(axes: Axes, heat: Heat) -> None:
    low, high = heat.span()
    colours = TWO_SIDED if heat.is_two_sided else ONE_SIDED
    # A map is a picture within the picture: as vectors its cells alone would outweigh the page.
    many = heat.values.size > _MOST_WRITTEN
    ground = Rectangle(
        (0.0, 0.0), 1.0, 1.0, transform=axes.transAxes, color=FURNITURE["hole"], linewidth=0.0, zorder=0.0
    )
    axes.add_patch(ground)
    axes.pcolormesh(heat.x, heat.y, heat.values, vmin=low, vmax=high, cmap=colours, shading="nearest", rasterized=many)
    if heat.names is not None:
        axes.set_xticks(heat.x, heat.names[0], rotation=60.0, ha="right", rotation_mode="anchor")
        axes.set_yticks(heat.y, heat.names[1])
        axes.invert_yaxis()
    for x, y, text, is_dark in heat.writings():
        colour = "white" if is_dark else "#222222"
        axes.text(x, y, text, ha="center", va="center", fontsize=6.0, color=colour)
