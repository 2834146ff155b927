"""Read from logs the channels that `identify` needs, in SI and in our frames."""

from collections.abc import Iterable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from decimal import Decimal, InvalidOperation
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from problems.arrays import FloatArray
from problems.errors import ParameterError

from ..errors import LogError, OutsideSpanError, PayloadChangedError
from ..result import Finding
from ..signals.recording import PoseSignal, Recording, StampArray, join_recordings, sampling_rate_hz, shifted
from ..signals.spikes import without_pose_spikes
from .checks.clocks import ChannelTimes, check_clocks
from .checks.losses import span_left, start_left
from .checks.payload import check_payload, payload_change
from .checks.robot_state import drop_idle_command, drop_zero_torques
from .checks.samples import joined
from .containers.formats import digests, is_folder, is_table
from .joints import joint_findings, poses_of_joints, resolve_joints
from .messages.decode import Series
from .numbers import number_fields
from .opened import OpenedLogs, open_logs
from .recording import build_recording, chosen_clocks, refuse, role_stamps, sample_findings
from .roles.cell import Cell, Clock
from .roles.choose import Choice, choose_all, open_questions, spelled_as_in, with_meanings
from .roles.orientation import make_continuous
from .roles.registry import ROLES, Role

Part = dict[Role, Series]

Instant = float | str
"""Seconds after the start of a log, as a number or text; with @ in front a stamp in seconds, as GNU date writes it."""
LONGEST_WHOLE_S, LARGEST_WHOLE_BYTES, WINDOW_S = 1200.0, 100_000_000, 600.0
"""A log that is longer and larger is read in windows of the third, so that its length takes no memory."""
_LARGEST_NS = 2**62
_LONGEST_PAUSE_NS = 10**9
"""A recorder that splits its files goes on at once; who records again takes longer."""
_CHANGED = frozenset({"payload-change", "tare-jump"})
_HELD = frozenset({Role.GAINS, Role.DESIRED_FORCE})
"""Roles whose last value goes on until there is another."""


def _parsed(name: str, instant: Instant | None) -> tuple[int, bool] | None:
    """Return the nanoseconds of an instant, and whether they are those of a stamp."""
    if instant is None:
        return None
    text = str(instant).strip()
    is_stamp = text.startswith("@")
    try:
        number = Decimal(text.removeprefix("@")).scaleb(9)
        if not number.is_finite() or abs(number) > _LARGEST_NS or number < 0:
            raise InvalidOperation
    except InvalidOperation as error:
        must = "seconds after the log's start (12.5), or with @ a stamp in seconds (@1700000012.5)"
        raise ParameterError(name, instant, must) from error
    return round(number), is_stamp


@dataclass(frozen=True, kw_only=True)
class LogSpan:
    """From `start` to `stop`; None is the log's own. A log starts where both its wrench and its pose have begun.

    Of a window of a long log, `recorded_ns` are the instants on the recording clock between which messages are read.

    Raises ParameterError for what is no time, and where `stop` is not after `start`.
    """

    start: Instant | None = None
    stop: Instant | None = None
    recorded_ns: tuple[int, int] | None = None

    def __post_init__(self) -> None:
        first, last = _parsed("from", self.start), _parsed("to", self.stop)
        if first is not None and last is not None and first[1] == last[1] and last[0] <= first[0]:
            raise ParameterError("to", self.stop, f"after the beginning, {self.start}")

    @property
    def has_stamps(self) -> bool:
        """Whether an end is a stamp, which says of several recordings where it lies."""
        return any(str(each).strip().startswith("@") for each in (self.start, self.stop))

    @property
    def is_whole(self) -> bool:
        """Whether all of a log is read."""
        return self.start is None and self.stop is None

    def bounds_ns(self, zero_ns: int) -> tuple[int | None, int | None]:
        """Return the stamps of its first and last instant in a log that starts at `zero_ns`; None for the log's own."""
        parsed = _parsed("from", self.start), _parsed("to", self.stop)
        first, last = (None if each is None else each[0] + (0 if each[1] else zero_ns) for each in parsed)
        return first, last

    def covers(self, stamp_ns: StampArray, zero_ns: int) -> NDArray[np.bool_]:
        """Return which stamps (n,) are in it, in a log that starts at `zero_ns`."""
        first, last = self.bounds_ns(zero_ns)
        inside = np.ones(stamp_ns.size, dtype=np.bool_)
        if first is not None:
            inside &= stamp_ns >= first
        return inside if last is None else inside & (stamp_ns <= last)

    def split(self, stamp_ns: int) -> "tuple[LogSpan, LogSpan]":
        """Return what of it lies up to a stamp, and what behind."""
        last, first = (f"@{each // 10**9}.{each % 10**9:09d}" for each in (stamp_ns, stamp_ns + 1))
        return replace(self, stop=last), replace(self, start=first)

    def __str__(self) -> str:
        first, last = (f"{each:.9g}" if isinstance(each, float) else each for each in (self.start, self.stop))
        return f"{'its start' if first is None else f'{first} s'} to {'its end' if last is None else f'{last} s'}"


WHOLE = LogSpan()


def cut_roles(
    parts: Sequence[dict[Role, Series]], stamps: Sequence[Mapping[Role, StampArray]], span: LogSpan, name: str
) -> tuple[list[dict[Role, Series]], tuple[Finding, ...]]:
    """Return what the parts of a recording hold within a span, without parts that lie outside, and say so.

    `stamps` are those of each role and part on their clocks. Raises OutsideSpanError where nothing is left of a role.
    """
    if span.is_whole:
        return list(parts), ()
    main = [role for role in (Role.WRENCH, Role.POSE) if role in parts[0]]
    zero = max(min(int(part[role][0]) for part in stamps) for role in main)
    end = max(int(part[role][-1]) for part in stamps for role in main)
    kept = []
    for part, times in zip(parts, stamps, strict=True):
        inside = {role: span.covers(times[role], zero) for role in part}
        if all(bool(inside[role].any()) for role in main):
            kept.append({role: series.part(_held(role, inside[role])) for role, series in part.items()})
    empty = [series.topic for part in kept for series in part.values() if not series.log_ns.size]
    if empty or not kept:
        what = f"of topic {empty[0]}" if empty else "of wrench and pose"
        raise OutsideSpanError(
            f"{name} must hold messages {what} from {span}, found none; it is {(end - zero) * 1e-9:.3f} s long and "
            f"starts at @{zero // 10**9}.{zero % 10**9:09d} (with @ a time is a stamp)."
        )
    return kept, (Finding.info("part-read", f"Of {name} only {span} is read.", "Times are counted from there."),)


def cut_series(series: Series, span: LogSpan, zero_ns: int) -> Series:
    """Return what a channel holds within a span, by its header stamps where it has them."""
    return series.part(span.covers(series.times_ns, zero_ns))


def _held(role: Role, inside: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return which rows (n,) of a role are of a span: also the one that still holds where it begins."""
    before = np.flatnonzero(~inside[: int(np.argmax(inside))] if inside.any() else ~inside)
    if role in _HELD and before.size:
        inside = inside.copy()
        inside[before[-1]] = True
    return inside


def recorded_spans(paths: Sequence[Path], cell: Cell, *, salvage: bool = False) -> tuple[tuple[int, int], ...]:
    """Return the first and the last instant of each log on its recording clock [ns]; raises LogError for no log.

    A damaged chunk is no matter yet: who reads it refuses it, or leaves it out of a window.
    """
    with open_logs(tuple(paths), cell, salvage=salvage, recorded_ns=(-_LARGEST_NS, _LARGEST_NS)) as logs:
        return tuple((part.survey.start_ns, part.survey.end_ns) for part in logs.parts)


def is_long(paths: Sequence[Path], cell: Cell, *, salvage: bool = False) -> bool:
    """Return whether logs are read in windows: too long and too large to be in memory as a whole, and no tables."""
    files = [file for path in paths for file in (path.iterdir() if is_folder(path) else [path]) if file.is_file()]
    if sum(file.stat().st_size for file in files) <= LARGEST_WHOLE_BYTES or any(map(is_table, paths)):
        return False
    spans = recorded_spans(paths, cell, salvage=salvage)
    length_ns = max(stop for _, stop in spans) - min(start for start, _ in spans)
    return length_ns / 1e9 > LONGEST_WHOLE_S


def window_bounds(start_ns: int, end_ns: int, width_s: float) -> tuple[tuple[int, int], ...]:
    """Return first and last instant of each window; the last one takes in a rest shorter than half a window."""
    width = round(width_s * 1e9)
    count = max(1, (end_ns - start_ns + width // 2) // width)
    edges = [start_ns + k * width for k in range(count)]
    return tuple(pairwise([*edges, end_ns + 1]))


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
    spans = sorted((*span, i) for i, span in enumerate(recorded_spans(paths, cell, salvage=salvage)))
    runs: list[list[int]] = []
    latest = 0
    for start, end, index in spans:
        if runs and start - latest <= _LONGEST_PAUSE_NS:
            runs[-1].append(index)
        else:
            runs.append([index])
        latest = max(latest, end)
    return tuple(tuple(paths[index] for index in sorted(run)) for run in runs)


def read_recording(
    paths: Path | Sequence[Path],
    cell: Cell | None = None,
    *,
    salvage: bool = False,
    span: LogSpan = WHOLE,
    wrench_topic: str | None = None,
    pose_topic: str | None = None,
    command_topic: str | None = None,
) -> Recording:
    """Read wrench, measured pose and, where they are, command, twist, gains and desired force.

    Parameters
    ----------
    paths
        Parts of one recording: one after the other, or each with other channels.
    cell
        Declares channels, layouts, units, frames and clocks; the rest is found by type, name, frame and rate. Header
        stamps are the clock unless a channel has none or the cell declares another.
    salvage
        Take what a damaged log still holds and report the loss.
    span
        The part that is read.
    wrench_topic, pose_topic, command_topic
        Topics that go before those of `cell`.

    Returns
    -------
    Recording
        Signals in SI, in the gravity-aligned base and the sensor frame; its findings list what was chosen. A window
        (`span.recorded_ns`) has no digest of its files.

    Raises
    ------
    LogError
        A file is damaged, a channel is missing or ambiguous, or its samples cannot be used.
    """
    declared = (cell or Cell()).with_topics(wrench=wrench_topic, pose=pose_topic, command=command_topic)
    return _read(paths, declared, salvage=salvage, span=span)[0]


def first_instant(
    paths: Sequence[Path], cell: Cell, *, salvage: bool = False, recorded_ns: tuple[int, int]
) -> tuple[int, int]:
    """Return where the part of a log that was recorded between two instants starts: by its clock, and as recorded.

    It starts where both its wrench and its pose have begun. Raises LogError where one of them is not in it.
    """
    return _read(paths, cell, salvage=salvage, span=LogSpan(recorded_ns=recorded_ns))[2]


def read_checked_recording(
    paths: Path | Sequence[Path],
    cell: Cell,
    *,
    salvage: bool = False,
    span: LogSpan = WHOLE,
    opened: OpenedLogs | None = None,
) -> Recording:
    """Read as `read_recording` does, and check clocks and payload by the motion itself.

    The offset between the clocks of wrench and pose is removed where the motion determines it. What was `opened` of
    the same span is not opened again.

    Raises
    ------
    LogError
        As `read_recording`; the clocks differ by an unknown offset.
    PayloadChangedError
        The payload changed within the log.
    """
    recording = _on_one_clock(*_read(paths, cell, salvage=salvage, span=span, opened=opened)[:2])
    about_payload = check_payload(recording)
    changed = [each for each in about_payload if each.code in _CHANGED and each.severity == "error"]
    if changed and (change := payload_change(recording)) is not None:
        raise PayloadChangedError(changed[0].message, changed[0].advice, *change)
    refuse(about_payload)
    return replace(recording, findings=(*recording.findings, *about_payload))


def _read(
    paths: Path | Sequence[Path], cell: Cell, *, salvage: bool, span: LogSpan, opened: OpenedLogs | None = None
) -> tuple[Recording, list[ChannelTimes], tuple[int, int]]:
    """Return a recording, header and recording stamps of the channels with clocks of their own, and both of its start.

    It starts where wrench and pose have both begun.
    """
    files = (paths,) if isinstance(paths, Path) else tuple(paths)
    with (
        open_logs(files, cell, salvage=salvage, recorded_ns=span.recorded_ns) if opened is None else nullcontext(opened)
    ) as logs:
        cell = spelled_as_in(cell, logs.infos)
        choices = choose_all(logs.infos, cell, logs.name, logs.frames_of)
        choices, cell, chain = resolve_joints(choices, cell, logs)
        cell, cautions = with_meanings(cell, choices.values())
        _check_fields(choices.values(), logs)
        is_window = span.recorded_ns is not None
        parts = _parts(logs.read_roles(tuple(choices.values())), choices, logs, is_window=is_window)
        poses_of_joints(parts, choices, cell, chain)
        idle = (*drop_idle_command(parts), *drop_zero_torques(parts))
        clocks, about_clocks = chosen_clocks(parts, cell)
        stamps = [role_stamps(part, clocks, cell) for part in parts]
        main = [role for role in (Role.WRENCH, Role.POSE) if role in parts[0]]
        start = max((int(stamps[0][role][0]), int(parts[0][role].log_ns[0])) for role in main)
        chosen = [
            _chosen(choice, [part[role] for part in stamps if role in part], is_window=is_window)
            for role, choice in choices.items()
        ]
        parts, about_span = cut_roles(parts, stamps, span, logs.name)
        times = _times(parts, clocks)
        # A pause of the recorder costs a long log what is around it, as does a chunk that is left out.
        keeps_holes = salvage or is_window or logs.is_damaged
        about_samples = sample_findings(
            parts, clocks, cell, logs.start_ns, keeps_holes=keeps_holes, examined=logs.examined
        )
        recordings = [build_recording(part, clocks, cell) for part in parts]
        recording = _continuous(join_recordings(recordings))
        questions = open_questions(logs.infos, cell, logs.name)
        about_log = logs.findings()
        if logs.is_damaged and not is_window:
            about_log = (*about_log, *start_left(logs.start_ns, start[1]))
            about_log = (*about_log, *span_left(logs.name, recording.wrench.stamp_ns)) if salvage else about_log
        findings = (*about_log, *about_span, *chosen, *cautions, *idle, *questions, *about_clocks, *about_samples)
        beside = joint_findings(choices[Role.POSE], recording, cell, chain, logs)
        findings = (*findings, *recording.findings, *beside)
        logs.let_go()
    # Many windows of a log do not each read all of it for its digest.
    sha256 = {} if is_window else digests(files)
    return replace(recording, sha256=sha256, findings=findings, keeps_holes=keeps_holes), times, start


def _check_fields(choices: Iterable[Choice], logs: OpenedLogs) -> None:
    """Raise LogError for declared numbers that the first message of their channel does not have."""
    having = {found.topic: found for part in logs.parts for found in number_fields(part) if found.is_complete}
    for choice in choices:
        found = having.get(choice.info.channel.topic)
        if found is None or choice.only or choice.info.columns or found.type != choice.info.channel.type_name:
            continue
        missing = [path for path in choice.fields if path is not None and path not in found.paths]
        if missing:
            raise LogError(
                f"Topic {found.topic} must have {', '.join(missing)}, which cell.yaml declares for the "
                f"{ROLES[choice.role].label}, found {found.short}; correct `{ROLES[choice.role].entry}: {{fields: …}}`."
            )


def _parts(
    read: Sequence[dict[Role, Series]], choices: Mapping[Role, Choice], logs: OpenedLogs, *, is_window: bool
) -> list[Part]:
    """Return what follows each other in time: the files, or all of them as one where each holds other roles."""
    held = [role for part in read for role in part]
    parts = [*read]
    if len(held) == len({*held}):
        parts = [dict(item for part in read for item in part.items())]
    for part in parts:
        for role, choice in choices.items():
            if role not in part or not len(part[role].log_ns):
                where, found = f"each of {logs.name}", "in one; leave that file out"
                if is_window:
                    where, found = f"the part of {logs.name} that is read", "there; read another part"
                raise LogError(
                    f"Topic {choice.info.channel.topic} must hold the {ROLES[role].label} in {where}, "
                    f"found no message of it {found}."
                )
    return parts


def _continuous(recording: Recording) -> Recording:
    """Return the recording with orientations whose quaternions do not jump to their negatives, across files too.

    Single poses that no robot could take are replaced.
    """
    pose, command = recording.pose, recording.command
    pose, found = without_pose_spikes(replace(pose, quaternion_xyzw=_continuous_quaternions(pose)))
    if command is not None:
        command = replace(command, quaternion_xyzw=_continuous_quaternions(command))
    return replace(recording, pose=pose, command=command, findings=(*recording.findings, *found))


def _continuous_quaternions(pose: PoseSignal) -> FloatArray:
    """Return the quaternions (n, 4) of a pose without jumps; read-only, so that the signal takes them as they are."""
    quaternion = make_continuous(pose.quaternion_xyzw)
    quaternion.setflags(write=False)
    return quaternion


def _on_one_clock(recording: Recording, times: Sequence[ChannelTimes]) -> Recording:
    """Take the offset between the clocks of wrench and pose out, where they have clocks of their own."""
    if not times or recording.pose.is_displacement:
        return recording
    report = check_clocks(recording, times)
    refuse(report.findings)
    return replace(
        recording,
        wrench=shifted(recording.wrench, report.shifted_s),
        findings=(*recording.findings, *report.findings),
        wrench_lag_s=report.lag_left_s,
        wrench_shifted_s=report.shifted_s,
    )


def _times(parts: Sequence[Part], clocks: Mapping[Role, Clock]) -> list[ChannelTimes]:
    """Return the stamps of wrench, pose and command; nothing where one channel or the recorder's clock serves."""
    main = [role for role in (Role.WRENCH, Role.POSE, Role.COMMAND) if role in clocks]
    channels = [part.channel for role, part in parts[0].items() if role in (Role.WRENCH, Role.POSE)]
    if len(set(channels)) < 2 or any(clocks[role] is Clock.LOG for role in main):
        return []
    times = []
    for role in main:
        pairs = [(s.stamp_ns, s.log_ns) for s in (part[role] for part in parts) if s.stamp_ns is not None]
        times.append(
            ChannelTimes(
                topic=parts[0][role].channel.topic,
                stamp_ns=joined([stamps for stamps, _ in pairs]),
                log_ns=joined([log for _, log in pairs]),
            )
        )
    return times


def _chosen(choice: Choice, parts: Sequence[StampArray], *, is_window: bool) -> Finding:
    # From one recording to the next there is no step; what moves nothing is in no part.
    steps_s = 1e-9 * joined([np.diff(stamps) for stamps in parts or [np.zeros(0, dtype=np.int64)]])
    pair = f", {choice.frames[1]} in {choice.frames[0]}" if choice.frames else ""
    has_count = parts and not is_window and not choice.frames
    read = replace(choice.info, count=sum(map(len, parts))) if has_count else choice.info
    source = f"{read.described(sampling_rate_hz(steps_s) if choice.info.is_timed else None)}{pair}"
    return Finding.info("channel-chosen", f"The {ROLES[choice.role].label} is read from {source}: {choice.reason}.", "")
