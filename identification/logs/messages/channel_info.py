"""What is known of each channel before its messages are decoded: count, rate, frame, header."""

from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from ...errors import LogError
from ..containers.channel import Batch, Channel, Container, Held, Survey
from .definitions import has_header
from .read import read_series
from .series import Wanted

T = TypeVar("T")


@dataclass(frozen=True, kw_only=True)
class ChannelInfo:
    """A channel, its number of messages, its rate over the whole log, and the frame in its first header.

    `columns` are the names that a table has, empty for messages. `has_header` says whether messages start with one.
    """

    channel: Channel
    count: int
    rate_hz: float | None = None
    frame: str | None = None
    has_header: bool = False
    columns: tuple[str, ...] = ()

    def __str__(self) -> str:
        """Name the channel for a list to choose from."""
        facts = [self.channel.type_name or "no type", f"{self.count} messages"]
        if self.rate_hz is not None:
            facts.append(f"{self.rate_hz:.1f} Hz")
        if self.frame:
            facts.append(f"frame {self.frame}")
        return f"{self.channel.topic} ({', '.join(facts)})"


Infos = Sequence[ChannelInfo]


def build_infos(survey: Survey) -> tuple[ChannelInfo, ...]:
    """Return what is known of each channel of a survey; a first message that cannot be decoded has no frame."""
    span_s = (survey.end_ns - survey.start_ns) / 1e9
    infos = [_info(held, span_s) for held in survey.held]
    return tuple(sorted(infos, key=lambda info: (info.channel.topic, info.channel.type_name)))


def _info(held: Held, span_s: float) -> ChannelInfo:
    is_headed = has_header(held.channel)
    return ChannelInfo(
        channel=held.channel,
        count=held.count,
        rate_hz=(held.count - 1) / span_s if held.count > 1 and span_s > 0 else None,
        frame=_frame(held) if is_headed and held.count else None,
        has_header=is_headed,
    )


def _frame(held: Held) -> str | None:
    try:
        series = read_series(FirstMessage(held), {held.channel: Wanted(fields=())})
    except LogError:
        return None
    frames = series[held.channel].frame_ids
    return frames[0] if frames else None


class FirstMessage(Container):
    """A container that holds the first message of one channel."""

    def __init__(self, held: Held) -> None:
        self._held = held

    def survey(self) -> Survey:
        """Return the one message."""
        return Survey(container="message", held=(self._held,), start_ns=0, end_ns=0, findings=())

    def read(self, wanted: Collection[Channel], handle: Callable[[Batch], T]) -> Iterator[tuple[Channel, T]]:
        """Read the one message."""
        held = self._held
        if held.channel in wanted and held.count:
            data = np.frombuffer(held.first_message, dtype=np.uint8)
            zero = np.zeros(1, dtype=np.int64)
            size = np.array([data.size], dtype=np.int64)
            yield held.channel, handle(Batch(channel=held.channel, log_ns=zero, data=data, starts=zero, sizes=size))
