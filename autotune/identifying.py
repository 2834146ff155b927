"""From a log file to an identified plant with its provenance."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from autotune import __version__
from identification.errors import EstimateError
from identification.identify import identify_cell
from identification.logs import read_recording
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


def identify_log(path: Path, topics: Topics, *, allow_partial: bool = False) -> IdentifiedLog:
    """Read a log and identify the cell.

    Raises LogError for a log that cannot be used, EstimateError when a parameter that a controller needs is missing
    (unless `allow_partial`, which keeps it as unidentifiable).
    """
    recording = read_recording(path, wrench_topic=topics.wrench, pose_topic=topics.pose, command_topic=topics.command)
    result = identify_cell(recording)
    missing = [finding for finding in result.findings if finding.severity == "error"]
    if missing and not allow_partial:
        raise EstimateError(_refusal(path, missing))
    return IdentifiedLog(result=result, provenance=_provenance(recording, topics, allow_partial))


def _refusal(path: Path, missing: list[Finding]) -> str:
    first = missing[0]
    others = f" (and {len(missing) - 1} more: {', '.join(f.code for f in missing[1:])})" if len(missing) > 1 else ""
    return f"{path.name}: {first.message} {first.advice}".rstrip() + others


def _provenance(recording: Recording, topics: Topics, allow_partial: bool) -> dict[str, Any]:
    wrench, pose, command = recording.wrench, recording.pose, recording.command
    return {
        "tool": f"autotune {__version__}",
        "logs": [{"path": path, "sha256": digest} for path, digest in recording.sha256.items()],
        "channels": {
            "wrench": wrench.topic,
            "pose": pose.topic,
            "command": command.topic if command is not None else None,
        },
        "time_span_s": [wrench.stamp_ns[0] / 1e9, wrench.stamp_ns[-1] / 1e9],
        "options": {
            "wrench_topic": topics.wrench,
            "pose_topic": topics.pose,
            "command_topic": topics.command,
            "allow_partial": allow_partial,
        },
    }
