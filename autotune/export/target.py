"""What an export target is: its name, its options, the files that it writes and how they are recognised."""

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, TypeVar

from problems.progress import Progress

if TYPE_CHECKING:
    from autotune.formats.controller import ControllerFile
    from problems.model.linear_controllers import LinearController

# `autotune export --help` reads the table of targets, so a target imports what it needs in the functions that need it.

Options = TypeVar("Options")
"""The options of a target as one value."""
ALL_GAINS = ("mass", "damping", "lead_s", "feedback_damping_s")
"""The gains of our own law by their names in `bounds`."""


@dataclass(frozen=True, kw_only=True)
class TargetOption:
    """An option of a target, such as `--joints`; `parse` turns its text, or its number, into what the target takes."""

    flag: str
    metavar: str
    help: str
    type: type = str
    parse: Callable[[Any], Any] = lambda value: value

    def said(self, value: Any) -> str:
        """Return a parsed value as it is typed."""
        parts = value if isinstance(value, tuple) else (value,)
        return ",".join(f"{each:g}" if isinstance(each, float) else str(each) for each in parts)

    @property
    def name(self) -> str:
        """The option as a Python name."""
        return self.flag.removeprefix("--").replace("-", "_")


@dataclass(frozen=True, kw_only=True)
class ExportRequest:
    """A controller file that was verified, the first file to write, and the options by name.

    `signed_by` is the fingerprint of the key whose signature was verified, None where none was asked for.
    """

    source: "ControllerFile"
    out: Path
    options: Mapping[str, Any] = field(default_factory=dict)
    signed_by: str | None = None
    progress: Callable[[float], None] | None = None


@dataclass(frozen=True, kw_only=True)
class Rendered:
    """The texts, or bytes, of the files, in the order of `ExportTarget.files`; `lines` and `tree` are also printed.

    `laws` are those that another program runs, axis by axis.
    """

    texts: tuple[str | bytes, ...]
    lines: tuple[str, ...] = ()
    tree: Mapping[str, Any] = field(default_factory=dict)
    laws: Mapping[str, "LinearController"] = field(default_factory=dict)


class Renderable(Protocol):
    """What another program runs, as the texts of its files."""

    def rendered(self) -> Rendered:
        """Return the texts."""


def render_translation(
    translate: Callable[["ControllerFile", Options, Progress | None], Renderable], options: Callable[..., Options]
) -> Callable[[ExportRequest], Rendered]:
    """Return how a target renders that writes another program's parameters: translated, certified, as text."""
    return lambda request: translate(request.source, options(**request.options), request.progress).rendered()


def begins_with(pattern: bytes) -> Callable[[Path], bool]:
    """Return a test of whether a file begins with a pattern."""
    mark = re.compile(pattern)

    def is_own(path: Path) -> bool:
        from autotune.formats.kinds import HEAD_BYTES  # noqa: PLC0415

        with path.open("rb") as stream:
            return mark.match(stream.read(HEAD_BYTES)) is not None

    return is_own


@dataclass(frozen=True, kw_only=True)
class ExportTarget:
    """A format that a controller can be exported to.

    `summary` is a sentence for `--help`. `render` returns what is to be written, or raises CertificateError,
    InfeasibleError or UsageError. `is_own` recognises an earlier export to this target, the only file that is replaced.
    `files` returns the files to write from the one that `-o` names. With `runs_same_law` the file's own law is
    checked before; a target that runs another law certifies it itself. `sample_time_s` is the period of a program that
    has one of its own, `expresses` names the gains of ours that a design for it may have (all where its
    structure is another one than ours), and `design_options` stand for those of an
    installation where nothing is written. With `is_folder` all `files` lie in a folder that `-o` names, which is
    written as one. `suffix` is that of an example's file, and `following` returns the command that uses what was
    written, None where nothing is usual.
    """

    name: str
    summary: str
    render: Callable[[ExportRequest], Rendered]
    is_own: Callable[[Path], bool]
    options: tuple[TargetOption, ...] = ()
    files: Callable[[Path], tuple[Path, ...]] = lambda out: (out,)
    runs_same_law: bool = True
    sample_time_s: float | None = None
    expresses: tuple[str, ...] = ALL_GAINS
    design_options: Mapping[str, Any] = field(default_factory=dict)
    is_folder: bool = False
    suffix: str = ".yaml"
    following: Callable[[ExportRequest], str] | None = None
