"""What every container hands on: channels and their raw messages, free of any file format."""

from array import array
from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..recording import StampArray
from ..result import Finding

ByteArray = NDArray[np.uint8]

HEADER_BYTES = 272
"""Bytes kept of a message of which only the header is wanted: 16 fixed ones and a frame name of up to 256."""


class Keep(IntEnum):
    """How much of a channel's messages is held in memory, in bytes per message."""

    TIMES = 0
    HEADERS = HEADER_BYTES
    ALL = 2**32 - 1


@dataclass(frozen=True, kw_only=True)
class Channel:
    """A topic with one type; `encoding` is `cdr`, `ros1` or what else the container names.

    `type_name` is written as in ROS 2 (`package/msg/Name`); `definition` is the message text or empty.
    """

    topic: str
    type_name: str
    encoding: str
    definition: str


@dataclass(frozen=True, kw_only=True)
class RawChannel:
    """The messages of a channel in order of recording.

    `log_ns` (n,) is the recording clock; message i is the next `sizes[i]` bytes of `payload`.
    """

    channel: Channel
    log_ns: StampArray
    sizes: StampArray
    payload: ByteArray

    @property
    def count(self) -> int:
        """Count the messages."""
        return int(self.log_ns.size)

    def message(self, index: int) -> bytes:
        """Return the kept bytes of one message."""
        start = int(self.sizes[:index].sum())
        return self.payload[start : start + int(self.sizes[index])].tobytes()

    def sorted_by_log_time(self) -> "RawChannel":
        """Put messages into order of recording where the file holds them in another one."""
        if bool(np.all(np.diff(self.log_ns) >= 0)):
            return self
        order = np.argsort(self.log_ns, kind="stable")
        ends = np.cumsum(self.sizes)
        pieces = [self.payload[ends[i] - self.sizes[i] : ends[i]] for i in order]
        return RawChannel(
            channel=self.channel,
            log_ns=self.log_ns[order],
            sizes=self.sizes[order],
            payload=np.concatenate(pieces),
        )


@dataclass(frozen=True, kw_only=True)
class Scan:
    """One pass over a log; `start_ns` and `end_ns` span all messages on the recording clock, both 0 without any."""

    path: Path
    container: str
    channels: tuple[RawChannel, ...]
    start_ns: int
    end_ns: int
    findings: tuple[Finding, ...]


class Buffer:
    """Messages of one channel while they arrive, each cut to `limit` bytes."""

    def __init__(self, limit: int) -> None:
        self.limit = limit
        self.log_ns = array("q")
        self.sizes = array("q")
        self.payload = bytearray()

    def add(self, log_ns: int, data: bytes | memoryview) -> None:
        """Add one message."""
        self.log_ns.append(log_ns)
        piece = data[: self.limit]
        self.sizes.append(len(piece))
        self.payload += piece


class Collector:
    """Gather messages per channel while a container is read; equal channels are merged."""

    def __init__(self, keep: Callable[[Channel], Keep]) -> None:
        self._keep = keep
        self._buffers: dict[Channel, Buffer] = {}

    def buffer(self, channel: Channel) -> Buffer:
        """Return the buffer of a channel, to which messages are added."""
        found = self._buffers.get(channel)
        if found is None:
            found = self._buffers[channel] = Buffer(int(self._keep(channel)))
        return found

    def finish(self, path: Path, container: str, findings: tuple[Finding, ...]) -> Scan:
        """Close the pass."""
        channels = tuple(
            RawChannel(
                channel=channel,
                log_ns=np.frombuffer(buffer.log_ns, dtype=np.int64),
                sizes=np.frombuffer(buffer.sizes, dtype=np.int64),
                payload=np.frombuffer(buffer.payload, dtype=np.uint8),
            ).sorted_by_log_time()
            for channel, buffer in sorted(self._buffers.items(), key=lambda item: (item[0].topic, item[0].type_name))
        )
        filled = [raw.log_ns for raw in channels if raw.count]
        return Scan(
            path=path,
            container=container,
            channels=channels,
            start_ns=min((int(log_ns[0]) for log_ns in filled), default=0),
            end_ns=max((int(log_ns[-1]) for log_ns in filled), default=0),
            findings=findings,
        )
