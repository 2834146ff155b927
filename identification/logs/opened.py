"""Log files opened side by side: what they hold, and the numbers of the chosen roles, whatever the format."""

from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from ..errors import LogError
from ..result import Finding
from .checks.samples import ExaminedRoles
from .containers.channel import Channel, ChannelInfo, Container, salvaged
from .containers.formats import is_table, open_container
from .gather import gather, list_frames, read_transform, recording_times
from .messages.decode import JointNames, Series, Wanted
from .messages.first import build_infos
from .messages.objects import build_decoder, joint_names
from .roles.cell import Cell
from .roles.choose import Choice
from .roles.registry import Role
from .tables.read import TableLog, check_time_units


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

    def let_go(self) -> None:
        """Forget the numbers that are held, and what was found of them."""
        self.examined.clear()
        for part in self.parts:
            if isinstance(part, ContainerLog):
                part.held.clear()

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
