"""From log files to an identified plant with its provenance."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from autotune import __version__
from autotune.files.cell import CellFile
from identification.advice import advise
from identification.combine import NamedResult, combine_identified
from identification.errors import EstimateError
from identification.given import Given, check_names
from identification.identify import identify_cell
from identification.logs import read_checked_recording
from identification.logs.cell import Cell
from identification.logs.interpret import build_frames
from identification.logs.runs import separate_runs
from identification.recording import Recording
from identification.result import Finding, Identified


@dataclass(frozen=True, kw_only=True)
class Topics:
    """Channels named by the user; None where they are to be found by type and name."""

    wrench: str | None = None
    pose: str | None = None
    command: str | None = None


@dataclass(frozen=True, kw_only=True)
class IdentifiedLog:
    """An identified plant and where it comes from (the `provenance` of `identified.yaml`)."""

    result: Identified
    provenance: Mapping[str, Any]


def identify_log(
    paths: Path | Sequence[Path],
    topics: Topics,
    *,
    cell: CellFile | None = None,
    salvage: bool = False,
    allow_partial: bool = False,
    given: Mapping[str, Given] | None = None,
) -> IdentifiedLog:
    """Read logs and identify the cell.

    Logs that follow each other within a second are one recording; each recording is identified on its own, and what
    they tell is combined with each other and with what is `given` from elsewhere. Raises LogError for a log that cannot
    be used, EstimateError when a parameter that a controller needs is missing from all of them or they disagree on one
    (unless `allow_partial`, which keeps the former as unidentifiable and the latter as a widened mean).
    """
    files = (paths,) if isinstance(paths, Path) else tuple(paths)
    told = (Cell() if cell is None else cell.cell).with_topics(
        wrench=topics.wrench, pose=topics.pose, command=topics.command
    )
    parts, recordings = [], []
    for run in separate_runs(files, told, salvage=salvage):
        recording = read_checked_recording(run, told, salvage=salvage)
        found = identify_cell(recording, build_frames(told), given)
        found = replace(found, findings=(*recording.findings, *found.findings))
        recordings.append(recording)
        parts.append(NamedResult(name=", ".join(path.name for path in run), result=found))
    result = combine_identified(parts)
    check_names(given or {}, result.axes)
    result = replace(result, findings=(*result.findings, *advise(result)))
    missing = [finding for finding in result.findings if finding.severity == "error"]
    if missing and not allow_partial:
        raise EstimateError(_refusal(files, missing))
    options = {
        "wrench_topic": topics.wrench,
        "pose_topic": topics.pose,
        "command_topic": topics.command,
        "allow_partial": allow_partial,
        "salvage": salvage,
        **({"given": {name: [prior.value, prior.std] for name, prior in given.items()}} if given else {}),
    }
    return IdentifiedLog(result=result, provenance=_provenance(recordings, cell, options))


def _refusal(files: Sequence[Path], missing: list[Finding]) -> str:
    first = missing[0]
    others = f" (and {len(missing) - 1} more: {', '.join(f.code for f in missing[1:])})" if len(missing) > 1 else ""
    names = ", ".join(path.name for path in files)
    return f"{names}: {first.message} {first.advice}".rstrip() + others


def _provenance(recordings: Sequence[Recording], cell: CellFile | None, options: Mapping[str, Any]) -> dict[str, Any]:
    """Return where the numbers come from; channels and clocks are those of the first recording."""
    first = recordings[0]
    wrench = first.wrench
    others = {"twist": first.twist, "gains": first.gains, "desired_force": first.desired_force}
    logs = [(path, digest) for recording in recordings for path, digest in recording.sha256.items()]
    spans = [[float(r.wrench.stamp_ns[0]) / 1e9, float(r.wrench.stamp_ns[-1]) / 1e9] for r in recordings]
    return {
        "tool": f"autotune {__version__}",
        "logs": [{"path": path, "sha256": digest} for path, digest in logs],
        "cell": None if cell is None else {"path": str(cell.path), "sha256": cell.sha256},
        "channels": {
            "wrench": wrench.topic,
            "pose": first.pose.topic,
            "command": first.command.topic if first.command is not None else None,
            **{name: signal.topic for name, signal in others.items() if signal is not None},
        },
        "clocks": dict(first.clocks),
        "time_span_s": spans[0],
        **({"recordings": spans} if len(spans) > 1 else {}),
        "options": dict(options),
    }
