"""Tables and pictures of `docs/paper.md`: what a study is, how it is printed, drawn, and put on `paper_tables.md`."""

import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, TypeVar

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.figure import Figure

PICTURES = Path(__file__).resolve().parents[2] / "docs" / "paper"
PAGE = PICTURES.parent / "paper_tables.md"
# Text stays text and ids stay the same from run to run, so that a picture is small and its bytes are reproducible.
SETTINGS: Any = {
    "svg.fonttype": "none",
    "svg.hashsalt": "autotune",
    "font.size": 9,
    "axes.titlesize": 9,
    "lines.linewidth": 1.4,
}
NONE = "–"

_PLACE = re.compile(
    r"(?P<begin><!-- table: (?P<name>[\w-]+) -->\n)(?P<table>.*?)(?P<end><!-- end -->)", flags=re.DOTALL
)

Found = TypeVar("Found")


@dataclass(frozen=True, kw_only=True)
class Table:
    """A table of the page, by the `name` that marks its place there; cells are text as printed."""

    name: str
    header: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]

    def markdown(self) -> str:
        """Return the table in Markdown, columns aligned for the eye."""
        lines = [self.header, *self.rows]
        widths = [max(len(line[i]) for line in lines) for i in range(len(self.header))]
        texts = [" | ".join(cell.ljust(width) for cell, width in zip(line, widths, strict=True)) for line in lines]
        rule = "-|-".join("-" * width for width in widths)
        return "\n".join(f"| {text} |" if text != rule else f"|-{text}-|" for text in [texts[0], rule, *texts[1:]])


@dataclass(frozen=True, kw_only=True)
class Study(Generic[Found]):
    """One part of the paper: `compute` its numbers once, then put them into `tables` and pictures by file name."""

    compute: Callable[[], Found]
    tables: Callable[[Found], Sequence[Table]]
    draw: Callable[[Found], dict[str, Figure]]


def new_figure(width: float = 9.0, height: float = 3.6, columns: int = 2, rows: int = 1) -> tuple[Figure, list[Axes]]:
    """Return a figure and its axes, row by row, without the global state of pyplot."""
    with mpl.rc_context(SETTINGS):
        figure = Figure(figsize=(width, height), layout="constrained")
        grid = figure.subplots(rows, columns, squeeze=False)
    axes = [each for row in grid for each in row]
    for each in axes:
        each.spines[["top", "right"]].set_visible(False)
        each.grid(visible=True, color="0.9", linewidth=0.6)
        each.set_axisbelow(True)
    return figure, axes


def save(figure: Figure, path: Path) -> None:
    """Write an SVG that has the same bytes every time."""
    with mpl.rc_context(SETTINGS):
        figure.savefig(path, format="svg", metadata={"Date": None, "Creator": None})


def show(study: Study[Found], folder: Path) -> Sequence[Table]:
    """Compute a study, print its tables and write its pictures to a folder; return the tables."""
    found = study.compute()
    tables = study.tables(found)
    for table in tables:
        print(f"{table.name}\n{table.markdown()}\n")
    folder.mkdir(parents=True, exist_ok=True)
    with mpl.rc_context(SETTINGS):
        pictures = study.draw(found)
    for name, figure in pictures.items():
        save(figure, folder / name)
    return tables


def run(study: Study[Found], arguments: Sequence[str]) -> int:
    """Do what every script of this folder does: tables to stdout, pictures to the folder given or to `docs/paper`."""
    show(study, Path(arguments[0]) if arguments else PICTURES)
    return 0


def tables_on_page(text: str) -> dict[str, str]:
    """Return the marked tables of a page by name, as they stand there."""
    return {found["name"]: found["table"].strip() for found in _PLACE.finditer(text)}


def put_on_page(text: str, tables: Sequence[Table]) -> str:
    """Return the page with its marked tables replaced; raises KeyError if places and tables are not the same."""
    new = {table.name: table.markdown() for table in tables}
    places = tables_on_page(text)
    if set(new) != set(places):
        raise KeyError(f"Tables without a place, or places without a table: {sorted(set(new) ^ set(places))}")
    return _PLACE.sub(lambda found: f"{found['begin']}{new[found['name']]}\n{found['end']}", text)


def number(value: float | None, digits: int = 0) -> str:
    """Return a number with fixed decimals, or a dash for one that does not exist (None, infinite, not a number)."""
    if value is None or not math.isfinite(value):
        return NONE
    text = f"{value:.{digits}f}"
    return text.replace("-", "−") if float(text) != 0.0 else text.lstrip("-")
