"""A log that was read: its signals and health; reading one, and simulating one to try everything else on."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from filecmp import cmp
from pathlib import Path
from shlex import quote
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import numpy as np

from autotune.arguments import count, errors_in_arguments, file_path, file_paths, in_arguments, truth
from autotune.errors import UsageError
from autotune.formats.atomic import check_target
from autotune.formats.cell import CellFile, read_cell
from autotune.formats.kinds import is_log, name_of
from autotune.pipeline import IdentifyOptions
from autotune.results import finding_notes
from autotune.shown import ResultTable, Shown, data_frame, plain_tree
from identification.errors import EstimateError, LogError
from identification.logs.read import Instant
from identification.logs.summary import LogSummary
from identification.signals.recording import Recording
from problems.errors import shown

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from autotune.charts.show import AxesLike

Paths = str | Path | Sequence[str | Path]


@dataclass(frozen=True, kw_only=True, repr=False, eq=False)
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
    options
        How it was read: `cell.yaml`, channels that were named, and whether a damaged log was read as far as it goes.

    """

    paths: tuple[Path, ...]
    summary: LogSummary
    recording: Recording | None = None
    options: IdentifyOptions = field(default_factory=IdentifyOptions)

    @property
    def roles(self) -> dict[str, str | None]:
        """Which topic serves which role; None where none does."""
        return {each.role.value: each.topic for each in self.summary.roles}

    @property
    def missing(self) -> tuple[str, ...]:
        """One sentence for each thing that `identify` lacks."""
        return tuple(map(in_arguments, self.summary.missing))

    @property
    def duration(self) -> float:
        """How long the log is [s]."""
        return 1e-9 * (self.summary.end_ns - self.summary.start_ns)

    def _headline(self) -> str:
        names = ", ".join(map(name_of, self.paths))
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
        return finding_notes(self.summary.findings)

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
        from autotune.charts.show import show  # noqa: PLC0415 - matplotlib, which only who draws pays
        from autotune.figures import log_chart  # noqa: PLC0415

        return show(log_chart(self._signals()), ax)


@errors_in_arguments()
def read_log(
    paths: Paths,
    *,
    cell: str | Path | CellFile | None = None,
    wrench_topic: str | None = None,
    pose_topic: str | None = None,
    command_topic: str | None = None,
    salvage: bool = False,
    urdf: str | Path | None = None,
    tip: str | None = None,
    start: Instant | None = None,
    stop: Instant | None = None,
) -> Log:
    """Read a log: what its channels are used for, their health, and the signals.

    Parameters
    ----------
    paths
        An MCAP, a rosbag2 folder, a ROS 1 bag, a CSV or Parquet table, or the parts of one recording.
    cell
        What the log cannot say of itself: a `cell.yaml`.
    wrench_topic, pose_topic, command_topic
        Channels of wrench, measured and commanded flange pose; found by type and name unless they are said.
    salvage
        Read what a damaged log still holds.
    urdf, tip
        The URDF through which joint positions are a pose, where the log has no other, and the link whose pose it is
        (extra `urdf`).
    start, stop
        The part that is read: seconds after the log's start (12.5), or with @ a stamp in seconds ("@1700000012.5").

    Returns
    -------
    Log
        With `missing` where it lacks what `identify` needs.

    Raises
    ------
    LogError
        A file is damaged or no log.
    UsageError
        `cell.yaml` cannot be used.

    Examples
    --------
    >>> import autotune as at
    >>> path = at.simulate_log("run7.mcap")
    >>> log = at.read_log(path)
    >>> log.roles["wrench"]
    '/ft_sensor/wrench'

    """
    from identification.logs.inspect import inspect_log  # noqa: PLC0415 - compiles
    from identification.logs.read import read_checked_recording  # noqa: PLC0415 - compiles

    files = file_paths("paths", paths)
    for name, topic in (("wrench_topic", wrench_topic), ("pose_topic", pose_topic), ("command_topic", command_topic)):
        if topic is not None and not isinstance(topic, str):
            raise UsageError(f"{name} must be the name of a channel, found {shown(topic)}.")
    options = IdentifyOptions(
        cell=cell_file(cell),
        wrench_topic=wrench_topic,
        pose_topic=pose_topic,
        command_topic=command_topic,
        salvage=truth("salvage", salvage),
        urdf=None if urdf is None else str(urdf),
        tip=tip,
        start=start,
        stop=stop,
    )
    declared, span = options.declared(), options.span
    recording, findings = None, None
    with suppress(LogError, EstimateError):  # What is wrong is said by the summary, or raised by it.
        recording = read_checked_recording(files, declared, salvage=salvage, span=span)
        findings = recording.findings
    summary = inspect_log(files, declared, salvage=salvage, span=span, reading=findings)
    return Log(paths=files, summary=summary, recording=recording, options=options)


def simulate_log(
    path: str | Path, *, seed: int = 0, overwrite: bool = False, progress: Callable[[float], None] | None = None
) -> Path:
    """Simulate a cell and write its log, to try everything else on.

    Parameters
    ----------
    path
        The MCAP file to write. One that this function wrote with the same seed is left as it is.
    seed
        The same seed gives the same log.
    overwrite
        Replace whatever file has this name.
    progress
        A callable that takes the share of the work done since its last call.

    Returns
    -------
    pathlib.Path
        The file: 44 s of poses at rest, a commanded sweep and four contacts along x, with 16.2 kg.

    Raises
    ------
    UsageError
        The file cannot be written, or another one has the name and not `overwrite`.

    """
    target, seed = file_path("path", path), count("seed", seed)
    is_there = target.is_file() and target.stat().st_size > 0
    if not is_there:
        check_target(target, kind="simulated log", option="path")
    from autotune.simulation.phases import Program  # noqa: PLC0415 - compiles
    from autotune.simulation.simulate import simulate_cell  # noqa: PLC0415
    from autotune.simulation.truth import SimulatedCell  # noqa: PLC0415
    from autotune.simulation.write import write_mcap  # noqa: PLC0415

    run = simulate_cell(SimulatedCell(), Program(), seed=seed)
    signals = (run.recording.wrench, run.recording.pose, run.recording.command)
    share = 1.0 / sum(len(signal.stamp_ns) for signal in signals if signal is not None)
    report = None if progress is None else lambda n: progress(share * n)
    if not is_there or overwrite:
        write_mcap(run.recording, target, progress=report)
        return target
    with TemporaryDirectory() as folder:
        again = Path(folder) / target.name
        write_mcap(run.recording, again, progress=report)
        if not cmp(again, target, shallow=False):
            raise UsageError(f"{target} exists and is not replaced; name another file, or say overwrite=True.")
    return target


def cell_file(cell: "str | Path | CellFile | None") -> CellFile | None:
    """Return a `cell.yaml` that was read, None for none; raises UsageError for anything else."""
    return cell if cell is None or isinstance(cell, CellFile) else read_cell(file_path("cell", cell))


def refuse_log(given: object) -> None:
    """Raise UsageError, with the call that helps, for a log or its path where what was identified of it is wanted."""
    if isinstance(given, Log):
        raise UsageError("A log must be identified first: say at.identify(log) in its place.")
    try:
        found = isinstance(given, str | Path) and is_log(Path(given))
    except OSError:
        return  # Whoever reads it says why it cannot be read.
    if found:
        call, command = f"at.identify({str(given)!r})", f"autotune identify {quote(str(given))}"
        raise UsageError(f"{given} is a log, which must be identified first: with {call}, or run `{command}`.")
