"""Rows of a damaged SQLite file, found page by page without its tree: whatever stands in a sound page can be read.

A leaf page of a table is its kind (13), some numbers, and the places of its cells; a cell is the size of its record,
the rowid, and the record, which may go on in a chain of overflow pages. A record is the size of its header, a code for
the type of each column, and the columns. All numbers are big endian or of variable length.
"""

import struct
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import BinaryIO

from .channel import CHUNK_LIMIT_BYTES

Row = tuple[int, int, int, bytes]
_LEAF = 13
_INTEGER_BYTES = {1: 1, 2: 2, 3: 3, 4: 4, 5: 6, 6: 8, 8: 0, 9: 0}
_FLOAT, _SMALLEST_BLOB = 7, 12


class SqlitePages:
    """The whole pages of a file; `columns` are the places of topic_id, timestamp and data in the table `messages`."""

    def __init__(self, path: Path, columns: Sequence[int]) -> None:
        self._path = path
        self._topic, self._time, self._data = columns
        with path.open("rb") as file:
            head = file.read(24)
        (told,) = struct.unpack_from(">H", head, 16)
        self._page_bytes = 65_536 if told == 1 else told
        self._usable = self._page_bytes - head[20]
        is_believable = self._usable >= 480 and self._page_bytes.bit_count() == 1
        # What follows the last whole page is one that was not written to its end.
        self._pages = path.stat().st_size // self._page_bytes if is_believable else 0

    def rows(self, missing: list[str]) -> Iterator[Row]:
        """Yield the rows (rowid, topic_id, timestamp, data) in order, and note in `missing` what is between them."""
        last = 0
        with self._path.open("rb") as file:
            for page, end in self._message_pages(file):
                for row in self._page_rows(file, page):
                    if not last < row[0] < end:
                        continue
                    if row[0] > last + 1:
                        missing.append(f"messages {last + 1} to {row[0] - 1} are missing")
                    last = row[0]
                    yield row
        missing.append(f"what followed message {last}, if anything, is missing")

    def _message_pages(self, file: BinaryIO) -> list[tuple[int, int]]:
        """Return the leaf pages that hold messages, in order, each with the rowid that the next one starts with.

        Pages do not overlap: a larger rowid in a page is damaged.
        """
        first = ((next(self._page_rows(file, page), None), page) for page in range(1, self._pages))
        starts = sorted((row[0], page) for row, page in first if row is not None)
        pages: list[tuple[int, int]] = []
        end = following = 2**63
        for start, page in reversed(starts):
            end = following if start < following else end
            pages.append((page, end))
            following = start
        return pages[::-1]

    def _page(self, file: BinaryIO, page: int) -> bytes:
        file.seek(page * self._page_bytes)
        return file.read(self._page_bytes)

    def _page_rows(self, file: BinaryIO, page: int) -> Iterator[Row]:
        """Yield the messages in a page by rowid; `page` counts from 0, the file itself counts from 1."""
        data = self._page(file, page)
        if data[0] != _LEAF:
            return
        (count,) = struct.unpack_from(">H", data, 3)
        for at in range(8, min(8 + 2 * count, len(data) - 1), 2):
            (start,) = struct.unpack_from(">H", data, at)
            try:
                size, start = _varint(data, start)
                rowid, start = _varint(data, start)
                values = self._values(self._record(file, data, start, size))
            except (IndexError, ValueError, struct.error):
                continue
            yield (rowid, *values)

    def _record(self, file: BinaryIO, data: bytes, start: int, size: int) -> bytes:
        """Return the bytes of a record that begins in a page; raise ValueError where its chain breaks."""
        largest = self._usable - 35
        local = size
        if size > largest:
            smallest = (self._usable - 12) * 32 // 255 - 23
            local = smallest + (size - smallest) % (self._usable - 4)
            local = local if local <= largest else smallest
        if size > min(CHUNK_LIMIT_BYTES, self._pages * self._page_bytes) or start + local > self._usable:
            raise ValueError("a record of unbelievable size")
        pieces, left = [data[start : start + local]], size - local
        following = struct.unpack_from(">I", data, start + local)[0] if left else 0
        while left:
            if not 1 < following <= self._pages:
                raise ValueError("a chain that leads out of the file")
            overflow = self._page(file, following - 1)
            (following,) = struct.unpack_from(">I", overflow)
            pieces.append(overflow[4 : 4 + min(left, self._usable - 4)])
            left -= len(pieces[-1])
        if following:
            raise ValueError("a chain that is too long")
        return b"".join(pieces)

    def _values(self, record: bytes) -> tuple[int, int, bytes]:
        """Return the three columns of a record; raise ValueError where it is no message."""
        header, at = _varint(record, 0)
        start, columns = header, []
        while at < header:
            kind, at = _varint(record, at)
            size = _column_bytes(kind)
            columns.append((kind, record[start : start + size]))
            start += size
        if at != header or start != len(record):
            raise ValueError("a record whose columns do not fill it")
        kind, data = columns[self._data]
        if kind < _SMALLEST_BLOB or kind % 2:
            raise ValueError("a message that is no bytes")
        return _integer(*columns[self._topic]), _integer(*columns[self._time]), data


def _varint(data: bytes, at: int) -> tuple[int, int]:
    """Return a number of variable length and the offset behind it; raise IndexError where the bytes end."""
    value = 0
    for index in range(8):
        value = value << 7 | data[at + index] & 0x7F
        if data[at + index] < 0x80:
            return value, at + index + 1
    value = value << 8 | data[at + 8]
    return value - (value >> 63 << 64), at + 9


def _column_bytes(kind: int) -> int:
    if kind in (0, *_INTEGER_BYTES):
        return _INTEGER_BYTES.get(kind, 0)
    if kind == _FLOAT:
        return 8
    if kind < _SMALLEST_BLOB:
        raise ValueError("a column of unknown type")
    return (kind - _SMALLEST_BLOB) // 2


def _integer(kind: int, data: bytes) -> int:
    if kind not in _INTEGER_BYTES:
        raise ValueError("a column that is no whole number")
    return int.from_bytes(data, "big", signed=True) if data else kind - 8
