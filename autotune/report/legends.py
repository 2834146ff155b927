"""What the colours and strokes of a figure mean: a list beside it that hides no curve, is never cut, and can wrap."""

from collections.abc import Iterator
from dataclasses import dataclass

from .charts import Band, Bars, Chart, Element, Heat, Limit, Line, Panel, Points


@dataclass(frozen=True, kw_only=True)
class LegendEntry:
    """One mark and its name; `look` is the class of the style sheet that draws the mark."""

    label: str
    role: str
    look: str


@dataclass(frozen=True, kw_only=True)
class Legend:
    """The entries of the figure as a whole, or those of each panel where no two panels share one."""

    whole: tuple[LegendEntry, ...]
    panels: tuple[tuple[LegendEntry, ...], ...]


def build_legend(chart: Chart) -> Legend:
    """Return what a reader must be told once per figure, and what once per panel."""
    panels = tuple(tuple(dict.fromkeys(_entries(panel))) for panel in chart.panels)
    every = [entry for panel in panels for entry in panel]
    apart = chart.beside and len(panels) > 1 and len(set(every)) == len(every)
    if apart:
        return Legend(whole=(), panels=panels)
    return Legend(whole=tuple(dict.fromkeys(every)), panels=((),) * len(panels))


def _entries(panel: Panel) -> Iterator[LegendEntry]:
    for element in panel.elements:
        if not isinstance(element, Heat) and element.label:
            yield LegendEntry(label=element.label, role=element.role, look=_look(element))


def _look(element: Element) -> str:
    if isinstance(element, Line):
        return "dashed" if element.dashed else "wide" if element.is_wide else "line"
    if isinstance(element, Points):
        return element.marker
    if isinstance(element, Limit):
        return "dotted"
    return "bars" if isinstance(element, Bars) else "band" if isinstance(element, Band) else "stretch"
