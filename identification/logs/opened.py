"""Log files opened side by side: what they hold, and the numbers of the chosen roles, whatever the format."""

import math
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from problems.arrays import FloatArray

from ..errors import LogError
from ..result import Finding
from ..signals.recording import StampArray
from .checks.samples import ExaminedRoles
from .containers.channel import Batch, Channel, ChannelInfo, Container, LeaveOut, salvaged
from .containers.formats import is_table, open_container
from .messages.decode import JointNames, MessageError, Series, Wanted
from .messages.first import build_infos
from .messages.objects import build_decoder, joint_names, messages_of
from .messages.transforms import FIELDS, Pair, build_transform_decoder
from .roles.cell import Cell
from .roles.choose import Choice
from .roles.registry import Role
from .tables.read import TableLog, check_time_units

_GROWTH = 1.5
_LEAST_ROOM = 1024
_SPARE = 1.02
_FILLED = 0.9
"""Room that is filled by less is not kept."""
Number = TypeVar("Number", np.int64, np.float64)


class ContainerLog:
    """A log of messages."""

    def __init__(self, path: Path, *, salvage: bool, recorded_ns: tuple[int, int] | None = None) -> None:
        self.path = path
        self._container: Container = open_container(path, salvage=salvage)
        self._container.recorded_ns = recorded_ns
        try:
            self.survey = self._container.survey()
            self.infos = build_infos(self.survey)
        except BaseException:
            self._container.close()
            raise
        self._salvage = salvage
        self._lost = dict.fromkeys(self._container.lost())
        self.held: dict[Channel, tuple[Wanted, Series]] = {}

    def read(self, channels: Mapping[Channel, Wanted]) -> dict[Channel, Series]:
        """Read channels; those of which only the time of recording is wanted are not decoded, nor what is held."""
        held = {channel: self.held[channel][1] for channel, wanted in channels.items() if self._holds(channel, wanted)}
        new = {channel: wanted for channel, wanted in channels.items() if channel not in held}
        decoders = {
            channel: build_decoder(channel, wanted) if wanted.fields or wanted.header else recording_times
            for channel, wanted in new.items()
        }
        found = {**held, **(gather(self._container, decoders, new) if new else {})}
        self._remember()
        return found

    def hold(self, channels: Mapping[Channel, Wanted]) -> None:
        """Read channels of which as much, or less, is asked again."""
        self.held = {channel: (channels[channel], series) for channel, series in self.read(channels).items()}

    def _holds(self, channel: Channel, wanted: Wanted) -> bool:
        if channel not in self.held:
            return False
        known = self.held[channel][0]
        return {*wanted.fields} <= {*known.fields} and (wanted.header, wanted.only) == (known.header, known.only)

    def frames(self, channel: Channel) -> tuple[tuple[str, str], ...]:
        """List the pairs (parent, child) of a channel of transforms."""
        found = list_frames(self._container, channel)
        self._remember()
        return found

    def transform(self, channel: Channel, pair: tuple[str, str]) -> Series:
        """Read one transform."""
        found = read_transform(self._container, channel, *pair)
        self._remember()
        return found

    def joint_names(self, channel: Channel, needed: Collection[str]) -> JointNames:
        """Return the names as `messages.objects.joint_names` does."""
        found = joint_names(self._container, channel, needed, self.path.name)
        self._remember()
        return found

    def findings(self) -> tuple[Finding, ...]:
        """Report what was seen of the container and what reading left out."""
        return (*self.survey.findings, *salvaged(self.path.name, tuple(self._lost), salvage=self._salvage))

    def close(self) -> None:
        """Close the files."""
        self._container.close()

    def _remember(self) -> None:
        self._lost = dict.fromkeys(self._container.lost())


OpenedLog = ContainerLog | TableLog
"""One log file or folder."""


@dataclass(frozen=True, kw_only=True)
class OpenedLogs:
    """The parts of one recording, and what was found of the samples of their roles."""

    parts: tuple[OpenedLog, ...]
    examined: ExaminedRoles = field(default_factory=ExaminedRoles)

    @property
    def name(self) -> str:
        """Name the files for a message."""
        return ", ".join(part.path.name or str(part.path) for part in self.parts)

    @property
    def is_damaged(self) -> bool:
        """Whether anything of them was left out so far."""
        return any(finding.code == "salvaged" for finding in self.findings())

    @property
    def start_ns(self) -> int:
        """The first instant on the recording clock, 0 without messages."""
        return min((part.survey.start_ns for part in self.parts if part.survey.end_ns), default=0)

    @property
    def end_ns(self) -> int:
        """The last instant on the recording clock, 0 without messages."""
        return max((part.survey.end_ns for part in self.parts), default=0)

    @property
    def infos(self) -> tuple[ChannelInfo, ...]:
        """The channels of all parts, a channel that is in several once, with all its messages."""
        merged: dict[Channel, ChannelInfo] = {}
        for part in self.parts:
            for info in part.infos:
                other = merged.get(info.channel)
                merged[info.channel] = info if other is None else _merged(other, info)
        return tuple(sorted(merged.values(), key=lambda info: (info.channel.topic, info.channel.type_name)))

    def frames_of(self, info: ChannelInfo) -> tuple[tuple[str, str], ...]:
        """List the pairs (parent, child) of a channel of transforms."""
        pairs = {pair for part in self._having(info) for pair in part.frames(info.channel)}
        return tuple(sorted(pairs))

    def joint_names(self, info: ChannelInfo, needed: Collection[str]) -> JointNames:
        """Return the names of the joints in a channel of joint states; raise LogError where they are not the same."""
        found = [part.joint_names(info.channel, needed) for part in self._having(info)]
        if len({each.names for each in found}) > 1:
            raise LogError(
                f"Topic {info.channel.topic} must name the same joints in each of {self.name}, found others."
            )
        return next((each for each in found if each.only), found[0])

    def findings(self) -> tuple[Finding, ...]:
        """Report what was seen of the containers and what reading left out, each once."""
        return tuple(dict.fromkeys(finding for part in self.parts for finding in part.findings()))

    def read(self, channels: Mapping[Channel, Wanted], *, holds: bool = False) -> dict[Channel, Series]:
        """Read channels, each file once, what several files hold of one joined; channels of no file are left out.

        What it `holds` is not read from a file of messages again while that is open.
        """
        parts = []
        for part in self.parts:
            held = {info.channel for info in part.infos}
            mine = {channel: wanted for channel, wanted in channels.items() if channel in held}
            if holds and isinstance(part, ContainerLog):
                part.hold(mine)
            parts.append(part.read(mine) if mine else {})
        return {channel: _joined([part[channel] for part in parts if channel in part]) for channel in channels}

    def read_roles(self, choices: Collection[Choice]) -> list[dict[Role, Series]]:
        """Read the chosen channels, each file once; one mapping per file, with the roles that it holds."""
        return [_read_roles(part, [c for c in choices if part in self._having(c.info)]) for part in self.parts]

    def _having(self, info: ChannelInfo) -> list[OpenedLog]:
        return [part for part in self.parts if any(h.channel == info.channel and h.count for h in part.infos)]


@contextmanager
def open_logs(
    paths: Sequence[Path], cell: Cell, *, salvage: bool, recorded_ns: tuple[int, int] | None = None
) -> Iterator[OpenedLogs]:
    """Open files or folders of any known format; raises LogError if one is none or damaged.

    With `recorded_ns` only what was recorded from the first instant on and before the second is read.
    """
    if not paths:
        raise LogError("At least one log must be named, found none.")
    if len({path.resolve() for path in paths}) < len(paths):
        raise LogError("Each log must be named once; one is named twice.")
    parts: list[OpenedLog] = []
    try:
        for path in paths:
            # What was opened is closed when the next one fails.
            parts.append(_opened(path, cell, salvage, recorded_ns))  # noqa: PERF401
        check_time_units([part for part in parts if isinstance(part, TableLog)])
        yield OpenedLogs(parts=tuple(parts))
    finally:
        for part in parts:
            part.close()


def _opened(path: Path, cell: Cell, salvage: bool, recorded_ns: tuple[int, int] | None) -> OpenedLog:
    if not path.is_dir() and is_table(path):
        return TableLog(path, cell.table_of(path.name), recorded_ns)
    return ContainerLog(path, salvage=salvage, recorded_ns=recorded_ns)


def _merged(one: ChannelInfo, other: ChannelInfo) -> ChannelInfo:
    frame = one.frame if one.frame is not None else other.frame
    return replace(one, count=one.count + other.count, is_timed=one.is_timed and other.is_timed, frame=frame)


def _joined(parts: Sequence[Series]) -> Series:
    """Put series of one channel one after the other, in the order of their recording clocks."""
    if len(parts) == 1:
        return parts[0]
    parts = sorted(parts, key=lambda part: int(part.log_ns[0]) if part.log_ns.size else 0)
    stamps = [part.stamp_ns for part in parts if part.stamp_ns is not None]
    return Series(
        channel=parts[0].channel,
        fields=parts[0].fields,
        log_ns=np.concatenate([part.log_ns for part in parts]),
        stamp_ns=np.concatenate(stamps) if len(stamps) == len(parts) else None,
        frame_ids=tuple(sorted({frame for part in parts for frame in part.frame_ids})),
        values=np.concatenate([part.values for part in parts]),
    )


def _read_roles(part: OpenedLog, choices: Sequence[Choice]) -> dict[Role, Series]:
    wanted: dict[Channel, Wanted] = {}
    for choice in choices:
        if choice.frames is None:
            before = wanted.get(choice.info.channel, Wanted(fields=(), header=""))
            paths = (*before.fields, *(path for path in choice.fields if path is not None))
            header = before.header or choice.header
            wanted[choice.info.channel] = Wanted(
                fields=tuple(dict.fromkeys(paths)), header=header, only=before.only or choice.only
            )
    series = part.read(wanted) if wanted else {}
    return {
        choice.role: _role_series(
            choice,
            series[choice.info.channel]
            if choice.frames is None
            else part.transform(choice.info.channel, choice.frames),
        )
        for choice in choices
    }


def _role_series(choice: Choice, series: Series) -> Series:
    at = {path: index for index, path in enumerate(series.fields)}
    columns = [at[path] for path in choice.fields if path is not None]
    if len(columns) == len(choice.fields) and columns == [*range(columns[0], columns[0] + len(columns))]:
        values = series.values[:, columns[0] : columns[0] + len(columns)]
    else:
        values = np.full((len(series.log_ns), len(choice.fields)), np.nan)
        values[:, [path is not None for path in choice.fields]] = series.values[:, columns]
    stamps = series.stamp_ns if choice.header else None
    return replace(series, fields=choice.fields, stamp_ns=stamps, values=values)


class _Gathering:
    """The numbers of one channel while it is read; `room` is the number of rows that are expected."""

    def __init__(self, wanted: Wanted, room: int) -> None:
        self._wanted = wanted
        self._rows = 0
        self._log_ns: StampArray = np.empty(room, dtype=np.int64)
        self._stamp_ns: StampArray | None = np.empty(room, dtype=np.int64) if wanted.header else None
        self._values: FloatArray = np.empty((room, len(wanted.fields)))
        self._frame_ids: set[str] = set()

    def add(self, part: Series) -> None:
        """Add what a batch holds."""
        first, self._rows = self._rows, self._rows + part.log_ns.size
        if self._rows > self._log_ns.size:
            self._grow(first)
        rows = slice(first, self._rows)
        self._log_ns[rows] = part.log_ns
        self._values[rows] = part.values
        if self._stamp_ns is not None and part.stamp_ns is not None:
            self._stamp_ns[rows] = part.stamp_ns
        self._frame_ids.update(part.frame_ids)

    def _grow(self, filled: int) -> None:
        room = max(_LEAST_ROOM, self._rows, int(self._log_ns.size * _GROWTH))
        self._log_ns = _moved(self._log_ns, filled, room)
        self._values = _moved(self._values, filled, room)
        if self._stamp_ns is not None:
            self._stamp_ns = _moved(self._stamp_ns, filled, room)

    def finish(self, channel: Channel) -> Series:
        """Return the numbers in order of recording; what was recorded at once stays in file order."""
        if self._rows < _FILLED * self._log_ns.size:
            self._log_ns = self._log_ns[: self._rows].copy()
            self._values = self._values[: self._rows].copy()
            self._stamp_ns = None if self._stamp_ns is None else self._stamp_ns[: self._rows].copy()
        self._log_ns, self._values = self._log_ns[: self._rows], self._values[: self._rows]
        self._stamp_ns = None if self._stamp_ns is None else self._stamp_ns[: self._rows]
        if bool(np.any(self._log_ns[1:] < self._log_ns[:-1])):
            order = np.argsort(self._log_ns, kind="stable")
            self._log_ns = self._log_ns[order]
            self._values = self._values[order]
            self._stamp_ns = None if self._stamp_ns is None else self._stamp_ns[order]
        return Series(
            channel=channel,
            fields=self._wanted.fields,
            log_ns=self._log_ns,
            stamp_ns=self._stamp_ns,
            frame_ids=tuple(sorted(self._frame_ids)),
            values=self._values,
        )


def _moved(array: NDArray[Number], filled: int, room: int) -> NDArray[Number]:
    moved = np.empty((room, *array.shape[1:]), dtype=array.dtype)
    moved[:filled] = array[:filled]
    return moved


def recording_times(batch: Batch) -> Series:
    """Return when the messages of a batch were recorded, without decoding them."""
    nothing = np.empty((batch.count, 0))
    return Series(
        channel=batch.channel, fields=(), log_ns=batch.log_ns.copy(), stamp_ns=None, frame_ids=(), values=nothing
    )


def gather(
    container: Container, decoders: Mapping[Channel, Callable[[Batch], Series]], wanted: Mapping[Channel, Wanted]
) -> dict[Channel, Series]:
    """Read the channels once and put together what their decoders make of each batch."""
    survey, recorded = container.survey(), container.recorded_ns
    share = _SPARE * (recorded[1] - recorded[0]) / max(survey.end_ns - survey.start_ns, 1) if recorded else 1.0
    rooms = {held.channel: math.ceil(min(share, 1.0) * held.count) for held in survey.held}
    gatherings = {channel: _Gathering(each, rooms.get(channel, 0)) for channel, each in wanted.items()}
    counts = dict.fromkeys(wanted, 0)

    def handle(batch: Batch) -> tuple[int, LeaveOut | None, Series | MessageError]:
        asked = _holding(container.recorded(batch), wanted[batch.channel].only)
        try:
            return batch.count, batch.leave_out, decoders[batch.channel](asked)
        except MessageError as fault:
            return batch.count, batch.leave_out, fault

    faults: list[_Undecodable] = []
    batches: Counter[Channel] = Counter()
    for channel, (count, leave_out, part) in container.read(tuple(wanted), handle):
        batches[channel] += 1
        if isinstance(part, MessageError):
            faults.append(_Undecodable(counts[channel] + part.index + 1, part, leave_out))
        else:
            gatherings[channel].add(part)
        counts[channel] += count
    if faults:
        _leave_out(faults, batches)
        return gather(container, decoders, wanted)
    return {channel: gatherings.pop(channel).finish(channel) for channel in wanted}


class _Undecodable(NamedTuple):
    number: int
    fault: MessageError
    leave_out: LeaveOut | None


def _leave_out(faults: Sequence[_Undecodable], batches: Mapping[Channel, int]) -> None:
    """Leave out the chunks of messages that cannot be decoded, where most other chunks show that their type is right.

    Raises LogError where not, and where a checksum says that a message is as it was recorded.
    """
    faulty = Counter(each.fault.channel for each in faults)
    for number, fault, leave_out in faults:
        if leave_out is None or 2 * faulty[fault.channel] >= batches[fault.channel]:
            raise LogError(
                f"Message {number} of topic {fault.channel.topic} is damaged or no {fault.channel.type_name}: "
                f"{fault.reason}; record again or leave this topic out."
            ) from fault
    for number, fault, leave_out in faults:
        if leave_out is not None:
            leave_out(f"message {number} of topic {fault.channel.topic} cannot be decoded: {fault.reason}")


def _holding(batch: Batch, block: bytes) -> Batch:
    """Return the messages of a batch that hold these bytes."""
    if not block:
        return batch
    keep = np.array([block in message for message in messages_of(batch)], dtype=np.bool_)
    return batch.part(keep)


def read_transform(container: Container, channel: Channel, parent: str, child: str) -> Series:
    """Read the transforms from `parent` to `child` in order of recording, stamped by their own headers.

    Works on topics of TFMessage, which hold several transforms per message, and of TransformStamped. Raises LogError
    where the topic holds no transform of these frames, or a message is not as its type says.
    """
    decoder = build_transform_decoder(channel, (parent, child))
    series = gather(container, {channel: decoder}, {channel: Wanted(fields=FIELDS)})[channel]
    if not series.log_ns.size:
        pairs = ", ".join(f"{first} to {second}" for first, second in sorted(decoder.pairs)[:10])
        raise LogError(
            f"Topic {channel.topic} holds no transform from {parent!r} to {child!r}; it holds: {pairs or 'none'}."
        )
    return series


def list_frames(container: Container, channel: Channel) -> tuple[Pair, ...]:
    """Return the pairs of parent and child frame that occur on a topic of transforms, sorted."""
    decoder = build_transform_decoder(channel, None)
    gather(container, {channel: decoder}, {channel: Wanted(fields=FIELDS)})
    return tuple(sorted(decoder.pairs))
