"""Aligned columns of text for people."""

import re
import sys
import textwrap
import unicodedata
from collections.abc import Iterator, Sequence

from ._terminal import echo, look_at, painted, printable

_NUMBER = re.compile(r"([+-]?\d+|-)((?:\.\d+)?(?:e[+-]?\d+)?)$")
_GAP = "  "
_NARROWEST_TEXT = 24


def table_lines(
    rows: Sequence[Sequence[str]],
    *,
    left: Sequence[int] = (0,),
    point: Sequence[int] = (),
    verdict: int | None = None,
    indent: str = "",
    columns: int | None = None,
    stacks: bool = False,
) -> Iterator[str]:
    """Yield one line per row, columns aligned: those in `left` to the left, in `point` at the decimal point.

    The others are aligned to the right. The words of the column `verdict` are coloured where that is wanted. For lines
    of at most `columns`, the last column is folded if it is one of text; with `stacks` it goes below its row where
    there is no room beside it, and else every row is told as a block of lines under the headings of the first row.
    What cannot be made to fit stays as it is.
    """
    cells = [[printable(text) for text in row] for row in rows]
    aligned = _aligned(cells, left, point)
    width = len(indent) + max(sum(map(display_width, row)) for row in aligned) + len(_GAP) * (len(aligned[0]) - 1)
    last = len(aligned[0]) - 1
    if columns is not None and width > columns:
        room = columns - (width - max(display_width(row[last]) for row in aligned))
        if last in left and room >= _NARROWEST_TEXT:
            yield from _last_folded(aligned, room, indent)
            return
        if stacks and last in left and room >= -len(_GAP):
            yield from _last_below(aligned, columns, indent)
            return
        if stacks:
            yield from _stacked(cells, indent, named=0 not in left)
            return
    for row in aligned:
        told = [painted(text) if column == verdict else text for column, text in enumerate(row)]
        yield (indent + _GAP.join(told)).rstrip()


def print_table(
    rows: Sequence[Sequence[str]],
    *,
    left: Sequence[int] = (0,),
    point: Sequence[int] = (),
    verdict: int | None = None,
    indent: str = "",
    stacks: bool = False,
) -> None:
    """Print `table_lines`, on a terminal within its width as far as that can be done."""
    columns = look_at(sys.stdout).columns
    for line in table_lines(
        rows, left=left, point=point, verdict=verdict, indent=indent, columns=columns, stacks=stacks
    ):
        echo(line)


def display_width(text: str) -> int:
    """Return how many columns of a terminal `text` takes: none for a combining mark, two for a wide character."""
    return sum(
        0 if unicodedata.combining(character) else 1 + (unicodedata.east_asian_width(character) in "WF")
        for character in text
    )


def _aligned(cells: Sequence[Sequence[str]], left: Sequence[int], point: Sequence[int]) -> list[list[str]]:
    """Return the cells with the blanks that make the columns of one width."""
    columns = []
    for column in range(len(cells[0])):
        texts = [row[column] for row in cells]
        if column in point:
            texts = _at_point(texts)
        width = max(map(display_width, texts))
        blanks = [" " * (width - display_width(text)) for text in texts]
        is_left = column in left
        columns.append([text + blank if is_left else blank + text for text, blank in zip(texts, blanks, strict=True)])
    return [list(row) for row in zip(*columns, strict=True)]


def _at_point(texts: Sequence[str]) -> list[str]:
    """Return numbers with blanks before and behind, so that their decimal points stand in one place."""
    parts = [_NUMBER.match(text) for text in texts]
    before = max((len(part[1]) for part in parts if part), default=0)
    behind = max((len(part[2]) for part in parts if part), default=0)
    return [
        f"{part[1]:>{before}}{part[2]:<{behind}}" if part else text for text, part in zip(texts, parts, strict=True)
    ]


def _last_folded(aligned: Sequence[Sequence[str]], room: int, indent: str) -> Iterator[str]:
    for row in aligned:
        head = indent + _GAP.join(row[:-1]) + _GAP
        folded = textwrap.wrap(row[-1], room, break_long_words=False, break_on_hyphens=False) or [""]
        yield (head + folded[0]).rstrip()
        yield from (" " * display_width(head) + text for text in folded[1:])


def _last_below(aligned: Sequence[Sequence[str]], columns: int, indent: str) -> Iterator[str]:
    under = indent + 2 * _GAP
    for row in aligned:
        yield (indent + _GAP.join(row[:-1])).rstrip()
        folded = textwrap.wrap(row[-1], columns - len(under), break_long_words=False, break_on_hyphens=False)
        yield from (under + text for text in folded)


def _stacked(cells: Sequence[Sequence[str]], indent: str, *, named: bool) -> Iterator[str]:
    """Yield each row as a block; `named`: its first cell is a number and says nothing without its heading."""
    headings, *rows = cells
    width = max(map(display_width, headings[1:]))
    for row in rows:
        yield f"{indent}{headings[0]} {row[0]}" if named else (indent + row[0]).rstrip()
        for heading, text in zip(headings[1:], row[1:], strict=True):
            if text:
                yield f"{indent}{_GAP}{heading}{' ' * (width - display_width(heading))}{_GAP}{text}"
