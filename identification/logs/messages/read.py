"""Read from a log the numbers that are wanted of some channels, in one pass."""

from collections.abc import Callable, Mapping

from ...errors import LogError
from ..containers.channel import Batch, Channel, Container
from .decode import CompiledDecoder, MessageError, Part
from .gathering import Gathering
from .layout import build_program
from .objects import ObjectDecoder
from .series import Series, Wanted


def read_series(container: Container, wanted: Mapping[Channel, Wanted]) -> dict[Channel, Series]:
    """Read the wanted numbers of each channel in order of recording.

    ROS messages go through a compiled program of their type, all others, and types that it does not know, one by one
    through a library, with the same result. Raises LogError where the log is damaged, a type has no such number, or a
    message is not as its type says: with its number, topic and byte.
    """
    decoders = {channel: build_decoder(channel, each) for channel, each in wanted.items()}
    gatherings = gather(container, decoders, wanted)
    return {channel: gatherings.pop(channel).finish(channel) for channel in wanted}


def build_decoder(channel: Channel, wanted: Wanted) -> Callable[[Batch], Part]:
    """Return what decodes batches of a channel; raise LogError where its type has no such numbers."""
    program = build_program(channel, wanted)
    if program is None:
        return ObjectDecoder(channel, wanted)
    return CompiledDecoder(channel, program, len(wanted.fields))


def gather(
    container: Container, decoders: Mapping[Channel, Callable[[Batch], Part]], wanted: Mapping[Channel, Wanted]
) -> dict[Channel, Gathering]:
    """Read the channels once and put together what their decoders make of each batch."""
    told = {held.channel: held.count for held in container.survey().held}
    gatherings = {channel: Gathering(each, told.get(channel, 0)) for channel, each in wanted.items()}
    counts = dict.fromkeys(wanted, 0)

    def handle(batch: Batch) -> tuple[int, Part]:
        return batch.count, decoders[batch.channel](batch)

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
    return gatherings
