"""Parts of one recording: which logs belong together, and their signals joined in the order of time."""

from collections.abc import Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import LogError
from ..result import Finding
from ..signals.recording import Recording
from .opened import open_logs
from .roles.cell import Cell

_LONGEST_PAUSE_NS = 10**9
"""A recorder that splits its files goes on at once; who records again takes longer."""
_GAP_PERIODS = 1.5


def separate_runs(paths: Sequence[Path], cell: Cell, *, salvage: bool = False) -> tuple[tuple[Path, ...], ...]:
    """Group logs into recordings: what follows within a second of recording time, or overlaps, is one.

    Tables without absolute time begin at 0 and go with each other.

    Returns
    -------
    tuple of tuple of Path
        The files of each recording, in the order in which they were named.

    Raises
    ------
    LogError
        A file is no log.
    """
    if len(paths) == 1:
        return ((paths[0],),)
    with open_logs(tuple(paths), cell, salvage=salvage) as logs:
        spans = sorted((part.survey.start_ns, part.survey.end_ns, i) for i, part in enumerate(logs.parts))
    runs: list[list[int]] = []
    latest = 0
    for start, end, index in spans:
        if runs and start - latest <= _LONGEST_PAUSE_NS:
            runs[-1].append(index)
        else:
            runs.append([index])
        latest = max(latest, end)
    return tuple(tuple(paths[index] for index in sorted(run)) for run in runs)


def join_recordings(parts: Sequence[Recording]) -> Recording:
    """Join recordings that hold the same topics in the same frames, in the order of their stamps.

    What a part repeats of the one before (the same stamps with the same values) is dropped; parts that overlap
    otherwise are refused with LogError, as are parts that differ in topics, frames or channels. Digests and findings
    of all parts are kept, and a gap at a seam is a finding.
    """
    if not parts:
        raise LogError("Joining needs at least one log, found none.")
    ordered = sorted(parts, key=lambda part: int(part.wrench.stamp_ns[0]) if len(part.wrench.stamp_ns) else 0)
    changes: dict[str, Any] = {
        "sha256": {path: digest for part in ordered for path, digest in part.sha256.items()},
        "clocks": _same("clocks", [dict(part.clocks) for part in ordered]),
    }
    findings = [finding for part in ordered for finding in part.findings]
    for field in fields(Recording):
        signals = [getattr(part, field.name) for part in ordered]
        if any(hasattr(signal, "stamp_ns") for signal in signals):
            lacking = [
                ", ".join(part.sha256) or "one of them"
                for part, signal in zip(ordered, signals, strict=True)
                if signal is None
            ]
            if lacking:
                raise LogError(
                    f"All parts of a log must hold the same channels; the {field.name} is missing in "
                    f"{', '.join(lacking)}. Join only logs of one run, or leave that part out."
                )
            changes[field.name] = _joined(field.name, signals, findings)
    return replace(ordered[0], **changes, findings=tuple(dict.fromkeys(findings)))


def _joined(role: str, signals: Sequence[Any], findings: list[Finding]) -> Any:
    names = [field.name for field in fields(signals[0])]
    rows = [name for name in names if isinstance(getattr(signals[0], name), np.ndarray)]
    for name in names:
        if name not in rows:
            _same(f"the {name} of the {role}", [getattr(signal, name) for signal in signals])
    whole = {name: getattr(signals[0], name) for name in rows}
    for signal in signals[1:]:
        whole = _appended(role, signals[0].topic, whole, {name: getattr(signal, name) for name in rows}, findings)
    return replace(signals[0], **whole)


def _same(what: str, values: Sequence[Any]) -> Any:
    """Return what all parts agree in; raise LogError when they do not."""
    for value in values[1:]:
        if value != values[0]:
            raise LogError(
                f"All parts of a log must agree in {what}, found {values[0]!r} and {value!r}. Join only logs of "
                "one run."
            )
    return values[0]


def _appended(
    role: str, topic: str, before: dict[str, Any], after: dict[str, Any], findings: list[Finding]
) -> dict[str, Any]:
    """Return two parts as one, without what the second repeats of the first."""
    stamps, following = before["stamp_ns"], after["stamp_ns"]
    if not len(stamps) or not len(following):
        return after if not len(stamps) else before
    repeated = int(np.searchsorted(following, stamps[-1], side="right"))
    if repeated:
        start = len(stamps) - repeated
        same = start >= 0 and all(
            np.array_equal(before[name][start:], after[name][:repeated], equal_nan=before[name].dtype.kind == "f")
            for name in before
        )
        if not same:
            raise LogError(
                f"Parts of a log must follow each other; those of the {role} `{topic}` overlap by "
                f"{(stamps[-1] - following[0]) * 1e-9:.3f} s with different samples. Join only logs of one run, each "
                "once."
            )
        after = {name: value[repeated:] for name, value in after.items()}
        following = after["stamp_ns"]
    if len(following) and len(stamps) > 1:
        gap, period = int(following[0] - stamps[-1]), float(np.median(np.diff(stamps)))
        if gap > _GAP_PERIODS * period:
            findings.append(
                Finding.warning(
                    "gap-between-parts",
                    f"{gap * 1e-9:.4f} s of `{topic}` are missing between two parts of the log (its period is "
                    f"{period * 1e-9:.6f} s).",
                    "Give all parts of the log, and let the recorder split without losing messages.",
                )
            )
    return {name: np.concatenate([before[name], after[name]]) for name in before}
