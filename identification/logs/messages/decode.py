"""Turn a batch of messages into numbers by the compiled program of their type."""

from dataclasses import dataclass

import numpy as np

from problems.arrays import FloatArray

from ...signals.recording import StampArray
from ..containers.channel import Batch, Channel
from .kernel import MAX_DEPTH, run_program
from .kernel_bytes import ENCAPSULATION, FINE, FRAMES_FULL, LEFT_OVER, NANOSECONDS, TERMINATOR, TOO_FEW, TOO_SHORT
from .layout import DecoderProgram

_REASONS = {
    TOO_SHORT: "a field at byte {at} does not fit into its {size} bytes",
    LEFT_OVER: "its type ends at byte {at}, the message has {size}",
    ENCAPSULATION: "its encapsulation {head} is not plain CDR (00 00 or 00 01), which the RMW should write",
    TERMINATOR: "a string should end with a zero at byte {at}",
    TOO_FEW: "the sequence at byte {at} has fewer entries than are wanted",
    NANOSECONDS: "its stamp has a second of more than 999999999 ns at byte {at}",
}


class MessageError(Exception):
    """A message of a batch, by its `index`, is not what its type says."""

    def __init__(self, batch: Batch, index: int, reason: str) -> None:
        super().__init__(reason)
        self.channel, self.index, self.reason = batch.channel, index, reason


@dataclass(frozen=True, kw_only=True)
class Part:
    """What a batch holds: (n,) recording times, (n,) header stamps or None, frame names, (n, k) values."""

    log_ns: StampArray
    stamp_ns: StampArray | None
    frame_ids: frozenset[str]
    values: FloatArray


class CompiledDecoder:
    """Decode batches of one channel; may be called in several threads."""

    def __init__(self, channel: Channel, program: DecoderProgram, width: int) -> None:
        self._program, self._width = program, width
        self._is_cdr = channel.encoding == "cdr"

    def __call__(self, batch: Batch) -> Part:
        """Decode a batch; raise MessageError for the first message that is not as its type says."""
        program = self._program
        values = np.empty((batch.count, self._width))
        stamps = np.empty(batch.count, dtype=np.int64)
        bits = np.empty(1, dtype=np.uint32)
        out = (values, values.view(np.uint64), bits, bits.view(np.float32))
        found, loops = np.zeros(1, dtype=np.int64), np.empty((MAX_DEPTH, 2), dtype=np.int64)
        code, room = FRAMES_FULL, 32
        while code == FRAMES_FULL:
            room *= 2
            frames = np.empty((room, 2), dtype=np.int64)
            code, index, at = run_program(
                batch.data,
                batch.starts,
                batch.sizes,
                self._is_cdr,
                program.steps,
                program.picks,
                out,
                stamps,
                frames,
                found,
                loops,
            )
        if code != FINE:
            raise MessageError(batch, index, fault(code, at, batch, index))
        return Part(
            log_ns=batch.log_ns.copy(),
            stamp_ns=stamps if program.has_header else None,
            frame_ids=frozenset(name_at(batch, *frame) for frame in frames[: found[0]].tolist()),
            values=values,
        )


def fault(code: int, at: int, batch: Batch, index: int) -> str:
    """Say what a kernel found in a message."""
    start, size = int(batch.starts[index]), int(batch.sizes[index])
    head = batch.data[start : start + min(4, size)].tobytes().hex(" ")
    return _REASONS[code].format(at=at, size=size, head=head)


def name_at(batch: Batch, place: int, length: int) -> str:
    """Return the name at a place in the data of a batch; raise MessageError if it is no text."""
    try:
        return batch.data[place : place + length].tobytes().decode()
    except UnicodeDecodeError as error:
        index = int(np.flatnonzero((batch.starts <= place) & (place <= batch.starts + batch.sizes))[0])
        raise MessageError(batch, index, f"a frame name is no text: {error}") from error
