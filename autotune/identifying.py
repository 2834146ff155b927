"""From log files to an identified plant with its provenance."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from autotune import __version__
from autotune.files.cell import CellFile
from identification.errors import EstimateError
from identification.identify import identify_cell
from identification.logs import read_checked_recording
from identification.logs.cell import Cell
from identification.logs.interpret import build_frames
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
) -> IdentifiedLog:
    """Read the logs of one recording and identify the cell.

    Raises LogError for a log that cannot be used, EstimateError when a parameter that a controller needs is missing
    (unless `allow_partial`, which keeps it as unidentifiable).
    """
    files = (paths,) if isinstance(paths, Path) else tuple(paths)
    told = (Cell() if cell is None else cell.cell).with_topics(
        wrench=topics.wrench, pose=topics.pose, command=topics.command
    )
    recording = read_checked_recording(files, told, salvage=salvage)
    result = identify_cell(recording, build_frames(told))
    missing = [finding for finding in result.findings if finding.severity == "error"]
    if missing and not allow_partial:
        raise EstimateError(_refusal(files, missing))
    result = replace(result, findings=(*recording.findings, *result.findings))
    options = {
        "wrench_topic": topics.wrench,
        "pose_topic": topics.pose,
        "command_topic": topics.command,
        "allow_partial": allow_partial,
        "salvage": salvage,
    }
    return IdentifiedLog(result=result, provenance=_provenance(recording, cell, options))


def _refusal(files: Sequence[Path], missing: list[Finding]) -> str:
    first = missing[0]
    others = f" (and {len(missing) - 1} more: {', '.join(f.code for f in missing[1:])})" if len(missing) > 1 else ""
    names = ", ".join(path.name for path in files)
    return f"{names}: {first.message} {first.advice}".rstrip() + others


def _provenance(recording: Recording, cell: CellFile | None, options: Mapping[str, Any]) -> dict[str, Any]:
    wrench = recording.wrench
    others = {"twist": recording.twist, "gains": recording.gains, "desired_force": recording.desired_force}
    return {
        "tool": f"autotune {__version__}",
        "logs": [{"path": path, "sha256": digest} for path, digest in recording.sha256.items()],
        "cell": None if cell is None else {"path": str(cell.path), "sha256": cell.sha256},
        "channels": {
            "wrench": wrench.topic,
            "pose": recording.pose.topic,
            "command": recording.command.topic if recording.command is not None else None,
            **{name: signal.topic for name, signal in others.items() if signal is not None},
        },
        "clocks": dict(recording.clocks),
        "time_span_s": [wrench.stamp_ns[0] / 1e9, wrench.stamp_ns[-1] / 1e9],
        "options": dict(options),
    }
