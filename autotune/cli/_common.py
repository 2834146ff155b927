"""What every command shares: the options for its output and the object that carries them out."""

import contextlib
import functools
import json
import os
import shlex
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Concatenate, ParamSpec, Protocol, TypeVar

import click

from autotune.shown import COMPILING
from problems.compiling import on_compilation

from ._terminal import detect_terminal, printable, wrap_lines

if TYPE_CHECKING:
    from rich.progress import ProgressColumn

_Parameters = ParamSpec("_Parameters")
_Result = TypeVar("_Result")


class Advance(Protocol):
    """Moves a bar on by n, in the unit of its total; `doing`, if given, is the text beside it from then on."""

    def __call__(self, n: float, doing: str | None = None, /) -> None:
        """Move on."""


@dataclass(kw_only=True)
class Delivery:
    """What the error report of a run must know of it.

    `done` is whether standard output already holds its one JSON object, so that an error does not add a second;
    `remark` follows the message of an error, and `report` is its page.
    """

    done: bool = False
    remark: str = ""
    report: str = ""


@dataclass(frozen=True, kw_only=True)
class Output:
    """Results go to standard output, messages and progress to standard error.

    `as_json` and `quiet` mirror `--json` and `--quiet`; `delivery` is shared with the error report of the run.
    """

    as_json: bool = False
    quiet: bool = False
    delivery: Delivery = field(default_factory=Delivery)

    def result(self, tree: Mapping[str, Any], text: Callable[[], None]) -> None:
        """Print `tree` as the one JSON object, or let `text` print for people; with `--quiet` only JSON is printed.

        A reader that closes the pipe early (`| head -1`) changes neither the outcome nor the exit code.

        Raises ValueError when `tree` holds NaN or an infinity, which JSON cannot say.
        """
        if self.as_json:
            document = json_text(tree)
            self.delivery.done = True
            with _reader_may_leave():
                click.echo(document)
                sys.stdout.flush()
        elif not self.quiet:
            with _reader_may_leave():
                text()
                sys.stdout.flush()

    def note(self, message: str) -> None:
        """Print a message that is not the result, on a terminal folded between words."""
        if not self.quiet:
            say("\n".join(wrap_lines(message, columns=detect_terminal(sys.stderr).columns, error=True)))

    def next_command(self, *words: str | Path | None) -> None:
        """Name the command that usually follows, ready to be pasted; nothing beside `--json`, and None is left out."""
        self.next_line(shlex.join(["autotune", *(str(word) for word in words if word is not None)]))

    def next_line(self, command: str) -> None:
        """Name a command line that usually follows, of whatever program."""
        if not (self.as_json or self.quiet):
            # Not folded: what is pasted is one line.
            say(f"next: {command}")

    @contextlib.contextmanager
    def replacing(self, path: Path, kind: str) -> Iterator[None]:
        """Note after the block, which writes `path`, what it replaced, if anything.

        Raises UsageError before it where the existing file is not of `kind` (`autotune.formats.kinds`).
        """
        from autotune.formats.kinds import check_replaced

        was = check_replaced(path, kind)
        yield
        if was:
            self.note(f"{path}: replaced {was}.")

    @contextlib.contextmanager
    def progress(self, description: str, total: float | None) -> Iterator[Advance]:
        """Show a bar while the block runs, on a terminal only; yields `advance(n)`, n in the unit of `total`.

        With `total` it shows the time that is left, without only the time that has gone.
        """
        if self.quiet or not detect_terminal(sys.stderr).can_redraw:
            yield _advance_nothing
            return
        with progress_bar(printable(description), total) as advance:
            yield advance


def output_options(
    function: Callable[Concatenate[Output, _Parameters], _Result],
) -> Callable[..., _Result]:
    """Add `--json`, `--quiet` and `--debug` to a command and hand it an `Output` as its first argument.

    `--debug` is read by `autotune.cli.main`, which decides what an error looks like.
    """

    @click.option("--json", "as_json", is_flag=True, help="Print one JSON object and nothing else.")
    @click.option("--quiet", is_flag=True, help="Print no messages, no progress and no text result.")
    @click.option("--debug", is_flag=True, help="Show the traceback of an error.")
    @functools.wraps(function)
    def command(*args: Any, as_json: bool, quiet: bool, debug: bool, **kwargs: Any) -> _Result:
        del debug
        delivery = click.get_current_context().find_object(Delivery) or Delivery()
        output = Output(as_json=as_json, quiet=quiet, delivery=delivery)
        if detect_terminal(sys.stderr).is_terminal:
            on_compilation(lambda: output.note(COMPILING))
        return function(output, *args, **kwargs)

    return command


def page_stays(report: Path) -> str:
    """Say of a page that what was just refused is not on it."""
    return f"{report} is the page of an earlier run and stays as it is."


def json_text(tree: Mapping[str, Any]) -> str:
    """Return `tree` as JSON text; read-only mappings, numpy values and paths are written as what they hold.

    Raises ValueError on NaN or an infinity and TypeError on a value that has no JSON form.
    """
    return json.dumps(tree, indent=2, allow_nan=False, default=_plain)


def say(message: str) -> None:
    """Print a message on standard error; nobody listening there is no error."""
    with contextlib.suppress(BrokenPipeError):
        click.echo(message, err=True, color=True)


def discard_output() -> None:
    """Point standard output at nothing, so that no later flush fails on a closed pipe."""
    nothing = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nothing, sys.stdout.fileno())
    os.close(nothing)


@contextlib.contextmanager
def _reader_may_leave() -> Iterator[None]:
    try:
        yield
    except BrokenPipeError:
        discard_output()


@contextlib.contextmanager
def progress_bar(description: str, total: float | None) -> Iterator[Advance]:
    """Draw the bar on standard error while the block runs, and wipe it; yields `advance(n)`, n in the unit of `total`.

    `advance(n, doing)` writes something else beside the bar from then on; with `total` None only the time is shown.
    """
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn

    columns: list[ProgressColumn] = [TextColumn("{task.description}", markup=False), BarColumn(bar_width=30)]
    columns += [] if total is None else [TextColumn("{task.percentage:>3.0f} %", markup=False)]
    console = Console(file=sys.stderr, no_color=not detect_terminal(sys.stderr).has_colour)
    with Progress(*columns, _times_column(), console=console, transient=True, get_time=time.monotonic) as bars:
        bar = bars.add_task(description, total=total)

        def advance(n: float, doing: str | None = None, /) -> None:
            if doing is not None:
                bars.update(bar, description=printable(doing))
            bars.advance(bar, n)

        yield advance


def _times_column() -> "ProgressColumn":
    """Return the column `0:07, 0:12 left`: the time that has gone, and what is left at the mean rate so far.

    Rich's own looks at the last half minute only, in which a long step may show nothing.
    """
    from rich.progress import ProgressColumn, Task
    from rich.text import Text

    class TimesColumn(ProgressColumn):
        max_refresh = 0.5

        def __init__(self) -> None:
            super().__init__()
            self._seen: dict[int, tuple[float, float]] = {}

        def render(self, task: Task) -> Text:
            elapsed = (task.finished_time if task.finished else task.elapsed) or 0.0
            text = clock(elapsed)
            if task.total:
                completed, at = self._seen.get(task.id, (0.0, 0.0))
                if task.completed != completed:
                    completed, at = self._seen[task.id] = (task.completed, elapsed)
                left = remaining_s(elapsed, at, completed / task.total)
                text += "" if left is None else f", {clock(left)} left"
            return Text(text, style="progress.elapsed")

    return TimesColumn()


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


def _advance_nothing(_n: float, _doing: str | None = None, /) -> None:
    """Count progress that nobody watches."""


def _plain(value: object) -> object:
    if isinstance(value, Mapping):
        return dict(value)
    if isinstance(value, Path):
        return str(value)
    to_list = getattr(value, "tolist", None)  # numpy arrays and scalars, without importing numpy
    if callable(to_list):
        return to_list()
    raise TypeError(f"{type(value).__name__} has no JSON form.")
