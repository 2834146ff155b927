"""From log files to an identified plant with its provenance."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import partial
from pathlib import Path
from typing import Any

from autotune.formats.cell import CellFile
from autotune.formats.kinds import name_of
from autotune.pieces import LogPiece, PieceOutcome, PieceRun, RunSource, pieces_of, telling, work_on_windows
from autotune.processes import map_in_processes
from autotune.results import Identification
from autotune.version import __version__
from autotune.windows import Window, window_findings
from identification.advice import advise
from identification.axis_findings import CLOCKS_AGREE
from identification.errors import EstimateError, LogError, OutsideSpanError
from identification.given import Given, check_names
from identification.identify import identify_with_evidence
from identification.logs.containers.formats import digests, sha256_of
from identification.logs.read import (
    Instant,
    LogSpan,
    read_checked_recording,
    separate_runs,
)
from identification.logs.recording import build_frames
from identification.logs.roles.cell import Cell
from identification.merging.combine import NamedResult, combine_identified
from identification.result import Finding, Identified
from identification.signals.recording import Recording
from problems.frozen import freeze
from problems.progress import no_progress

_READING_SHARE = 0.25
_ABSOLUTE_S = 1e8
_ONLY_WHERE_GIVEN = ("urdf", "tip", "start", "stop", "gains", "windows_s")
"""Options that a file without them was identified without."""


@dataclass(frozen=True, kw_only=True)
class IdentifyOptions:
    """How logs are read and what is made of them: what the provenance keeps of how `identify` was called.

    An option that is added here is in the provenance, and is used again where a report is made from a file.

    Parameters
    ----------
    cell
        The `cell.yaml`, of which the provenance keeps path and digest instead.
    wrench_topic, pose_topic, command_topic
        Channels named by the user; None where they are to be found by type and name.
    allow_partial
        Keep a missing parameter as unidentifiable, and a widened mean of what logs disagree on.
    salvage
        Read what a damaged log still holds.
    urdf, tip
        The URDF through which joint positions are a pose, where the log has no other, and the link whose pose it is.
    start, stop
        The part of the log that is read (`LogSpan`); None for its beginning and end.
    given
        What is known from elsewhere, by name as in `mass_kg` or `x.delay_s` [SI].
    gains
        The gains that ran, in the place of numbers in `cell.yaml`: `mass`, `damping` and `lead` [SI].
    windows_s
        Identify windows of this length [s] each on its own, and take those that say most; None reads a log whole up to
        twenty minutes or 100 MB, a longer one in windows of ten minutes.

    """

    cell: CellFile | None = None
    wrench_topic: str | None = None
    pose_topic: str | None = None
    command_topic: str | None = None
    allow_partial: bool = False
    salvage: bool = False
    urdf: str | None = None
    tip: str | None = None
    start: Instant | None = None
    stop: Instant | None = None
    given: Mapping[str, Given] = field(default_factory=dict)
    gains: Mapping[str, float] | None = None
    windows_s: float | None = None

    def __post_init__(self) -> None:
        freeze(self, "given")
        if self.gains is not None:
            freeze(self, "gains")

    @property
    def span(self) -> LogSpan:
        """The part of the log that is read; raises ParameterError where start or stop is no time."""
        return LogSpan(start=self.start, stop=self.stop)

    def declared(self) -> Cell:
        """Return what is declared of the cell, with the channels that were named."""
        cell = Cell() if self.cell is None else self.cell.cell
        cell = cell.with_topics(wrench=self.wrench_topic, pose=self.pose_topic, command=self.command_topic)
        if self.gains is not None:
            cell = cell.with_gains(self.gains)
        return cell.with_urdf(self.urdf, self.tip)

    def tree(self) -> dict[str, Any]:
        """Return the `options` of the provenance: plain data, without the cell and what was not given."""
        given = {name: [prior.value, prior.std] for name, prior in self.given.items()}
        own = {each.name: getattr(self, each.name) for each in fields(self) if each.name not in ("cell", "given")}
        own = {name: value for name, value in own.items() if value is not None or name not in _ONLY_WHERE_GIVEN}
        own |= {} if self.gains is None else {"gains": dict(self.gains)}
        return {**own, **({"given": given} if given else {})}

    @classmethod
    def from_tree(cls, tree: Mapping[str, Any], cell: CellFile | None) -> "IdentifyOptions":
        """Return the options that a provenance holds; what an older file does not have is left at its default."""
        own = {each.name: tree[each.name] for each in fields(cls) if each.name in tree}
        given = {name: Given(value=value, std=std) for name, (value, std) in tree.get("given", {}).items()}
        return cls(**{**own, "given": given, "cell": cell})


def identify_log(
    paths: Path | Sequence[Path],
    options: IdentifyOptions | None = None,
    *,
    recording: Recording | None = None,
    defers_refusal: bool = False,
    processes: int = 1,
    with_evidence: bool = False,
    progress: Callable[[float], None] | None = None,
) -> Identification:
    """Read logs and identify the cell.

    Logs that follow each other within a second are one recording; each recording is identified on its own, and the
    results are combined with each other and with what is given from elsewhere. A recording of over twenty minutes and
    100 MB, and one whose options say so, is identified in windows, of which no more is held in memory than is worked
    on; no signals of them are kept.

    Parameters
    ----------
    paths
        Log files.
    options
        How they are read and what is made of them.
    recording
        What the logs hold, where they were read as one already.
    defers_refusal
        Leave it to the caller to `require` the result, where a parameter is missing or logs disagree.
    processes
        How many recordings at a time (see `map_in_processes` for what a script must do for more than one).
    with_evidence
        Keep the signals, for pictures.
    progress
        Receives the share of the work done since the last call.

    Raises
    ------
    LogError
        A log cannot be used.
    EstimateError
        A parameter that a controller needs is missing from all logs or they disagree on one, and partial results are
        not allowed.
    """
    options = options or IdentifyOptions()
    report = progress or no_progress
    files = (paths,) if isinstance(paths, Path) else tuple(paths)
    cell, given = options.declared(), options.given
    pieces, work = _work_on(files, options, is_read=recording is not None, with_evidence=with_evidence)
    windows: tuple[Window, ...] = ()
    if pieces[0].window is not None:
        done, windows = telling(work_on_windows(pieces, _side_by_side(work, processes, len(pieces), report)))
    elif len(pieces) == 1:
        done = _inside([work(pieces[0], recording=recording, report=report)])
    else:
        done = _inside(_side_by_side(work, processes, len(pieces), report)(pieces))
    check_names(given, [axis for run in done for axis in run.named.result.axes])
    parts = [run.named for run in done]
    result = combine_identified(parts, given)
    if len(parts) > 1:
        from autotune.prediction.left_out_logs import with_left_out_logs  # noqa: PLC0415 - compiles

        result = with_left_out_logs(result, parts, partial(combine_identified, given=given))
    payload = replace(result.payload, contact_points_m=cell.payload.contact_points_m)
    about_windows = window_findings(windows) if windows else ()
    result = replace(result, payload=payload, findings=(*about_windows, *result.findings, *advise(result)))
    found = Identification(
        result=result,
        provenance=_provenance([run.source for run in done], options, windows),
        evidence=tuple(run.evidence for run in done if run.evidence is not None),
        names=tuple(map(name_of, files)),
    )
    if not (options.allow_partial or defers_refusal):
        found.require()
    return found


def identify_windows(
    paths: Sequence[Path], options: IdentifyOptions, *, progress: Callable[[float], None] | None = None
) -> tuple[tuple[str, Identified], ...]:
    """Return what each window of logs shows, by its name, one at a time in memory; nothing of logs that are not long.

    Raises LogError where a log cannot be used, EstimateError where no window shows anything.
    """
    pieces, work = _work_on(tuple(paths), options, is_read=False, with_evidence=False)
    if pieces[0].window is None:
        return ()
    done = work_on_windows(pieces, _side_by_side(work, 1, len(pieces), progress or no_progress))
    telling(done)
    return tuple((piece.name, run.named.result) for piece, run in done if isinstance(run, PieceRun))


def _work_on(
    files: tuple[Path, ...], options: IdentifyOptions, *, is_read: bool, with_evidence: bool
) -> tuple[list[LogPiece], "_Work"]:
    """Return the pieces of logs that are identified on their own, and the work on one of them."""
    cell, pieces = options.declared(), [LogPiece(files=files, span=options.span)]
    if not is_read:
        runs = separate_runs(files, cell, salvage=options.salvage)
        pieces = pieces_of(runs, cell, options.span, width_s=options.windows_s, salvage=options.salvage)
    work = partial(
        _identify_piece,
        cell=cell,
        salvage=options.salvage,
        # Of several recordings each is identified without: what is known from elsewhere counts once; a period is exact.
        given={**_given_by_cell(cell), **(options.given if len(pieces) == 1 else {})},
        is_one_of_many=len(pieces) > 1,
        with_evidence=with_evidence,
    )
    return pieces, work


_Work = Callable[..., PieceOutcome]


def _side_by_side(
    work: _Work, processes: int, count: int, report: Callable[[float], None]
) -> Callable[[Sequence[LogPiece]], list[PieceOutcome]]:
    """Return what works on pieces in processes; `count` of them are all that is reported."""
    left = count

    def done() -> None:
        nonlocal left
        if left:
            left -= 1
            report(1.0 / count)

    return lambda pieces: map_in_processes(work, pieces, processes, each=done)


def _given_by_cell(cell: Cell) -> dict[str, Given]:
    """Return what a cell.yaml declares of a recording's numbers."""
    return {} if cell.sample_time_s is None else {"sample_time_s": Given(value=cell.sample_time_s, std=0.0)}


def _inside(done: Sequence[PieceOutcome]) -> list[PieceRun]:
    """Return what was identified, with a finding for each recording that lies outside the span that was asked for."""
    found = [each for each in done if isinstance(each, PieceRun)]
    outside = [each for each in done if isinstance(each, OutsideSpanError)]
    if not found:
        raise outside[0]
    skipped = tuple(Finding.info("recording-outside", f"Not used: {error}", "") for error in outside)
    named = found[0].named
    result = replace(named.result, findings=(*named.result.findings, *skipped))
    return [replace(found[0], named=replace(named, result=result)), *found[1:]]


def _without_withdrawn(read: Sequence[Finding], found: Sequence[Finding]) -> tuple[Finding, ...]:
    """Return the findings of reading without an offset between clocks that the fit of the axes did not confirm."""
    agree = any(finding.code == CLOCKS_AGREE for finding in found)
    return tuple(finding for finding in read if not (agree and finding.code == "clock-offset"))


def _identify_piece(
    piece: LogPiece,
    *,
    cell: Cell,
    salvage: bool,
    given: Mapping[str, Given],
    is_one_of_many: bool,
    with_evidence: bool,
    recording: Recording | None = None,
    report: Callable[[float], None] | None = None,
) -> PieceOutcome:
    """Read and identify one recording; where it is one of many, errors bear its name.

    A window that identifies nothing, and one of many that lies outside a span of stamps, are no errors yet.
    """
    report, name = report or no_progress, piece.name
    keeps_signals = with_evidence and piece.window is None
    try:
        if recording is None:
            recording = read_checked_recording(piece.files, cell, salvage=salvage, span=piece.span)
        report(_READING_SHARE)
        reading, source = recording.findings, _source(recording, piece.files)
        # Nobody but `identify_with_evidence` holds it then, which lets go of what it no longer needs.
        held, recording = [recording], None
        found, evidence = identify_with_evidence(
            held.pop(),
            build_frames(cell),
            given,
            lambda share: report((1.0 - _READING_SHARE) * share),
            piece.known,
            with_signals=keeps_signals,
        )
    except OutsideSpanError as error:
        if not is_one_of_many or not (piece.span.has_stamps or piece.window):
            raise
        return error
    except (EstimateError, LogError) as error:
        if piece.window is not None:
            return error
        if not is_one_of_many or name in str(error):
            raise
        raise type(error)(f"{name}: {error}") from error
    read = _without_withdrawn(reading, found.findings)
    found = replace(found, findings=(*read, *found.findings))
    kept = replace(evidence, log=name, reading=reading) if evidence is not None and keeps_signals else None
    share = 0.0 if evidence is None else evidence.gain_error_share
    named = NamedResult(name=name, result=found, gain_error_share=share, recorded_s=_end_s(source))
    run = PieceRun(named=named, source=source, evidence=kept)
    if evidence is None or evidence.payload is None:
        return run
    if piece.known:
        return replace(run, payload_from=evidence.payload.source)
    return replace(run, payload=replace(evidence.payload, source=f"window {name}"))


def _end_s(source: RunSource) -> float:
    """Return when a recording ends on an absolute clock, 0 where it counts from its own start."""
    start_s, end_s = source.span_s
    return end_s if start_s > _ABSOLUTE_S else 0.0


def _source(recording: Recording, files: Sequence[Path]) -> RunSource:
    wrench, command, lag = recording.wrench, recording.command, recording.wrench_lag_s
    others = {"twist": recording.twist, "gains": recording.gains, "desired_force": recording.desired_force}
    return RunSource(
        channels={
            "wrench": wrench.topic,
            "pose": recording.pose.topic,
            "command": None if command is None else command.topic,
            **{name: signal.topic for name, signal in others.items() if signal is not None},
        },
        clocks=dict(recording.clocks),
        sha256=dict(recording.sha256) or dict.fromkeys(map(str, files), ""),
        span_s=(float(wrench.stamp_ns[0]) / 1e9, float(wrench.stamp_ns[-1]) / 1e9),
        wrench_offset_s=None if lag is None else (recording.wrench_shifted_s + lag[0], lag[1]),
    )


def _provenance(sources: Sequence[RunSource], options: IdentifyOptions, windows: Sequence[Window]) -> dict[str, Any]:
    """Return where the numbers come from; channels and clocks are those of the first recording."""
    first, spans = sources[0], [list(source.span_s) for source in sources]
    cell, joints = options.cell, options.declared().joints
    said = dict.fromkeys((path, digest) for source in sources for path, digest in source.sha256.items())
    logs = [(path, digest or digests([Path(path)])[path]) for path, digest in said]
    return {
        "tool": f"autotune {__version__}",
        "logs": [{"path": path, "sha256": digest} for path, digest in logs],
        "cell": None if cell is None else {"path": str(cell.path), "sha256": cell.sha256},
        **({} if joints is None else {"urdf": {"path": str(joints.urdf), "sha256": sha256_of(joints.urdf)}}),
        "channels": dict(first.channels),
        "clocks": dict(first.clocks),
        **({} if first.wrench_offset_s is None else {"wrench_offset_s": list(first.wrench_offset_s)}),
        "time_span_s": spans[0],
        **({"recordings": spans} if len(spans) > 1 else {}),
        **({"windows": [each.tree() for each in windows]} if windows else {}),
        "options": options.tree(),
    }
