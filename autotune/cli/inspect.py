"""`autotune inspect`: channels of a log, their roles, and what is missing for `identify`."""

import shlex
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from autotune.errors import UsageError
from autotune.formats.kinds import LOG, name_of

from ._common import Output, output_options
from ._options import LOGS, FilePath, GroupedCommand, cell_option, salvage_option, span_options, urdf_options
from ._terminal import print_message, print_table

if TYPE_CHECKING:
    from identification.logs.guess import CellGuess
    from identification.logs.summary import ChannelSummary, LogSummary

_NEEDED = ("wrench", "pose", "command")
_MATRIX = 16
# Errors that an entry of cell.yaml mends; of the others the log has to be recorded again.
_DECLARED = frozenset(
    {"time-undeclared", "turn-unit", "length-unit", "force-unit", "stamp-unit", "no-rotation", "matrix-order"}
    | {"undecodable", "unusable"}
)
_EPILOG = """\b
Examples:
  autotune inspect run7.mcap
  autotune inspect run7.bag --write-cell cell.yaml
  autotune inspect run7.bag --cell cell.yaml
"""


@click.command("inspect", cls=GroupedCommand, epilog=_EPILOG)
@click.argument("logs", metavar="LOG...", nargs=-1, required=True, type=FilePath(*LOGS, kinds=(LOG,), dir_okay=True))
@cell_option
@click.option(
    "--write-cell",
    "start_path",
    type=click.Path(path_type=Path, dir_okay=False),
    help="Write a cell.yaml to complete: what was found or guessed is filled in, what is open is a question.",
)
@click.option("--force", is_flag=True, help="Let --write-cell replace a file.")
@urdf_options
@span_options
@salvage_option
@output_options
def command(
    output: Output,
    logs: tuple[Path, ...],
    cell_path: Path | None,
    start_path: Path | None,
    force: bool,
    urdf: str | None,
    tip: str | None,
    start: float | str | None,
    stop: float | str | None,
    salvage: bool,
) -> None:
    """List the channels of LOG and what is missing for `identify`; several LOGs are parts of one recording.

    Reads MCAP, rosbag2 folders, ROS 1 bags, CSV and Parquet. Shows types, rates, gaps, clocks and the role of each
    channel. Exit code 3: the log cannot be read; errors that are listed are what `identify` would refuse it for.
    """
    from autotune.formats.cell import check_new, read_cell, write_cell_start
    from identification.errors import LogError, UntimedError
    from identification.logs.guess import guess_cell
    from identification.logs.inspect import inspect_log
    from identification.logs.read import LogSpan
    from identification.logs.roles.cell import Cell

    span = LogSpan(start=start, stop=stop)
    if start_path is not None:
        if cell_path is not None:
            raise UsageError("--write-cell begins a cell.yaml where there is none; leave out --cell.")
        check_new(start_path, force=force)
    cell = (Cell() if cell_path is None else read_cell(cell_path).cell).with_urdf(urdf, tip)
    with output.progress(f"reading {', '.join(map(name_of, logs))}", None):
        try:
            summary = inspect_log(logs, cell, salvage=salvage, span=span)
        except UntimedError:
            # What --write-cell recognises as the time is in the cell.yaml that it begins; the part is read with that.
            if start_path is None:
                raise
            summary = inspect_log(logs, cell, salvage=salvage)
        guess = None if start_path is None else guess_cell(logs, salvage=salvage)
    if start_path is not None:
        write_cell_start(start_path, summary, guess, force=force)
        output.note(f"written: {start_path}")
    if start_path is not None and guess is not None and (guess.roles or guess.tables or guess.wrenches):
        # What the log lacks is now what it lacks with the guesses, not what it lacked before them.
        begun = read_cell(start_path).cell.with_urdf(urdf, tip)
        with output.progress(f"reading {', '.join(map(name_of, logs))}", None), suppress(LogError):
            summary = inspect_log(logs, begun, salvage=salvage, span=span)
        output.note(_guessed(guess, summary))
    output.result(summary_tree(summary), lambda: print_summary(summary))
    reading = _reading_words(urdf, tip, start, stop, salvage=salvage)
    _name_next(output, logs, summary, reading, cell=cell_path, begun=start_path)


def _name_next(
    output: Output,
    logs: Sequence[Path],
    summary: "LogSummary",
    reading: list[str],
    *,
    cell: Path | None,
    begun: Path | None,
) -> None:
    has_cell = Path("cell.yaml").exists()
    errors = {finding.code for finding in summary.findings if finding.severity == "error"}
    known = cell or begun or (Path("cell.yaml") if has_cell and errors & _DECLARED else None)
    declared = () if known is None else ("--cell", known)
    if begun is None and errors - _DECLARED:
        output.next_line("autotune plan  # says what to record, once what the errors above name is mended")
    elif begun is None and errors and known is not None:
        words = shlex.join(["autotune", "identify", *map(str, (*logs, *declared, *reading))])
        output.next_line(f"{words}  # once {known} declares what the errors above ask for")
    elif (errors or summary.missing) and known is None and not has_cell:
        output.next_command("inspect", *logs, "--write-cell", "cell.yaml", *reading)
    elif begun is not None and any(role.entry == "wrench" and role.topic is None for role in summary.roles):
        output.next_command("inspect", *logs, *declared, *reading)  # once the questions are answered
    else:
        partial = ("--allow-partial",) if summary.missing else ()
        output.next_command("identify", *logs, *declared, *partial, *reading)


def _reading_words(
    urdf: str | None, tip: str | None, start: float | str | None, stop: float | str | None, *, salvage: bool
) -> list[str]:
    """Return the options by which a log was read, for the next command."""
    said = {"--urdf": urdf, "--tip": tip, "--from": start, "--to": stop}
    words = [word for option, value in said.items() if value is not None for word in (option, str(value))]
    return [*words, *(["--salvage"] if salvage else [])]


def _guessed(guess: "CellGuess", summary: "LogSummary") -> str:
    """Name what was guessed and what is still open."""
    guessed = [role.entry for role in summary.roles if role.role in guess.roles]
    untimed = {channel.topic for channel in summary.channels if channel.encoding == "table"} - {*guess.tables}
    asked = [role for role in summary.roles if role.entry in _NEEDED]
    still_open = [role.entry for role in asked if role.topic is None and role.role not in guess.roles]
    guessed += ["time"] if guess.tables else []
    guessed += [f"{', '.join(each.key for each in entries)} of {topic}" for topic, entries in guess.wrenches.items()]
    still_open += list(_lacking_parts(guess))
    still_open += [f"time of {topic}" for topic in sorted(untimed)]
    return f"guessed: {', '.join(guessed)}; open: {', '.join(still_open) or 'nothing'}; check the guesses"


def _lacking_parts(guess: "CellGuess") -> Iterator[str]:
    """Yield what a guessed pose or command lacks to be whole; a travel, and poses at rest, need not be."""
    from identification.logs.roles.registry import ROLES, Role

    if guess.is_displacement or any(entry.value == {"rows": "poses"} for entry in guess.tables.values()):
        return
    for role in (Role.POSE, Role.COMMAND):
        fields = next((entry.value for entry in guess.roles.get(role, ()) if entry.key == "fields"), None)
        if not isinstance(fields, Mapping):
            continue
        is_whole = len(fields.get("orientation", ())) == _MATRIX
        for part in ("position", "orientation"):
            if part not in fields and not is_whole:
                yield f"{part} of {ROLES[role].entry}"


def summary_tree(summary: "LogSummary") -> dict[str, Any]:
    """Return a summary as plain data for JSON."""
    return {**asdict(summary), "path": str(summary.path), "duration_s": _duration_s(summary)}


def print_summary(summary: "LogSummary") -> None:
    """Print a summary: the channels as a table, their roles, then findings, then what is missing."""
    others = f" and {len(summary.sha256s) - 1} more" if len(summary.sha256s) > 1 else ""
    print_message(
        f"{summary.path}{others} · {summary.container} · {summary.size_bytes / 1e6:.1f} MB · "
        f"{_duration_s(summary):.1f} s · sha256 {summary.sha256[:12]}…"
    )
    print_message()
    print_table([_HEADINGS, *(_row(channel) for channel in summary.channels)], left=_LEFT, stacks=True)
    chosen = [role for role in summary.roles if role.topic is not None]
    if chosen:
        print_message()
        print_message("Roles")
        for role in chosen:
            pair = f", {role.child} in {role.parent}" if role.parent is not None else ""
            print_message(f"{role.entry}: {role.topic}{pair} ({role.reason})", indent="  ")
    if summary.findings:
        print_message()
        print_message("Findings")
        for finding in summary.findings:
            print_message(f"{finding.message} {finding.advice}", verdict=f"{finding.severity}: ", indent="  ")
    print_message()
    print_message(_said_of_channels(summary))
    for sentence in summary.missing:
        print_message(f"- {sentence}", indent="  ")


def _said_of_channels(summary: "LogSummary") -> str:
    """Return whether `identify` finds its channels, and whether errors keep it from using them."""
    if summary.missing:
        return "Missing for identify"
    if any(finding.severity == "error" for finding in summary.findings):
        return "Every channel that identify needs is there; correct the errors above first."
    return "Every channel that identify needs is there."


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
