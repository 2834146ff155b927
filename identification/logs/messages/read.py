"""Read from a log the numbers that are wanted of some channels, in one pass, and what is known of each before that."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from problems.arrays import FloatArray

from ...errors import LogError
from ...signals.recording import StampArray
from ..containers.channel import Batch, Channel, ChannelInfo, Container, Held, Survey
from .decode import HEADER, ROS_ENCODINGS, MessageError, Series, Wanted, build_program, needed_types
from .objects import ObjectDecoder, messages_of

Number = TypeVar("Number", np.int64, np.float64)
_GROWTH = 1.5
_LEAST_ROOM = 1024


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
        if self._rows < self._log_ns.size:
            self._log_ns = self._log_ns[: self._rows].copy()
            self._values = self._values[: self._rows].copy()
            self._stamp_ns = None if self._stamp_ns is None else self._stamp_ns[: self._rows].copy()
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


def read_series(container: Container, wanted: Mapping[Channel, Wanted]) -> dict[Channel, Series]:
    """Read the wanted numbers of each channel in order of recording.

    ROS messages go through a compiled program of their type, all others, and types that it does not know, one by one
    through a library, with the same result. Raises LogError where the log is damaged, a type has no such number, or a
    message is not as its type says: with its number, topic and byte.
    """
    decoders = {channel: build_decoder(channel, each) for channel, each in wanted.items()}
    return gather(container, decoders, wanted)


def build_decoder(channel: Channel, wanted: Wanted) -> Callable[[Batch], Series]:
    """Return what decodes batches of a channel; raise LogError where its type has no such numbers."""
    return build_program(channel, wanted) or ObjectDecoder(channel, wanted)


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
    counted = {held.channel: held.count for held in container.survey().held}
    gatherings = {channel: _Gathering(each, counted.get(channel, 0)) for channel, each in wanted.items()}
    counts = dict.fromkeys(wanted, 0)

    def handle(batch: Batch) -> tuple[int, Series]:
        return batch.count, decoders[batch.channel](_holding(batch, wanted[batch.channel].only))

    try:
        for channel, (count, part) in container.read(tuple(wanted), handle):
            gatherings[channel].add(part)
            counts[channel] += count
    except MessageError as fault:
        number = counts[fault.channel] + fault.index + 1
        raise LogError(
            f"Message {number} of topic {fault.channel.topic} is damaged or no {fault.channel.type_name}: "
            f"{fault.reason}; record again or leave this topic out."
        ) from fault
    return {channel: gatherings.pop(channel).finish(channel) for channel in wanted}


def _holding(batch: Batch, block: bytes) -> Batch:
    """Return the messages of a batch that hold these bytes."""
    if not block:
        return batch
    keep = np.array([block in message for message in messages_of(batch)], dtype=np.bool_)
    return replace(batch, log_ns=batch.log_ns[keep], starts=batch.starts[keep], sizes=batch.sizes[keep])


def build_infos(survey: Survey) -> tuple[ChannelInfo, ...]:
    """Return what is known of each channel of a survey; a first message that cannot be decoded has no frame."""
    infos = map(_info, survey.held)
    return tuple(sorted(infos, key=lambda info: (info.channel.topic, info.channel.type_name)))


def _info(held: Held) -> ChannelInfo:
    is_headed = _has_header(held.channel)
    return ChannelInfo(
        channel=held.channel,
        count=held.count,
        frame=_frame(held) if is_headed and held.count else None,
        has_header=is_headed,
    )


def _has_header(channel: Channel) -> bool:
    """Return whether messages begin with a `std_msgs/msg/Header`."""
    if channel.encoding not in ROS_ENCODINGS:
        return False
    try:
        fields = needed_types(channel)[channel.type_name][1]
    except LogError:
        return False
    return bool(fields) and fields[0][1][1] == HEADER


def _frame(held: Held) -> str | None:
    try:
        frames = decode_first(held, Wanted(fields=())).frame_ids
    except LogError:
        return None
    return frames[0] if frames else None


def decode_first(held: Held, wanted: Wanted) -> Series:
    """Decode the first message of a channel; raise LogError where it is not as its type says, or lacks a number."""
    data = np.frombuffer(held.first_message, dtype=np.uint8)
    zero, size = np.zeros(1, dtype=np.int64), np.array([data.size], dtype=np.int64)
    try:
        return build_decoder(held.channel, wanted)(
            Batch(channel=held.channel, log_ns=zero, data=data, starts=zero, sizes=size)
        )
    except MessageError as fault:
        raise LogError(f"The first message of topic {held.channel.topic} cannot be decoded: {fault.reason}.") from fault
