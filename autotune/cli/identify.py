"""`autotune identify`: plant parameters from a log."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from autotune.formats.kinds import LOG, name_of

from ._common import Output, output_options
from ._options import (
    LOGS,
    FilePath,
    GroupedCommand,
    cell_option,
    output_option,
    salvage_option,
    span_options,
    urdf_options,
)
from ._report import check_report, print_report_path, report_option, report_refusal, write_report
from ._terminal import print_message, print_table

if TYPE_CHECKING:
    from autotune.pipeline import IdentifyOptions
    from autotune.report.page import Page
    from autotune.results import Identification
    from autotune.windows import Window
    from identification.result import Identified, Timeline

_EPILOG = """\b
Examples:
  autotune identify run7.mcap -o identified.yaml --report run7.html
  autotune identify run7.mcap --wrench-topic /ft/raw --command-topic /servo/target
  autotune identify run7.mcap --annotate run7.annotated.mcap
  autotune identify part1.bag part2.bag --cell cell.yaml
  autotune identify monday.mcap friday.mcap --given mass_kg=16.2±0.1
  autotune identify run7.mcap --windows 10min
"""
_GROUPS = {
    "Settings of the cell": ("cell_path", "wrench_topic", "pose_topic", "command_topic", "urdf", "tip", "given"),
    "Parts of logs, damaged logs and missing parameters": ("start", "stop", "windows_s", "allow_partial", "salvage"),
}


def _duration(_context: click.Context, _option: click.Parameter, text: str | None) -> float | None:
    if text is None:
        return None
    from autotune.windows import window_length_s

    try:
        return window_length_s(text)
    except ValueError as error:
        raise click.BadParameter(str(error)) from None


@click.command("identify", cls=GroupedCommand, groups=_GROUPS, epilog=_EPILOG)
@click.argument("logs", metavar="LOG...", nargs=-1, required=True, type=FilePath(*LOGS, kinds=(LOG,), dir_okay=True))
@output_option("identified.yaml")
@cell_option
@click.option("--wrench-topic", help="Channel of the wrench, if the log has several.")
@click.option("--pose-topic", help="Channel of the measured flange pose, if the log has several.")
@click.option("--command-topic", help="Channel of the commanded flange pose.")
@click.option(
    "--allow-partial",
    is_flag=True,
    help="Write the file even if a parameter is unidentifiable or logs disagree.",
)
@urdf_options
@span_options
@click.option(
    "--windows",
    "windows_s",
    metavar="DURATION",
    callback=_duration,
    help="For long logs: identify each window of this length (600, 600s, 10min, 1h) on its own, tell what changed, and "
    "take the windows that tell most.",
)
@salvage_option
@click.option(
    "--given",
    metavar="NAME=VALUE±STD",
    multiple=True,
    help="A known parameter, e.g. mass_kg=16.2±0.1 or x.delay_s=2.4e-3+-1e-4; exact without ±.",
)
@report_option
@click.option(
    "--annotate",
    type=click.Path(path_type=Path, dir_okay=False),
    metavar="OUT.mcap",
    help="Also write phases, contacts and forces as messages for Foxglove and PlotJuggler, and a layout.",
)
@output_options
def command(
    output: Output,
    /,
    logs: tuple[Path, ...],
    out: Path,
    cell_path: Path | None,
    given: tuple[str, ...],
    report: Path | None,
    annotate: Path | None,
    **reading: Any,
) -> None:
    """Estimate payload, sensor, robot, coupling and environment from LOG, each with its uncertainty and a verdict.

    LOGs that follow each other within a second are one recording; others are identified apart and combined, and
    parameters on which they disagree are named. A recording needs wrench, measured and commanded flange pose, with 6
    to 12 tilted poses at rest, a commanded sweep in free space, and contacts. Exit code 3: a log cannot be used. 4: the
    payload's mass or centre, the robot's r(s) or delay, K_s, B_s, B_p or a surface's K_e is unidentifiable, or logs
    disagree; without --allow-partial nothing is written then.
    """
    from autotune.annotations import check_annotations, layout_path, write_annotations
    from autotune.formats.atomic import check_target
    from autotune.formats.cell import read_cell
    from autotune.formats.identified import identified_tree, write_identified
    from autotune.pipeline import IdentifyOptions, identify_log
    from autotune.processes import count_processors
    from autotune.quantities import parse_given
    from autotune.windows import windows_of

    sources = [*logs, *([] if cell_path is None else [cell_path])]
    check_target(out, sources, kind="identified")
    check_report(report, [*sources, out])
    if annotate is not None:
        check_annotations(annotate, [*sources, out])
    options = IdentifyOptions(**reading)
    seen = _Seen(logs=logs, options=options)
    with report_refusal(output, report, sources, seen.refused_page):
        cell = None if cell_path is None else read_cell(cell_path)
        seen.options = replace(options, cell=cell, given=parse_given(given))
        with output.progress(f"identifying {', '.join(map(name_of, logs))}", 1.0) as advance:
            found = seen.found = identify_log(
                logs,
                seen.options,
                defers_refusal=True,
                processes=count_processors(),
                progress=advance,
                with_evidence=report is not None or annotate is not None,
            )
        if not options.allow_partial:
            found.require()
        with output.replacing(out, "identified"):
            write_identified(out, found.result, found.provenance)
    if annotate is not None:
        write_annotations(annotate, found)
    tree = {**identified_tree(found.result, found.provenance), **write_report(output, report, seen.page)}

    def text() -> None:
        print_windows(windows_of(found.provenance))
        print_identified(found.result, out)
        print_report_path(report)
        if annotate is not None:
            print_message(f"annotations: {annotate}, layout of Foxglove {layout_path(annotate)}")

    output.result(tree, text)
    _name_next(output, found.result, out, logs)


def _name_next(output: Output, result: "Identified", out: Path, logs: Sequence[Path]) -> None:
    from autotune.tuning.problems import has_no_weight

    # Without weight the log shows all that a design needs: the cell says centre of mass and bias.
    without = "centre of mass: " if has_no_weight(result) else None
    errors = [finding.message for finding in result.findings if finding.severity == "error"]
    if all(without is not None and message.startswith(without) for message in errors):
        output.next_command("optimize", out)
    elif result.axes:
        output.next_command("plan", out)
    else:
        output.next_command("report", out, *logs)


@dataclass(kw_only=True)
class _Seen:
    """What the page of a run shows, also of one that is refused midway."""

    logs: tuple[Path, ...]
    options: "IdentifyOptions"
    found: "Identification | None" = None

    def page(self) -> "Page":
        """Build the page of what was found."""
        from autotune.report.identify_page import build_identify_page, summaries_of

        if self.found is None:
            raise ValueError("nothing was found yet")
        summaries = summaries_of(self.logs, self.options, self.found.evidence)
        return build_identify_page(self.found.result, self.found.provenance, self.found.evidence, summaries)

    def refused_page(self, error: Exception) -> "Page":
        """Build the page of what was refused."""
        from autotune.report.refused_page import refused_estimate_page, refused_log_page

        if self.found is None:
            return refused_log_page(error, self.logs, self.options)
        return refused_estimate_page(error, self.page())


def print_windows(windows: "Sequence[Window]") -> None:
    """Print what each window of a long log says of the payload; those that are refused alike are one row."""
    from autotune.windows import window_columns, window_rows

    if windows:
        print_table([window_columns(), *window_rows(windows)], left=(0, 4), point=(1, 2))
        print_message()


def print_identified(result: "Identified", out: Path) -> None:
    """Print the parameters as a table, the findings below."""
    from autotune.text import held_out_lines, parameter_rows, touch_columns, touch_note, touch_rows

    rows = [
        ("parameter", "value", "± std", "unit", "verdict"),
        *((row.name, row.value, row.std, row.unit, row.verdict) for row in parameter_rows(result)),
    ]
    print_table(rows, left=(0, 3, 4), point=(1, 2), verdict=4)
    for name, axis in result.axes.items():
        for line in held_out_lines(name, axis):
            print_message(line)
    for timeline in result.timelines:
        if timeline.touches:
            if timeline.log:
                print_message(f"touches in {timeline.log}, from its start:")
            print_table([touch_columns(timeline), *touch_rows(timeline)], left=(0, 1, 8), point=(2, 3, 4, 6))
            if note := touch_note(timeline):
                print_message(note)
        print_message(_timeline_line(timeline))
    for finding in result.findings:
        print_message(f"{finding.message} {finding.advice}", verdict=f"{finding.severity}: ")
    print_message(f"written: {out}")


def _timeline_line(timeline: "Timeline") -> str:
    """Return what happened in a log and for how long, in the order of its first time."""
    spent: dict[str, tuple[int, float]] = {}
    for phase in timeline.phases:
        count, seconds = spent.get(phase.kind.value, (0, 0.0))
        spent[phase.kind.value] = count + 1, seconds + phase.stop_s - phase.start_s
    spans = ", ".join(f"{count} x {kind} {seconds:.1f} s" for kind, (count, seconds) in spent.items())
    return f"time line{f' of {timeline.log}' if timeline.log else ''}: {spans}"
