"""Which logs of which cells a campaign works on: a folder, a CSV table, or a YAML file."""

import csv
import re
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from autotune.errors import UsageError
from autotune.formats.cell import read_cell
from autotune.formats.kinds import check_kind, is_log
from autotune.formats.problem import read_problem
from autotune.formats.schema import check_document, check_format
from autotune.formats.yaml12 import load_document
from problems.frozen import freeze

from .options import OPTION_NAMES, read_options

STATE = "campaign.sqlite"
TABLES = ("campaign.csv", "campaign.parquet")
CELLS = "cells"
"""What a campaign writes into its folder, which may be the folder of the logs, or in it."""
_COLUMNS = ("cell", "log", "run", "cell_file", "problem", "controller")
_FILES = ("cell_file", "problem", "controller")
_NAME = re.compile(r"[\w.+-][\w .+-]*")
_BESIDE = ("cell.yaml", "problem.yaml", "controller.yaml")
_LEAST_REST_S = 5.0


@dataclass(frozen=True, kw_only=True)
class LoggedRun:
    """One recording of one cell, and the files that say more of it; `controller` is what runs there today.

    `options` are the fields of `RunOptions` that the manifest says of it, in the place of those of the campaign.
    """

    cell: str
    run: str
    logs: tuple[Path, ...]
    cell_file: Path | None = None
    problem: Path | None = None
    controller: Path | None = None
    options: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        freeze(self, "options")

    @property
    def name(self) -> str:
        """Cell and run, as in messages and as the folder of the results."""
        return f"{self.cell}/{self.run}"

    def in_any_folder(self) -> "LoggedRun":
        """Return the run with absolute paths, for processes that have another current folder."""
        said = (None if path is None else path.absolute() for path in (self.cell_file, self.problem, self.controller))
        cell_file, problem, controller = said
        logs = tuple(path.absolute() for path in self.logs)
        return replace(self, logs=logs, cell_file=cell_file, problem=problem, controller=controller)


def read_manifest(
    path: Path, *, may_be_empty: bool = False, note: Callable[[str], None] | None = None
) -> tuple[LoggedRun, ...]:
    """Return the runs that a manifest names, in its order, or those of a folder, by their names.

    Of a folder every folder in it is a cell and its logs are runs of that cell; a log in the folder itself is a cell of
    its own. A `cell.yaml`, `problem.yaml` or `controller.yaml` beside the logs is used, else that of the folder itself.
    `note` is called with a sentence about logs in deeper folders, which are no runs.

    Raises UsageError: the manifest, a `cell.yaml` or a `problem.yaml` cannot be read; it names nothing (unless it
    `may_be_empty`), a file that is not there, or a run twice.
    """
    if not path.exists():
        raise UsageError(f"{path} is not there; name a folder of logs, a CSV or a YAML file that names them.")
    passed_over: list[Path] = []
    if path.is_dir():
        runs = list(_of_folder(path, passed_over))
    elif path.suffix.lower() == ".csv":
        runs = list(_of_table(path))
    else:
        runs = list(_of_document(path))
    deeper = _passed_over_text(passed_over)
    if not (runs or may_be_empty):
        what = deeper or "A folder holds them or folders of them, a manifest a run in each row."
        raise UsageError(f"{path} names no logs. {what}")
    if deeper and note is not None:
        note(deeper)
    seen: set[str] = set()
    for run in runs:
        if run.name in seen:
            raise UsageError(f"{path} names {run.name} twice; give each run of a cell a name of its own.")
        seen.add(run.name)
    _check_settings(runs)
    return tuple(runs)


def _check_settings(runs: Iterable[LoggedRun]) -> None:
    """Raise UsageError for a `cell.yaml` or `problem.yaml` that cannot be read: refusals would replace results."""
    for path in dict.fromkeys(run.cell_file for run in runs if run.cell_file is not None):
        read_cell(path)
    for path in dict.fromkeys(run.problem for run in runs if run.problem is not None):
        read_problem(path)


class LogWatch:
    """Polls the runs of a manifest, and separates those whose logs may still grow.

    A log rests when it is as it was at the look before, and was last changed `rest_s` ago or earlier: the time between
    two looks, but at least 5 s. At the first look, or where its time lies in the future, one of both must do.
    """

    def __init__(self, interval_s: float) -> None:
        self.rest_s = max(interval_s, _LEAST_REST_S)
        self._seen: dict[str, tuple[int, int] | None] | None = None
        self._waiting: set[str] = set()

    def look(self, runs: Sequence[LoggedRun]) -> tuple[tuple[LoggedRun, ...], tuple[str, ...]]:
        """Return the runs whose logs rest, and the names of those that wait and did not at the look before."""
        now_ns, before = time.time_ns(), self._seen
        self._seen = {run.name: _state(run) for run in runs}
        rested = tuple(run for run in runs if self._rests(self._seen[run.name], run.name, before, now_ns))
        waiting = {run.name for run in runs} - {run.name for run in rested}
        new = tuple(run.name for run in runs if run.name in waiting - self._waiting)
        self._waiting = waiting
        return rested, new

    def _rests(
        self,
        state: tuple[int, int] | None,
        name: str,
        before: Mapping[str, tuple[int, int] | None] | None,
        now_ns: int,
    ) -> bool:
        is_old = state is not None and state[1] <= now_ns - round(1e9 * self.rest_s)
        if state is None or before is None:
            return is_old
        return before.get(name) == state and (is_old or state[1] > now_ns)


def _state(run: LoggedRun) -> tuple[int, int] | None:
    """Return the size of the logs of a run and when they were last changed [ns]; None where one cannot be looked at."""
    try:
        found = [each.stat() for log in run.logs for each in (log, *(log.rglob("*") if log.is_dir() else ()))]
    except OSError:
        return None
    return sum(each.st_size for each in found), max(each.st_mtime_ns for each in found)


# What is a log by its name alone: one that is empty or damaged from its beginning on is refused, not passed over.
_RECORDED = frozenset({".mcap", ".bag", ".db3"})
# What is still being written or copied, whatever it begins with.
_UNFINISHED = frozenset({".part", ".partial", ".tmp", ".active", ".crdownload", ".filepart"})


def _of_folder(folder: Path, passed_over: list[Path]) -> Iterator[LoggedRun]:
    """Yield the runs of a folder, and put the logs that lie too deep in it into `passed_over`."""
    for entry in _entries(folder):
        if _is_run(entry):
            yield _beside(LoggedRun(cell=entry.stem, run=entry.stem, logs=(entry,)), folder, folder)
        elif entry.is_dir():
            for each in _entries(entry):
                if _is_run(each):
                    yield _beside(LoggedRun(cell=entry.name, run=each.stem, logs=(each,)), entry, folder)
                else:
                    passed_over.extend(_logs_below(each))


def _entries(folder: Path) -> list[Path]:
    """Return what is in a folder, without what is hidden and what a campaign has written there."""
    found = sorted(each for each in folder.iterdir() if not each.name.startswith("."))
    names = {each.name for each in found}
    if STATE in names or {CELLS, TABLES[0]} <= names:
        found = [each for each in found if each.name not in (STATE, *TABLES, CELLS)]
    return found


def _logs_below(path: Path) -> Iterator[Path]:
    """Yield the logs in a folder and in those in it; a folder that cannot be read, or a link to one, has none."""
    try:
        entries = _entries(path) if path.is_dir() and not path.is_symlink() else []
    except OSError:
        return
    for each in entries:
        if _is_run(each):
            yield each
        else:
            yield from _logs_below(each)


def _passed_over_text(logs: Sequence[Path]) -> str:
    """Say which logs lie too deep, "" for none."""
    if not logs:
        return ""
    return (
        f"Passed over {len(logs)} log{'' if len(logs) == 1 else 's'} deeper than in the folder of a cell, the first "
        f"{logs[0]}: move them up, or name them in a CSV or YAML file."
    )


def _is_run(path: Path) -> bool:
    """Return whether a path is a log: a file that begins as one or has its name, or a ROS 2 bag's folder."""
    if path.is_dir():
        return (path / "metadata.yaml").is_file()
    if path.name.startswith(".") or path.suffix.lower() in _UNFINISHED or not path.is_file():
        return False
    return path.suffix.lower() in _RECORDED or is_log(path)


def _beside(run: LoggedRun, *folders: Path) -> LoggedRun:
    """Return the run with the files that lie in the first of the folders that has them."""
    found = [next((each / name for each in folders if (each / name).is_file()), None) for name in _BESIDE]
    return replace(run, cell_file=found[0], problem=found[1], controller=found[2])


def _of_table(path: Path) -> Iterator[LoggedRun]:
    try:
        with path.open(encoding="utf-8-sig", newline="") as stream:
            reader = csv.DictReader(stream)
            unknown = [name for name in reader.fieldnames or () if name not in (*_COLUMNS, *OPTION_NAMES)]
            if unknown or not {"cell", "log"} <= set(reader.fieldnames or ()):
                raise UsageError(
                    f"{path} must have the columns cell and log, and may have {', '.join(_COLUMNS[2:])}, and the "
                    f"options {', '.join(OPTION_NAMES)}; found {', '.join(reader.fieldnames or ()) or 'none'}"
                    f"{'; columns are parted by commas' if ';' in ''.join(reader.fieldnames or ()) else ''}."
                )
            for row in reader:
                entry = {key: value for key, value in row.items() if value}
                options = {name: entry.pop(name) for name in OPTION_NAMES if name in entry}
                yield _run(path, f"line {reader.line_num}", {**entry, "options": options})
    except UnicodeDecodeError as error:
        byte = f"{error.object[error.start]:#04x}"
        raise UsageError(f"{path} must be UTF-8, found the byte {byte}; save it as UTF-8 (`CSV UTF-8`).") from error
    except (OSError, csv.Error) as error:
        raise UsageError(f"{path} cannot be read: {getattr(error, 'strerror', None) or error}.") from error


def _of_document(path: Path) -> Iterator[LoggedRun]:
    check_kind(path, ("campaign",))
    document = load_document(path, error=UsageError)
    check_format(document, "campaign")
    check_document(document, "campaign")
    for number, entry in enumerate(document.tree["runs"], 1):
        yield _run(path, f"run {number}", entry)


def _run(path: Path, where: str, entry: Mapping[str, Any]) -> LoggedRun:
    said = entry.get("log", "")
    logs = tuple(path.parent / each for each in (said.split(";") if isinstance(said, str) else said) if each)
    cell = entry.get("cell", "")
    run = entry.get("run") or (logs[0].stem if logs else "")
    for what, name in (("cell", cell), ("run", run)):
        if not _NAME.fullmatch(name) or set(name) <= {"."}:
            raise UsageError(
                f"{path}, {where}: the name of a {what} must be letters, digits, spaces, _ . + -, begin with no space, "
                f"and not be dots alone; found {name!r}."
            )
    files = {key: path.parent / entry[key] for key in _FILES if entry.get(key)}
    for file in (*logs, *files.values()):
        if not file.exists():
            raise UsageError(f"{path}, {where}: {file} is not there.")
    if not logs:
        raise UsageError(f"{path}, {where}: no log is named.")
    options = read_options(f"{path}, {where}", entry.get("options", {}), path.parent)
    return LoggedRun(cell=cell, run=run, logs=logs, options=options, **files)
