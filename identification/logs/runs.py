"""Which logs are parts of one recording and which are recordings of their own."""

from collections.abc import Sequence
from pathlib import Path

from .cell import Cell
from .opened import open_logs

_LONGEST_PAUSE_NS = 10**9
"""A recorder that splits its files goes on at once; who records again takes longer."""


def separate_runs(paths: Sequence[Path], cell: Cell, *, salvage: bool = False) -> tuple[tuple[Path, ...], ...]:
    """Group logs into recordings: what follows within a second of recording time, or overlaps, is one.

    Tables without absolute time begin at 0 and go with each other. Raises LogError for what is no log.
    """
    if len(paths) == 1:
        return ((paths[0],),)
    with open_logs(tuple(paths), cell, salvage=salvage) as logs:
        spans = sorted((part.survey.start_ns, part.survey.end_ns, i) for i, part in enumerate(logs.parts))
    runs: list[list[int]] = []
    latest = 0
    for start, end, index in spans:
        if runs and start - latest <= _LONGEST_PAUSE_NS:
            runs[-1].append(index)
        else:
            runs.append([index])
        latest = max(latest, end)
    return tuple(tuple(paths[index] for index in sorted(run)) for run in runs)
