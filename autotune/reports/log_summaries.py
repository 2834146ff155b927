"""What `inspect` tells of the logs behind a report."""

from collections.abc import Sequence
from pathlib import Path

from autotune.files.cell import CellFile
from identification.errors import LogError
from identification.logs import LogSummary, inspect_log
from identification.logs.cell import Cell


def summaries_of(
    logs: Sequence[Path], cell: CellFile | None, *, salvage: bool, asks_motion: bool = False
) -> tuple[LogSummary, ...]:
    """Return what `inspect` tells of each log, as far as one alone can be told of.

    What the motion tells of clocks and payload is among the findings of the identification already; `asks_motion`
    where there is none.
    """
    told, found = Cell() if cell is None else cell.cell, []
    for log in logs:
        try:
            found.append(inspect_log(log, told, salvage=salvage, asks_motion=asks_motion))
        except LogError:
            # A part of a recording need not hold everything by itself.
            continue
    return tuple(found)
