"""Search a damaged MCAP file for places at which something sound starts."""

from collections.abc import Callable, Collection
from dataclasses import replace

import numpy as np

from .channel import CHUNK_LIMIT_BYTES
from .channel import ByteArray
from .file_bytes import FileBytes
from .mcap_kernel import find_chunk, find_messages
from .mcap_layout import message_piece
from .mcap_pieces import Opener
from .mcap_records import CHUNK_HEAD_BYTES, FRAME, FRAME_BYTES, Damage, Kind, Piece, parse_chunk
from .mcap_tally import Counting

_WINDOW_BYTES = 4 * 2**20
_OVERLAP_BYTES = 2**18
_IDS = 2**16


def next_chunk(file: FileBytes, opener: Opener, begin: int, stop: int) -> int | None:
    """Return where the first chunk record starts at or after `begin` that unpacks and agrees with its CRC, if any."""
    while True:
        found = _search(file, find_chunk, begin, stop)
        if found is None or _is_sound(file, opener, found):
            return found
        begin = found + 1


def _is_sound(file: FileBytes, opener: Opener, start: int) -> bool:
    try:
        opener.open(_chunk_at(file, start))
    except Damage:
        return False
    return True


def _chunk_at(file: FileBytes, start: int) -> Piece:
    head = file.read(start, FRAME_BYTES + CHUNK_HEAD_BYTES)
    _, length = FRAME.unpack_from(head)
    piece = parse_chunk(head[FRAME_BYTES:], start, start + FRAME_BYTES + length)
    if piece.stop > file.size:
        raise Damage(start, "a chunk does not fit into the file")
    return piece


def next_messages(file: FileBytes, channel_ids: Collection[int], begin: int, stop: int) -> int | None:
    """Return where the first message of a known channel starts after which other records follow, if any."""
    is_known = np.zeros(_IDS, dtype=np.uint8)
    is_known[list(channel_ids)] = 1
    return _search(file, lambda data, start, end: find_messages(data, start, end, is_known), begin, stop)


def _search(file: FileBytes, find: Callable[[ByteArray, int, int], int], begin: int, stop: int) -> int | None:
    while begin < stop:
        data = np.frombuffer(file.read(begin, min(_WINDOW_BYTES, stop - begin)), dtype=np.uint8)
        found = find(data, 0, data.size)
        if found >= 0:
            return begin + found
        if begin + data.size >= stop:
            break
        begin += data.size - _OVERLAP_BYTES
    return None


def cut_chunk(file: FileBytes, start: int) -> Piece | None:
    """Return the whole messages of a chunk without compression whose end is beyond that of the file, if it is that."""
    head = file.read(start, FRAME_BYTES + CHUNK_HEAD_BYTES)
    if len(head) < FRAME_BYTES + CHUNK_HEAD_BYTES or head[0] != Kind.CHUNK:
        return None
    _, length = FRAME.unpack_from(head)
    try:
        piece = parse_chunk(head[FRAME_BYTES:], start, start + FRAME_BYTES + length)
    except Damage:
        return None
    if piece.compression or piece.declared > CHUNK_LIMIT_BYTES or piece.body + piece.stored <= file.size:
        return None
    data = np.frombuffer(file.read(piece.body, piece.stored), dtype=np.uint8)
    tally = Counting().count(data)
    if not tally.stop:
        return None
    whole = Counting().count(data[: tally.stop])
    return replace(message_piece(piece.body, piece.body + tally.stop, whole), start=start)


def start_of_last(file: FileBytes, piece: Piece) -> tuple[int, ByteArray]:
    """Return where the last message starts in a piece outside of chunks, and the bytes before it."""
    data = np.frombuffer(file.read(piece.start, piece.stop - piece.start), dtype=np.uint8)
    position = last = 0
    while position < data.size:
        last = position
        position += FRAME_BYTES + FRAME.unpack_from(data.data, position)[1]
    return piece.start + last, data[:last]
