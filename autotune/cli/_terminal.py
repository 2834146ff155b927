"""Detect what a terminal shows; print messages, coloured verdicts and tables within its width.

A pipe or a file gets the plain text, one line for each message.
"""

import os
import re
import sys
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TextIO

import click

_DUMB = frozenset({"dumb", "unknown"})
_NARROWEST = 40
_BLOCKS = "▁█"
# A number and its unit stay on one line.
_UNIT = re.compile(r"(?<=\d) (?=\S{1,7}(?:[\s,;)]|$))")
_FIXED = "\N{NO-BREAK SPACE}"

_NUMBER = re.compile(r"([+-]?\d+|-)((?:\.\d+)?(?:e[+-]?\d+)?)$")
_GAP = "  "
_TO_PASTE = "    "
# A line of YAML among them: below others of its file it must begin where they do.
_YAML = re.compile(r" {4}(?=\w+: )")
_NARROWEST_TEXT = 24

# Every word that judges, with its colour; errors are in bold as well.
_WORDS = {
    "green": ("ok", "identified", "valid", "validated"),
    "yellow": ("weak", "warning", "note"),
    "red": ("unidentifiable", "error", "FAILED", "NOT valid", "UNSTABLE", "autotune"),
    "cyan": ("given", "info"),
}
_COLOURS = {word: colour for colour, words in _WORDS.items() for word in words}


@dataclass(frozen=True, kw_only=True)
class Screen:
    """What a stream shows: whether a person reads it, colours, block characters, lines that are drawn over.

    `columns` is None where lines may be of any length.
    """

    is_terminal: bool
    has_colour: bool
    has_blocks: bool
    can_redraw: bool
    columns: int | None


def detect_terminal(stream: TextIO | None, environment: Mapping[str, str] = os.environ) -> Screen:
    """Return what `stream` can show (None: the process has no such stream).

    `NO_COLOR` set to anything switches colour off, even where it is forced; `FORCE_COLOR` or `CLICOLOR_FORCE` set to
    anything but 0 switches it on, even in a pipe; `CLICOLOR=0` and `TERM=dumb` switch it off on a terminal. Lines are
    folded, drawn over or adorned on a terminal only, whatever is set.
    """
    is_terminal = _is_terminal(stream)
    is_able = is_terminal and environment.get("TERM", "").lower() not in _DUMB
    return Screen(
        is_terminal=is_terminal,
        has_colour=_has_colour(is_able, environment),
        has_blocks=is_terminal and _can_encode(stream, _BLOCKS),
        can_redraw=is_able,
        columns=max(_columns(stream, environment), _NARROWEST) if is_terminal else None,
    )


def _is_terminal(stream: TextIO | None) -> bool:
    try:
        return stream is not None and stream.isatty()
    except ValueError:  # closed
        return False


def _has_colour(is_able: bool, environment: Mapping[str, str]) -> bool:
    if environment.get("NO_COLOR"):
        return False
    if any(environment.get(name, "0") not in {"", "0"} for name in ("FORCE_COLOR", "CLICOLOR_FORCE")):
        return True
    return is_able and environment.get("CLICOLOR") != "0"


def _columns(stream: TextIO | None, environment: Mapping[str, str]) -> int:
    """Return the width that `COLUMNS` says, else that of the terminal, else 80."""
    said = environment.get("COLUMNS", "")
    if said.isdecimal() and int(said) > 0:
        return int(said)
    try:
        return 80 if stream is None else os.get_terminal_size(stream.fileno()).columns or 80
    except (OSError, ValueError):
        return 80


def _can_encode(stream: TextIO | None, text: str) -> bool:
    try:
        text.encode(getattr(stream, "encoding", None) or "ascii")
    except (UnicodeEncodeError, LookupError):
        return False
    return True


def printable(text: str) -> str:
    """Replace control characters, which a name from a file could otherwise send to the terminal."""
    return "".join(character if character.isprintable() else "?" for character in text)


def painted(text: str, *, error: bool = False) -> str:
    """Colour the word that judges in `text`, which holds nothing else but blanks and a colon; others stay as they are.

    `error`: the text goes to standard error.
    """
    word = text.strip(" :")
    colour = _COLOURS.get(word)
    if colour is None or not detect_terminal(sys.stderr if error else sys.stdout).has_colour:
        return text
    return text.replace(word, click.style(word, fg=colour, bold=True if colour == "red" else None))


def print_message(text: str = "", *, verdict: str = "", indent: str = "") -> None:
    """Print a line on standard output; `verdict` is written before it, in colour where there is any.

    On a terminal the line is folded between words, what follows indented to its beginning.
    """
    text = "\n".join(map(printable, text.split("\n")))
    for line in wrap_lines(text, verdict=verdict, indent=indent, columns=detect_terminal(sys.stdout).columns):
        echo(line)


def wrap_lines(
    text: str, *, verdict: str = "", indent: str = "", columns: int | None = None, error: bool = False
) -> list[str]:
    """Return the lines of `print_message` for a width of `columns`, None for any; `error`: for standard error.

    Further lines of the text are lines of their own. What is indented there, to be pasted, is not folded, and lines of
    YAML begin at the margin.
    """
    text, *further = text.split("\n")
    whole = f"{indent}{verdict}{text}".rstrip()
    before = len(indent + verdict) if verdict else len(whole) - len(whole.lstrip()) + 2
    lines = [whole] if columns is None else _folded(whole, " " * before, columns)
    head = indent + verdict
    if verdict and lines[0].startswith(head):
        lines[0] = indent + painted(verdict, error=error) + lines[0][len(head) :]
    for each in further:
        if columns is None or each.startswith(_TO_PASTE):
            lines.append(_YAML.sub("", each))
        else:
            lines += _folded(each, "  ", columns)
    return lines


def set_apart(text: str, to_paste: Sequence[str]) -> str:
    """Return a text with each of its parts that are to be pasted on an indented line of its own."""
    for each in to_paste:
        text = text.replace(each, f"\n{_TO_PASTE}{each}\n")
    lines = (each if each.startswith(_TO_PASTE) else each.strip("; ") for each in text.split("\n"))
    return "\n".join(each for each in lines if each not in {"", "."})


def _folded(text: str, under: str, columns: int) -> list[str]:
    lead = re.match(r" *", text)
    begin = "" if lead is None else lead.group()
    folded = textwrap.wrap(
        _UNIT.sub(_FIXED, text[len(begin) :]),
        width=columns,
        initial_indent=begin,
        subsequent_indent=under,
        break_long_words=False,
        break_on_hyphens=False,
        # Blanks in a row hold columns apart.
        replace_whitespace=False,
    )
    return [line.replace(_FIXED, " ") for line in folded] or [text]


def echo(line: str) -> None:
    """Print a line that is finished; colours in it were put there because they are wanted."""
    click.echo(line, color=True)


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
    columns = detect_terminal(sys.stdout).columns
    lines = table_lines(rows, left=left, point=point, verdict=verdict, indent=indent, columns=columns, stacks=stacks)
    for line in lines:
        echo(line)


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

    The others are aligned to the right. The words of the column `verdict`, the last one, are coloured where that is
    wanted. For lines of at most `columns`, the last column is folded if it is one of text; with `stacks` it goes below
    its row where there is no room beside it, and else every row becomes a block of lines under the headings of the
    first row. What cannot be made to fit stays as it is.
    """
    from rich.cells import cell_len

    cells = [[printable(text) for text in row] for row in rows]
    texts = [_at_point(column) if i in point else column for i, column in enumerate(zip(*cells, strict=True))]
    widths = [max(map(cell_len, column)) for column in texts]
    is_left = [i in left or i in point for i in range(len(widths))]
    last, width = len(widths) - 1, len(indent) + sum(widths) + len(_GAP) * (len(widths) - 1)
    is_folded = columns is not None and width > columns
    if columns is not None and is_folded:
        room = columns - (width - widths[last])
        if last in left and room >= _NARROWEST_TEXT:
            widths[last] = room
        elif stacks and last in left and room >= -len(_GAP):
            for row, line in zip(cells, _grid_lines(texts[:last], widths[:last], is_left), strict=True):
                yield (indent + line).rstrip()
                yield from _folded(indent + 2 * _GAP + row[last], indent + 2 * _GAP, columns) if row[last] else ()
            return
        elif stacks:
            yield from _stacked(cells, indent, named=0 not in left)
            return
    for i, line in enumerate(_grid_lines(texts, widths, is_left)):
        word = "" if verdict is None or is_folded else cells[i][verdict]
        yield (indent + line).rstrip().removesuffix(word) + painted(word)


def _grid_lines(texts: Sequence[Sequence[str]], widths: Sequence[int], is_left: Sequence[bool]) -> list[str]:
    """Return columns of texts as lines, the last column folded to its width."""
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    grid = Table.grid(padding=(0, len(_GAP), 0, 0))
    for i, width in enumerate(widths):
        grid.add_column(width=width, justify="left" if is_left[i] else "right", no_wrap=i < len(widths) - 1)
    for row in zip(*texts, strict=True):
        grid.add_row(*(Text(text, overflow="fold") for text in row))
    console = Console(width=sum(widths) + len(_GAP) * len(widths), color_system=None, legacy_windows=False)
    with console.capture() as found:
        console.print(grid)
    return found.get().splitlines()


def _at_point(texts: Sequence[str]) -> list[str]:
    """Return texts of one width, numbers with their decimal points in one place."""
    from rich.cells import cell_len

    parts = [_NUMBER.match(text) for text in texts]
    before = max((len(part[1]) for part in parts if part), default=0)
    behind = max((len(part[2]) for part in parts if part), default=0)
    placed = [
        f"{part[1]:>{before}}{part[2]:<{behind}}" if part else text for part, text in zip(parts, texts, strict=True)
    ]
    width = max(map(cell_len, placed))
    return [" " * (width - cell_len(text)) + text for text in placed]


def _stacked(cells: Sequence[Sequence[str]], indent: str, *, named: bool) -> Iterator[str]:
    """Yield each row as a block; `named`: its first cell is a number and says nothing without its heading."""
    from rich.cells import cell_len

    headings, *rows = cells
    width = max(map(cell_len, headings[1:]))
    for row in rows:
        yield f"{indent}{headings[0]} {row[0]}" if named else (indent + row[0]).rstrip()
        for heading, text in zip(headings[1:], row[1:], strict=True):
            if text:
                yield f"{indent}{_GAP}{heading}{' ' * (width - cell_len(heading))}{_GAP}{text}"
