"""The entry point: find the command, run it, turn whatever happens into an exit code."""

import atexit
import contextlib
import difflib
import gc
import importlib
import io
import os
import sys
import traceback
import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from enum import IntEnum
from pathlib import Path
from typing import Any, TextIO

import click
from click.shell_completion import CompletionItem

from autotune.cli._common import Delivery, discard_output, json_text, say
from autotune.cli._terminal import detect_terminal, set_apart, wrap_lines
from autotune.cli.completion import COMPLETE_VARIABLE
from autotune.errors import AutotuneError, CertificateError, InfeasibleError, UsageError
from autotune.formats.kinds import check_kind
from autotune.version import __version__
from identification.errors import EstimateError, LogError
from problems.errors import MissingExtraError, ParameterError
from problems.frozen import FrozenDict

PROGRAM = "autotune"
_GARBAGE = 50_000
_EPILOG = """\b
Examples:
  autotune demo                     # start here: every step on a simulated cell
  autotune inspect run7.mcap        # your log: what it holds and what is missing
  autotune identify run7.mcap && autotune optimize identified.yaml
  autotune validate controller.yaml --identified identified.yaml

\b
Exit codes: 2 usage, 3 log unusable, 4 the log does not show enough, 5 no controller
meets the requirements, 6 a claim does not hold or a file was altered.

\b
Colour and progress are for terminals; NO_COLOR=1 switches colour off, FORCE_COLOR=1 on.
"""


class ExitCode(IntEnum):
    """Exit codes of the process."""

    GOOD = 0
    UNFORESEEN = 1
    USAGE = 2
    LOG = 3
    ESTIMATE = 4
    INFEASIBLE = 5
    CERTIFICATE = 6
    INTERRUPTED = 130


@dataclass(frozen=True, kw_only=True)
class CommandEntry:
    """The module of a command, which holds `command: click.Command`, and its one-line help."""

    module: str
    help: str


COMMANDS: Mapping[str, CommandEntry] = FrozenDict(
    {
        "inspect": CommandEntry(
            module="autotune.cli.inspect", help="List the channels of a log, and what is missing for identify."
        ),
        "identify": CommandEntry(module="autotune.cli.identify", help="Estimate plant parameters from logs."),
        "optimize": CommandEntry(module="autotune.cli.optimize", help="Search and validate a controller."),
        "validate": CommandEntry(module="autotune.cli.validate", help="Verify a controller file, by a second method."),
        "export": CommandEntry(module="autotune.cli.export", help="Write a controller in another format."),
        "demo": CommandEntry(module="autotune.cli.demo", help="Run all steps on the log of a simulated cell."),
        "predict": CommandEntry(
            module="autotune.cli.predict", help="Predict the peak force of a contact, with an interval."
        ),
        "map": CommandEntry(
            module="autotune.cli.map", help="Draw stability, a margin or the peak force over two parameters."
        ),
        "report": CommandEntry(module="autotune.cli.report", help="Write an HTML page with figures from result files."),
        "plan": CommandEntry(module="autotune.cli.plan", help="Propose the next recording."),
        "explore": CommandEntry(
            module="autotune.cli.explore", help="Change gains and plant with sliders in the browser."
        ),
        "campaign": CommandEntry(
            module="autotune.cli.campaign", help="Identify and tune many logs of many cells, and compare them."
        ),
        "limit": CommandEntry(module="autotune.cli.limit", help="Say what any linear controller could reach."),
        "warm": CommandEntry(module="autotune.cli.warm", help="Compile every kernel now, so that nothing waits later."),
        "completion": CommandEntry(module="autotune.cli.completion", help="Print the completion script for a shell."),
    }
)

EXIT_CODES: tuple[tuple[type[BaseException], ExitCode], ...] = (
    (KeyboardInterrupt, ExitCode.INTERRUPTED),
    (click.Abort, ExitCode.INTERRUPTED),
    (click.ClickException, ExitCode.USAGE),
    (UsageError, ExitCode.USAGE),
    (ParameterError, ExitCode.USAGE),
    (MissingExtraError, ExitCode.USAGE),
    (LogError, ExitCode.LOG),
    (EstimateError, ExitCode.ESTIMATE),
    (InfeasibleError, ExitCode.INFEASIBLE),
    (CertificateError, ExitCode.CERTIFICATE),
)


class LazyGroup(click.Group):
    """A group that knows its commands by name and imports one only when it runs."""

    def __init__(self, *, entries: Mapping[str, CommandEntry], **options: Any) -> None:
        super().__init__(**options)
        self.entries = entries

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Return the names in the order of the work."""
        del ctx
        return list(self.entries)

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """Find the command; of an unknown one name the nearest, and of a file the command that it is for."""
        name = args[0]
        if name not in self.entries and not name.startswith("-"):
            if Path(name).is_file():
                check_kind(Path(name), ("command",))
            near = difflib.get_close_matches(name, self.entries, 1)
            if near:
                ctx.fail(f"No such command '{name}'. Did you mean `{PROGRAM} {near[0]}`?")
        return super().resolve_command(ctx, args)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """Import and return the command, or None when there is none of that name."""
        del ctx
        if cmd_name not in self.entries:
            return None
        command = importlib.import_module(self.entries[cmd_name].module).command
        if not isinstance(command, click.Command):
            raise TypeError(f"{self.entries[cmd_name].module}.command must be a click.Command, found {command!r}.")
        return command

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the list of commands without importing any."""
        del ctx
        with formatter.section("Commands"):
            formatter.write_dl([(name, entry.help) for name, entry in self.entries.items()])

    def shell_complete(self, ctx: click.Context, incomplete: str) -> list[CompletionItem]:
        """Complete names without importing any command."""
        names = [CompletionItem(n, help=e.help) for n, e in self.entries.items() if n.startswith(incomplete)]
        return [*names, *click.Command.shell_complete(self, ctx, incomplete)]


def build_cli(entries: Mapping[str, CommandEntry] = COMMANDS) -> click.Group:
    """Build the command group over a table of commands."""
    group = LazyGroup(
        entries=entries,
        name=PROGRAM,
        context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100},
        help="From the log of a contact experiment to a validated admittance controller.",
        epilog=_EPILOG,
    )
    return click.version_option(__version__, prog_name=PROGRAM, message="%(prog)s %(version)s")(group)


def _one_thread() -> None:
    """Keep linear algebra on one thread, whatever the environment says.

    Our matrices are small, and threads that wait for each other cost tenfold; sums in another order round differently,
    and the same input gives the same file.
    """
    os.environ |= dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"), "1")


def main(argv: Sequence[str] | None = None, *, entries: Mapping[str, CommandEntry] = COMMANDS) -> int:
    """Run the command line `argv` (default: that of the process) and return its exit code.

    Never raises: an error becomes one line on standard error and its code of `EXIT_CODES`; with `--json` also
    the object `{"error": {...}}` on standard output; with `--debug` the traceback as well.
    """
    # What imports and logs make lives to the end: looking for cycles in it costs a twentieth of a run, and so does a
    # last look as the interpreter ends.
    gc.set_threshold(_GARBAGE)
    atexit.register(gc.freeze)
    arguments = list(sys.argv[1:] if argv is None else argv)
    _tolerate_narrow_encodings()
    _one_thread()
    delivery = Delivery()
    try:
        with _warnings_in_plain_words(arguments):
            code = _run(build_cli(entries), arguments, delivery)
        sys.stdout.flush()
    except BrokenPipeError:
        discard_output()
        code = ExitCode.GOOD
    except BaseException as error:  # noqa: BLE001 - this is the border where every error becomes an exit code
        code = _report(error, arguments, delivery)
    _settle_output()
    return int(code)


@contextlib.contextmanager
def _warnings_in_plain_words(arguments: Sequence[str]) -> Iterator[None]:
    """Count what Python warns of while a command runs, and say so in one line at its end; `--debug` shows each."""
    if _has_option("--debug", arguments):
        yield
        return
    seen: list[str] = []

    def remember(
        message: Warning | str,
        category: type[Warning],
        filename: str,
        lineno: int,
        file: TextIO | None = None,
        line: str | None = None,
    ) -> None:
        del file, line
        seen.append(f"{category.__name__}: {message} ({Path(filename).name}:{lineno})")

    with warnings.catch_warnings():
        warnings.showwarning = remember
        try:
            yield
        finally:
            if seen:
                say(
                    f"{PROGRAM}: {len(seen)} warning(s) of the numerical libraries inside, the first {seen[0]}. What "
                    "is not finite is never written, but please report this; --debug shows where it comes from."
                )


def exit_code_of(error: BaseException) -> ExitCode:
    """Return the exit code of `error`."""
    return next((code for kind, code in EXIT_CODES if isinstance(error, kind)), ExitCode.UNFORESEEN)


def _run(cli: click.Group, arguments: list[str], delivery: Delivery) -> int:
    instruction = os.environ.get(COMPLETE_VARIABLE)
    if instruction:
        from click.shell_completion import shell_complete

        from autotune.cli._options import register

        register()
        return shell_complete(cli, {}, PROGRAM, COMPLETE_VARIABLE, instruction)
    # Not `cli.main`: it ends the process by itself on a closed pipe, with a code of its own.
    try:
        with cli.make_context(PROGRAM, arguments, obj=delivery) as context:
            returned = cli.invoke(context)
    except click.exceptions.Exit as leave:
        return leave.exit_code
    return returned if isinstance(returned, int) else ExitCode.GOOD


def _report(error: BaseException, arguments: Sequence[str], delivery: Delivery) -> ExitCode:
    if isinstance(error, click.exceptions.NoArgsIsHelpError):
        say(error.format_message())
        return ExitCode.USAGE
    code = exit_code_of(error)
    if code is ExitCode.INTERRUPTED:
        # An interrupt inside of code that is run from text, such as that of a new dataclass, leaves a mark by which the
        # interpreter ends with the signal instead of our code; the next text that is run takes it away.
        exec("")
    if _has_option("--debug", arguments):
        say("".join(traceback.format_exception(error)).rstrip())
    message = _one_line(error, code)
    hint = _hint(error, code)
    # A line to paste stands alone, without a full stop.
    ended = f"{message.rstrip('.')}." if delivery.remark and not message.endswith(_to_paste(error)) else message
    text = " ".join(part for part in (ended, hint, delivery.remark) if part)
    text, columns = set_apart(text, _to_paste(error)), detect_terminal(sys.stderr).columns
    say("\n".join(wrap_lines(text, verdict=f"{PROGRAM}: ", columns=columns, error=True)))
    if _has_option("--json", arguments) and not delivery.done:
        tree: dict[str, Any] = {
            "error": {
                "kind": getattr(error, "kind", type(error).__name__),
                "message": message,
                "exit_code": int(code),
                **_details(error),
            }
        }
        tree |= {"report": delivery.report} if delivery.report else {}
        with contextlib.suppress(BrokenPipeError):
            click.echo(json_text(tree))
            sys.stdout.flush()
    return code


def _to_paste(error: BaseException) -> tuple[str, ...]:
    """Return the parts of an error's sentence that are lines of `problem.yaml`, or commands."""
    if not isinstance(error, AutotuneError):
        return ()
    if not isinstance(error, InfeasibleError) or not error.suggestion:
        return error.to_paste
    from autotune.formats.canonical import lines_to_paste

    return (*lines_to_paste(error.suggestion), *error.to_paste)


def _details(error: BaseException) -> dict[str, Any]:
    """Return what an error carries beside its sentence."""
    if not isinstance(error, InfeasibleError):
        return {}
    names = ("name", "asked", "possible")
    eased = [dict(zip(names, each, strict=True)) for each in error.relaxations]
    return {
        **({"relaxations": eased} if eased else {}),
        **({"suggestion": error.suggestion} if error.suggestion else {}),
    }


def _one_line(error: BaseException, code: ExitCode) -> str:
    if code is ExitCode.INTERRUPTED:
        return "Interrupted."
    text = error.format_message() if isinstance(error, click.ClickException) else str(error)
    sentence = " ".join(text.split())
    if code is not ExitCode.UNFORESEEN:
        return sentence
    return f"Unforeseen {type(error).__name__}: {sentence or 'no further message'}".rstrip(".") + "."


def _hint(error: BaseException, code: ExitCode) -> str:
    if code is ExitCode.UNFORESEEN:
        return "Run the command again with --debug to see where."
    if isinstance(error, click.UsageError) and error.ctx is not None:
        return f"See {error.ctx.command_path} --help."
    return ""


def _has_option(option: str, arguments: Sequence[str]) -> bool:
    """Whether `option` is among the arguments, which an error may have kept from being parsed."""
    before = arguments[: arguments.index("--")] if "--" in arguments else arguments
    return option in before


def _settle_output() -> None:
    """Flush now, so that a full disk or a closed pipe cannot replace the exit code while the interpreter ends."""
    try:
        sys.stdout.flush()
    except OSError:
        discard_output()


def _tolerate_narrow_encodings() -> None:
    """Let a terminal without Greek letters show a question mark instead of ending the run."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")
