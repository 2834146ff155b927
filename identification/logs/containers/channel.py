"""The interface of all containers: channels, their counts, raw messages in batches, and numbers out of their bytes."""

import os
from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from threading import Lock
from typing import Self, TypeVar

import numpy as np
from numpy.typing import NDArray
from zlib_ng import zlib_ng

from problems.compiled import inlined

from ...errors import LogError
from ...result import Finding
from ...signals.recording import StampArray

ByteArray = NDArray[np.uint8]
T = TypeVar("T")
LeaveOut = Callable[[str], object]
"""Leave out the chunk that some messages are from, for a reason."""

CHUNK_LIMIT_BYTES = 256 * 2**20
"""Largest size a compressed chunk may unpack to; recorders use a few MiB."""
_LISTED = 5
_CRC_BYTES = 2**20
_LARGE_BYTES = 50_000_000


@dataclass(frozen=True, kw_only=True)
class Channel:
    """A topic with one type. Channels that are equal in all of this are one, however often the file defines them.

    `type_name` is written as in ROS 2 (`package/msg/Name`) for ROS types, else as the file has it; `encoding` is that
    of the messages (`cdr`, `ros1`, `json`, `protobuf` or what else the container names); `schema` is what the file
    carries of the type, in the language `schema_encoding` (`ros2msg`, `ros1msg`, `ros2idl`, `jsonschema`, `protobuf`,
    empty for none).
    """

    topic: str
    type_name: str
    encoding: str
    schema_encoding: str
    schema: bytes


class Damage(Exception):  # noqa: N818 - it is what is found, and becomes a LogError or a finding
    """Something at a byte of the file is not as the format says: `offset` is where."""

    def __init__(self, offset: int, reason: str) -> None:
        super().__init__(reason)
        self.offset, self.reason = offset, reason


@dataclass(frozen=True, kw_only=True)
class Held:
    """What a log holds of a channel: the number of messages and the first of them, empty where there is none."""

    channel: Channel
    count: int
    first_message: bytes


@dataclass(frozen=True, kw_only=True)
class ChannelInfo:
    """A channel, its number of messages, and the frame in its first header.

    `columns` are the names that a table has, empty for messages. `has_header` says whether messages start with one;
    rows of a table may have no time, and then it is not `is_timed`.
    """

    channel: Channel
    count: int
    is_timed: bool = True
    frame: str | None = None
    has_header: bool = False
    columns: tuple[str, ...] = ()

    def __str__(self) -> str:
        """Name the channel for a list to choose from."""
        return self.described()

    def described(self, rate_hz: float | None = None) -> str:
        """Name the channel, with its rate where its stamps were read."""
        facts = [self.channel.type_name or "no type", f"{self.count} messages"]
        if rate_hz is not None:
            facts.append(f"{rate_hz:.1f} Hz")
        if self.frame:
            facts.append(f"frame {self.frame}")
        return f"{self.channel.topic} ({', '.join(facts)})"


Infos = Sequence[ChannelInfo]


@dataclass(frozen=True, kw_only=True)
class Survey:
    """What a log holds, known without decoding it.

    `container` names the format; `start_ns` and `end_ns` span all messages on the recording clock, both 0 without any;
    `findings` report what was seen of the container itself (no CRCs, no index).
    """

    container: str
    held: tuple[Held, ...]
    start_ns: int
    end_ns: int
    findings: tuple[Finding, ...]


@dataclass(frozen=True, kw_only=True)
class Batch:
    """Some messages of one channel in the order of the file.

    `log_ns` (n,) is the recording clock; message i is `data[starts[i] : starts[i] + sizes[i]]`. `data` may be shared
    with other batches and is valid only while the batch is being handled. `leave_out` makes the container leave out the
    chunk that the messages are from, for the reason that it is called with; None where a checksum agrees with the
    content, or nothing says what the chunk holds.
    """

    channel: Channel
    log_ns: StampArray
    data: ByteArray
    starts: StampArray
    sizes: StampArray
    leave_out: LeaveOut | None = None

    @property
    def count(self) -> int:
        """Count the messages."""
        return int(self.log_ns.size)

    def part(self, keep: NDArray[np.bool_]) -> "Batch":
        """Return the messages that a mask (n,) keeps."""
        return replace(self, log_ns=self.log_ns[keep], starts=self.starts[keep], sizes=self.sizes[keep])


def pack(messages: Sequence[bytes]) -> tuple[StampArray, ByteArray]:
    """Return the sizes of messages and their bytes one behind the other."""
    sizes = np.fromiter(map(len, messages), dtype=np.int64, count=len(messages))
    return sizes, np.frombuffer(b"".join(messages), dtype=np.uint8)


class Container(ABC):
    """An opened log file (or folder of files) of one format; a context manager.

    `recorded_ns` are the instants on the recording clock between which messages are wanted, all where it is None:
    chunks that lie outside need not be read, other messages from outside are the caller's to leave out.
    """

    recorded_ns: tuple[int, int] | None = None

    def may_want(self, start_ns: int, end_ns: int) -> bool:
        """Return whether messages recorded from `start_ns` to `end_ns`, 0 and 0 where nobody knows, may be wanted."""
        if self.recorded_ns is None or (start_ns, end_ns) == (0, 0):
            return True
        return start_ns < self.recorded_ns[1] and end_ns >= self.recorded_ns[0]

    def recorded(self, batch: Batch) -> Batch:
        """Return the messages of a batch that were recorded from the first instant on and before the second."""
        if self.recorded_ns is None:
            return batch
        return batch.part((batch.log_ns >= self.recorded_ns[0]) & (batch.log_ns < self.recorded_ns[1]))

    @abstractmethod
    def survey(self) -> Survey:
        """Return what the log holds; raise LogError if it is damaged."""

    @abstractmethod
    def read(self, wanted: Collection[Channel], handle: Callable[[Batch], T]) -> Iterator[tuple[Channel, T]]:
        """Read the wanted channels once and yield what `handle` makes of each batch, per channel in file order.

        `handle` may be called in several threads at once, on different batches. Raises LogError as soon as anything
        that is read turns out to be damaged, at the latest when the iteration ends.
        """

    def lost(self) -> tuple[str, ...]:
        """Name the damaged places that were left out so far."""
        return ()

    def close(self) -> None:  # noqa: B027 - what opens nothing has nothing to close
        """Close the files."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()


class FileBytes:
    """A file that is read at given offsets, by several threads at once; its size is that at the time of opening."""

    def __init__(self, path: Path) -> None:
        self.name, self.path = path.name, path
        try:
            self._file = path.open("rb", buffering=0)
        except OSError as error:
            raise LogError(f"{path} cannot be read: {error.strerror}; name an existing log file.") from error
        self._lock = Lock()
        state = os.fstat(self._file.fileno())
        self.size, self.changed_ns = state.st_size, state.st_mtime_ns

    def read(self, offset: int, length: int) -> bytes:
        """Read up to `length` bytes, fewer only at the end of the file."""
        wanted = max(0, min(length, self.size - offset))
        data = bytearray(wanted)
        self.read_into(offset, memoryview(data))
        return bytes(data)

    def read_into(self, offset: int, target: memoryview) -> None:
        """Fill `target` from an offset; raise LogError when the file has become shorter since it was opened."""
        done = 0
        while done < len(target):
            count = self._read_some(offset + done, target[done:])
            if not count:
                raise LogError(f"{self.name} has become shorter while it was read; close the recorder and read again.")
            done += count

    def crc32(self, start: int, stop: int) -> int:
        """Return the CRC-32 of the bytes from `start` to `stop`."""
        crc, buffer = 0, bytearray(min(_CRC_BYTES, max(0, stop - start)))
        while start < stop:
            part = memoryview(buffer)[: stop - start]
            self.read_into(start, part)
            crc = zlib_ng.crc32(part, crc)
            start += len(part)
        return crc

    def _read_some(self, offset: int, target: memoryview) -> int:
        if hasattr(os, "preadv"):
            return os.preadv(self._file.fileno(), [target], offset)
        with self._lock:
            self._file.seek(offset)
            return self._file.readinto(target) or 0

    def close(self) -> None:
        """Close the file."""
        self._file.close()


def worked_out(work: Callable[[FileBytes], T], file: FileBytes) -> T:
    """Return `work` of a file; that of a large one is kept, since it is read in many windows."""
    return work(file) if file.size < _LARGE_BYTES else _in_state(work, file.path, file.size, file.changed_ns)


@lru_cache(maxsize=4)
def _in_state(work: Callable[[FileBytes], T], path: Path, size: int, changed_ns: int) -> T:
    del size, changed_ns
    file = FileBytes(path)
    try:
        return work(file)
    finally:
        file.close()


def recorded_text(start_ns: int, end_ns: int, first_ns: int) -> str:
    """Say when messages were recorded, from the first instant of the log on."""
    return f"recorded {1e-9 * (start_ns - first_ns):.3f} to {1e-9 * (end_ns - first_ns):.3f} s after the log's start"


def salvaged(name: str, lost: Sequence[str], *, salvage: bool) -> tuple[Finding, ...]:
    """Return one warning that names the damaged places of a file, or nothing where there are none.

    Without `salvage` they are chunks of a file whose index is sound: what is beside them is as it was recorded.
    """
    if not lost:
        return ()
    more = f"; and {len(lost) - _LISTED} more" if len(lost) > _LISTED else ""
    advice = (
        "Use the result to look at the data; record again before a robot relies on it."
        if salvage
        else "Record again where a rest, a motion or a contact is missed."
    )
    return (Finding.warning("salvaged", f"{name} is damaged: {'; '.join(lost[:_LISTED])}{more}.", advice),)


# Positions become unsigned first: with them the compiler sees one load where eight bytes are put together, with signed
# ones it sees eight loads and asks at each whether the index counts from the end.
_1, _2, _3, _4, _8, _16, _24, _32 = (np.uint64(value) for value in (1, 2, 3, 4, 8, 16, 24, 32))


@inlined
def little16(data: ByteArray, at: int) -> np.uint64:
    """Return 2 bytes, the lowest first."""
    place = np.uint64(at)
    return np.uint64(data[place]) | np.uint64(data[place + _1]) << _8


@inlined
def little32(data: ByteArray, at: int) -> np.uint64:
    """Return 4 bytes, the lowest first."""
    place = np.uint64(at)
    low = np.uint64(data[place]) | np.uint64(data[place + _1]) << _8
    return low | np.uint64(data[place + _2]) << _16 | np.uint64(data[place + _3]) << _24


@inlined
def little64(data: ByteArray, at: int) -> np.uint64:
    """Return 8 bytes, the lowest first."""
    place = np.uint64(at)
    return little32(data, place) | little32(data, place + _4) << _32  # type: ignore[arg-type]


@inlined
def big32(data: ByteArray, at: int) -> np.uint64:
    """Return 4 bytes, the highest first."""
    place = np.uint64(at)
    high = np.uint64(data[place]) << _24 | np.uint64(data[place + _1]) << _16
    return high | np.uint64(data[place + _2]) << _8 | np.uint64(data[place + _3])


@inlined
def u16(data: ByteArray, at: int) -> int:
    """Return an unsigned number of 2 bytes, the lowest first."""
    return int(np.int64(little16(data, at)))


@inlined
def u32(data: ByteArray, at: int) -> int:
    """Return an unsigned number of 4 bytes, the lowest first."""
    return int(np.int64(little32(data, at)))


@inlined
def u64(data: ByteArray, at: int) -> int:
    """Return a number of 8 bytes, the lowest first; 2^63 and more come out negative, as no length or time is."""
    return int(np.int64(little64(data, at)))
