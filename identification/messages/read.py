"""Read from a log the numbers that are wanted of some channels, in one pass."""

from collections.abc import Callable, Mapping
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from ..containers.channel import Batch, Channel, Container
from ..errors import LogError
from .decode import CompiledDecoder, MessageError, Part
from .layout import build_program
from .objects import ObjectDecoder
from .series import Series, Wanted

Number = TypeVar("Number", np.int64, np.float64)


def read_series(container: Container, wanted: Mapping[Channel, Wanted]) -> dict[Channel, Series]:
    """Read the wanted numbers of each channel in order of recording.

    ROS messages go through a compiled program of their type, all others, and types that it does not know, one by one
    through a library, with the same result. Raises LogError where the log is damaged, a type has no such number, or a
    message is not as its type says: with its number, topic and byte.
    """
    decoders = {channel: build_decoder(channel, each) for channel, each in wanted.items()}
    parts = read_parts(container, decoders)
    return {channel: join(channel, each, parts.pop(channel)) for channel, each in wanted.items()}


def build_decoder(channel: Channel, wanted: Wanted) -> Callable[[Batch], Part]:
    """Return what decodes batches of a channel; raise LogError where its type has no such numbers."""
    program = build_program(channel, wanted)
    if program is None:
        return ObjectDecoder(channel, wanted)
    return CompiledDecoder(channel, program, len(wanted.fields))


def read_parts(container: Container, decoders: Mapping[Channel, Callable[[Batch], Part]]) -> dict[Channel, list[Part]]:
    """Read the channels once and return what their decoders make of each batch, in file order."""
    parts: dict[Channel, list[Part]] = {channel: [] for channel in decoders}
    counts = dict.fromkeys(decoders, 0)

    def handle(batch: Batch) -> tuple[int, Part]:
        return batch.count, decoders[batch.channel](batch)

    try:
        for channel, (count, part) in container.read(tuple(decoders), handle):
            parts[channel].append(part)
            counts[channel] += count
    except MessageError as fault:
        number = counts[fault.channel] + fault.index + 1
        raise LogError(
            f"Message {number} of topic {fault.channel.topic} is damaged or no {fault.channel.type_name}: "
            f"{fault.reason}; record again or leave this topic out."
        ) from fault
    return parts


def join(channel: Channel, wanted: Wanted, parts: list[Part]) -> Series:
    """Put the parts of a channel together, in order of recording; what was recorded at once stays in file order."""
    log_ns = _joined([part.log_ns for part in parts], np.empty(0, dtype=np.int64))
    values = _joined([part.values for part in parts], np.empty((0, len(wanted.fields))))
    stamp_ns = None
    if wanted.header:
        stamp_ns = _joined([part.stamp_ns for part in parts if part.stamp_ns is not None], np.empty(0, dtype=np.int64))
    frame_ids = tuple(sorted(frozenset[str]().union(*(part.frame_ids for part in parts))))
    parts.clear()
    if bool(np.any(log_ns[1:] < log_ns[:-1])):
        order = np.argsort(log_ns, kind="stable")
        log_ns, values = log_ns[order], values[order]
        stamp_ns = None if stamp_ns is None else stamp_ns[order]
    return Series(
        channel=channel,
        fields=wanted.fields,
        log_ns=log_ns,
        stamp_ns=stamp_ns,
        frame_ids=frame_ids,
        values=values,
    )


def _joined(pieces: list[NDArray[Number]], empty: NDArray[Number]) -> NDArray[Number]:
    if len(pieces) == 1:
        return pieces[0]
    return np.concatenate(pieces) if pieces else empty
