"""Read channels of a container once, and put the numbers of their messages together in the order of recording."""

import math
from collections.abc import Callable, Mapping
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from problems.arrays import FloatArray

from ...errors import LogError
from ...signals.recording import StampArray
from ..containers.channel import Batch, Channel, Container
from .decode import MessageError, Series, Wanted, build_program
from .objects import ObjectDecoder, messages_of
from .transforms import FIELDS, Pair, build_transform_decoder

_GROWTH = 1.5
_LEAST_ROOM = 1024
_SPARE = 1.02
_FILLED = 0.9
"""Room that is filled by less is not kept."""
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
    survey, recorded = container.survey(), container.recorded_ns
    share = _SPARE * (recorded[1] - recorded[0]) / max(survey.end_ns - survey.start_ns, 1) if recorded else 1.0
    rooms = {held.channel: math.ceil(min(share, 1.0) * held.count) for held in survey.held}
    gatherings = {channel: _Gathering(each, rooms.get(channel, 0)) for channel, each in wanted.items()}
    counts = dict.fromkeys(wanted, 0)

    def handle(batch: Batch) -> tuple[int, Series]:
        asked = _holding(container.recorded(batch), wanted[batch.channel].only)
        return batch.count, decoders[batch.channel](asked)

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
