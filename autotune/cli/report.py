"""`autotune report`: one page with figures from files that are already written."""

from pathlib import Path

import click

from autotune.formats.kinds import LOG
from autotune.processes import MOST_SAMPLES

from ._common import Output, output_options
from ._options import LOGS, SETTINGS, FilePath, GroupedCommand, PresentType, output_option
from ._report import check_report, report_refusal, write_report
from ._terminal import print_message

_EPILOG = """\b
Examples:
  autotune report controller.yaml
  autotune report controller.yaml --compare old.yaml -o controller.html
  autotune report controller.yaml identified.yaml --compare mass=10,damping=1500
  autotune report identified.yaml run7.mcap
  autotune report identified.yaml run7.mcap controller.yaml pareto.yaml -o cell.html
"""
_SHOWN = ("identified", "controller", "pareto", "schedule", LOG)
_SEARCH = b'-convergence"'


@click.command("report", cls=GroupedCommand, epilog=_EPILOG)
@click.argument(
    "files", metavar="FILE...", nargs=-1, required=True, type=FilePath(*SETTINGS, *LOGS, kinds=_SHOWN, dir_okay=True)
)
@output_option("report.html", "Page to write.")
@click.option(
    "--compare",
    "old",
    type=PresentType(*SETTINGS, kinds=("controller", "cell")),
    metavar="GAINS|log|FILE",
    help="What runs today, drawn beside: gains as in mass=10,damping=1500, those of the log (with its identified.yaml "
    "among FILEs), a controller or cell.yaml.",
)
@click.option(
    "--samples",
    type=click.IntRange(0, MOST_SAMPLES),
    default=256,
    show_default=True,
    help="Plants of each certified set to simulate with all disturbances; 0: none.",
)
@output_options
def command(output: Output, files: tuple[Path, ...], out: Path, old: Path | str | None, samples: int) -> None:
    """Write one HTML page with figures of all FILEs, which needs no network.

    FILE is a result of identify, optimize, --pareto or --schedule. A log beside the identified.yaml that came from it,
    recognised by its SHA-256, adds the signals. A controller is verified again. Exit code 2: a file without a report.
    3: a log that cannot be used, or is another one. 6: a controller was altered, or a claim does not hold; the page
    then says so.
    """
    from autotune.report.from_files import report_files
    from autotune.report.refused_page import NOT_SHOWN, refuse

    sources = [*files, *([old] if isinstance(old, Path) else [])]
    check_report(out, sources, option="-o")
    with (
        report_refusal(output, out, sources, lambda error: refuse(NOT_SHOWN, error)),
        output.progress("reading and verifying", 1.0) as advance,
    ):
        found = report_files(files, old=old, samples=samples, progress=advance)
    is_richer = out.is_file() and _SEARCH in out.read_bytes()
    tree = {**write_report(output, out, lambda: found.page), "files": dict(found.kinds)}
    output.result(tree, lambda: print_message(f"written: {out}"))
    if is_richer and _SEARCH not in out.read_bytes():
        output.note(f"{out} was a page of optimize; how the search converged is in no file, and no longer on it.")
    found.require()
    for kind, command in (("controller", "explore"), ("identified", ""), ("schedule", "validate")):
        first = next((path for path, of in found.kinds.items() if of == kind), None)
        if first is not None:
            following = command or _after_identify(Path(first))
            if following:
                output.next_command(following, first)
            break


def _after_identify(path: Path) -> str:
    """Return the command for a plant that is whole, for one that lacks something, "" for one without an axis."""
    from autotune.formats.identified import read_identified

    found = read_identified(path).result
    if all(finding.severity != "error" for finding in found.findings):
        return "optimize"
    return "plan" if found.axes else ""
