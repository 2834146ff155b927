"""MCAP: own framing, so that what is not wanted is neither read nor unpacked, and what is wanted is checked.

The top records are walked first, without the content of chunks. Chunks are then read, unpacked, checked and decoded in
two threads. Counts in the file's summary and indexes have to agree with the messages that are read.
"""

from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import contextmanager
from functools import cached_property
from pathlib import Path

import numpy as np

from ...errors import LogError
from ...result import Finding
from ...signals.recording import StampArray
from .channel import Batch, Channel, Container, Damage, Held, Survey, T, salvaged
from .file_bytes import FileBytes
from .mcap_chunks import ChunkReader, Opened, complete, map_in_order, total_counts
from .mcap_kernel import gather
from .mcap_layout import Layout, Walker
from .mcap_records import Chunk, Definition
from .mcap_salvage import salvage_layout

_IDS = 2**16


def file_findings(layout: Layout) -> tuple[Finding, ...]:
    """Report messages without a checksum, and a file without a summary."""
    found = []
    total = sum(sum((chunk.counts or {}).values()) for chunk in layout.chunks)
    bare = sum(sum((chunk.counts or {}).values()) for chunk in layout.chunks if not chunk.crc)
    if bare and not layout.data_crc:
        found.append(
            Finding.info(
                "crc-absent",
                f"{bare} of {total} messages carry no checksum (CRC): a flipped bit in the file would not be noticed.",
                "Let the recorder write chunk CRCs (rosbag2: storage option `noChunkCRC: false`).",
            )
        )
    if layout.statistics is None:
        found.append(
            Finding.info(
                "summary-absent",
                f"The file has no summary that would confirm that all its {total} messages are there.",
                "Let the recorder write a summary (rosbag2: storage option `noSummary: false`).",
            )
        )
    return tuple(found)


class McapContainer(Container):
    """An MCAP file; with `salvage` damaged parts are left out and reported instead of refused."""

    def __init__(self, path: Path, *, salvage: bool = False) -> None:
        self._file = FileBytes(path)
        self._salvage = salvage

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def survey(self) -> Survey:
        """Return what the file holds, from its indexes where they are complete, else by counter."""
        with self._refusing():
            return self._survey

    def read(self, wanted: Collection[Channel], handle: Callable[[Batch], T]) -> Iterator[tuple[Channel, T]]:
        """Read the wanted channels; see `Container`."""
        with self._refusing():
            yield from self._read(tuple(dict.fromkeys(wanted)), handle)

    def findings(self) -> tuple[Finding, ...]:
        """Return what a salvage leaves out."""
        return salvaged(self._file.name, self._known[0].lost) if self._salvage else ()

    @contextmanager
    def _refusing(self) -> Iterator[None]:
        try:
            yield
        except Damage as damage:
            raise LogError(
                f"{self._file.name} is truncated or damaged at byte {damage.offset}: {damage.reason}; "
                "record again, or read what is left with `--salvage`."
            ) from damage

    @cached_property
    def _known(self) -> tuple[Layout, ChunkReader]:
        if self._salvage:
            return salvage_layout(self._file)
        layout = Walker(self._file).walk()
        opener = ChunkReader(self._file, layout.definitions)
        return complete(layout, self._file, opener), opener

    @cached_property
    def _ids(self) -> dict[Channel, list[int]]:
        """The ids of each channel: those that say the same are one."""
        definitions = self._known[0].definitions
        ids: dict[Channel, list[int]] = {}
        for channel_id in sorted(definitions.usable if self._salvage else definitions.ids):
            ids.setdefault(definitions.channel(channel_id), []).append(channel_id)
        return ids

    @cached_property
    def _survey(self) -> Survey:
        layout, _ = self._known
        total = total_counts(layout.chunks)
        first = self._first_messages()
        filled = [chunk for chunk in layout.chunks if chunk.counts]
        return Survey(
            container="mcap",
            held=tuple(
                Held(channel=channel, count=sum(total[i] for i in ids), first_message=first.get(channel, b""))
                for channel, ids in sorted(self._ids.items(), key=lambda item: (item[0].topic, item[0].type_name))
            ),
            start_ns=min((chunk.start_ns for chunk in filled), default=0),
            end_ns=max((chunk.end_ns for chunk in filled), default=0),
            findings=(*file_findings(layout), *self.findings()),
        )

    def _first_messages(self) -> dict[Channel, bytes]:
        layout, opener = self._known
        missing, found = dict(self._ids), {}
        for chunk in layout.chunks:
            here = [channel for channel, ids in missing.items() if any((chunk.counts or {}).get(i) for i in ids)]
            if here:
                selection = Selection({channel: missing.pop(channel) for channel in here})
                for batch in selection.batches(opener.open(chunk)):
                    begin = int(batch.starts[0])
                    found[batch.channel] = batch.data[begin : begin + int(batch.sizes[0])].tobytes()
        return found

    def _read(self, wanted: tuple[Channel, ...], handle: Callable[[Batch], T]) -> Iterator[tuple[Channel, T]]:
        layout, opener = self._known
        for channel in wanted:
            if channel not in self._ids:
                raise LogError(f"Topic {channel.topic} of type {channel.type_name} is not in {self._file.name}.")
        selection = Selection({channel: self._ids[channel] for channel in wanted})

        def work(chunk: Chunk) -> tuple[tuple[Definition, ...], list[tuple[Channel, T]]]:
            opened = opener.open(chunk)
            return opened.definitions, [(batch.channel, handle(batch)) for batch in selection.batches(opened)]

        for definitions, results in map_in_order(work, filter(selection.is_in, layout.chunks)):
            for definition in definitions:
                layout.definitions.add(*definition)
            yield from results


class Selection:
    """The channels that are wanted of a file, each with its ids."""

    def __init__(self, ids: Mapping[Channel, Collection[int]]) -> None:
        self._ids = ids
        self._slot_of: StampArray = np.full(_IDS, -1, dtype=np.int64)
        for slot, group in enumerate(ids.values()):
            self._slot_of[list(group)] = slot

    def is_in(self, chunk: Chunk) -> bool:
        """Return whether a chunk holds any of them."""
        return any(self._slot_of[channel_id] >= 0 for channel_id in chunk.counts or ())

    def batches(self, opened: Opened) -> Iterator[Batch]:
        """Yield their messages in an opened chunk, a batch for each channel that has any."""
        counts = opened.record_counts.counts
        sizes = [sum(counts.get(channel_id, 0) for channel_id in group) for group in self._ids.values()]
        stops: StampArray = np.cumsum(sizes, dtype=np.int64)
        next_row: StampArray = stops - np.array(sizes, dtype=np.int64)
        table: StampArray = np.empty((3, sum(sizes)), dtype=np.int64)
        log_ns, starts, lengths = table
        gather(opened.data, 0, opened.data.size, self._slot_of, next_row, log_ns, starts, lengths)
        for channel, size, stop in zip(self._ids, sizes, stops.tolist(), strict=True):
            if size:
                rows = slice(stop - size, stop)
                yield Batch(
                    channel=channel, log_ns=log_ns[rows], data=opened.data, starts=starts[rows], sizes=lengths[rows]
                )
