"""Messages that rosbag2 compressed one by one."""

import numpy as np
import zstandard

from ...errors import LogError
from .bounded_file import CHUNK_LIMIT_BYTES
from .channel import Batch
from .gather import pack

ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
"""How a zstd frame starts; no CDR message does (its first byte is 0)."""
_BATCH_LIMIT_BYTES = 4 * CHUNK_LIMIT_BYTES
_FEED_BYTES = 256


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
    """Unpack a frame that does not tell its size, in pieces so small that a bomb is noticed early."""
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
