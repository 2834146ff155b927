"""Walk an MCAP file by the chunk index of its summary.

So the damaged head of a chunk record costs that chunk, and a damaged length of a message index costs nothing.
"""

from collections.abc import Iterator, Mapping
from dataclasses import replace

import numpy as np
from mcap import records
from mcap.opcode import Opcode

from .channel import Damage, FileBytes
from .mcap_kernel import FRAME_BYTES, Chunk
from .mcap_layout import CHUNK_HEAD_BYTES, INDEX_HEAD_BYTES, Layout, Walker, parse_chunk, parse_index_head, read_summary


def walk(file: FileBytes) -> Layout:
    """Return the layout of a file; a chunk whose head is damaged, but not what lists it, has a `fault`.

    Raises Damage where anything else is wrong.
    """
    try:
        return Walker(file).walk()
    except Damage as damage:
        try:
            return _IndexedWalker(file, read_summary(file)[0].chunk_indexes).walk()
        except Damage:
            raise damage from None


class _IndexedWalker(Walker):
    """Take place, size and times of a chunk from the index where its head says something else."""

    def __init__(self, file: FileBytes, listed: list[records.ChunkIndex]) -> None:
        super().__init__(file)
        self._listed: Mapping[int, records.ChunkIndex] = {index.chunk_start_offset: index for index in listed}

    def walk_data(self, offset: int) -> int:
        index = self._listed.get(offset)
        if index is None:
            return super().walk_data(offset)
        chunk = _listed_chunk(index)
        fault = self._fault(chunk)
        if fault and not self._is_proven(index):
            raise Damage(offset, fault)
        self.chunks.append(replace(chunk, fault=fault) if fault else self._chunk_at(offset))
        return self._walk_message_indexes(chunk, chunk.stop + index.message_index_length)

    def _walk_message_indexes(self, chunk: Chunk, stop: int) -> int:
        """Take in the message indexes of a chunk; of damaged ones none, and its content has to be counted."""
        offset = chunk.stop
        try:
            while offset < stop:
                if self.frame(offset)[0] != Opcode.MESSAGE_INDEX:
                    raise Damage(offset, "a message index should be here")
                offset = super().walk_data(offset)
        except Damage:
            offset = -1
        if offset != stop:
            self.indexed.pop(chunk.start, None)
        return stop

    def _chunk_at(self, offset: int) -> Chunk:
        kind, length = self.frame(offset)
        if kind != Opcode.CHUNK:
            raise Damage(offset, f"a chunk should start here, a record of kind {kind} does")
        head = self.peek(offset + FRAME_BYTES, CHUNK_HEAD_BYTES)
        return parse_chunk(head, offset, offset + FRAME_BYTES + length)

    def _fault(self, listed: Chunk) -> str:
        """Return what is wrong with the head of a chunk, empty where it says the same as the index."""
        try:
            found = self._chunk_at(listed.start)
        except Damage as damage:
            return f"the head of a chunk is damaged: {damage.reason}"
        same = replace(found, crc=0) == listed
        return "" if same else "the head of a chunk names other times or sizes than the summary lists"

    def _is_proven(self, index: records.ChunkIndex) -> bool:
        """Return whether the message indexes that follow a chunk are where its index says and span its times."""
        try:
            times = np.concatenate([*self._message_times(index)]) if index.message_index_offsets else np.empty(0)
        except Damage:
            return False
        return times.size > 0 and (times.min(), times.max()) == (index.message_start_time, index.message_end_time)

    def _message_times(self, index: records.ChunkIndex) -> Iterator[np.ndarray[tuple[int], np.dtype[np.uint64]]]:
        begin = index.chunk_start_offset + index.chunk_length
        for channel_id, offset in index.message_index_offsets.items():
            if not begin <= offset < begin + index.message_index_length:
                raise Damage(offset, "a message index is not behind its chunk")
            kind, length = self.frame(offset)
            body = self.body(offset, length)
            found, count = parse_index_head(body[:INDEX_HEAD_BYTES], length, offset)
            if (kind, found) != (Opcode.MESSAGE_INDEX, channel_id):
                raise Damage(offset, f"the message index of channel {channel_id} should start here")
            yield np.frombuffer(body, dtype="<u8", count=2 * count, offset=INDEX_HEAD_BYTES)[::2]


def _listed_chunk(index: records.ChunkIndex) -> Chunk:
    """Return the chunk that an index describes, without its CRC, which an index does not hold."""
    stop = index.chunk_start_offset + index.chunk_length
    return Chunk(
        start=index.chunk_start_offset,
        stop=stop,
        body=stop - index.compressed_size,
        stored=index.compressed_size,
        declared=index.uncompressed_size,
        is_chunk=True,
        compression=index.compression,
        crc=0,
        start_ns=index.message_start_time,
        end_ns=index.message_end_time,
        counts=None,
    )
