"""Tell what a log holds, what each channel can be used for, and what is missing for `identify`."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..errors import LogError
from ..recording import StampArray
from ..result import Finding
from .channel import Channel, Keep, RawChannel, Scan
from .containers import scan_log, sha256_of
from .definitions import has_header
from .joint_states import joint_state_findings
from .messages import POSE_FIELDS, WRENCH_FIELDS, Headers, decode_headers, decode_values
from .read import pose_findings, wrench_findings
from .roles import Request, Role, choose_command, choose_pose, choose_wrench, missing_sentence, roles_of

CLOCK_OFFSET_S = 1.0
"""A header clock farther off the recording clock than this is another clock, not a slow transport."""
CLOCK_SPREAD_S = 0.02
"""Channels whose offsets differ by more than this do not share a clock or pass different queues."""
GAP_FACTOR = 1.5


@dataclass(frozen=True, kw_only=True)
class ChannelSummary:
    """One channel; times in s. Rate, gaps and steps are those of the header stamps if there are any (`clock`).

    `header_minus_log_s` is the median offset of the header clock from the recording clock.
    """

    topic: str
    type: str
    encoding: str
    count: int
    clock: str
    rate_hz: float | None
    median_gap_s: float | None
    max_gap_s: float | None
    backwards_steps: int
    duplicates: int
    header_minus_log_s: float | None
    frame_ids: tuple[str, ...]
    roles: tuple[Role, ...]


@dataclass(frozen=True, kw_only=True)
class LogSummary:
    """A log as `inspect` tells it; `missing` holds one sentence for each thing `identify` lacks."""

    path: Path
    container: str
    sha256: str
    size_bytes: int
    start_ns: int
    end_ns: int
    channels: tuple[ChannelSummary, ...]
    findings: tuple[Finding, ...]
    missing: tuple[str, ...]


def inspect_log(path: Path) -> LogSummary:
    """Read a whole log and summarise it; raise LogError if it is damaged or no log."""
    scan = scan_log(path, _keep)
    findings = list(scan.findings)
    channels = []
    for raw in scan.channels:
        try:
            headers = decode_headers(raw) if has_header(raw.channel) and raw.count else None
            findings += _channel_findings(raw, headers, scan.start_ns)
        except LogError as error:
            headers = None
            findings.append(_undecodable(error))
        channels.append(_summary(raw, headers))
    findings += _clock_findings(channels)
    return LogSummary(
        path=path,
        container=scan.container,
        sha256=sha256_of(path),
        size_bytes=path.stat().st_size,
        start_ns=scan.start_ns,
        end_ns=scan.end_ns,
        channels=tuple(channels),
        findings=tuple(findings),
        missing=_missing(scan),
    )


def _keep(channel: Channel) -> Keep:
    if roles_of(channel):
        return Keep.ALL
    return Keep.HEADERS if has_header(channel) else Keep.TIMES


def _undecodable(error: LogError) -> Finding:
    return Finding(
        code="undecodable", severity="error", message=str(error), advice="Record this topic again with its true type."
    )


def _channel_findings(raw: RawChannel, headers: Headers | None, start_ns: int) -> Iterator[Finding]:
    if headers is None:
        return
    roles = roles_of(raw.channel)
    if Role.WRENCH in roles:
        yield from wrench_findings(raw, headers, decode_values(raw, WRENCH_FIELDS), start_ns)
    elif Role.POSE in roles or Role.COMMAND in roles:
        yield from pose_findings(raw, headers, decode_values(raw, POSE_FIELDS), start_ns)
    elif Role.JOINT_STATE in roles:
        yield from joint_state_findings(raw)
    if roles:
        yield from _gap_findings(raw.channel.topic, headers.stamp_ns)


def _gap_findings(topic: str, stamp_ns: StampArray) -> Iterator[Finding]:
    steps = np.diff(stamp_ns)
    if not steps.size or np.median(steps) <= 0:
        return
    ratio = steps / np.median(steps)
    long = ratio > GAP_FACTOR
    if bool(np.any(long)):
        lost = int(np.sum(np.round(ratio[long]) - 1))
        yield Finding(
            code="gaps",
            severity="warning",
            message=f"{topic} has {np.count_nonzero(long)} gaps longer than {GAP_FACTOR:g} sample times, "
            f"the longest {steps.max() / 1e9:.4f} s; about {lost} samples may have been dropped.",
            advice="Record to a local disk with a larger queue if samples were dropped.",
        )


def _summary(raw: RawChannel, headers: Headers | None) -> ChannelSummary:
    stamps = raw.log_ns
    clock = "recording"
    if headers is not None and raw.count and bool(np.any(headers.stamp_ns != headers.stamp_ns[0])):
        stamps, clock = headers.stamp_ns, "header"
    steps = np.diff(stamps)
    span_s = float(stamps.max() - stamps.min()) / 1e9 if raw.count else 0.0
    return ChannelSummary(
        topic=raw.channel.topic,
        type=raw.channel.type_name,
        encoding=raw.channel.encoding,
        count=raw.count,
        clock=clock,
        rate_hz=(raw.count - 1) / span_s if span_s > 0 else None,
        median_gap_s=float(np.median(steps)) / 1e9 if steps.size else None,
        max_gap_s=float(steps.max()) / 1e9 if steps.size else None,
        backwards_steps=int(np.count_nonzero(steps < 0)),
        duplicates=int(np.count_nonzero(steps == 0)),
        header_minus_log_s=None if headers is None else float(np.median(headers.stamp_ns - raw.log_ns)) / 1e9,
        frame_ids=() if headers is None else headers.frame_ids,
        roles=roles_of(raw.channel),
    )


def _clock_findings(channels: Sequence[ChannelSummary]) -> Iterator[Finding]:
    stamped = [c for c in channels if c.clock == "header" and c.roles]
    offsets = {c.topic: c.header_minus_log_s for c in stamped if c.header_minus_log_s is not None}
    for topic, offset in offsets.items():
        if abs(offset) > CLOCK_OFFSET_S:
            yield Finding(
                code="clock-offset",
                severity="warning",
                message=f"The header clock of {topic} is {offset:+.3f} s off the recording clock.",
                advice="Header stamps are used; synchronise the clocks if channels come from several machines.",
            )
    if offsets and max(offsets.values()) - min(offsets.values()) > CLOCK_SPREAD_S:
        low, high = min(offsets, key=offsets.__getitem__), max(offsets, key=offsets.__getitem__)
        yield Finding(
            code="clock-spread",
            severity="warning",
            message=f"Header stamps of {low} and {high} differ by {offsets[high] - offsets[low]:.4f} s "
            "more than their times of recording do: the two may not share a clock.",
            advice="Stamp all channels on one machine or synchronise the clocks; the delay estimate depends on it.",
        )


def _missing(scan: Scan) -> tuple[str, ...]:
    name = scan.path.name
    choices: tuple[Callable[[Sequence[RawChannel], Request, str], RawChannel | None], ...] = (
        choose_wrench,
        choose_pose,
        choose_command,
    )
    sentences = []
    for choose in choices:
        try:
            if choose(scan.channels, Request(), name) is None:
                sentences.append(missing_sentence(Role.COMMAND, name, scan.channels))
        except LogError as error:
            sentences.append(str(error))
    return tuple(sentences)
