"""Reports: sections of tables, facts, notes and charts, rendered as one HTML page that needs no network."""

import base64
import gzip
import json
from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from importlib.resources import files
from typing import Any, Literal

from jinja2 import Environment, StrictUndefined, Template
from markupsafe import Markup

from autotune.charts.chart import MOST_POINTS, Band, Bars, Chart, Element, Heat, Limit, Line, Panel, Points, Region
from autotune.charts.palette import colour_variables, dark_colours
from autotune.processes import map_in_processes
from problems.progress import Progress

Tone = Literal["", "good", "warn", "bad", "quiet"]
_GRAVITY: tuple[Tone, ...] = ("", "quiet", "good", "warn", "bad")


@dataclass(frozen=True, kw_only=True)
class TableCell:
    """One entry of a table; `tone` colours it, `is_number` sets it to the right, `is_whole` keeps it in one line."""

    text: str
    tone: Tone = ""
    is_number: bool = False
    is_whole: bool = False


@dataclass(frozen=True, kw_only=True)
class Table:
    """Rows below named columns; `caption` says what the table is."""

    caption: str
    columns: tuple[str, ...]
    rows: tuple[tuple[TableCell, ...], ...]

    def __post_init__(self) -> None:
        if any(len(row) != len(self.columns) for row in self.rows):
            raise ValueError(f"a table of {len(self.columns)} columns needs as many cells in every row")

    def heads(self) -> tuple[TableCell, ...]:
        """Return the columns' names, each to the side to which its entries are set."""
        entries = [[row[i] for row in self.rows if row[i].text] for i in range(len(self.columns))]
        return tuple(
            TableCell(text=name, is_number=bool(cells) and all(cell.is_number for cell in cells))
            for name, cells in zip(self.columns, entries, strict=True)
        )


def build_table(
    caption: str, columns: Iterable[str], rows: Iterable[Iterable[str | TableCell]], *, numbers: Collection[int] = ()
) -> Table:
    """Return a table of texts and cells; those in the columns `numbers` are set to the right."""
    cells = (
        tuple(
            replace(each, is_number=each.is_number or i in numbers)
            if isinstance(each, TableCell)
            else TableCell(text=each, is_number=i in numbers)
            for i, each in enumerate(row)
        )
        for row in rows
    )
    return Table(caption=caption, columns=tuple(columns), rows=tuple(cells))


@dataclass(frozen=True, kw_only=True)
class Note:
    """A remark, a finding or an advice; `tone` says how much it matters, `kind` says it in a word."""

    text: str
    advice: str = ""
    kind: str = ""
    tone: Tone = ""


@dataclass(frozen=True, kw_only=True)
class Fact:
    """A number in large type with what it is; `is_large` for the one to read from afar."""

    label: str
    value: str
    detail: str = ""
    tone: Tone = ""
    is_large: bool = False


@dataclass(frozen=True, kw_only=True)
class Facts:
    """Facts beside each other."""

    facts: tuple[Fact, ...]


# Letters of a drawing, 8 pt in its own measure, are nine tenths of the text around it.
_REM_PER_POINT = 0.9 / 8.0

Block = Chart | Table | Note | Facts


@dataclass(frozen=True, kw_only=True)
class Section:
    """A part of the page under a heading; `key` is the anchor that the contents point to.

    One that `is_part` begins a report of its own on a page of several; one that `is_folded` opens on demand.
    """

    key: str
    title: str
    blocks: tuple[Block, ...]
    lead: str = ""
    is_part: bool = False
    is_folded: bool = False


@dataclass(frozen=True, kw_only=True)
class Page:
    """A whole report: `lead` says the outcome in a sentence, `footer` where it comes from."""

    title: str
    lead: str
    sections: tuple[Section, ...]
    footer: str = ""
    tone: Tone = ""


def join_pages(title: str, pages: Sequence[tuple[str, Page]]) -> Page:
    """Return one page with a part for each of the named pages; a single one is returned as it is.

    Keys are made different by the number of the part. The tone is that of the gravest part.
    """
    if len(pages) == 1:
        return pages[0][1]
    sections: list[Section] = []
    for number, (name, page) in enumerate(pages, 1):
        mark = f"part-{number}"
        lead = " ".join(part for part in (page.lead, page.footer) if part)
        sections.append(Section(key=mark, title=f"{name}: {page.title}", blocks=(), lead=lead, is_part=True))
        sections += [_renamed(section, mark) for section in page.sections]
    gravest = max((page.tone for _, page in pages), key=_GRAVITY.index)
    return Page(title=title, lead=", ".join(name for name, _ in pages), sections=tuple(sections), tone=gravest)


def _renamed(section: Section, mark: str) -> Section:
    blocks = tuple(
        replace(block, key=f"{mark}-{block.key}") if isinstance(block, Chart) else block for block in section.blocks
    )
    return replace(section, key=f"{mark}-{section.key}", blocks=blocks)


def render_page(page: Page, progress: Progress | None = None, *, processes: int = 1) -> str:
    """Return the page as one HTML text that refers to nothing outside of itself.

    Every figure is a picture that needs no script, with its text alternative; those that can be zoomed carry what the
    engine needs, which draws them when asked. Pictures and engine are two libraries' work, done side by side by two
    `processes`. `progress` receives the share of the figures drawn since the last call. The same page gives the same
    text.
    """
    charts = [block for section in page.sections for block in section.blocks if isinstance(block, Chart)]
    keys = [chart.key for chart in charts] + [section.key for section in page.sections]
    if len(set(keys)) < len(keys):
        raise ValueError(f"keys of sections and figures must differ: {sorted(keys)}")
    charts = [_thinned(chart) for chart in charts]
    tasks = [_Drawing(charts=tuple(charts), is_live=False)]
    if any(chart.live for chart in charts):
        tasks.append(_Drawing(charts=tuple(chart for chart in charts if chart.live), is_live=True))
    done = None if progress is None else partial(progress, 1.0 / len(tasks))
    drawn = map_in_processes(_draw, tasks, processes, each=done)
    live = drawn[1] if len(drawn) > 1 else _Drawn(figures={})
    return _template().render(page=page, stills=drawn[0].figures, live=live.figures, engine=live.engine)


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
    """Return what the legend says once per figure, and what once per panel."""
    panels = tuple(tuple(dict.fromkeys(_entries(panel))) for panel in chart.panels)
    every = [entry for panel in panels for entry in panel]
    apart = chart.beside and len(panels) > 1 and len(set(every)) == len(every)
    if apart:
        return Legend(whole=(), panels=panels)
    return Legend(whole=tuple(dict.fromkeys(every)), panels=((),) * len(panels))


def _entries(panel: Panel) -> Iterator[LegendEntry]:
    for element in panel.elements:
        if not isinstance(element, Heat | Region) and element.label:
            yield LegendEntry(label=element.label, role=element.role, look=_look(element))


def _look(element: Element) -> str:
    if isinstance(element, Line):
        return "dashed" if element.dashed else "wide" if element.is_wide else "line"
    if isinstance(element, Points):
        return element.marker
    if isinstance(element, Limit):
        return "dotted"
    return "bars" if isinstance(element, Bars) else "band" if isinstance(element, Band) else "stretch"


def kind_of(block: Block) -> str:
    """Return by which part of the template a block is written."""
    return type(block).__name__.lower()


def _thinned(chart: Chart) -> Chart:
    """Return the chart with no more points than are drawn: those of a long log are not passed around."""
    panels = tuple(
        replace(panel, elements=tuple(_thinned_element(each) for each in panel.elements)) for panel in chart.panels
    )
    return replace(chart, panels=panels)


def _thinned_element(element: Element) -> Element:
    if not isinstance(element, Line):
        return element
    x, y = element.thinned(MOST_POINTS)
    return replace(element, x=x, y=y)


@dataclass(frozen=True, kw_only=True)
class _Drawing:
    """Charts to be drawn by one of the two libraries."""

    charts: tuple[Chart, ...]
    is_live: bool


@dataclass(frozen=True, kw_only=True)
class _Drawn:
    """What the page carries of every chart, by its key, and the engine that draws the live ones."""

    figures: dict[str, Any]
    engine: str = ""


def _draw(drawing: _Drawing) -> _Drawn:
    if drawing.is_live:
        return _Drawn(figures={chart.key: _live(chart) for chart in drawing.charts}, engine=_engine())
    return _Drawn(figures={chart.key: _stills(chart) for chart in drawing.charts})


def _stills(chart: Chart) -> tuple[dict[str, Any], ...]:
    # matplotlib and Bokeh take a second to import; what only reads or checks a page does without.
    from .stills import draw_stills  # noqa: PLC0415

    drawn = draw_stills(chart)
    return tuple(
        {"svg": Markup(each.svg), "width_rem": each.width_pt * _REM_PER_POINT, "is_wide": each.is_wide}
        for each in drawn
    )


def _live(chart: Chart) -> str:
    from autotune.charts.bokeh_renderer import draw_live  # noqa: PLC0415

    return _packed(json.dumps(draw_live(chart), separators=(",", ":")))


def _engine() -> str:
    from autotune.charts.bokeh_renderer import engine  # noqa: PLC0415

    return _packed(engine())


def _packed(text: str) -> str:
    """Return text as the page carries what it may never need: a third of the length, and nothing a browser reads."""
    return base64.b64encode(gzip.compress(text.encode(), mtime=0)).decode()


@lru_cache(maxsize=1)
def _template() -> Template:
    folder = files("autotune.report")
    environment = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    environment.filters["kind"] = kind_of
    environment.filters["legend"] = build_legend
    style = (folder / "page.css").read_text("utf-8")
    for mark, dark in (("--draw: light;", False), ("--draw: dark;", True)):
        style = style.replace(mark, colour_variables(dark=dark))
    environment.globals["style"] = Markup(style)
    environment.globals["dark_colours"] = dark_colours()
    environment.globals["script"] = Markup((folder / "page.js").read_text("utf-8"))
    return environment.from_string((folder / "page.html.jinja").read_text("utf-8"))
