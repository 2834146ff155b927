"""Put the messages of a channel together until there are enough of them to be worth handing on."""

from collections.abc import Iterator, Sequence

import numpy as np

from ...signals.recording import StampArray
from .channel import Batch, ByteArray, Channel

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
