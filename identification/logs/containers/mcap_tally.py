"""Count the records in a piece of memory."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from .channel import ByteArray
from .mcap_kernel import BAD_TIME, FINE, FULL, MESSAGE_HEAD_BYTES, NO_FIT, tally
from .mcap_records import FRAME, FRAME_BYTES

_IDS = 2**16
_NEVER_NS = 2**63 - 1


@dataclass(frozen=True, kw_only=True)
class Tally:
    """Messages per channel id, the recording times they span (0 and 0 without any), where other records stand.

    `fault` says what does not fit at `stop`, empty where all is well.
    """

    counts: Mapping[int, int]
    start_ns: int
    end_ns: int
    others: tuple[int, ...]
    stop: int
    fault: str


class Counting:
    """Arrays that are used again for every count, by one thread."""

    def __init__(self) -> None:
        self._counts = np.zeros(_IDS, dtype=np.int64)
        self._ids = np.empty(_IDS, dtype=np.int64)
        self._others = np.empty(256, dtype=np.int64)
        self._span = np.empty(2, dtype=np.int64)

    def count(self, data: ByteArray) -> Tally:
        """Count the records in `data`."""
        while True:
            self._span[:] = _NEVER_NS, -1
            code, stop, other_count, id_count = tally(
                data, 0, data.size, self._counts, self._ids, self._span, self._others
            )
            ids = self._ids[:id_count]
            counts = dict(zip(ids.tolist(), self._counts[ids].tolist(), strict=True))
            self._counts[ids] = 0
            if code != FULL:
                break
            self._others = np.empty(2 * self._others.size, dtype=np.int64)
        return Tally(
            counts=counts,
            start_ns=int(self._span[0]) if counts else 0,
            end_ns=int(self._span[1]) if counts else 0,
            others=tuple(self._others[:other_count].tolist()),
            stop=stop,
            fault="" if code == FINE else _fault(code, data, stop),
        )


def _fault(code: int, data: ByteArray, position: int) -> str:
    where = f"{position} bytes into it"
    if code == BAD_TIME:
        return f"a message has a recording time of 2^63 ns or more, {where}"
    if code != NO_FIT:
        return f"a message record is too short, {where}: it takes {MESSAGE_HEAD_BYTES} bytes"
    if data.size - position < FRAME_BYTES:
        return f"a record does not fit into its chunk, {where}"
    kind, length = FRAME.unpack_from(data.data, position)
    return f"a record of kind {kind} and {length} bytes does not fit into its chunk, {where}"
