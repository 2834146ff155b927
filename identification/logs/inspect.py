"""Summarise what logs hold, what each channel can be used for, and what is missing for `identify`."""

import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from pathlib import Path

import numpy as np

from ..errors import EstimateError, LogError, UntimedError
from ..result import Finding
from ..signals.medians import median
from ..signals.recording import WEIGHT_NEEDS_ORIENTATION, sampling_rate_hz
from .checks.clocks import ChannelClock, clock_findings, compare_clocks, measure_clock
from .checks.robot_state import without_zero_torques
from .checks.stamps import HOLE, with_holes_once
from .containers.channel import Channel, ChannelInfo
from .containers.formats import begin_digests, digests
from .long_logs import WindowSpan, windows_of_part
from .messages.decode import Series, Wanted
from .numbers import number_fields, number_findings
from .opened import OpenedLogs, open_logs
from .read import WHOLE, LogSpan, cut_series, read_checked_recording
from .roles.cell import Cell, WrenchSource
from .roles.choose import Choice, candidates_of, choose, open_questions, source_of, spelled_as_in
from .roles.registry import ROLES, TRANSFORMS, Role, is_undeclared, layout_of, missing_sentence, roles_of
from .summary import Candidate, ChannelSummary, LogSummary, RoleSummary
from .tables.read import TIME_UNDECLARED
from .threads import map_in_order

_SAID_ELSEWHERE = frozenset({"channel-chosen", "role-open"})


def inspect_log(
    paths: Path | Sequence[Path],
    cell: Cell | None = None,
    *,
    salvage: bool = False,
    span: LogSpan = WHOLE,
    reading: Sequence[Finding] | None = None,
) -> LogSummary:
    """Read logs and summarise channels, roles, findings and what `identify` lacks.

    Parameters
    ----------
    paths
        Parts of one recording.
    cell
        What is declared of the cell.
    salvage
        Take what a damaged log still holds and report the loss.
    span
        The part that is read; a channel is cut by its header stamps where it has them.
    reading
        What `read_checked_recording` found of the same files, which are read once more where it is not given.

    Raises
    ------
    LogError
        A log is damaged or of no known format, or a part is asked of a table whose time is not declared.
    """
    files = (paths,) if isinstance(paths, Path) else tuple(paths)
    declared = cell or Cell()
    if reading is None and span.recorded_ns is None:
        windows = windows_of_part(files, declared, span, salvage=salvage)
        if len(windows) > 1:
            return _inspect_in_windows(files, declared, windows, salvage=salvage)
        span = windows[0].span if windows else span
    with _contents(files, declared, salvage=salvage, span=span) as contents:
        return _summarised(files, contents, salvage=salvage, span=span, reading=reading)


@dataclass(frozen=True, kw_only=True)
class _Contents:
    """What was read of logs that are open, before it is looked at."""

    logs: OpenedLogs
    cell: Cell
    roles: tuple[RoleSummary, ...]
    choices: Mapping[Role, Choice]
    missing: tuple[str, ...]
    series: dict[Channel, Series]
    findings: tuple[Finding, ...]


@contextmanager
def _contents(files: tuple[Path, ...], cell: Cell, *, salvage: bool, span: LogSpan) -> Iterator[_Contents]:
    """Open logs and read what is summarised of them."""
    with open_logs(files, cell, salvage=salvage, recorded_ns=span.recorded_ns) as logs:
        begin_digests(files)
        if not span.is_whole:
            _check_timed(logs)
        cell = spelled_as_in(cell, logs.infos)
        roles, choices, missing = _roles(logs, cell)
        findings: list[Finding] = []
        series = _cut(_read_all(logs, findings), choices, span, logs.start_ns)
        yield _Contents(
            logs=logs,
            cell=cell,
            roles=roles,
            choices=choices,
            missing=missing,
            series=series,
            findings=tuple(findings),
        )


def _summarised(
    files: tuple[Path, ...], read: _Contents, *, salvage: bool, span: LogSpan, reading: Sequence[Finding] | None
) -> LogSummary:
    """Return the summary of what is in memory at once."""
    # A pause of the recorder costs a long log what is around it, as does a chunk that is left out.
    keeps = salvage or span.recorded_ns is not None or read.logs.is_damaged
    logs, series, choices, infos = read.logs, read.series, read.choices, read.logs.infos
    channels = tuple(_summary(info, series[info.channel]) for info in infos)
    numbers = tuple(found for part in logs.parts for found in number_fields(part))
    findings = [*read.findings]
    findings += [f for info in infos for f in _channel_findings(info, series[info.channel], logs, salvage=keeps)]
    if span.is_whole:
        # Of a part, reading it for identify says the same.
        findings += _declared_findings(logs, choices, read.cell, salvage=keeps)
    findings += number_findings(logs, numbers, {choice.info.channel for choice in choices.values()})
    findings += _clock_findings(series, choices)
    findings += open_questions(infos, read.cell, logs.name)
    findings = with_holes_once(findings)
    seen = logs.findings()
    ends = (logs.start_ns, logs.end_ns)
    if not span.is_whole:
        held = [each.log_ns for each in series.values() if each.log_ns.size]
        ends = (min((int(each[0]) for each in held), default=0), max((int(each[-1]) for each in held), default=0))
    ends = _by_headers(ends, [series[choice.info.channel] for choice in choices.values()])
    series.clear()  # reading for `identify` holds the same numbers, and lets go of them when it has copied its own
    if Role.WRENCH in choices and Role.POSE in choices:
        if reading is None:
            reading = _read_findings(files, read.cell, findings, logs, salvage=salvage, span=span)
        said = _SAID_ELSEWHERE | {finding.code for finding in findings if finding.code == HOLE}
        findings += [finding for finding in reading if finding.code not in said]
    sha256s = digests(files)
    return LogSummary(
        path=files[0],
        container=logs.parts[0].survey.container,
        sha256=sha256s[str(files[0])],
        size_bytes=sum(map(_size, files)),
        start_ns=ends[0],
        end_ns=ends[1],
        channels=channels,
        roles=tuple(_with_rates(role, channels) for role in read.roles),
        numbers=numbers,
        findings=tuple(dict.fromkeys((*seen, *findings))),
        missing=read.missing,
        sha256s=sha256s,
    )


def _summary_of_window(files: tuple[Path, ...], cell: Cell, window: WindowSpan, *, salvage: bool) -> LogSummary:
    with _contents(files, cell, salvage=salvage, span=window.span) as contents:
        return _summarised(files, contents, salvage=salvage, span=window.span, reading=None)


def _inspect_in_windows(
    files: tuple[Path, ...], cell: Cell, windows: Sequence[WindowSpan], *, salvage: bool
) -> LogSummary:
    """Return the summary of a long log from those of its windows, of which two at a time are in memory."""
    begin_digests(files)
    summaries = [*map_in_order(partial(_summary_of_window, files, cell, salvage=salvage), windows)]
    first = summaries[0]
    together = zip(*(each.channels for each in summaries), strict=True)
    channels = tuple(_joined(parts) for parts in together)
    seen: dict[tuple[str, str], list[Finding]] = {}
    for finding in (finding for each in summaries for finding in each.findings):
        # Of messages that differ in their numbers the first one speaks for all.
        seen.setdefault((finding.code, re.sub(r"[-+]?\d[\d.]*", "0", finding.message)), []).append(finding)
    findings = tuple(
        each[0]
        if each[0] == each[-1]
        else replace(each[0], message=f"{each[0].message} (First of {len(each)} like it.)")
        for each in seen.values()
    )
    minutes = (windows[-1].stop_s - windows[0].start_s) / 60.0 / len(windows)
    note = f"The log is long: it was looked at in {len(windows)} windows of {minutes:.0f} minutes, one by one."
    return replace(
        first,
        start_ns=first.start_ns,
        end_ns=summaries[-1].end_ns,
        channels=channels,
        roles=tuple(_with_rates(role, channels) for role in first.roles),
        findings=(Finding.info("windows", note, ""), *findings),
    )


def _joined(parts: Sequence[ChannelSummary]) -> ChannelSummary:
    """Return the summary of a channel over all windows; gaps across their borders are not looked at."""
    count = sum(each.count for each in parts)

    def middle(values: Sequence[float | None]) -> float | None:
        known = [value for value in values if value is not None]
        return float(np.median(known)) if known else None

    gaps = [each.max_gap_s for each in parts if each.max_gap_s is not None]
    return replace(
        parts[0],
        count=count,
        rate_hz=middle([each.rate_hz for each in parts]),
        median_gap_s=middle([each.median_gap_s for each in parts]),
        max_gap_s=max(gaps, default=None),
        backwards_steps=sum(each.backwards_steps for each in parts),
        duplicates=sum(each.duplicates for each in parts),
        header_minus_log_s=middle([each.header_minus_log_s for each in parts]),
        frame_ids=tuple(dict.fromkeys(frame for each in parts for frame in each.frame_ids)),
    )


def _by_headers(ends: tuple[int, int], series: Sequence[Series]) -> tuple[int, int]:
    """Return when a log begins and ends, by its roles' headers where it was written in less time than they count."""
    stamps = [each.stamp_ns for each in series if each.stamp_ns is not None and each.stamp_ns.size]
    if not stamps:
        return ends
    headers = (min(int(each.min()) for each in stamps), max(int(each.max()) for each in stamps))
    longest = max(int(np.ptp(each)) for each in stamps)
    return headers if longest > 2 * (ends[1] - ends[0]) and headers[1] - headers[0] < 2 * longest else ends


def _size(path: Path) -> int:
    files = [file for file in path.iterdir() if file.is_file()] if path.is_dir() else [path]
    return sum(file.stat().st_size for file in files)


def _roles(logs: OpenedLogs, cell: Cell) -> tuple[tuple[RoleSummary, ...], dict[Role, Choice], tuple[str, ...]]:
    summaries, choices, missing = [], {}, []
    for role in ROLES:
        candidates = candidates_of(role, logs.infos, cell)
        try:
            choice = choose(role, logs.infos, cell, logs.name, logs.frames_of)
        except LogError as error:
            missing.append(str(error))
            summaries.append(_role_summary(role, None, str(error), candidates))
            continue
        if choice is None and role is Role.COMMAND:
            missing.append(missing_sentence(role, logs.name, logs.infos))
        if choice is not None:
            choices[role] = choice
        summaries.append(_role_summary(role, choice, "", candidates))
    if cell.rows_are_poses:
        missing = [sentence for sentence in missing if Role.WRENCH not in choices or Role.POSE not in choices]
        missing.append(
            "Each row is a pose at rest: payload and sensor are in it, robot, coupling and surfaces are not."
        )
    without_weight = _without_weight(choices.get(Role.WRENCH), cell)
    pose = choices.get(Role.POSE)
    if without_weight:
        missing.append(f"{without_weight} that gravity is removed from the wrench; identify needs the sensor's own.")
    elif pose is not None and not pose.of_joints and (len(pose.fields) < 6 or None in pose.fields[3:]):
        missing.append(f"Topic {pose.info.channel.topic} has no orientation, {WEIGHT_NEEDS_ORIENTATION}.")
    if cell.displacement is not None:
        missing.append("cell.yaml declares a displacement; identify needs the flange pose in the base frame.")
    return tuple(summaries), choices, tuple(dict.fromkeys(missing))


def _without_weight(wrench: Choice | None, cell: Cell) -> str:
    """Return who says that the weight was removed from the wrench, nothing where nobody does."""
    if cell.wrench is not None and cell.wrench.gravity_compensated is not None:
        return "cell.yaml declares" if cell.wrench.gravity_compensated else ""
    meaning = None if wrench is None or wrench.layout is None else wrench.layout.meaning
    is_removed = isinstance(meaning, WrenchSource) and meaning.gravity_compensated
    return f"The type of {wrench.info.channel.topic} says" if wrench is not None and is_removed else ""


def _role_summary(role: Role, choice: Choice | None, reason: str, candidates: Sequence[ChannelInfo]) -> RoleSummary:
    frames = None if choice is None else choice.frames
    return RoleSummary(
        role=role,
        entry=ROLES[role].entry,
        topic=None if choice is None else choice.info.channel.topic,
        reason=reason if choice is None else choice.reason,
        candidates=tuple(map(_candidate, candidates)),
        needs_fields=bool(candidates) and all(map(is_undeclared, candidates)),
        parent=frames[0] if frames else None,
        child=frames[1] if frames else None,
    )


def _with_rates(role: RoleSummary, channels: Sequence[ChannelSummary]) -> RoleSummary:
    seen = {(channel.topic, channel.type): channel for channel in channels}
    known = ((each, seen.get((each.topic, each.type))) for each in role.candidates)
    candidates = (each if of is None else replace(each, rate_hz=of.rate_hz, count=of.count) for each, of in known)
    return replace(role, candidates=tuple(candidates))


def _candidate(info: ChannelInfo) -> Candidate:
    return Candidate(
        topic=info.channel.topic,
        type=info.channel.type_name,
        count=info.count,
        frame=info.frame,
    )


def _read_all(logs: OpenedLogs, findings: list[Finding]) -> dict[Channel, Series]:
    """Read what is summarised of every channel: its clocks, and the numbers of one whose type says what they are.

    Raises LogError if the log is damaged; a channel that is not what its type says is a finding.
    """
    wanted = {info.channel: _wanted(info) for info in logs.infos}
    try:
        return logs.read(wanted, holds=True)
    except LogError:
        times = logs.read({channel: Wanted(fields=(), header="") for channel in wanted})
    series = {}
    for channel, mine in wanted.items():
        try:
            series[channel] = logs.read({channel: mine})[channel]
        except LogError as error:
            series[channel] = times[channel]
            advice = "Record this topic again with its true type."
            findings.append(Finding.error("undecodable", str(error), advice))
    return series


def _check_timed(logs: OpenedLogs) -> None:
    """Raise LogError for a table without times, of which no part can be read."""
    for finding in logs.findings():
        if finding.code == TIME_UNDECLARED:
            raise UntimedError(
                f"To read a part (--from, --to) the times must be known: {finding.message} {finding.advice}"
            )


def _cut(
    series: dict[Channel, Series], choices: Mapping[Role, Choice], span: LogSpan, start_ns: int
) -> dict[Channel, Series]:
    """Return what the channels hold within a span; those of wrench and pose say where the log starts."""
    if span.is_whole:
        return series
    main = [series[choices[role].info.channel] for role in (Role.WRENCH, Role.POSE) if role in choices]
    log_zero = max((int(each.log_ns[0]) for each in main if each.log_ns.size), default=start_ns)
    zero = max((int(each.stamp_ns[0]) for each in main if each.stamp_ns is not None), default=None)
    cut = {}
    for channel, each in series.items():
        own = log_zero if each.stamp_ns is None or not each.log_ns.size else int(each.stamp_ns[0])
        cut[channel] = cut_series(each, span, own if each.stamp_ns is None or zero is None else zero)
    return cut


def _wanted(info: ChannelInfo) -> Wanted:
    by_type = [layout_of(role, info.channel) for role in roles_of(info.channel) if role in ROLES]
    is_plain = bool(by_type) and info.channel.type_name not in TRANSFORMS
    return Wanted(fields=by_type[0].fields if is_plain else (), header="header" if info.has_header else "")


def _channel_findings(info: ChannelInfo, series: Series, logs: OpenedLogs, *, salvage: bool) -> Iterator[Finding]:
    roles = [role for role in roles_of(info.channel) if role in ROLES]
    if not roles or not series.log_ns.size or series.stamp_ns is None:
        return
    if series.fields:
        kept, about_torques = without_zero_torques([series]) if roles[0] is Role.WRENCH else ([series], ())
        yield from about_torques
        yield from logs.examined.faults(roles[0], kept, [series.stamp_ns], None, logs.start_ns, keeps_holes=salvage)


def _declared_findings(logs: OpenedLogs, choices: Mapping[Role, Choice], cell: Cell, *, salvage: bool) -> list[Finding]:
    """Return the faults of roles whose layout the cell declares; others are examined by their type."""
    declared = [choice for choice in choices.values() if choice.reason.startswith("declared")]
    found: list[Finding] = []
    try:
        parts = logs.read_roles(declared)
    except LogError as error:
        return [Finding.error("undecodable", str(error), "Check cell.yaml.")]
    for role in dict.fromkeys(role for part in parts for role in part):
        mine = [part[role] for part in parts if role in part]
        stamps = [part.times_ns for part in mine]
        found += logs.examined.faults(role, mine, stamps, source_of(cell, role), logs.start_ns, keeps_holes=salvage)
    return found


def _read_findings(
    files: Sequence[Path], cell: Cell, known: Sequence[Finding], logs: OpenedLogs, *, salvage: bool, span: LogSpan
) -> Sequence[Finding]:
    """Return what reading for `identify` finds beside what is known: tare, payload, clocks, or why it is refused."""
    try:
        return read_checked_recording(files, cell, salvage=salvage, span=span, opened=logs).findings
    except EstimateError:
        return []
    except LogError as error:
        if any(finding.severity == "error" and finding.message in str(error) for finding in known):
            return []
        return [Finding.error("unusable", str(error), "")]


def _summary(info: ChannelInfo, series: Series) -> ChannelSummary:
    headers, stamps = series.stamp_ns, series.log_ns
    offset = median(headers - stamps) / 1e9 if headers is not None and headers.size else None
    clock = "recording"
    if headers is not None and headers.size and bool(np.any(headers != headers[0])):
        stamps, clock = headers, "header"
    if not info.is_timed:
        stamps = stamps[:0]  # rows without a time
    steps = np.diff(stamps)
    return ChannelSummary(
        topic=info.channel.topic,
        type=info.channel.type_name,
        encoding=info.channel.encoding,
        count=series.log_ns.size,
        clock=clock,
        rate_hz=sampling_rate_hz(1e-9 * steps),
        median_gap_s=median(steps) / 1e9 if steps.size else None,
        max_gap_s=float(steps.max()) / 1e9 if steps.size else None,
        backwards_steps=int(np.count_nonzero(steps < 0)),
        duplicates=int(np.count_nonzero(steps == 0)),
        header_minus_log_s=offset,
        frame_ids=series.frame_ids,
        roles=roles_of(info.channel),
    )


def _clock_findings(series: Mapping[Channel, Series], choices: Mapping[Role, Choice]) -> Iterator[Finding]:
    """Yield what the header clocks of channels with a role say against the recording clock and each other."""
    clocks: dict[Channel, ChannelClock] = {}
    used = {choice.info.channel for choice in choices.values()}
    for channel, mine in series.items():
        if (channel in used or roles_of(channel)) and mine.stamp_ns is not None:
            clock = measure_clock(channel.topic, mine.stamp_ns, mine.log_ns)
            if clock is not None:
                clocks[channel] = clock
                yield from clock_findings(clock, median(np.diff(mine.stamp_ns)) * 1e-9)
    main = [choices[role].info.channel for role in (Role.WRENCH, Role.POSE, Role.COMMAND) if role in choices]
    for first, second in pairwise(dict.fromkeys(channel for channel in main if channel in clocks)):
        difference = compare_clocks(clocks[first], clocks[second])
        if not difference.agree:
            yield Finding.warning(
                "clocks-differ",
                f"The header clocks of {difference.first} and {difference.second} are "
                f"{difference.offset_s:+.4f} ± {difference.std_s:.4f} s apart by the recording clock.",
                "Stamp all channels on one machine or synchronise the clocks; the delay estimate depends on it.",
            )
