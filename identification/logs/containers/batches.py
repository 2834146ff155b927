"""Gather the messages of a channel into batches, and unpack those that rosbag2 compressed one by one."""

from collections.abc import Iterator, Sequence

import numpy as np
import zstandard

from ...errors import LogError
from ...signals.recording import StampArray
from .channel import CHUNK_LIMIT_BYTES, Batch, ByteArray, Channel

ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
"""How a zstd frame starts; no CDR message does (its first byte is 0)."""
_BATCH_LIMIT_BYTES = 4 * CHUNK_LIMIT_BYTES
_FEED_BYTES = 256
BATCH_BYTES = 2 * 2**20
"""Size from which a batch is handed on: large against the cost of handling one, small against memory."""
BATCH_COUNT = 32_768
"""Number of messages from which a batch is handed on, however small they are."""


class Gatherer:
    """Gather packed messages of one channel into batches."""

    def __init__(self, channel: Channel) -> None:
        self._channel = channel
        self._clear()

    def _clear(self) -> None:
        self._log_ns: list[StampArray] = []
        self._sizes: list[StampArray] = []
        self._data: list[ByteArray] = []
        self._bytes = 0
        self._count = 0

    def add(self, log_ns: StampArray, sizes: StampArray, data: ByteArray) -> Iterator[Batch]:
        """Add messages that lie in `data` one behind the other; yield a batch once there are enough."""
        self._log_ns.append(log_ns)
        self._sizes.append(sizes)
        self._data.append(data)
        self._bytes += data.size
        self._count += log_ns.size
        if self._bytes >= BATCH_BYTES or self._count >= BATCH_COUNT:
            yield from self.flush()

    def flush(self) -> Iterator[Batch]:
        """Yield what is left."""
        if not self._count:
            return
        sizes = np.concatenate(self._sizes)
        batch = Batch(
            channel=self._channel,
            log_ns=np.concatenate(self._log_ns),
            data=np.concatenate(self._data),
            starts=np.cumsum(sizes) - sizes,
            sizes=sizes,
        )
        self._clear()
        yield batch


def pack(messages: Sequence[bytes]) -> tuple[StampArray, ByteArray]:
    """Return the sizes of messages and their bytes one behind the other."""
    sizes = np.fromiter(map(len, messages), dtype=np.int64, count=len(messages))
    return sizes, np.frombuffer(b"".join(messages), dtype=np.uint8)


def unpack_message(data: bytes, topic: str) -> bytes:
    """Unpack one message; raise LogError where it is not zstd or larger than `CHUNK_LIMIT_BYTES`."""
    try:
        size = zstandard.frame_content_size(data)
        if size > CHUNK_LIMIT_BYTES:
            raise _too_large(topic)
        if size < 0:
            return _unpack_unknown(data, topic)
        return zstandard.ZstdDecompressor().decompress(data, max_output_size=max(size, 1))
    except zstandard.ZstdError as error:
        raise LogError(
            f"A message of topic {topic} cannot be unpacked (zstd: {error}); the log is damaged, record again."
        ) from error


def _unpack_unknown(data: bytes, topic: str) -> bytes:
    """Unpack a frame of unknown size, in pieces so small that a bomb is noticed early."""
    unpacker = zstandard.ZstdDecompressor().decompressobj()
    pieces: list[bytes] = []
    left = CHUNK_LIMIT_BYTES
    for at in range(0, len(data), _FEED_BYTES):
        pieces.append(unpacker.decompress(data[at : at + _FEED_BYTES]))
        left -= len(pieces[-1])
        if left < 0:
            raise _too_large(topic)
    if not unpacker.eof:
        raise LogError(f"A compressed message of topic {topic} breaks off; the log is damaged, record again.")
    return b"".join(pieces)


def unpack_messages(batch: Batch, lost: list[str] | None = None) -> Batch:
    """Unpack every message of a batch; those that cannot be are noted in `lost`, without it LogError is raised."""
    kept: list[int] = []
    messages: list[bytes] = []
    left = _BATCH_LIMIT_BYTES
    for index, (start, size) in enumerate(zip(batch.starts, batch.sizes, strict=True)):
        try:
            messages.append(unpack_message(batch.data[start : start + size].tobytes(), batch.channel.topic))
        except LogError as error:
            if lost is None:
                raise
            lost.append(str(error).rstrip("."))
            continue
        kept.append(index)
        left -= len(messages[-1])
        if left < 0:
            raise _too_large(batch.channel.topic)
    sizes, data = pack(messages)
    log_ns = batch.log_ns[np.array(kept, dtype=np.intp)]
    return Batch(channel=batch.channel, log_ns=log_ns, data=data, starts=np.cumsum(sizes) - sizes, sizes=sizes)


def _too_large(topic: str) -> LogError:
    return LogError(
        f"The compressed messages of topic {topic} unpack to more than the {CHUNK_LIMIT_BYTES} bytes "
        "that are allowed; the log is damaged."
    )
