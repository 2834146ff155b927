"""A bar with the time that has gone and the time that is left, on a terminal."""

import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from rich.console import Console
from rich.progress import BarColumn, Progress, ProgressColumn, Task, TextColumn
from rich.text import Text

from ._terminal import look_at, printable

if TYPE_CHECKING:
    from ._common import Advance


class TimesColumn(ProgressColumn):
    """The time that has gone, and what is left if the rest goes as the part that is done.

    It is counted down between the steps. Rich's own looks at the last half minute only, in which a long step may show
    nothing.
    """

    max_refresh = 0.5

    def __init__(self) -> None:
        super().__init__()
        self._seen: dict[int, tuple[float, float]] = {}

    def render(self, task: Task) -> Text:
        """Return `0:07, 0:12 left`; the second only where there is something to go by."""
        elapsed = (task.finished_time if task.finished else task.elapsed) or 0.0
        told = clock(elapsed)
        if task.total:
            completed, at = self._seen.get(task.id, (0.0, 0.0))
            if task.completed != completed:
                completed, at = self._seen[task.id] = (task.completed, elapsed)
            left = remaining_s(elapsed, at, completed / task.total)
            told += "" if left is None else f", {clock(left)} left"
        return Text(told, style="progress.elapsed")


def remaining_s(elapsed_s: float, at_s: float, done: float) -> float | None:
    """Return how long it takes from now on when the share `done` had taken `at_s`.

    None while nothing is done, and where a step takes longer than all that was expected.
    """
    if not done > 0.0:
        return None
    left = at_s * (1.0 - done) / done - (elapsed_s - at_s)
    return left if left > 0.0 else None


def clock(seconds: float) -> str:
    """Return minutes and seconds as `0:07`, with hours from an hour on."""
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"


@contextmanager
def progress_bar(description: str, total: float | None) -> "Iterator[Advance]":
    """Draw the bar on standard error while the block runs, and wipe it; yields `advance(n)`, n in the unit of `total`.

    `advance(n, doing)` tells something else beside the bar from then on; `total` None tells the time only. What stands
    beside it is shown as it is, whatever brackets a file's name may have.
    """
    columns: list[ProgressColumn] = [TextColumn("{task.description}", markup=False), BarColumn(bar_width=30)]
    columns += [] if total is None else [TextColumn("{task.percentage:>3.0f} %", markup=False)]
    console = Console(file=sys.stderr, no_color=not look_at(sys.stderr).has_colour)
    with Progress(*columns, TimesColumn(), console=console, transient=True, get_time=time.monotonic) as bars:
        bar = bars.add_task(description, total=total)

        def advance(n: float, doing: str | None = None, /) -> None:
            if doing is not None:
                bars.update(bar, description=printable(doing))
            bars.advance(bar, n)

        yield advance
