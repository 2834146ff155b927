"""ROS 1 bags (version 2.0): only chunks with wanted connections are unpacked, and their index is held against them."""

from collections import Counter
from collections.abc import Callable, Collection, Iterator
from pathlib import Path
from typing import TypeVar

import numpy as np

from ...errors import LogError
from ...result import Finding
from .channel import Batch, Channel, Held, Survey
from .closing import Closing
from .gather import Gatherer
from .ros1_chunk import read_chunk, salvage_chunk
from .ros1_index import MAGIC, BagFile, ChunkPlace, Damage, Layout, read_index, walk_file
from .ros1_records import Op, Walk, copy_messages
from .salvage import salvaged

T = TypeVar("T")

NO_CRC = Finding(
    code="crc-absent",
    severity="info",
    message="A ROS 1 bag carries no checksums (CRC): a flipped bit in the file may go unnoticed.",
    advice="Record MCAP with chunk CRCs where that is possible.",
)


class Ros1BagContainer(Closing):
    """A ROS 1 bag; with `salvage` its index is not used and damaged places are left out."""

    def __init__(self, path: Path, *, salvage: bool = False) -> None:
        self._name, self._salvage = path.name, salvage
        self._survey: Survey | None = None
        self._lost: list[Damage] = []
        self._was_read = False
        try:
            self._file = BagFile(path)
        except OSError as error:
            raise self._refusal(error) from error
        try:
            if self._file.bytes_at(0, min(len(MAGIC), self._file.size)) != MAGIC:
                raise Damage(0, "a ROS 1 bag must start with the line `#ROSBAG V2.0`")
            self._layout: Layout = self._walked_layout() if salvage else read_index(self._file)
        except (Damage, OSError) as error:
            self.close()
            raise self._refusal(error) from error
        self._lost.extend(self._layout.damage)

    def survey(self) -> Survey:
        """Tell what the index counts, or with `salvage` what can be read; raise LogError on damage."""
        if self._survey is None:
            try:
                self._survey = self._walked_survey() if self._salvage else self._indexed_survey()
            except (Damage, OSError) as error:
                raise self._refusal(error) from error
        return self._survey

    def read(self, wanted: Collection[Channel], handle: Callable[[Batch], T]) -> Iterator[tuple[Channel, T]]:
        """Read the wanted channels once; see `Container.read`."""
        if self._salvage:
            self.survey()
        self._was_read = True
        chosen = set(wanted)
        channels = {number: channel for number, channel in self._layout.connections.items() if channel in chosen}
        gatherers = {channel: Gatherer(channel) for channel in channels.values()}
        try:
            for place in self._layout.chunks:
                if self._salvage or place.counts.keys() & channels.keys():
                    for batch in self._batches(place, channels, gatherers):
                        yield batch.channel, handle(batch)
        except (Damage, OSError) as error:
            raise self._refusal(error) from error
        for gatherer in gatherers.values():
            for batch in gatherer.flush():
                yield batch.channel, handle(batch)

    def findings(self) -> tuple[Finding, ...]:
        """Tell what the last `read` had to leave out."""
        return self._salvaged() if self._was_read else ()

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def _walked_layout(self) -> Layout:
        layout = walk_file(self._file)
        try:
            read_index(self._file)
        except Damage as damage:
            # A file that ends between two records looks sound, but for the index.
            if all(damage.offset != known.offset for known in layout.damage):
                layout.damage.append(damage)
        return layout

    def _refusal(self, error: Damage | OSError) -> LogError:
        if isinstance(error, OSError):
            return LogError(f"{self._name} cannot be read: {error.strerror or error}; copy the file again.")
        return LogError(
            f"{self._name} is damaged at byte {error.offset}: {error.reason}; "
            "read what is sound of it with --salvage, or record again."
        )

    def _salvaged(self) -> tuple[Finding, ...]:
        return salvaged(self._name, [f"at byte {item.offset}: {item.reason}" for item in self._lost])

    def _chunk(self, place: ChunkPlace, lost: list[Damage]) -> tuple[bytes, Walk]:
        if self._salvage:
            return salvage_chunk(self._file, place, self._layout.connections, lost)
        return read_chunk(self._file, place, self._layout.connections)

    def _batches(
        self, place: ChunkPlace, channels: dict[int, Channel], gatherers: dict[Channel, Gatherer]
    ) -> Iterator[Batch]:
        data, walk = self._chunk(place, [])
        for channel in {channels[number]: None for number in _numbers(walk) if number in channels}:
            numbers = [number for number, each in channels.items() if each == channel]
            rows = (walk.ops == Op.MESSAGE) & np.isin(walk.connections, numbers)
            packed = copy_messages(data, walk.starts[rows], walk.sizes[rows])
            yield from gatherers[channel].add(walk.log_ns[rows], walk.sizes[rows], packed)

    def _indexed_survey(self) -> Survey:
        connections = self._layout.connections
        counts: Counter[Channel] = Counter()
        first: dict[Channel, bytes] = {}
        for place in self._layout.chunks:
            for number, count in place.counts.items():
                counts[connections[number]] += count
            if any(count and connections[number] not in first for number, count in place.counts.items()):
                self._note_first(*self._chunk(place, []), first)
        filled = [place for place in self._layout.chunks if place.counts]
        start_ns, end_ns = [place.start_ns for place in filled], [place.end_ns for place in filled]
        return self._told(counts, first, min(start_ns, default=0), max(end_ns, default=0))

    def _walked_survey(self) -> Survey:
        connections = self._layout.connections
        counts: Counter[Channel] = Counter()
        first: dict[Channel, bytes] = {}
        times: list[int] = []
        for place in self._layout.chunks:
            data, walk = self._chunk(place, self._lost)
            is_message = walk.ops == Op.MESSAGE
            for number, count in Counter(walk.connections[is_message].tolist()).items():
                if number in connections:
                    counts[connections[number]] += count
                else:
                    reason = f"{count} messages of connection {number}, whose definition is lost"
                    self._lost.append(Damage(place.record.offset, reason))
            if bool(np.any(is_message)):
                times += [int(walk.log_ns[is_message].min()), int(walk.log_ns[is_message].max())]
            self._note_first(data, walk, first)
        return self._told(counts, first, min(times, default=0), max(times, default=0))

    def _told(self, counts: Counter[Channel], first: dict[Channel, bytes], start_ns: int, end_ns: int) -> Survey:
        channels = sorted(
            set(self._layout.connections.values()), key=lambda each: (each.topic, each.type_name, each.schema)
        )
        return Survey(
            container="ros1 bag",
            held=tuple(Held(channel=each, count=counts[each], first_message=first.get(each, b"")) for each in channels),
            start_ns=start_ns,
            end_ns=end_ns,
            findings=(NO_CRC, *self._salvaged()),
        )

    def _note_first(self, data: bytes, walk: Walk, first: dict[Channel, bytes]) -> None:
        rows = np.flatnonzero(walk.ops == Op.MESSAGE)
        _, at = np.unique(walk.connections[rows], return_index=True)
        for row in rows[np.sort(at)].tolist():
            channel = self._layout.connections.get(int(walk.connections[row]))
            if channel is not None and channel not in first:
                start = int(walk.starts[row])
                first[channel] = data[start : start + int(walk.sizes[row])]


def _numbers(walk: Walk) -> list[int]:
    """Return the connections that have a message, sorted."""
    return [int(number) for number in np.unique(walk.connections[walk.ops == Op.MESSAGE])]
