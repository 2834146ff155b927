"""A log of any length for the benchmarks: simulated recordings one after the other, their bytes stamped anew."""

import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import BinaryIO

import numpy as np
import zstandard
from mcap import records
from mcap.data_stream import RecordBuilder
from mcap.reader import make_reader
from numpy.typing import NDArray

from autotune.simulation.phases import Program
from autotune.simulation.simulate import simulate_cell
from autotune.simulation.truth import SimulatedCell
from autotune.simulation.write import write_mcap

_CHUNK_BYTES = 2**20
_HEAD = np.dtype(
    [("kind", "u1"), ("length", "<u8"), ("channel", "<u2"), ("sequence", "<u4"), ("log", "<u8"), ("sent", "<u8")]
)
_MAGIC = b"\x89MCAP0\r\n"
PROGRAM = Program()
_PAUSE_NS = 2 * 10**9
_SECOND = 10**9


@dataclass(frozen=True)
class _Piece:
    """Records of messages one behind the other: where each begins, its channel and its time since the first [ns]."""

    data: NDArray[np.uint8]
    starts: NDArray[np.int64]
    channels: NDArray[np.int64]
    times_ns: NDArray[np.int64]

    @property
    def length_ns(self) -> int:
        return int(self.times_ns[-1]) + _PAUSE_NS

    def stamped(self, start_ns: int) -> NDArray[np.uint8]:
        """Return the records as if the first message had been recorded, and stamped by its sender, at an instant."""
        data, times = self.data.copy(), self.times_ns + start_ns
        for place, values in (
            (_HEAD.fields["log"][1], times.astype("<u8")),  # type: ignore[index]
            (_HEAD.fields["sent"][1], times.astype("<u8")),  # type: ignore[index]
            (_HEAD.itemsize + 4, (times // _SECOND).astype("<u4")),
            (_HEAD.itemsize + 8, (times % _SECOND).astype("<u4")),
        ):
            width = values.dtype.itemsize
            at = (self.starts + place)[:, None] + np.arange(width)
            data[at] = values.view(np.uint8).reshape(-1, width)
        return data


def _pieces(cells: Sequence[SimulatedCell], made: Path) -> tuple[list[_Piece], bytes, int]:
    """Return the messages of simulated cells, and the records that define their schemas and channels."""
    pieces, definitions, count = [], b"", 0
    for seed, cell in enumerate(cells):
        path = made / f"{seed}.mcap"
        write_mcap(simulate_cell(cell, PROGRAM, seed=seed).recording, path)
        with path.open("rb") as file:
            reader = make_reader(file)
            summary = reader.get_summary()
            assert summary is not None
            builder = RecordBuilder()
            for each in (*summary.schemas.values(), *summary.channels.values()):
                each.write(builder)
            definitions, count = builder.end(), len(summary.channels)
            read = [(channel.id, message.log_time, message.data) for _, channel, message in reader.iter_messages()]
        heads = np.zeros(len(read), dtype=_HEAD)
        sizes = np.array([len(data) for _, _, data in read], dtype=np.int64)
        heads["kind"], heads["length"] = 5, sizes + _HEAD.itemsize - 9
        heads["channel"] = channels = np.array([each for each, _, _ in read])
        times = np.array([log_ns for _, log_ns, _ in read], dtype=np.int64)
        raw = b"".join(head.tobytes() + data for head, (_, _, data) in zip(heads, read, strict=True))
        starts = np.concatenate([[0], np.cumsum(sizes + _HEAD.itemsize)[:-1]])
        pieces.append(_Piece(np.frombuffer(raw, dtype=np.uint8), starts, channels, times - times[0]))
    return pieces, definitions, count


def _chunks(pieces: Sequence[_Piece], duration_s: float) -> Iterator[tuple[NDArray[np.uint8], _Piece, slice, int]]:
    """Yield the bytes of each chunk with the piece it is of, its messages and the instant of the piece's start."""
    start_ns, turn = 1_700_000_000 * _SECOND, 0
    end_ns = start_ns + round(duration_s * 1e9)
    while start_ns < end_ns:
        piece = pieces[turn % len(pieces)]
        data = piece.stamped(start_ns)
        edges = np.searchsorted(piece.starts, np.arange(0, data.size, _CHUNK_BYTES))
        for first, last in zip(edges, [*edges[1:], piece.starts.size], strict=True):
            stop = piece.starts[last] if last < piece.starts.size else data.size
            yield data[piece.starts[first] : stop], piece, slice(int(first), int(last)), start_ns
        start_ns, turn = start_ns + piece.length_ns, turn + 1


def write_long_log(path: Path, duration_s: float, cells: Sequence[SimulatedCell], *, compression: str = "") -> int:
    """Write a ROS 2 MCAP of simulated cells in turn, with chunks, indexes and CRCs; return how many messages it has."""
    with TemporaryDirectory() as made:
        pieces, definitions, channel_count = _pieces(cells, Path(made))
    counts: dict[int, int] = {}
    indexes: list[records.ChunkIndex] = []
    packer = zstandard.ZstdCompressor(level=1)
    with path.open("wb") as file:
        builder = RecordBuilder()
        records.Header(profile="ros2", library="autotune benchmark").write(builder)
        file.write(_MAGIC + builder.end() + definitions)
        for data, piece, rows, start_ns in _chunks(pieces, duration_s):
            raw = data.tobytes()
            times = piece.times_ns[rows] + start_ns
            chunk = records.Chunk(
                compression=compression,
                data=packer.compress(raw) if compression == "zstd" else raw,
                message_start_time=int(times[0]),
                message_end_time=int(times[-1]),
                uncompressed_crc=zlib.crc32(raw),
                uncompressed_size=len(raw),
            )
            at = file.tell()
            chunk.write(builder)
            file.write(builder.end())
            stop = file.tell()
            offsets = _write_indexes(file, piece, rows, times, counts)
            indexes.append(
                records.ChunkIndex(
                    chunk_length=stop - at,
                    chunk_start_offset=at,
                    compression=compression,
                    compressed_size=len(chunk.data),
                    message_start_time=chunk.message_start_time,
                    message_end_time=chunk.message_end_time,
                    message_index_length=file.tell() - stop,
                    message_index_offsets=offsets,
                    uncompressed_size=len(raw),
                )
            )
        _write_summary(file, definitions, counts, indexes, channel_count)
    return sum(counts.values())


def _write_indexes(
    file: BinaryIO, piece: _Piece, rows: slice, times: NDArray[np.int64], counts: dict[int, int]
) -> dict[int, int]:
    """Write an index of each channel in a chunk; return where they are."""
    offsets: dict[int, int] = {}
    inside = piece.starts[rows] - piece.starts[rows][0]
    for channel in np.unique(piece.channels[rows]).tolist():
        mine = piece.channels[rows] == channel
        entries = np.stack([times[mine], inside[mine]], axis=1).astype("<u8").tobytes()
        offsets[channel] = file.tell()
        head = bytes([7]) + (6 + len(entries)).to_bytes(8, "little")
        file.write(head + channel.to_bytes(2, "little") + len(entries).to_bytes(4, "little") + entries)
        counts[channel] = counts.get(channel, 0) + int(np.count_nonzero(mine))
    return offsets


def _write_summary(
    file: BinaryIO, definitions: bytes, counts: dict[int, int], indexes: Sequence[records.ChunkIndex], channels: int
) -> None:
    builder = RecordBuilder()
    records.DataEnd(data_section_crc=0).write(builder)
    file.write(builder.end())
    start = file.tell()
    records.Statistics(
        attachment_count=0,
        channel_count=channels,
        channel_message_counts=counts,
        chunk_count=len(indexes),
        message_count=sum(counts.values()),
        message_start_time=indexes[0].message_start_time,
        message_end_time=indexes[-1].message_end_time,
        metadata_count=0,
        schema_count=definitions.count(b"ros2msg"),
    ).write(builder)
    for index in indexes:
        index.write(builder)
    body = definitions + builder.end()
    head = bytes([2]) + (20).to_bytes(8, "little") + start.to_bytes(8, "little") + (0).to_bytes(8, "little")
    file.write(body + head + zlib.crc32(body + head).to_bytes(4, "little") + _MAGIC)
