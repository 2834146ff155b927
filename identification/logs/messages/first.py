"""What the first message of each channel of a log shows: whether it has a header, its frame, and its numbers."""

import numpy as np

from ...errors import LogError
from ..containers.channel import Batch, Channel, ChannelInfo, Held, Survey
from .decode import HEADER, ROS_ENCODINGS, MessageError, Series, Wanted, needed_types
from .objects import build_decoder


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
