"""What a stream can show, the few colours, and lines folded to a terminal's width.

A pipe or a file gets the plain text, one line for each thing that is told.
"""

import os
import re
import sys
import textwrap
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TextIO

import click

_DUMB = frozenset({"dumb", "unknown"})
_NARROWEST = 40
_BLOCKS = "▁█"
# A number and its unit stay on one line.
_UNIT = re.compile(r"(?<=\d) (?=\S{1,7}(?:[\s,;)]|$))")
_FIXED = "\N{NO-BREAK SPACE}"

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


def look_at(stream: TextIO | None, environment: Mapping[str, str] = os.environ) -> Screen:
    """Tell what `stream` can show (None: the process has no such stream).

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
    if colour is None or not look_at(sys.stderr if error else sys.stdout).has_colour:
        return text
    return text.replace(word, click.style(word, fg=colour, bold=True if colour == "red" else None))


def tell(text: str = "", *, verdict: str = "", indent: str = "") -> None:
    """Print a line on standard output; `verdict` stands before it, in colour where there is any.

    On a terminal the line is folded between words, what follows standing under its beginning.
    """
    for line in told_lines(printable(text), verdict=verdict, indent=indent, columns=look_at(sys.stdout).columns):
        echo(line)


def told_lines(text: str, *, verdict: str = "", indent: str = "", columns: int | None = None) -> list[str]:
    """Return the lines of `tell` for a width of `columns`, None for any."""
    whole = f"{indent}{verdict}{text}".rstrip()
    before = len(indent + verdict) if verdict else len(whole) - len(whole.lstrip()) + 2
    lines = [whole] if columns is None else _folded(whole, " " * before, columns)
    head = indent + verdict
    if verdict and lines[0].startswith(head):
        lines[0] = indent + painted(verdict) + lines[0][len(head) :]
    return lines


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
