"""What `inspect` tells of the logs behind a report."""

from collections.abc import Sequence
from pathlib import Path

from autotune.formats.cell import CellFile
from identification.errors import LogError
from identification.evidence import Evidence
from identification.logs import LogSummary, inspect_log
from identification.logs.cell import Cell


def summaries_of(
    logs: Sequence[Path], cell: CellFile | None, *, salvage: bool, evidence: Sequence[Evidence] = ()
) -> tuple[LogSummary, ...]:
    """Return what `inspect` tells of each log, as far as one alone can be told of.

    `evidence` is what identification left of these logs: those that it read by themselves are not read once more.
    """
    told, found = Cell() if cell is None else cell.cell, []
    names = [log.name for log in logs]
    known = {each.log: each.reading for each in evidence if names.count(each.log) == 1}
    for log in logs:
        try:
            found.append(inspect_log(log, told, salvage=salvage, reading=known.get(log.name)))
        except LogError:
            # A part of a recording need not hold everything by itself.
            continue
    return tuple(found)
