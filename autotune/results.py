"""What the Python interface returns of a log: its signals and health, and the plant identified from it."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from hashlib import sha256
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from autotune.errors import UsageError
from autotune.formats.atomic import check_target
from autotune.formats.cell import CellFile
from autotune.formats.identified import IN_MEMORY, IdentifiedFile, identified_tree, write_identified
from autotune.formats.yaml12 import dump_yaml
from autotune.shown import ResultTable, Shown, data_frame, plain_tree
from autotune.text import parameter_rows
from identification.errors import EstimateError
from identification.evidence import Evidence
from identification.logs.roles.cell import Cell
from identification.logs.summary import LogSummary
from identification.result import Finding, Identified
from identification.signals.recording import Recording
from problems.frozen import freeze

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from autotune.figures import AxesLike

_CONTRADICTIONS = frozenset({"given-contradicts", "logs-disagree"})
_ALL_THE_SAME = " With --allow-partial what was found is written all the same."
_EXPLAINING = frozenset({"clock-offset", "hand-in-contact", "rests-without-spring", "mass-disagreement"})


def _notes(findings: Sequence[Finding]) -> list[str]:
    return [f"{each.severity}: {each.message} {each.advice}".rstrip() for each in findings if each.severity != "info"]


@dataclass(frozen=True, kw_only=True)
class Topics:
    """Channels named by the user; None where they are to be found by type and name."""

    wrench: str | None = None
    pose: str | None = None
    command: str | None = None

    def applied(self, cell: CellFile | None) -> Cell:
        """Return what is declared of the cell, with these channels."""
        declared = Cell() if cell is None else cell.cell
        return declared.with_topics(wrench=self.wrench, pose=self.pose, command=self.command)


@dataclass(frozen=True, kw_only=True, repr=False)
class Log(Shown):
    """A log that was read: what its channels are used for, their health, and the signals.

    Attributes
    ----------
    paths
        The files, parts of one recording.
    summary
        Channels, roles, rates, clocks and findings, as `autotune inspect` prints them.
    recording
        The signals in SI on one clock; None where the log lacks what `identify` needs (`missing` says what).
    cell
        The `cell.yaml` that was given.
    topics
        Channels that were named.
    salvage
        Whether a damaged log was read as far as it goes.

    """

    paths: tuple[Path, ...]
    summary: LogSummary
    recording: Recording | None = None
    cell: CellFile | None = None
    topics: Topics = field(default_factory=Topics)
    salvage: bool = False

    @property
    def roles(self) -> dict[str, str | None]:
        """Which topic serves which role; None where none does."""
        return {each.role.value: each.topic for each in self.summary.roles}

    @property
    def missing(self) -> tuple[str, ...]:
        """One sentence for each thing that `identify` lacks."""
        return self.summary.missing

    @property
    def duration(self) -> float:
        """How long the log is [s]."""
        return 1e-9 * (self.summary.end_ns - self.summary.start_ns)

    def _headline(self) -> str:
        names = ", ".join(path.name for path in self.paths)
        what = "lacks " + " ".join(self.missing) if self.missing else "ready to identify"
        return f"Log {names}: {self.duration:.1f} s, {len(self.summary.channels)} channels, {what}"

    def _tables(self) -> Iterator[ResultTable]:
        roles = {each.topic: each.role.value for each in self.summary.roles if each.topic is not None}
        yield ResultTable(
            title="channels",
            columns=("topic", "type", "role", "messages", "rate [Hz]", "largest gap [ms]"),
            rows=tuple(
                (
                    each.topic,
                    each.type,
                    roles.get(each.topic, ""),
                    str(each.count),
                    "-" if each.rate_hz is None else f"{each.rate_hz:.4g}",
                    "-" if each.max_gap_s is None else f"{1e3 * each.max_gap_s:.4g}",
                )
                for each in self.summary.channels
            ),
        )

    def _notes(self) -> Sequence[str]:
        return _notes(self.summary.findings)

    def to_dict(self) -> dict[str, Any]:
        """Return the summary as plain data: channels, roles, findings, digests."""
        return dict(plain_tree(self.summary))

    def _signals(self) -> Recording:
        if self.recording is None:
            raise UsageError(f"{self._headline()}; its signals cannot be read into one table.")
        return self.recording

    def to_pandas(self) -> Any:
        """Return the signals as a pandas.DataFrame over the time [s] from the first wrench on.

        Columns are `wrench.fx` … `wrench.tz` [N, N·m], `pose.x` … `pose.qw` [m, quaternion] and, where the log has a
        command, `command.x` …; each channel keeps its own stamps, and where another one has none its columns are NaN.

        Raises
        ------
        UsageError
            pandas is not installed, or the log lacks what `identify` needs.

        """
        recording = self._signals()
        wrench, start = recording.wrench, int(recording.wrench.stamp_ns[0])
        parts = [("wrench", wrench.stamp_ns, np.hstack([wrench.force_n, wrench.torque_n_m]), "fx fy fz tx ty tz")]
        for name, pose in (("pose", recording.pose), ("command", recording.command)):
            if pose is not None:
                values = np.hstack([pose.position_m, pose.quaternion_xyzw])
                parts.append((name, pose.stamp_ns, values, "x y z qx qy qz qw"))
        every = np.unique(np.concatenate([stamps for _, stamps, _, _ in parts]))
        columns = {}
        for name, stamps, values, names in parts:
            rows = np.searchsorted(every, stamps)
            for i, each in enumerate(names.split()):
                column = np.full(len(every), np.nan)
                column[rows] = values[:, i]
                columns[f"{name}.{each}"] = column
        return data_frame(columns, 1e-9 * (every - start), "time [s]")

    def plot(self, ax: "AxesLike | None" = None) -> "Figure":
        """Draw force, torque and path of the flange over time; on a single `ax` the force alone."""
        from autotune.figures import log_chart, show  # noqa: PLC0415 - matplotlib, which only who draws pays

        return show(log_chart(self._signals()), ax)


@dataclass(frozen=True, kw_only=True, repr=False)
class Identification(Shown):
    """Plant parameters with deviations and verdicts, and where they come from.

    Attributes
    ----------
    result
        Payload, sensor and axes, every parameter as an `Estimate` with value, std and status.
    provenance
        Logs, digests, channels, clocks and options: the `provenance` of `identified.yaml`.
    evidence
        The signals of each recording where they were kept, in the order of `result.timelines`.
    names
        Names of the logs.
    path
        The file that it was loaded from; None where it was identified here.
    sha256
        Digest of that file.

    """

    result: Identified
    provenance: Mapping[str, Any]
    evidence: tuple[Evidence, ...] = ()
    names: tuple[str, ...] = ()
    path: Path | None = None
    sha256: str | None = None

    def __post_init__(self) -> None:
        freeze(self, "provenance")

    def require(self) -> None:
        """Raise EstimateError where a parameter that a controller needs is missing, or logs disagree on one."""
        if any(finding.severity == "error" for finding in self.result.findings):
            raise EstimateError(_refusal(self.names, self.result.findings))

    def _headline(self) -> str:
        axes = ", ".join(self.result.axes) or "none"
        return f"Identification of {', '.join(self.names) or 'a plant'}: axes {axes}"

    def _tables(self) -> Iterator[ResultTable]:
        yield ResultTable(
            title="parameters",
            columns=("parameter", "value", "± std", "unit", "verdict"),
            rows=tuple((row.name, row.value, row.std, row.unit, row.verdict) for row in parameter_rows(self.result)),
        )

    def _notes(self) -> Sequence[str]:
        return _notes(self.result.findings)

    def to_dict(self) -> dict[str, Any]:
        """Return the tree of `identified.yaml`."""
        return identified_tree(self.result, self.provenance)

    def to_pandas(self) -> Any:
        """Return the parameters as a pandas.DataFrame, numbers as printed; raises UsageError without pandas."""
        rows = list(parameter_rows(self.result))
        names = ("value", "std", "unit", "verdict", "method", "note")
        return data_frame({name: [getattr(row, name) for row in rows] for name in names}, [r.name for r in rows])

    def save(self, path: Path | str) -> None:
        """Write `identified.yaml` in one step.

        Raises UsageError where it cannot be written, or a file of another kind would be lost.
        """
        check_target(path, kind="identified", option="path")
        write_identified(path, self.result, self.provenance)

    def file(self) -> IdentifiedFile:
        """Return it as a file is handed on: with the digest of the bytes that `save` would write."""
        path = self.path or IN_MEMORY
        digest = self.sha256 or sha256(dump_yaml(self.to_dict()).encode()).hexdigest()
        return IdentifiedFile(result=self.result, provenance=self.provenance, path=path, sha256=digest)


def _refusal(names: Sequence[str], findings: Sequence[Finding]) -> str:
    """Return one sentence: a contradiction first, since what is missing may follow from it; then what explains it."""
    missing = [finding for finding in findings if finding.severity == "error"]
    missing = sorted(missing, key=lambda finding: finding.code not in _CONTRADICTIONS)
    first = missing[0]
    alike = [finding.message for finding in missing[1:] if finding.code == first.code]
    rest = [finding.code for finding in missing[1:] if finding.code != first.code]
    others = (f" Also: {' '.join(alike)}" if alike else "") + (f" (And {', '.join(rest)}.)" if rest else "")
    noticed = [finding.message for finding in findings if finding.code in _EXPLAINING and finding.severity != "info"]
    others += f" Noticed: {' '.join(noticed)}" if noticed else ""
    return f"{', '.join(names)}: {first.message} {first.advice}".rstrip() + others + _ALL_THE_SAME
