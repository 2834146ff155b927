"""Verify a controller file, write it in another format, as a file or a folder, and return what was written."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from hashlib import sha256
from pathlib import Path
from typing import Any, cast

from autotune.errors import AutotuneError, CertificateError, InfeasibleError, UsageError
from autotune.formats.atomic import check_target, write_atomic, write_folder_atomic
from autotune.formats.canonical import dump_yaml, lines_to_paste
from autotune.formats.controller import ControllerFile, read_controller
from autotune.formats.yaml12 import load_yaml
from autotune.runtime.load import check_digits, check_expected, verify_signature
from autotune.validation.validate import validate_controller

from .base_axes import MissingOrientationError
from .designing import DESIGNED, design_command, export_command, lines_for
from .ros_yaml import DOWNWARDS
from .target import ExportRequest, ExportTarget, Rendered
from .targets import TARGETS

_SAME_PERIOD = 1e-6

LIST = "autotune_export.yaml"
"""The file with the names and digests of all others, by which a folder of this tool is known."""
_FORMAT = "autotune/export_folder"


@dataclass(frozen=True, kw_only=True)
class Trust:
    """What is asked of the file: the signature of a key (a file, PEM or OpenSSH), its checksum (64 digits), or neither.

    Raises UsageError: the checksum is not 64 hexadecimal digits.
    """

    public_key: Path | None = None
    expected_checksum: str | None = None

    def __post_init__(self) -> None:
        if self.expected_checksum is not None:
            check_digits(self.expected_checksum)

    def verify(self, source: ControllerFile) -> str | None:
        """Return the fingerprint of the key that signed the file, None where no key is asked for.

        Raises CertificateError: the file is not signed by the key, or another one. UsageError: the key cannot be read.
        """
        signed_by = None
        if self.public_key is not None:
            signed_by = verify_signature(source.path, self.public_key, source.sha256)
        if self.expected_checksum is not None:
            check_expected(self.expected_checksum, source.checksum, source.path)
        return signed_by


@dataclass(frozen=True, kw_only=True)
class Exported:
    """What was written, for which target, from which file; `replaced` are files of an earlier export by now gone.

    `following` is the command that uses what was written, None where nothing is usual.
    """

    target: ExportTarget
    source: ControllerFile
    rendered: Rendered
    replaced: tuple[Path, ...]
    following: str | None = None

    @property
    def checksum(self) -> str:
        """The checksum of the controller file."""
        return self.source.checksum


def export_controller(
    path: Path | str,
    target: str,
    out: Path | str,
    *,
    options: Mapping[str, Any] | None = None,
    trust: Trust | None = None,
    progress: Callable[[float], None] | None = None,
) -> Exported:
    """Verify the controller file `path` and write it in a format of `TARGETS`.

    Parameters
    ----------
    path
        A validated controller.yaml.
    target
        The name of the target, a key of `TARGETS`.
    out
        The file or folder to write; each is replaced in one step, and none before all texts are made.
    options
        Options of the target by name (`TargetOption.name`); by default those of the target.
    trust
        The signature or checksum that the file must have; by default neither.
    progress
        Called with the share of the work done since the last call.

    Raises
    ------
    UsageError
        An unknown target or option, one that is missing, a file that cannot be opened or written, or an `out` that is
        not of the same export.
    CertificateError
        A file that is altered, not validated, not as `trust` asks, or whose law is not what it states.
    InfeasibleError
        Another controller can do nothing that meets the file's requirements.

    """
    if target not in TARGETS:
        raise UsageError(f"There is no export target {target}; targets: {', '.join(TARGETS)}.")
    kind, given = TARGETS[target], dict(options or {})
    _check_options(kind, given)
    files = kind.files(Path(out))
    source = read_controller(path)
    replaced = check_files(kind, files, path) if not kind.is_folder else _check_folder(Path(out), path)
    signed_by = (trust or Trust()).verify(source)
    if kind.runs_same_law:
        check_law(source, progress)
    request = ExportRequest(source=source, out=Path(out), options=given, signed_by=signed_by, progress=progress)
    _check_period(kind, request)
    try:
        rendered = kind.render(request)
    except MissingOrientationError as error:
        raise _with_orientation(error, kind, request) from error
    except InfeasibleError as error:
        raise _with_commands(error, kind, request) from error
    if kind.is_folder:
        names = (file.relative_to(out).as_posix() for file in files)
        write_folder(Path(out), dict(zip(names, cast("tuple[str, ...]", rendered.texts), strict=True)))
    else:
        for file, text in zip(files, rendered.texts, strict=True):
            write_atomic(file, text)
    following = None if kind.following is None else kind.following(request)
    return Exported(target=kind, source=source, rendered=rendered, replaced=replaced, following=following)


def check_files(target: ExportTarget, files: tuple[Path, ...], source: Path | str) -> tuple[Path, ...]:
    """Return the files of an earlier export that will be replaced; raises UsageError where another file is."""
    for file in files:
        check_target(file, [source], kind=f"export to {target.name}", is_own=target.is_own)
    return tuple(file for file in files if file.is_file() and file.stat().st_size > 0)


def _check_period(target: ExportTarget, request: ExportRequest) -> None:
    """Raise UsageError for a file of another period than the one that the target has of its own."""
    own, h = target.sample_time_s, request.source.controller.sample_time_s
    if own is not None and abs(h / own - 1.0) > _SAME_PERIOD:
        problem = request.source.controller.provenance.get("options", {}).get("problem")
        commands = _commands(target, request, problem)
        raise UsageError(
            f"{target.name} runs every {own * 1e3:g} ms whatever the cell does, and {request.source.path} is for "
            f"{h * 1e3:g} ms; what is certified for one period is not for another. Design for it: run "
            f"{'; '.join(commands)}",
            to_paste=commands,
        )


def _with_orientation(error: UsageError, target: ExportTarget, request: ExportRequest) -> UsageError:
    """Return the error with the command for a tool that points down, and the two that design in the target's law."""
    downwards = replace(request, options={**request.options, **DOWNWARDS})
    plain = export_command(target, request.source.path, request.out, downwards.options)
    problem = request.source.controller.provenance.get("options", {}).get("problem")
    designed = _commands(target, downwards, problem)
    return UsageError(
        f"{error} For a tool that points down run {plain}; where this law is beyond that controller, design in the law "
        f"that it runs: {'; '.join(designed)}",
        to_paste=(plain, *designed),
    )


def _with_commands(error: InfeasibleError, target: ExportTarget, request: ExportRequest) -> InfeasibleError:
    """Return the error with the lines that are enough and the two commands that lead to the export."""
    if not error.suggestion:
        return error
    lines = f"{lines_for(request.source.controller, error.suggestion)}: {'; '.join(lines_to_paste(error.suggestion))}"
    commands = _commands(target, request, "problem.yaml")
    return InfeasibleError(
        f"{error} {lines} and run {'; '.join(commands)}",
        error.relaxations,
        suggestion=error.suggestion,
        to_paste=commands,
    )


def _commands(target: ExportTarget, request: ExportRequest, problem: str | None) -> tuple[str, str]:
    """Return the two commands that design for the target and export to it, with the options that were given."""
    design = design_command(target, request.source.controller, problem)
    return design, export_command(target, DESIGNED, request.out, request.options)


def _check_folder(out: Path, source: Path | str) -> tuple[Path, ...]:
    """Return the folder of an earlier export that will be replaced; raises UsageError where another one is."""
    return (out,) if check_folder(out, source) else ()


def _check_options(target: ExportTarget, given: Mapping[str, Any]) -> None:
    known = {option.name: option.flag for option in target.options}
    unknown = sorted(f"--{name.replace('_', '-')}" for name in given if name not in known)
    if unknown:
        there_are = f"its options: {', '.join(known.values())}" if known else "it takes no options"
        raise UsageError(f"The target {target.name} has no option {', '.join(unknown)}; {there_are}.")


def check_law(source: ControllerFile, progress: Callable[[float], None] | None = None) -> None:
    """Raise CertificateError unless the law is stable, has its margins at the recorded plants, and keeps its limits.

    Stable over the whole domain, and within the limits in the hardest of the predicted contacts. The checksum can be
    made anew by anybody; what a law does cannot.
    """
    try:
        validate_controller(source.controller, progress, is_short=True).require()
    except CertificateError as reason:
        raise CertificateError(f"{source.path} is false, so nothing is exported from it: {reason}") from reason


def check_folder(folder: Path, source: Path | str) -> bool:
    """Return whether an earlier export will be replaced; raises UsageError where anything else would be lost."""
    check_target(folder, [source])
    if not folder.exists():
        return False
    advice = "so it is not replaced; name another folder with -o"
    if not folder.is_dir():
        raise UsageError(f"{folder} is a file, and this export is a folder, {advice}.")
    present = {str(each.relative_to(folder)) for each in folder.rglob("*") if not each.is_dir() or each.is_symlink()}
    if not present:
        return False
    if LIST not in present:
        raise UsageError(f"{folder} exists and is no earlier export, {advice}.")
    digests = _digests(folder / LIST)
    strange = sorted(present - {LIST} - set(digests))
    if strange:
        raise UsageError(f"{folder} holds {strange[0]} beside an earlier export, which would be lost, {advice}.")
    changed = [name for name in sorted(present - {LIST}) if _digest((folder / name).read_bytes()) != digests[name]]
    if changed:
        raise UsageError(f"{folder / changed[0]} was changed since it was exported, {advice}.")
    return True


def write_folder(folder: Path, texts: Mapping[str, str]) -> None:
    """Write the texts by their names inside of the folder, and their list, in one step."""
    digests = {name: _digest(text.encode()) for name, text in texts.items()}
    listed = dump_yaml({"format": _FORMAT, "version": 1, "files": digests})
    write_folder_atomic(folder, {**texts, LIST: listed})


def _digests(path: Path) -> dict[str, str]:
    try:
        tree = load_yaml(path, error=UsageError)
    except AutotuneError:
        tree = {}
    found = tree.get("files")
    if tree.get("format") != _FORMAT or not isinstance(found, dict):
        raise UsageError(
            f"{path} is no list of an export, so {path.parent} is not replaced; name another folder with -o."
        )
    return {str(name): str(digest) for name, digest in found.items()}


def _digest(data: bytes) -> str:
    return sha256(data).hexdigest()
