"""Option types, completion of file names, and the layout of `--help`."""

import math
import shlex
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import click
from click.shell_completion import BashComplete, CompletionItem, add_completion_class

from autotune.errors import UsageError
from autotune.formats.kinds import LOG, check_kind
from identification.errors import LogError
from problems.frozen import FrozenDict

from ._common import Delivery, page_stays

SETTINGS = (".yaml", ".yml")
LOGS = (".mcap", ".bag", ".db3", ".csv", ".parquet")
KEYS = (".pem", ".pub", ".key")
_WIDEST = 100
_COMMON = ("--json", "--quiet", "--debug", "--help")
_WITH_UNIT = "autotune.with_unit"
_LAST = "Messages and output"


class FilePath(click.Path):
    """A file to be read whose name ends in one of `endings`; the shell proposes those, and folders on the way to them.

    One that is not there, or plainly of another kind than one of `kinds` (`formats.kinds`), is noticed before any work.
    """

    def __init__(self, *endings: str, kinds: Sequence[str] = (), **options: Any) -> None:
        super().__init__(path_type=Path, **{"dir_okay": False, **options})
        self.endings, self.kinds = endings, tuple(kinds)

    def check(self, path: Path) -> None:
        """Raise LogError for a log that is not there, UsageError for another such file and for one of another kind."""
        if not self.kinds:
            return
        if not path.exists():
            said = f"{path} cannot be read: No such file or directory"
            raise LogError(f"{said}; name an existing log file.") if self.kinds == (LOG,) else UsageError(f"{said}.")
        check_kind(path, self.kinds)

    def shell_complete(self, ctx: click.Context, param: click.Parameter, incomplete: str) -> list[CompletionItem]:
        """Return the files of the kind that begin with `incomplete`, and leave the folders to the shell."""
        del ctx, param
        folder, _, begin = incomplete.rpartition("/")
        lead = incomplete[: len(incomplete) - len(begin)]
        where = Path(folder or ("/" if lead else ".")).expanduser()
        try:
            names = sorted(each.name for each in where.iterdir() if self._fits(each, begin))
        except OSError:
            names = []
        # The script for bash forgets what came before a folder, so that comes first.
        return [CompletionItem(incomplete, type="dir"), *(CompletionItem(lead + name) for name in names)]

    def _fits(self, path: Path, begin: str) -> bool:
        is_shown = begin.startswith(".") or not path.name.startswith(".")
        return is_shown and path.name.startswith(begin) and path.suffix.lower() in self.endings and path.is_file()


class PresentType(FilePath):
    """What runs in a cell today: gains as in mass=10,damping=1500, the word log, or a file that says it."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Return gains and the word as text, and a file as its path."""
        if isinstance(value, str) and not value.strip():
            self.fail("must be gains as in mass=10,damping=1500, log or a file; found an empty text.", param, ctx)
        is_text = isinstance(value, str) and ("=" in value or value == "log")
        return value if is_text else super().convert(value, param, ctx)


class BothComplete(BashComplete):
    """Completion for bash that proposes folders beside names, where click's own would do so instead of them."""

    # As file names, a blank in one of them is quoted.
    source_template = BashComplete.source_template.replace("compopt -o dirnames", "compopt -o plusdirs -o filenames")


def register() -> None:
    """Let bash be completed by `BothComplete`."""
    add_completion_class(BothComplete, "bash")


class FiniteRange(click.FloatRange):
    """A number between bounds, neither of which NaN keeps nor infinity where one is open."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Return the number, inside the bounds."""
        found = super().convert(value, param, ctx)
        if not math.isfinite(found):
            self.fail(f"{found} is not a finite number.", param, ctx)
        return found


class QuantityRange(FiniteRange):
    """A number of a kind (`autotune.quantities`) between bounds in SI."""

    def __init__(self, kind: str, *, least: float, most: float) -> None:
        super().__init__(min=least, max=most)
        self.kind = kind

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Return the number in SI, inside the bounds."""
        from autotune.quantities import parse_quantity

        if isinstance(value, str):
            try:
                value = parse_quantity(value, self.kind).value
            except ValueError as error:
                self.fail(str(error), param, ctx)
        return super().convert(value, param, ctx)


def typed_range(parts: list[str], kind: str, field: str) -> tuple[float, float]:
    """Return the range that numbers say, in SI; that the unit of `field` was typed is kept for `fields_with_unit`."""
    from autotune.quantities import parse_range

    try:
        low, high = parse_range(parts, kind)
    except ValueError as error:
        raise click.BadParameter(str(error)) from None
    if low.has_unit and high.has_unit:
        click.get_current_context().meta.setdefault(_WITH_UNIT, set()).add(field)
    return low.value, high.value


def fields_with_unit() -> frozenset[str]:
    """Return the fields whose units were typed."""
    return frozenset(click.get_current_context().meta.get(_WITH_UNIT, ()))


class GroupedCommand(click.Command):
    """A command whose help puts its options under headings.

    `groups` maps a heading to the names of its parameters; what is in none of them comes first, under "Options", and
    what every command has comes last, under "Messages and output". Raises ValueError for a name that is no option.
    """

    def __init__(self, name: str | None, *, groups: Mapping[str, Sequence[str]] | None = None, **options: Any) -> None:
        super().__init__(name, **options)
        self.context_settings = {"max_content_width": _WIDEST, **self.context_settings}
        self.groups = FrozenDict(groups or {})
        known = {parameter.name for parameter in self.params if isinstance(parameter, click.Option)}
        unknown = [name for names in self.groups.values() for name in names if name not in known]
        if unknown:
            raise ValueError(f"The command {self.name} has no option {unknown[0]}.")

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Refuse an option that takes one value and is given two, of which the first would be dropped."""
        if not ctx.resilient_parsing:
            _, _, given = self.make_parser(ctx).parse_args(args=list(args))
            for each in given:
                takes_one = isinstance(each, click.Option) and not (each.multiple or each.is_flag or each.count)
                if takes_one and given.count(each) > 1:
                    raise click.UsageError(
                        f"{each.opts[-1]} is given {given.count(each)} times and takes one value; leave one, or run "
                        "the command once for each.",
                        ctx,
                    )
        return super().parse_args(ctx, args)

    def invoke(self, ctx: click.Context) -> Any:
        """Check every file that is to be read, then run the command."""
        report = ctx.params.get("report") or (ctx.params.get("out") if ctx.info_name == "report" else None)
        try:
            for parameter in self.params:
                value, kind = ctx.params.get(parameter.name or ""), parameter.type
                paths = value if isinstance(value, tuple) else (value,)
                for path in paths if isinstance(kind, FilePath) else ():
                    if isinstance(path, Path) and isinstance(kind, FilePath):
                        kind.check(path)
        except (LogError, UsageError):
            delivery = ctx.find_object(Delivery)
            if delivery is not None and isinstance(report, Path) and report.is_file():
                delivery.remark = page_stays(report)
            raise
        try:
            return super().invoke(ctx)
        except LogError as error:
            # A command that is named is one that can be pasted.
            named = shlex.join(str(log) for log in ctx.params.get("logs") or ("LOG",))
            error.args = (str(error).replace("inspect LOG ", f"inspect {named} "), *error.args[1:])
            raise

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the groups, each in the order in which its options were declared."""
        heading_of = {name: heading for heading, names in self.groups.items() for name in names}
        sections: dict[str, list[tuple[str, str]]] = {heading: [] for heading in ("Options", *self.groups, _LAST)}
        for option in (each for each in self.get_params(ctx) if isinstance(each, click.Option)):
            record = option.get_help_record(ctx)
            heading = _LAST if option.opts[-1] in _COMMON else heading_of.get(option.name or "", "Options")
            if record is not None:
                sections[heading].append(record)
        for heading, records in sections.items():
            if records:
                with formatter.section(heading):
                    formatter.write_dl(records)


def output_option(default: str, text: str = "File to write.") -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Add `-o`, handed on as `out`: the one file that a command writes."""
    kind = click.Path(path_type=Path, dir_okay=False)
    return click.option("-o", "--output", "out", type=kind, default=Path(default), show_default=True, help=text)


def cell_option(function: Callable[..., Any]) -> Callable[..., Any]:
    """Add `--cell`, handed on as `cell_path`."""
    text = "Settings that the log does not hold: cell.yaml."
    return click.option("--cell", "cell_path", type=FilePath(*SETTINGS, kinds=("cell",)), help=text)(function)


def urdf_options(function: Callable[..., Any]) -> Callable[..., Any]:
    """Add `--urdf` and `--tip`: how joint positions are a pose."""
    text = "Take the pose from joint positions through this URDF, where the log has no other."
    tip = click.option("--tip", metavar="LINK", help="Link of the URDF whose pose it is, e.g. tool0.")
    kind = FilePath(".urdf", ".xml")
    return click.option("--urdf", type=kind, callback=lambda _, __, path: path and str(path), help=text)(tip(function))


def span_options(function: Callable[..., Any]) -> Callable[..., Any]:
    """Add `--from` and `--to`, handed on as `start` and `stop`: the part of a log that is read."""
    text = "seconds after its start, or @ and a stamp in seconds."
    to = click.option("--to", "stop", metavar="TIME", callback=_check_instant, help=f"Read the log up to here: {text}")
    since = click.option(
        "--from", "start", metavar="TIME", callback=_check_instant, help=f"Read the log from here: {text}"
    )
    return since(to(function))


def _check_instant(ctx: click.Context, param: click.Parameter, value: str | None) -> float | str | None:
    """Return seconds as a number and a stamp as it is; refuse others, and an end that is not after the beginning."""
    if value is not None:
        from identification.logs.read import LogSpan
        from problems.errors import ParameterError

        try:
            given = {name: ctx.params.get(name) for name in ("start", "stop")} | {str(param.name): value}
            LogSpan(start=given["start"], stop=given["stop"])
        except ParameterError as error:
            raise click.BadParameter(str(error), ctx, param) from error
    return value if value is None or value.strip().startswith("@") else float(value)


def salvage_option(function: Callable[..., Any]) -> Callable[..., Any]:
    """Add `--salvage`."""
    text = "Read what is left of a log whose end, index or database is damaged, and list what is lost."
    return click.option("--salvage", is_flag=True, help=text)(function)


def bumper_option(text: str) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Add `--bumper`, handed on as a `Bumper`; `text` is its help."""
    return click.option("--bumper", callback=_check_bumper, metavar="KG,N/m[,N·s/m]", help=text)


def _check_bumper(ctx: click.Context, param: click.Parameter, value: str | None) -> Any:
    """Read mass, stiffness and perhaps damping of a bumper."""
    if value is None:
        return None
    from autotune.validation.bumper import parse_bumper

    try:
        return parse_bumper(value)
    except ValueError as error:
        raise click.BadParameter(str(error), ctx, param) from None
