"""Read channels of a container once: what each batch of messages holds, put together."""

import math
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from problems.arrays import FloatArray

from ..errors import LogError
from ..signals.recording import StampArray
from .containers.channel import Batch, Channel, Container, LeaveOut
from .messages.decode import MessageError, Series, Wanted
from .messages.objects import messages_of
from .messages.transforms import FIELDS, Pair, build_transform_decoder

_GROWTH = 1.5
_LEAST_ROOM = 1024
_SPARE = 1.02
_FILLED = 0.9
"""Room that is filled by less is not kept."""
_FAR_NS = 60 * 10**9
_RARE = 10
Number = TypeVar("Number", np.int64, np.float64)


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
    headers = {channel: _Headers(channel) for channel in wanted}
    for channel, (count, leave_out, part) in container.read(tuple(wanted), handle):
        batches[channel] += 1
        if isinstance(part, MessageError):
            faults.append(_Undecodable(counts[channel] + part.index + 1, part, leave_out))
        else:
            gatherings[channel].add(part)
            headers[channel].add(part, leave_out)
        counts[channel] += count
    _leave_out(faults, batches)
    altered = [*(found for each in headers.values() for found in each.altered())]
    for leave_out, reason in altered:
        leave_out(reason)
    if faults or altered:
        return gather(container, decoders, wanted)
    return {channel: gatherings.pop(channel).finish(channel) for channel in wanted}


@dataclass
class _Run:
    """Batches one behind the other whose headers name the same frames, with stamps near the recording clock or not."""

    frame_ids: tuple[str, ...]
    is_near: bool
    leave_out: LeaveOut | None
    count: int = 1

    def agrees_with(self, other: "_Run") -> bool:
        return (self.frame_ids, self.is_near) == (other.frame_ids, other.is_near)


class _Headers:
    """What the headers of a channel say while it is read, from batch to batch."""

    def __init__(self, channel: Channel) -> None:
        self._channel = channel
        self._offset_ns: int | None = None
        self._runs: list[_Run] = []

    def add(self, part: Series, leave_out: LeaveOut | None) -> None:
        """Add what a batch holds."""
        run = _Run(tuple(sorted(part.frame_ids)), self._is_near(part), leave_out)
        if self._runs and self._runs[-1].agrees_with(run):
            self._runs[-1].count += 1
        else:
            self._runs.append(run)

    def _is_near(self, part: Series) -> bool:
        """Return whether all stamps differ from the time of recording about as the first ones of the channel do."""
        if part.stamp_ns is None or not part.stamp_ns.size:
            return True
        offsets = part.stamp_ns - part.log_ns
        if self._offset_ns is None:
            self._offset_ns = int(np.median(offsets))
        return bool(np.all(np.abs(offsets - self._offset_ns) < _FAR_NS))

    def altered(self) -> Iterator[tuple[LeaveOut, str]]:
        """Yield how to leave out chunks without a checksum whose headers those before and behind contradict.

        They are few: who renames a frame or sets a clock does so for longer than a chunk, or again and again.
        """
        alone = [
            (run, before)
            for (before, run), (_, after) in pairwise(pairwise(self._runs))
            if run.count == 1 and before.agrees_with(after)
        ]
        if not alone:
            return
        usual = max(self._runs, key=lambda run: run.count)
        unusual = sum(run.count for run in self._runs if not run.agrees_with(usual))
        if unusual > max(1, sum(run.count for run in self._runs) // _RARE):
            return
        for run, before in alone:
            if run.leave_out is not None:
                here, there = (" and ".join(map(repr, each.frame_ids)) for each in (run, before))
                said = f"names the frame {here}, those around it {there}"
                if here == there:
                    said = f"has a stamp that is more than {1e-9 * _FAR_NS:.0f} s from those around it"
                yield run.leave_out, f"a message of topic {self._channel.topic} {said}"


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
