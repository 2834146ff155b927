"""The option `--report` of the commands that have something to show, and what carries it out."""

import contextlib
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from autotune.errors import CertificateError, InfeasibleError, UsageError
from identification.errors import EstimateError, LogError
from problems.errors import require_extra

from ._common import Output, page_stays
from ._terminal import print_message

if TYPE_CHECKING:
    from autotune.report.page import Page

_SUFFIXES = (".html", ".htm")
# What was read and found wanting; of anything else, a wrong name or an interruption, there is nothing to show.
_REFUSALS = (LogError, EstimateError, InfeasibleError, CertificateError)


def report_option(function: Callable[..., Any]) -> Callable[..., Any]:
    """Add `--report`, handed on as `report`: a path, or None."""
    return click.option(
        "--report",
        type=click.Path(path_type=Path, dir_okay=False),
        metavar="R.html",
        help="Also write a report: one HTML page with figures, which needs no network.",
    )(function)


def check_report(report: Path | None, others: Iterable[Path], *, option: str = "--report") -> None:
    """Refuse now what could not be written later; `others` are the files that the command reads and writes.

    Raises UsageError: the path is not that of a page, is one of `others`, or cannot be written.
    """
    if report is None:
        return
    from autotune.formats.atomic import check_target

    require_extra(option, "bokeh", "reports")
    if report.suffix.lower() not in _SUFFIXES:
        raise UsageError(f"{report} is to be a page, so its name must end in .html; name it with {option}.")
    check_target(report, others, kind="report", option=option)


def write_report(output: Output, report: Path | None, build: Callable[[], "Page"]) -> dict[str, str]:
    """Draw and write the page, and return its entry for `--json`: nothing without a report."""
    if report is None:
        return {}
    from autotune.formats.atomic import write_atomic
    from autotune.processes import count_processors
    from autotune.report.page import render_page

    with output.progress("drawing the report", 1.0) as advance:
        text = render_page(build(), advance, processes=count_processors())
    with output.replacing(report, "report"):
        write_atomic(report, text)
    return {"report": str(report)}


@contextlib.contextmanager
def report_refusal(
    output: Output, report: Path | None, sources: Iterable[Path], build: Callable[[Exception], "Page"]
) -> Iterator[None]:
    """Write the refusal of the block on the page, so that no older page is taken for it; the error goes on.

    `build` makes the page of an error, of what could be seen all the same. Where nothing could be (a file that is not
    there, a wrong option, an interruption) an older page stays as it is, and the message of the error says so.
    """
    try:
        yield
    except BaseException as error:
        if report is not None:
            is_there = all(path.exists() for path in sources)
            if isinstance(error, _REFUSALS) and is_there:
                _write_refusal(output, report, error, build)
            elif report.is_file():
                output.delivery.remark = page_stays(report)
        raise


def _write_refusal(output: Output, report: Path, error: Exception, build: Callable[[Exception], "Page"]) -> None:
    from autotune.formats.atomic import write_atomic
    from autotune.report.page import render_page
    from autotune.report.refused_page import NOT_SHOWN, refuse

    try:
        text = render_page(build(error))
    except Exception:  # noqa: BLE001 - a fault in the page must not take the place of the refusal
        text = render_page(refuse(NOT_SHOWN, error))
    try:
        write_atomic(report, text)
    except UsageError:
        output.delivery.remark = page_stays(report) if report.is_file() else ""
    else:
        output.delivery.remark, output.delivery.report = f"The page {report} says so.", str(report)


def print_report_path(report: Path | None) -> None:
    """Print where the page is, if there is one."""
    if report is not None:
        print_message(f"report: {report}")
