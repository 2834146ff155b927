"""CSV files, converted by Arrow, only the wanted columns; an unreadable file is searched for its first bad line."""

import csv
import re
from collections.abc import Iterator, Sequence
from decimal import Decimal, InvalidOperation

import numpy as np
import pyarrow as pa  # type: ignore[import-untyped]  # the package carries no annotations
import pyarrow.compute as pc  # type: ignore[import-untyped]  # the package carries no annotations
import pyarrow.csv  # type: ignore[import-untyped]  # the package carries no annotations

from problems.arrays import FloatArray

from ...errors import LogError
from ...signals.recording import StampArray
from .layout import EXPONENT, NO_ROW
from .text import COMMA, CutOffError, Text, row_blocks, split, unreadable
from .times import from_texts

_DECIMAL_POINT = re.compile(r"[-+]?\d*\.\d+([eE][-+]?\d+)?")
# A date and time by ISO 8601, with or without a zone.
_DATE = re.compile(r"\d{4}-\d\d-\d\d[ T]\d\d:\d\d(:\d\d(\.\d{1,9})?)?(Z|[-+]\d\d:?\d\d)?")
_MISSING = ("", "nan", "NaN", "NAN")
_EMPTY = tuple(" " * width for width in range(40))


def first_fault(text: Text, columns: Sequence[int], time: int | None) -> str | None:
    """Return a sentence that begins with the line number, or None where no line is at fault.

    `columns` are those whose fields must be numbers or empty, `time` is the one that may not be empty.
    """
    dates = _dates(text, columns if time is None else (time, *columns))
    for number, line in text.lines():
        try:
            fields = split(line, text.delimiter)
        except csv.Error as error:
            return f"line {number}: it cannot be split ({error}); correct the line"
        if line.strip("\r\n") and len(fields) != len(text.names):
            return f"line {number}: {_count_fault(text, line, len(fields))}"
        for column in columns if time is None else (time, *columns):
            field = fields[column].strip() if column < len(fields) else ""
            fault = _value_fault(text, column, field, is_time=column == time, is_date=column in dates)
            if fault is not None:
                return f"line {number}: {fault}"
    return None


def _value_fault(text: Text, column: int, field: str, *, is_time: bool, is_date: bool) -> str | None:
    where = f"column `{text.names[column]}` holds {field[:40]!r}"
    if field in _MISSING:
        return f"the time `{text.names[column]}` is missing; remove the row or record again" if is_time else None
    if is_date:
        return None if _DATE.fullmatch(field) else f"{where}, no date and time as in the first row; correct the line"
    if not _is_number(field, text.decimal):
        return _field_fault(text, column, field)
    if is_time and not _is_time(field, text):
        return f"{where}, no time within 292 years; correct the line or its unit"
    return None


def _dates(text: Text, columns: Sequence[int]) -> dict[int, pa.DataType]:
    """Return which columns hold dates by the first row, and as what Arrow reads them."""
    try:
        fields = split(next(text.lines(), (0, ""))[1], text.delimiter)
    except csv.Error:
        return {}
    found = {column: _DATE.fullmatch(fields[column].strip()) for column in columns if column < len(fields)}
    return {column: pa.timestamp("ns", "UTC" if date[3] else None) for column, date in found.items() if date}


def _is_time(field: str, text: Text) -> bool:
    number = _parse(field, text.decimal)
    return number.is_finite() and abs(number.scaleb(EXPONENT[text.layout.time_unit])) < 2**63


def _parse(field: str, decimal: str) -> Decimal:
    if "_" in field or (decimal == "," and "." in field):
        raise InvalidOperation
    return Decimal(field.replace(",", ".") if decimal == "," else field)


def _is_number(field: str, decimal: str) -> bool:
    try:
        _parse(field, decimal)
    except InvalidOperation:
        return False
    return True


def _count_fault(text: Text, line: str, count: int) -> str:
    expected = len(text.names)
    others = [mark for mark in (";", "\t", ",", "|") if mark != text.delimiter and len(split(line, mark)) == expected]
    if others and expected > 1:
        return f"it is separated by {others[0]!r}, the table by {text.delimiter!r}; use one of them throughout"
    if count > expected and text.delimiter == ",":
        hint = "; if commas are decimal marks, export with another delimiter and declare `decimal: ','`"
    else:
        hint = "; the table may be cut off here or the line damaged: export it again"
    return f"{expected} column(s) are expected, found {count}{hint}"


def _field_fault(text: Text, column: int, field: str) -> str:
    where = f"column `{text.names[column]}` holds {field[:40]!r}"
    if text.decimal == "." and COMMA.fullmatch(field):
        return f"{where}, a number with a decimal comma; declare `decimal: ','`"
    if text.decimal == "," and _DECIMAL_POINT.fullmatch(field):
        return f"{where}, a number with a decimal point where a comma is declared; declare `decimal: '.'`"
    if text.delimiter != " " and len(field.split()) == len(text.names) > 1:
        return f"{where}; columns must be separated by one character"
    return f"{where}, not a number; correct the line, or name another column"


def read_csv(text: Text, columns: Sequence[int], time: int | None) -> tuple[FloatArray, StampArray | None]:
    """Return the values (n, len(columns)), NaN where a cell is empty, and the times in ns of the column `time`.

    Dates by ISO 8601 count from 1970, as values in s. Raises LogError with the number of the first line at fault.
    """
    values: list[FloatArray] = []
    times: list[StampArray] = []
    kinds = {str(column): pa.float64() for column in columns}
    if time is not None:
        kinds[str(time)] = pa.string()
    elif not columns:  # Some column must be read, if only for its length.
        kinds["0"] = pa.string()
    try:
        dates = _dates(text, columns if time is None else (time, *columns))
        kinds |= {str(column): kind for column, kind in dates.items()}
        for batch in _batches(text, kinds):
            values.append(np.empty((batch.num_rows, len(columns))))
            for index, column in enumerate(columns):
                values[-1][:, index] = _numbers(batch.column(str(column)), text.decimal)
            if time is not None:
                times.append(_times(batch.column(str(time)), text))
        if not values:
            raise ValueError("no row")
    except (UnicodeError, OSError) as error:
        raise unreadable(text.path, text.encoding, error) from error
    except (pa.ArrowInvalid, ValueError, OverflowError) as error:
        reason = first_fault(text, columns, time)
        if reason is None and isinstance(error, CutOffError):
            reason = str(error)
        if reason is None:
            has_rows = next(text.lines(), None) is not None
            what = f"cannot be read as a table ({' '.join(str(error).split())}); export it again"
            raise LogError(f"{text.path.name} {what if has_rows else NO_ROW}.") from error
        raise LogError(f"{text.path.name}, {reason}.") from error
    return np.concatenate(values), np.concatenate(times) if time is not None else None


def _batches(text: Text, kinds: dict[str, pa.DataType]) -> Iterator[pa.RecordBatch]:
    parsing = pa.csv.ParseOptions(delimiter=text.delimiter, ignore_empty_lines=False)
    converting = pa.csv.ConvertOptions(
        column_types=kinds,
        include_columns=list(kinds),
        null_values=list(_EMPTY),
        strings_can_be_null=True,
        decimal_point=text.decimal,
    )
    names = [str(index) for index in range(len(text.names))]
    for block in row_blocks(text):
        # Arrow reads ahead in a thread of its own, which may outlive an error: it gets memory of Arrow's and never
        # a Python object, whose release at the interpreter's end aborts the process.
        with pa.BufferOutputStream() as copied:
            copied.write(block)
            owned = copied.getvalue()
        reading = pa.csv.ReadOptions(column_names=names, block_size=len(block) + 1, use_threads=False)
        yield from pa.csv.read_csv(pa.BufferReader(owned), reading, parsing, converting).to_batches()


def _numbers(column: pa.Array, decimal: str) -> FloatArray:
    if pa.types.is_timestamp(column.type):
        column = pc.divide(column.cast(pa.int64()).cast(pa.float64(), safe=False), 1e9)
    elif pa.types.is_string(column.type):
        column = pc.replace_substring(column, decimal, ".").cast(pa.float64())
    numbers: FloatArray = column.to_numpy(zero_copy_only=False)
    return numbers


def _times(column: pa.Array, text: Text) -> StampArray:
    if column.null_count:
        raise ValueError("a time is missing")
    if pa.types.is_timestamp(column.type):
        stamps: StampArray = column.cast(pa.int64()).to_numpy(zero_copy_only=False)
        return stamps
    return from_texts(column, text.layout.time_unit, text.decimal)
