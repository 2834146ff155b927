"""`cell.yaml`: what the logs of a cell cannot say of themselves."""

from dataclasses import dataclass
from difflib import get_close_matches
from pathlib import Path

from autotune.errors import UsageError
from identification.logs.roles.cell import Cell

from .records import EntryError, read_record
from .schema import Violation, check_format, violations
from .yaml12 import Document, load_document, parse_document

_NAME = "cell"


@dataclass(frozen=True, kw_only=True)
class CellFile:
    """A cell as a file declares it, with the path and the sha256 of the file's bytes."""

    cell: Cell
    path: Path
    sha256: str


def read_cell(path: Path) -> CellFile:
    """Read `cell.yaml`; raises UsageError with file, line and reason for anything unknown or contradictory."""
    document = load_document(path, error=UsageError)
    return CellFile(cell=_cell(document), path=path, sha256=document.sha256)


def check_cell_text(text: str, path: Path) -> Cell:
    """Read a text as if it stood in `path`; raises UsageError as `read_cell` does."""
    return _cell(parse_document(text.encode(), path, error=UsageError, exact=False))


def _cell(document: Document) -> Cell:
    check_format(document, _NAME)
    found = min(
        violations(document.tree, _NAME),
        key=lambda violation: (document.line(violation.place), len(violation.place)),
        default=None,
    )
    if found is not None:
        document.refuse(found.place, f"{found.entry} must be {found.must}, found {found.found}{_nearest(found)}.")
    tree = {key: value for key, value in document.tree.items() if key not in ("format", "version")}
    try:
        return read_record(Cell, tree)
    except EntryError as error:
        document.refuse(error.place, str(error).rstrip(".") + ".")


def _nearest(violation: Violation) -> str:
    """Name the key that an unknown one may stand for."""
    key = str(violation.place[-1]) if violation.place else ""
    if violation.found != f"the key {key}":
        return ""
    near = get_close_matches(key, violation.must.removeprefix("one of ").split(", "), n=1, cutoff=0.5)
    return f"; {near[0]} may be meant" if near else ""
