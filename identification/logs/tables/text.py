"""The text of a CSV file: its encoding, the lines before its rows, and the rows as a stream of UTF-8."""

import codecs
import csv
import io
import re
from collections.abc import Generator, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from ...errors import LogError
from .layout import TableLayout

_BLOCK_CHARACTERS = 2**18
_BLOCK_BYTES = 2**18
_LINE_LIMIT = 2**20
_LOOKED_AT = 50
_HEAD_BYTES = 2**16
_WESTERN = "cp1252"
_DELIMITERS = (";", "\t", "|", ",")
_NUMBER = re.compile(r"\s*([-+]?(\d+([.,]\d*)?|[.,]\d+)([eE][-+]?\d+)?|[-+]?(nan|inf|infinity)|)\s*", re.IGNORECASE)
COMMA = re.compile(r"[-+]?\d*,\d+([eE][-+]?\d+)?")
_UTF16 = (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)


@dataclass(frozen=True, kw_only=True)
class Text:
    """A CSV file that was looked at: `names` of its columns, and the number of the line where its rows begin.

    `header` holds the lines of names and units, field by field.
    """

    path: Path
    layout: TableLayout
    encoding: str
    delimiter: str
    decimal: str
    names: tuple[str, ...]
    header: tuple[tuple[str, ...], ...]
    first_line: int

    def lines(self) -> Iterator[tuple[int, str]]:
        """Yield number and text of the lines of rows, without comments and without blank lines at the end."""
        blank: list[tuple[int, str]] = []
        with _opened(self.path, self.encoding, newline=None) as file:
            for number, line in enumerate(file, start=1):
                if number >= self.first_line and not is_comment(line, self.layout):
                    blank.append((number, line))
                    if line != "\n":
                        yield from blank
                        blank.clear()


def look_at(path: Path, layout: TableLayout) -> Text:
    """Find out encoding, delimiter and names; raise LogError where the file is no table that can be read."""
    encoding = _encoding(path, layout)
    count = layout.skip_rows + (layout.header_rows or 0) + _LOOKED_AT
    try:
        with _opened(path, encoding, newline=None) as file:
            numbered = list(_numbered(path, file, count))
    except (UnicodeError, LookupError, OSError) as error:
        raise unreadable(path, encoding, error) from error
    written = [(number, line) for number, line in numbered[layout.skip_rows :] if not is_comment(line, layout)]
    while written and not written[0][1].strip():
        written.pop(0)
    if not written:
        raise LogError(f"{path.name} holds no line of a table; record again, or correct the lines that are left out.")
    if layout.header_rows is None and not layout.skip_rows:
        written = written[_count_preamble([line for _, line in written], layout) :]
    delimiter = layout.delimiter or _find_delimiter([line for _, line in written])
    try:
        first = split(written[0][1], delimiter)
    except csv.Error as error:
        raise LogError(f"{path.name}, line {written[0][0]}: it cannot be split ({error}); correct the line.") from error
    rows = [_fields(line, delimiter) for _, line in written]
    header_rows = _count_header(rows) if layout.header_rows is None else layout.header_rows
    _check_header(path, written[:header_rows], rows[:header_rows])
    names = (field.strip() or str(index) for index, field in enumerate(first))
    return Text(
        path=path,
        layout=layout,
        encoding=encoding,
        delimiter=delimiter,
        decimal=layout.decimal or _find_decimal(rows[header_rows:], delimiter),
        names=tuple(names) if header_rows else tuple(map(str, range(len(first)))),
        header=tuple(tuple(fields) for fields in rows[:header_rows]),
        first_line=written[header_rows][0] if header_rows < len(written) else numbered[-1][0] + 1,
    )


class CutOffError(ValueError):
    """The last line of a table has no end."""


def row_blocks(text: Text) -> Generator[bytes]:
    """Yield the rows of a CSV file as UTF-8 in blocks of whole lines, without blank lines at the end.

    Raises CutOffError where the last line has no end, UnicodeError where the file is not in its encoding.
    """
    begun = b""
    for block in _encoded(text):
        begun += block
        end = begun.rfind(b"\n") + 1
        if end >= _BLOCK_BYTES:
            yield begun[:end]
            begun = begun[end:]
    if begun:
        yield begun


def _encoded(text: Text) -> Iterator[bytes]:
    held, is_begun = "", False
    for block in _characters(text):
        whole = held + block
        kept = whole.rstrip("\r\n")
        held = whole[len(kept) :]
        if kept:
            is_begun = True
            yield kept.encode()
    if is_begun and not held:
        with _opened(text.path, text.encoding, newline=None) as file:
            number = sum(1 for _ in file)
        raise CutOffError(
            f"line {number}: the last line has no end, so it may be cut off; "
            "record again, or end the line if the table is complete"
        )
    yield b"\n" if is_begun else b""


def _characters(text: Text) -> Iterator[str]:
    layout = text.layout
    with _opened(text.path, text.encoding, newline="") as file:
        for _ in range(text.first_line - 1):
            file.readline()
        if layout.comment:
            yield from (line for line in file if not is_comment(line, layout))
            return
        while block := file.read(_BLOCK_CHARACTERS):
            yield block


def split(line: str, delimiter: str) -> list[str]:
    """Split a line into its fields; raise csv.Error where a quote is not closed."""
    return next(csv.reader([line.rstrip("\r\n")], delimiter=delimiter, strict=True), [""])


def is_comment(line: str, layout: TableLayout) -> bool:
    """Return whether a line is to be left out."""
    return bool(layout.comment) and line.startswith(layout.comment)


def unreadable(path: Path, encoding: str, error: Exception) -> LogError:
    """Make the error for a file that cannot be read as text."""
    if isinstance(error, UnicodeDecodeError):
        bytes_found = error.object[error.start : error.start + 4].hex(" ")
        reason = f"is not text in {encoding} (it holds the bytes {bytes_found})"
        return LogError(f"{path.name} {reason}; save it as UTF-8, or export it again if it is damaged.")
    return LogError(f"{path.name} cannot be read as text ({error}); save it as UTF-8.")


def _opened(path: Path, encoding: str, *, newline: str | None) -> io.TextIOWrapper:
    return path.open(encoding=encoding, newline=newline)


def _encoding(path: Path, layout: TableLayout) -> str:
    try:
        with path.open("rb") as file:
            head = file.read(_HEAD_BYTES)
    except OSError as error:
        raise LogError(f"{path} cannot be read: {error.strerror or error}; name an existing table.") from error
    if not head:
        raise LogError(f"{path.name} is empty (0 bytes); export it again.")
    if head.startswith(_UTF16):
        return "utf-16"
    if head.startswith(codecs.BOM_UTF8):
        return "utf-8-sig"
    return layout.encoding or (_WESTERN if _is_western(head) else "utf-8-sig")


def _is_western(head: bytes) -> bool:
    """Return whether bytes are no UTF-8, but text as many loggers in Europe write it: ° or ü is one byte.

    It only spells names and remarks; digits are the same.
    """
    try:
        codecs.getincrementaldecoder("utf-8")().decode(head)
    except UnicodeDecodeError:
        text = head.decode(_WESTERN, errors="replace")
        return "\ufffd" not in text and all(each.isprintable() or each.isspace() for each in text)
    return False


def _numbered(path: Path, file: io.TextIOWrapper, count: int) -> Iterator[tuple[int, str]]:
    for number in range(1, count + 1):
        line = file.readline(_LINE_LIMIT)
        if len(line) >= _LINE_LIMIT:
            raise LogError(f"{path.name}, line {number}: longer than {_LINE_LIMIT} characters, which is no table.")
        if not line:
            return
        yield number, line


def _find_delimiter(lines: Sequence[str]) -> str:
    """Return the delimiter that splits the first lines alike, else the one that splits the first line most."""
    lines = [line for line in lines if line.strip()]
    counts = {mark: [len(_fields(line, mark)) for line in lines] for mark in _DELIMITERS}
    alike = [mark for mark, widths in counts.items() if widths[0] > 1 and len(set(widths)) == 1]
    if alike:
        return alike[0]
    most = max(_DELIMITERS, key=lambda mark: counts[mark][0])
    numbers = lines[1 if len(lines) > 1 else 0].split()
    if counts[most][0] <= 1 and len(lines[0].split()) == len(numbers) > 1 and all(map(_NUMBER.fullmatch, numbers)):
        return " "
    return most if counts[most][0] > 1 else ","


def _count_preamble(lines: Sequence[str], layout: TableLayout) -> int:
    """Count the lines before the names of columns: all of another width than every line from the names on."""
    later = lines[len(lines) // 2 :]
    delimiter = layout.delimiter or _find_delimiter(later)
    rows = [_fields(line, delimiter) for line in lines]
    width = len(rows[-1])
    count = max((index + 1 for index, row in enumerate(rows) if len(row) != width), default=0)
    if width < 2 or not 0 < count < len(rows) - 1 or any(len(row) == width for row in rows[:count]):
        return 0
    has_names = not any(_NUMBER.fullmatch(field) for field in rows[count])
    has_numbers = all(_NUMBER.fullmatch(field) for field in rows[-1])
    return count if has_names and has_numbers else 0


def _check_header(path: Path, written: Sequence[tuple[int, str]], rows: Sequence[list[str]]) -> None:
    """Raise LogError where a line that is declared to be of units holds a row of numbers."""
    for (number, _), fields in zip(written[1:], rows[1:], strict=True):
        counted = [str(i) for i in range(len(fields) + 1)]
        if all(_NUMBER.fullmatch(field) for field in fields) and fields not in (counted[:-1], counted[1:]):
            raise LogError(
                f"{path.name}, line {number}: `header_rows: {len(rows)}` takes it for one of names or units, but it "
                "holds numbers only; declare fewer `header_rows` in cell.yaml, or leave it out."
            )


def _count_header(rows: Sequence[list[str]]) -> int:
    """Count the lines of names and, where one is there, of units, before the first line of numbers."""
    if all(_NUMBER.fullmatch(field) for field in rows[0]):
        return 0
    # Of units none is a number; a row with a word among numbers is a faulty one.
    has_units = (
        len(rows) > 2
        and len(rows[0]) == len(rows[1]) == len(rows[2])
        and not any(field.strip() and _NUMBER.fullmatch(field) for field in rows[1])
        and any(field.strip() for field in rows[1])
        and all(_NUMBER.fullmatch(field) for field in rows[2])
    )
    return 2 if has_units else 1


def _find_decimal(rows: Sequence[list[str]], delimiter: str) -> str:
    """Return a comma where every broken number of the first lines is written with one, else the point."""
    fields = [field.strip() for row in rows for field in row]
    commas = delimiter != "," and any(COMMA.fullmatch(field) for field in fields)
    return "," if commas and not any("." in field for field in fields) else "."


def _fields(line: str, delimiter: str) -> list[str]:
    try:
        return split(line, delimiter)
    except csv.Error:
        return []
