"""`autotune explore`: a page with sliders for gains and plant."""

import contextlib
import signal
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING

import click
from click.core import ParameterSource

from autotune.formats.kinds import PLANTS
from problems.errors import require_extra

from ._common import Output, output_options
from ._options import SETTINGS, FilePath, GroupedCommand, output_option

if TYPE_CHECKING:
    from autotune.explore.saving import Target
    from autotune.explore.source import Exploration

_EPILOG = """\b
Examples:
  autotune explore identified.yaml
  autotune explore identified.yaml --problem problem.yaml -o tried.yaml
  autotune explore controller.yaml -o tried.yaml --port 5010 --no-open
"""


@click.command("explore", cls=GroupedCommand, epilog=_EPILOG)
@click.argument("source", metavar="FILE", type=FilePath(*SETTINGS, kinds=(*PLANTS, "controller")))
@output_option("controller.yaml", "The only file that the page can write; tried.yaml where controller.yaml is FILE.")
@click.option(
    "--problem",
    type=FilePath(*SETTINGS, kinds=("problem",)),
    help="Requirements, bounds and ranges for an identified plant: problem.yaml.",
)
@click.option("--port", type=click.IntRange(0, 65535), default=0, show_default="a free one", help="Port of the page.")
@click.option(
    "--open/--no-open",
    "opens",
    default=None,
    show_default="on a terminal",
    help="Open the page in the browser.",
)
@output_options
def command(output: Output, source: Path, out: Path, problem: Path | None, port: int, opens: bool | None) -> None:
    """Serve a page on this machine with sliders for the gains and the plant of FILE.

    FILE is identified.yaml or plant.yaml (the page starts at the best design) or controller.yaml. Contact transient,
    admittance, Nyquist, requirements and the map of feasible designs follow the sliders; "save" proves and validates as
    optimize does and writes an ordinary controller.yaml, or says why not. The page needs no network, and no other
    machine can open it. Ctrl-C ends it with exit code 0; before the page is ready, or during a save, with 130 and
    nothing written.
    """
    with _noticed_interrupts() as noticed:
        require_extra("explore", "bokeh", "reports")
        from autotune.explore.saving import Target
        from autotune.explore.server import serve
        from autotune.explore.source import read_exploration
        from autotune.formats.atomic import check_target

        out = _free_of(source, out)
        check_target(out, [path for path in (source, problem) if path is not None], kind="controller")
        with output.progress("searching where to start", 1.0) as advance:
            exploration = read_exploration(source, problem, advance)
        if noticed:
            raise KeyboardInterrupt
    wants = sys.stderr.isatty() and not output.as_json if opens is None else opens
    target, is_there = Target(out), False

    def ready(address: str) -> None:
        nonlocal is_there
        _print_target(output, exploration, target, address)
        is_there = True
        if wants:
            click.launch(address)

    try:
        serve(exploration, target, port=port, ready=ready)
    except KeyboardInterrupt:
        if not is_there:
            raise
    if target.is_cut_short:
        output.note(f"The save under way was given up: {out} is not written.")
        raise KeyboardInterrupt
    output.note("Ended.")
    if target.path.is_file():
        output.next_command("validate", target.path)


def _free_of(source: Path, out: Path) -> Path:
    """Return where to save: where nobody said it and the usual file is the one that is read, another one."""
    is_said = click.get_current_context().get_parameter_source("out") is not ParameterSource.DEFAULT
    return out if is_said or not out.exists() or not out.samefile(source) else out.with_name("tried.yaml")


@contextlib.contextmanager
def _noticed_interrupts() -> Iterator[list[int]]:
    """Yield the interrupts of the block: one that falls into a finalizer or a callback of C is otherwise lost."""
    noticed: list[int] = []
    if threading.current_thread() is not threading.main_thread():
        yield noticed
        return

    def notice(number: int, frame: FrameType | None) -> None:
        noticed.append(number)
        signal.default_int_handler(number, frame)

    before = signal.signal(signal.SIGINT, notice)
    try:
        yield noticed
    finally:
        signal.signal(signal.SIGINT, before)


def _print_target(output: Output, exploration: "Exploration", target: "Target", address: str) -> None:
    for name, start in exploration.axes.items():
        if start.note:
            output.note(f"axis {name}: {start.note}")
    out, existing = target.path, target.existing()
    if existing:
        output.note(f"Saving replaces {out}, {existing}.")
    tree = {
        "url": address,
        "source": str(exploration.path),
        "output": str(out),
        "replaces": existing or None,
        "axes": list(exploration.axes),
    }
    output.result(tree, lambda: click.echo(f"{address}\nCtrl-C ends it."))
