"""`autotune inspect`: what a log holds and what each channel can be used for."""

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ._common import Output, output_options
from ._table import printable, table_lines

if TYPE_CHECKING:
    from identification.logs import ChannelSummary, LogSummary

_EPILOG = """\b
Example:
  autotune inspect run7.mcap
"""


@click.command("inspect", epilog=_EPILOG)
@click.argument("log", type=click.Path(path_type=Path))
@output_options
def command(output: Output, log: Path) -> None:
    """Tell what LOG (MCAP or ROS 1 bag) holds and what it can be used for.

    Shows channels, types, rates, gaps and clocks, the use of each channel, and what is missing for `identify`.
    """
    from identification.logs import inspect_log

    summary = inspect_log(log)
    output.result(summary_tree(summary), lambda: print_summary(summary))


def summary_tree(summary: "LogSummary") -> dict[str, Any]:
    """Return a summary as plain data for JSON."""
    return {**asdict(summary), "path": str(summary.path), "duration_s": _duration_s(summary)}


def print_summary(summary: "LogSummary") -> None:
    """Print a summary: the channels as a table, then findings, then what is missing."""
    click.echo(
        f"{summary.path} · {summary.container} · {summary.size_bytes / 1e6:.1f} MB · {_duration_s(summary):.1f} s · "
        f"sha256 {summary.sha256[:12]}…"
    )
    click.echo()
    rows = [_HEADINGS, *(_row(channel) for channel in summary.channels)]
    for line in table_lines(rows, left=_LEFT):
        click.echo(line)
    if summary.findings:
        click.echo("\nFindings")
        for finding in summary.findings:
            click.echo(f"  {finding.severity}: {printable(finding.message)} {finding.advice}")
    click.echo("\nMissing for identify" if summary.missing else "\nEvery channel that identify needs is there.")
    for sentence in summary.missing:
        click.echo(f"  - {printable(sentence)}")


_HEADINGS = (
    "topic",
    "type",
    "messages",
    "rate [Hz]",
    "median gap [ms]",
    "longest gap [ms]",
    "back/duplicate",
    "clock",
    "header-recording [s]",
    "frame",
    "can serve as",
)
_LEFT = (0, 1, 7, 9, 10)


def _duration_s(summary: "LogSummary") -> float:
    return (summary.end_ns - summary.start_ns) / 1e9


def _row(channel: "ChannelSummary") -> tuple[str, ...]:
    return (
        channel.topic,
        channel.type or "?",
        str(channel.count),
        _number(channel.rate_hz, 1.0, 2),
        _number(channel.median_gap_s, 1e3, 3),
        _number(channel.max_gap_s, 1e3, 3),
        f"{channel.backwards_steps}/{channel.duplicates}",
        channel.clock,
        _number(channel.header_minus_log_s, 1.0, 4),
        ", ".join(name or "(empty)" for name in channel.frame_ids[:3]) or "-",
        ", ".join(channel.roles) or "-",
    )


def _number(value: float | None, scale: float, digits: int) -> str:
    return "-" if value is None else f"{value * scale:.{digits}f}"
