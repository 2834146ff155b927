"""`autotune validate`: verify a controller file from the file alone."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ._common import Output, output_options
from ._schedule import validate_schedule

if TYPE_CHECKING:
    from autotune.validation.validate import ValidationReport

_EPILOG = """\b
Examples:
  autotune validate controller.yaml
  autotune validate controller.yaml --identified identified.yaml
  autotune validate schedule/schedule.yaml
"""


@click.command("validate", epilog=_EPILOG)
@click.argument("controller", type=click.Path(path_type=Path, dir_okay=False))
@click.option(
    "--identified",
    type=click.Path(path_type=Path, dir_okay=False),
    help="Also check that this identified plant lies inside the certified domain.",
)
@output_options
def command(output: Output, controller: Path, identified: Path | None) -> None:
    """Verify CONTROLLER again, from the file alone and by other code than the optimizer's.

    Checksum, schema and ranges; stability proved anew over the whole domain; margins and free-space admittance by a
    second method; every predicted contact replayed. Of a schedule, every controller that it lists. Exit code 6: a claim
    does not hold, or the file was altered.
    """
    from autotune.files.schedule import is_schedule

    if is_schedule(controller):
        validate_schedule(output, controller, identified)
        return
    from autotune.files.canonical import short
    from autotune.files.controller import read_controller
    from autotune.files.identified import read_identified
    from autotune.validation.domain import check_domain
    from autotune.validation.validate import ValidationReport, validate_controller

    read = read_controller(controller)
    with output.progress(f"validating {controller.name}", 1.0) as advance:
        report = validate_controller(read.controller, advance)
    if identified is not None:
        inside = check_domain(read.controller, read_identified(identified).result)
        report = ValidationReport(checks=(*report.checks, *inside))
    tree = {
        "path": str(controller),
        "checksum": read.checksum,
        "short_checksum": short(read.checksum),
        "passed": report.passed,
        "checks": checks_tree(report),
    }
    output.result(tree, lambda: print_report(report, controller, short(read.checksum)))
    report.require()


def checks_tree(report: "ValidationReport") -> list[dict[str, Any]]:
    """Return the checks as plain data."""
    return [{"axis": c.axis, "name": c.name, "passed": c.passed, "message": c.message} for c in report.checks]


def print_report(report: "ValidationReport", path: Path, checksum: str) -> None:
    """Print one line per check."""
    for check in report.checks:
        click.echo(f"{'ok' if check.passed else 'FAILED':6} axis {check.axis}, {check.name}: {check.message}")
    click.echo(f"{path}: {'valid' if report.passed else 'NOT valid'}, checksum {checksum}")
