"""From log files to an identified plant with its provenance."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from autotune.formats.cell import CellFile
from autotune.processes import map_in_processes
from autotune.results import Identification, Topics
from autotune.version import __version__
from identification.advice import advise
from identification.errors import EstimateError, LogError
from identification.evidence import Evidence
from identification.given import Given, check_names
from identification.identify import identify_with_evidence
from identification.logs import read_checked_recording
from identification.logs.parts import separate_runs
from identification.logs.roles.cell import Cell
from identification.logs.roles.interpret import build_frames
from identification.merging.combine import NamedResult, combine_identified
from identification.signals.recording import Recording
from problems.progress import no_progress

_READING_SHARE = 0.25


def identify_log(
    paths: Path | Sequence[Path],
    topics: Topics,
    *,
    cell: CellFile | None = None,
    salvage: bool = False,
    recording: Recording | None = None,
    allow_partial: bool = False,
    defers_refusal: bool = False,
    given: Mapping[str, Given] | None = None,
    processes: int = 1,
    with_evidence: bool = False,
    progress: Callable[[float], None] | None = None,
) -> Identification:
    """Read logs and identify the cell.

    Logs that follow each other within a second are one recording; each recording is identified on its own, `processes`
    of them at a time (`map_in_processes` tells what a script must do for more than one). What they tell is combined
    with each other and with what is `given` from elsewhere. Raises LogError for a log that cannot be used,
    EstimateError when a parameter that a controller needs is missing from all of them or they disagree on one (unless
    `allow_partial`, which keeps the former as unidentifiable and the latter as a widened mean). `defers_refusal` leaves
    that last refusal to whoever asks the result to `require`. `recording` is what the logs hold, where they were read
    as one already. `with_evidence` keeps the signals, for pictures.
    `progress` is told the share of the work done since the last call: stage by stage of one recording, else recording
    by recording.
    """
    report = progress or no_progress
    files = (paths,) if isinstance(paths, Path) else tuple(paths)
    told = topics.applied(cell)
    runs = separate_runs(files, told, salvage=salvage)
    work = partial(
        _identify_run,
        cell=told,
        salvage=salvage,
        # Of several recordings each is identified without: what is known from elsewhere counts once.
        given=dict(given or {}) if len(runs) == 1 else {},
        is_one_of_many=len(runs) > 1,
        with_evidence=with_evidence,
    )
    if len(runs) == 1:
        done = [work(runs[0], recording=recording, report=report)]
    else:
        done = map_in_processes(work, runs, processes, each=lambda: report(1.0 / len(runs)))
    check_names(given or {}, [axis for run in done for axis in run.told.result.axes])
    result = combine_identified([run.told for run in done], given)
    result = replace(result, findings=(*result.findings, *advise(result)))
    options = _options(topics, allow_partial=allow_partial, salvage=salvage, given=given or {})
    found = Identification(
        result=result,
        provenance=_provenance([run.source for run in done], cell, options),
        evidence=tuple(run.evidence for run in done if run.evidence is not None),
        names=tuple(path.name for path in files),
    )
    if not (allow_partial or defers_refusal):
        found.require()
    return found


def _options(topics: Topics, *, allow_partial: bool, salvage: bool, given: Mapping[str, Given]) -> dict[str, object]:
    """Return what the provenance keeps of how it was asked."""
    return {
        "wrench_topic": topics.wrench,
        "pose_topic": topics.pose,
        "command_topic": topics.command,
        "allow_partial": allow_partial,
        "salvage": salvage,
        **({"given": {name: [prior.value, prior.std] for name, prior in given.items()}} if given else {}),
    }


@dataclass(frozen=True, kw_only=True)
class _Source:
    """What the provenance keeps of a recording."""

    channels: Mapping[str, str | None]
    clocks: Mapping[str, str]
    sha256: Mapping[str, str]
    span_s: tuple[float, float]


@dataclass(frozen=True, kw_only=True)
class _Run:
    """What one recording told, and where it comes from; small, so that it passes from process to process."""

    told: NamedResult
    source: _Source
    evidence: Evidence | None


def _identify_run(
    run: tuple[Path, ...],
    *,
    cell: Cell,
    salvage: bool,
    given: Mapping[str, Given],
    is_one_of_many: bool,
    with_evidence: bool,
    recording: Recording | None = None,
    report: Callable[[float], None] | None = None,
) -> _Run:
    """Read and identify one recording; where it is one of many, errors bear its name."""
    report = report or no_progress
    name = ", ".join(path.name for path in run)
    try:
        if recording is None:
            recording = read_checked_recording(run, cell, salvage=salvage)
        report(_READING_SHARE)
        found, evidence = identify_with_evidence(
            recording, build_frames(cell), given, lambda share: report((1.0 - _READING_SHARE) * share)
        )
    except (EstimateError, LogError) as error:
        if not is_one_of_many or name in str(error):
            raise
        raise type(error)(f"{name}: {error}") from error
    found = replace(found, findings=(*recording.findings, *found.findings))
    kept = None if evidence is None or not with_evidence else replace(evidence, log=name, reading=recording.findings)
    told = NamedResult(name=name, result=found, gain_error_share=0.0 if evidence is None else evidence.gain_error_share)
    return _Run(told=told, source=_source(recording), evidence=kept)


def _source(recording: Recording) -> _Source:
    wrench, command = recording.wrench, recording.command
    others = {"twist": recording.twist, "gains": recording.gains, "desired_force": recording.desired_force}
    return _Source(
        channels={
            "wrench": wrench.topic,
            "pose": recording.pose.topic,
            "command": None if command is None else command.topic,
            **{name: signal.topic for name, signal in others.items() if signal is not None},
        },
        clocks=dict(recording.clocks),
        sha256=dict(recording.sha256),
        span_s=(float(wrench.stamp_ns[0]) / 1e9, float(wrench.stamp_ns[-1]) / 1e9),
    )


def _provenance(sources: Sequence[_Source], cell: CellFile | None, options: Mapping[str, Any]) -> dict[str, Any]:
    """Return where the numbers come from; channels and clocks are those of the first recording."""
    first, spans = sources[0], [list(source.span_s) for source in sources]
    logs = [(path, digest) for source in sources for path, digest in source.sha256.items()]
    return {
        "tool": f"autotune {__version__}",
        "logs": [{"path": path, "sha256": digest} for path, digest in logs],
        "cell": None if cell is None else {"path": str(cell.path), "sha256": cell.sha256},
        "channels": dict(first.channels),
        "clocks": dict(first.clocks),
        "time_span_s": spans[0],
        **({"recordings": spans} if len(spans) > 1 else {}),
        "options": dict(options),
    }
