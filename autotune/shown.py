"""How results show themselves: in one line, as text with tables, and as HTML in a notebook."""

import logging
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, fields, is_dataclass
from enum import Enum
from html import escape
from pathlib import PurePath
from typing import Any

from autotune.errors import UsageError
from problems.compiling import on_compilation
from problems.errors import shown
from problems.frozen import said_fields, short_repr

COMPILING = (
    "Compiling once: kernels are not in the cache yet, so this takes up to some minutes more than the next time "
    "(`autotune warm` compiles all of them)."
)
_LOG = logging.getLogger("autotune")
_STYLE = "text-align:left"


@dataclass(frozen=True, kw_only=True)
class ResultTable:
    """A table for people: a title, the names of the columns, rows of texts."""

    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]

    def text(self) -> str:
        """Return the table as lines of text, columns in line."""
        rows = [self.columns, *self.rows]
        widths = [max(len(row[i]) for row in rows) for i in range(len(self.columns))]
        lines = ["  ".join(part.ljust(width) for part, width in zip(row, widths, strict=True)).rstrip() for row in rows]
        return "\n".join([self.title, *(f"  {line}" for line in lines)])

    def html(self) -> str:
        """Return the table as HTML, every text escaped."""
        head = "".join(f'<th style="{_STYLE}">{escape(name)}</th>' for name in self.columns)
        body = "".join(
            "<tr>" + "".join(f'<td style="{_STYLE}">{escape(part)}</td>' for part in row) + "</tr>" for row in self.rows
        )
        caption = f'<caption style="{_STYLE}"><b>{escape(self.title)}</b></caption>'
        return f"<table>{caption}<thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"


class Shown:
    """A result with a short `repr`, tables as its `str`, and the same as HTML for notebooks."""

    def _headline(self) -> str:
        """Return the one line that says what this is."""
        raise NotImplementedError

    def _tables(self) -> Iterator[ResultTable]:
        """Yield the tables; none unless a result has some."""
        yield from ()

    def _answers(self) -> Sequence[str]:
        """Return what is read first in a notebook, before the numbers."""
        return ()

    def _notes(self) -> Sequence[str]:
        """Return what should not be overlooked."""
        return ()

    def parts(self) -> tuple[str, tuple[ResultTable, ...], tuple[str, ...]]:
        """Return the headline, the tables and the notes."""
        return self._headline(), tuple(self._tables()), tuple(self._notes())

    def to_dict(self) -> dict[str, Any]:
        """Return it as plain data."""
        raise NotImplementedError

    def __eq__(self, other: object) -> bool:
        return NotImplemented if type(other) is not type(self) else self.to_dict() == other.to_dict()

    def __hash__(self) -> int:
        return hash(self._headline())

    def __repr__(self) -> str:
        return f"<{self._headline()}>"

    def __str__(self) -> str:
        notes = [f"note: {note}" for note in self._notes()]
        return "\n\n".join([self._headline(), *(table.text() for table in self._tables()), *notes])

    def _repr_html_(self) -> str:
        notes = "".join(f"<p>⚠ {escape(note)}</p>" for note in self._notes())
        lines = "".join(f"<p>{escape(line)}</p>" for line in (*self._answers(), self._headline()))
        return lines + "".join(table.html() for table in self._tables()) + notes


class Said(Shown):
    """What a person says: its `repr`, the arguments that are not at their defaults, is its headline too.

    `Problem` is public under that name, which the class `ProblemSpec` has not.
    """

    def _headline(self) -> str:
        return repr(self)

    def __repr__(self) -> str:
        return short_repr(self, type(self).__name__.removesuffix("Spec"))

    def to_dict(self) -> dict[str, Any]:
        """Return the arguments that are not at their defaults as plain data."""
        return {name: plain_tree(value) for name, value in said_fields(self).items()}


def data_frame(columns: Mapping[str, Any], index: Any = None, index_name: str | None = None) -> Any:
    """Return a pandas.DataFrame; raises UsageError where pandas is not installed."""
    try:
        import pandas as pd  # noqa: PLC0415 - optional, and half a second to import
    except ImportError:
        raise UsageError(
            "to_pandas() needs pandas, which is not installed; install robot-autotune[pandas], or use to_dict()."
        ) from None
    frame = pd.DataFrame(dict(columns), index=index)
    frame.index.name = index_name
    return frame


def plain_tree(value: Any) -> Any:
    """Return records, arrays, paths and enumerations as dict, list, str and numbers, field names kept."""
    if is_dataclass(value) and not isinstance(value, type):
        return {each.name: plain_tree(getattr(value, each.name)) for each in fields(value)}
    if isinstance(value, Mapping):
        return {str(key): plain_tree(each) for key, each in value.items()}
    if isinstance(value, Enum):
        return value.value
    if isinstance(value, PurePath):
        return str(value)
    if hasattr(value, "tolist"):
        return value.tolist()
    return [plain_tree(each) for each in value] if isinstance(value, tuple | list | frozenset) else value


def leaves(tree: Any, name: str = "") -> Iterator[tuple[str, str]]:
    """Yield every number and text of a plain tree with its place, a list of them as one."""
    if isinstance(tree, Mapping):
        for key, each in tree.items():
            yield from leaves(each, f"{name}.{key}" if name else str(key))
    elif tree is not None:
        yield name, ", ".join(map(str, tree)) if isinstance(tree, list) else str(tree)


Report = Callable[[float], None]
Progress = bool | Report | None
"""True for a line on standard error, or a callable that takes the share of the work done since its last call."""


@contextmanager
def reporting(progress: Progress, doing: str, total: float = 1.0) -> Iterator[Report | None]:
    """Yield what takes the progress: the caller's own, a line of per cents while the block runs, or None.

    That the block compiles, which takes minutes once, is a warning of the logger `autotune`.
    """
    if not (progress is None or isinstance(progress, bool) or callable(progress)):
        raise UsageError(f"progress must be True, False or a callable that takes a share, found {shown(progress)}.")
    on_compilation(lambda: _LOG.warning(COMPILING))
    if not isinstance(progress, bool) or not progress:
        yield None if progress is False else progress
        return
    done = 0.0

    def advance(share: float) -> None:
        nonlocal done
        done += share
        print(f"\r{doing} {min(done / total, 1.0):4.0%}", end="", file=sys.stderr, flush=True)

    advance(0.0)
    try:
        yield advance
    finally:
        print(file=sys.stderr)
