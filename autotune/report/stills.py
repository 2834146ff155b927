"""Draw a chart as vector graphics within a page, which refer to nothing and take their colours from its style sheet."""

import io
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure

from autotune.charts.chart import Chart, Heat, Panel
from autotune.charts.matplotlib_renderer import POINTS_PER_INCH, TEXT_LINE_INCHES, add_colour_bar, draw_panel
from autotune.charts.palette import FURNITURE, named_colours

Span = tuple[float, float]

_WIDTH_INCHES, _PANEL_INCHES, _NAMED_INCHES, _AROUND_NAMED_INCHES = 8.0, 1.85, 0.36, 1.6
_MOST_BESIDE = 3
_FONT, _GLYPH = 8.0, 0.62
_BELOW_INCHES, _TICKS_INCHES, _RIGHT_INCHES = 0.45, 0.2, 0.14
_BAR_GAP_INCHES, _BAR_INCHES, _BAR_TEXT_INCHES = 0.07, 0.11, 0.48
# A hundredth of a point is no width on any paper, and the digits after it were a third of the file.
# Text between tags is for people, and stays.
_LONG_NUMBER = re.compile(r">[^<]*<|(\d\.\d\d)\d+")
_HEAD = re.compile(r'^.*?<svg [^>]*?viewBox="([^"]*)"[^>]*>\s*(?:<metadata>.*?</metadata>)?', re.DOTALL)
_STYLE = re.compile(r"<defs>\s*<style[^>]*>[^<]*</style>\s*</defs>")
# What the page's style sheet says of every text, and the air between elements.
_NEEDLESS = re.compile(r"font-size: 8px; |font-family: [^;]*; | transform=\"rotate\(-0 [^\"]*\)\"|(?<=>)\s+(?=<)")
_ID, _REFERENCE = re.compile(r' id="([^"]*)"'), re.compile(r'(url\(#|href="#)([^")]*)')


@dataclass(frozen=True, kw_only=True)
class Still:
    """A drawing as an SVG element that fits into a page, and its own width [pt], where letters have 8 pt.

    One that `is_wide` loses more than half of it on a narrow screen, and has the room for larger letters there.
    """

    svg: str
    width_pt: float
    is_wide: bool


def draw_stills(chart: Chart) -> tuple[Still, ...]:
    """Return the chart as drawings: one per panel where panels are beside each other, so that a page can wrap them.

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
            stills.append(Still(svg=svg, width_pt=POINTS_PER_INCH * width, is_wide=is_wide))
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
    above = [TEXT_LINE_INCHES * (bool(panel.title) + bool(panel.y.label)) + 0.08 for panel in panels]
    below = [0.02 if shut else _below_inches(panel) for shut, panel in zip(close, panels, strict=True)]
    heights = [_PANEL_INCHES * panel.height for panel in panels]
    height = sum(above) + sum(below) + sum(heights)
    figure = Figure(figsize=(width, height))
    every, top = [], height
    for i, panel in enumerate(panels):
        top -= above[i] + heights[i]
        axes = figure.add_axes((0.1, top / height, 0.8, heights[i] / height))
        top -= below[i]
        draw_panel(axes, panel, labels="above")
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
            return 0.1 + longest * _GLYPH * _FONT * math.sin(math.radians(60.0)) / POINTS_PER_INCH
    return _BELOW_INCHES if panel.x.label else _TICKS_INCHES


def _place(figure: Figure, panels: Sequence[Panel], every: Sequence[Axes], width: float) -> None:
    """Give the axes the width that their numbers leave, and the scale of colours what is beside them."""
    letters = max(_most_letters(axes.yaxis) for axes in every)
    left = (0.17 * _FONT * 10.0 / POINTS_PER_INCH) + letters * _GLYPH * _FONT / POINTS_PER_INCH
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
                add_colour_bar(figure, panel, axes, beside)


def _most_letters(side: Axis) -> int:
    low, high = sorted(side.get_view_interval())
    places = [place for place in side.get_majorticklocs() if low <= place <= high]
    return max((len(text) for text in side.get_major_formatter().format_ticks(places)), default=1)


def fitted_limits(x: Span, y: Span, shape: float) -> tuple[Span, Span]:
    """Return limits that hold the given ones and have the same length per unit in both; `shape` is width by height."""
    wide, high = x[1] - x[0], y[1] - y[0]
    return _widened(x, max(wide, high * shape)), _widened(y, max(high, wide / shape))


def _widened(span: Span, length: float) -> Span:
    middle = 0.5 * (span[0] + span[1])
    return middle - 0.5 * length, middle + 0.5 * length
