"""Open a piece of an MCAP file: read, unpack, check and count it."""

import threading
from dataclasses import dataclass

import lz4.frame  # type: ignore[import-untyped]  # the package carries no annotations
import numpy as np
import zstandard
from zlib_ng import zlib_ng

from .channel import CHUNK_LIMIT_BYTES
from .channel import ByteArray
from .file_bytes import FileBytes
from .mcap_definitions import Definition, Definitions
from .mcap_records import FRAME, FRAME_BYTES, KNOWN, Damage, Kind, Piece
from .mcap_tally import Counting, Tally


@dataclass(frozen=True, kw_only=True)
class Opened:
    """A piece in memory: its records fill `data`, which is valid until the same thread opens the next piece.

    `definitions` are those that were not known; `has_strangers` tells of records whose kind the format does not name.
    """

    piece: Piece
    data: ByteArray
    tally: Tally
    definitions: tuple[Definition, ...]
    has_strangers: bool


class _Space(threading.local):
    """Buffers that a thread uses again for every piece."""

    def __init__(self) -> None:
        self.packed = np.empty(0, dtype=np.uint8)
        self.unpacked = np.empty(0, dtype=np.uint8)
        self.counting = Counting()
        self.zstd = zstandard.ZstdDecompressor()


class Opener:
    """Open pieces of one file, in any thread."""

    def __init__(self, file: FileBytes, definitions: Definitions) -> None:
        self._file, self._definitions = file, definitions
        self._space = _Space()

    def open(self, piece: Piece) -> Opened:
        """Read and check one piece; raise Damage when anything about it is wrong."""
        if piece.declared > CHUNK_LIMIT_BYTES:
            what = f"a chunk unpacks to {piece.declared}" if piece.is_chunk else f"a message has {piece.declared}"
            raise Damage(piece.start, f"{what} bytes, more than the {CHUNK_LIMIT_BYTES} that are allowed")
        data = self.unpack(piece)
        if data.size != piece.declared:
            raise Damage(piece.start, f"a chunk unpacks to {_amount(data, piece)}, it says {piece.declared}")
        if piece.crc and zlib_ng.crc32(data.data) != piece.crc:
            raise Damage(piece.start, "the CRC of a chunk does not agree with its content")
        tally = self._space.counting.count(data)
        _check(piece, tally)
        definitions, has_strangers = self._others(piece, data, tally)
        return Opened(piece=piece, data=data, tally=tally, definitions=definitions, has_strangers=has_strangers)

    def unpack(self, piece: Piece) -> ByteArray:
        """Return the content of a piece, of one byte too many where it goes on beyond what is declared."""
        space = self._space
        space.packed = _at_least(space.packed, piece.stored)
        packed = space.packed[: piece.stored]
        self._file.read_into(piece.body, packed.data)
        try:
            if piece.compression == "zstd":
                return self._unzstd(piece, packed)
            if piece.compression == "lz4":
                return np.frombuffer(_unlz4(packed, piece.declared), dtype=np.uint8)
        except (zstandard.ZstdError, RuntimeError, ValueError, MemoryError, EOFError) as error:
            raise Damage(piece.start, f"a chunk cannot be unpacked ({error})") from error
        return packed

    def _unzstd(self, piece: Piece, packed: ByteArray) -> ByteArray:
        space, size = self._space, piece.declared + 1
        space.unpacked = _at_least(space.unpacked, size)
        target, done = space.unpacked.data[:size], 0
        with space.zstd.stream_reader(packed.data, read_across_frames=True) as reader:
            while done < size and (count := reader.readinto(target[done:])):
                done += count
        return space.unpacked[:done]

    def _others(self, piece: Piece, data: ByteArray, tally: Tally) -> tuple[tuple[Definition, ...], bool]:
        found: list[Definition] = []
        has_strangers = False
        for position in tally.others:
            kind, length = FRAME.unpack_from(data.data, position)
            if kind in (Kind.SCHEMA, Kind.CHANNEL):
                body = data[position + FRAME_BYTES : position + FRAME_BYTES + length].tobytes()
                if self._definitions.is_new(kind, body):
                    found.append((kind, body, piece.start))
            elif kind in KNOWN:
                raise Damage(piece.start, f"a record of kind {kind} stands in a chunk")
            else:
                has_strangers = True
        return tuple(found), has_strangers


def _check(piece: Piece, tally: Tally) -> None:
    """Compare what a piece holds with what was told of it."""
    if tally.fault:
        raise Damage(piece.start, tally.fault)
    total = sum(tally.counts.values())
    if piece.counts is not None and {key: count for key, count in piece.counts.items() if count} != tally.counts:
        raise Damage(piece.start, f"a chunk holds {total} messages, its index has {sum(piece.counts.values())}")
    if total and piece.has_span and not piece.start_ns <= tally.start_ns <= tally.end_ns <= piece.end_ns:
        raise Damage(piece.start, "a chunk holds messages from before or after the times that it tells")


def _amount(data: ByteArray, piece: Piece) -> str:
    return f"{data.size} bytes" if data.size < piece.declared else f"more than {piece.declared} bytes"


def _unlz4(packed: ByteArray, declared: int) -> bytes:
    rest: memoryview | bytes = packed.data
    parts: list[bytes] = []
    room = declared + 1
    while len(rest) and room > 0:
        unpacker = lz4.frame.LZ4FrameDecompressor()
        parts.append(unpacker.decompress(rest, max_length=room))
        room -= len(parts[-1])
        if not unpacker.eof:
            break
        rest = unpacker.unused_data or b""
    return parts[0] if len(parts) == 1 else b"".join(parts)


def _at_least(buffer: ByteArray, size: int) -> ByteArray:
    return buffer if buffer.size >= size else np.empty(size + size // 8, dtype=np.uint8)
