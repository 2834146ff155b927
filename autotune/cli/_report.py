"""The option `--report` of the commands that have something to show, and what carries it out."""

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ._common import Output
from ._terminal import tell

if TYPE_CHECKING:
    from autotune.reports.page import Page

_SUFFIXES = (".html", ".htm")


def report_option(function: Callable[..., Any]) -> Callable[..., Any]:
    """Add `--report`, handed on as `report`: a path, or None."""
    return click.option(
        "--report",
        type=click.Path(path_type=Path, dir_okay=False),
        metavar="R.html",
        help="Also write what was found as one page with figures, which needs no network.",
    )(function)


def check_report(report: Path | None, others: Iterable[Path], *, option: str = "--report") -> None:
    """Refuse now what could not be written later; `others` are the files that the command reads and writes.

    Raises UsageError: the path is not that of a page, is one of `others`, or cannot be written.
    """
    if report is None:
        return
    from autotune.errors import UsageError
    from autotune.files.atomic import check_target

    if report.suffix.lower() not in _SUFFIXES:
        raise UsageError(f"{report} is to be a page, so its name must end in .html; name it with {option}.")
    check_target(report, others, option=option)


def write_report(output: Output, report: Path | None, build: Callable[[], "Page"]) -> dict[str, str]:
    """Draw and write the page, and return what `--json` tells of it: nothing without a report."""
    if report is None:
        return {}
    from autotune.files.atomic import write_atomic
    from autotune.reports.page import render_page

    with output.progress("drawing the report", 1.0) as advance:
        text = render_page(build(), advance)
    write_atomic(report, text)
    return {"report": str(report)}


def print_report_path(report: Path | None) -> None:
    """Print where the page is, if there is one."""
    if report is not None:
        tell(f"report: {report}")
