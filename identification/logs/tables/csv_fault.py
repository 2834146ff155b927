"""Find the first line of a CSV file that cannot be read and say why; slow, so only asked once reading has failed."""

import csv
import re
from collections.abc import Sequence
from decimal import Decimal, InvalidOperation

from .layout import EXPONENT
from .text import Text, split

_DECIMAL_COMMA = re.compile(r"[-+]?\d*,\d+([eE][-+]?\d+)?")
_DECIMAL_POINT = re.compile(r"[-+]?\d*\.\d+([eE][-+]?\d+)?")
_MISSING = ("", "nan", "NaN", "NAN")


def first_fault(text: Text, columns: Sequence[int], time: int | None) -> str | None:
    """Return a sentence that begins with the line number, or None where no line is at fault.

    `columns` are those whose fields must be numbers or empty, `time` is the one that may not be empty.
    """
    for number, line in text.lines():
        try:
            fields = split(line, text.delimiter)
        except csv.Error as error:
            return f"line {number}: it cannot be split ({error}); correct the line"
        if line.strip("\r\n") and len(fields) != len(text.names):
            return f"line {number}: {_count_fault(text, line, len(fields))}"
        for column in columns if time is None else (time, *columns):
            field = fields[column].strip() if column < len(fields) else ""
            if field in _MISSING and column == time:
                return f"line {number}: the time `{text.names[column]}` is missing; remove the row or record again"
            if field not in _MISSING and not _is_number(field, text.layout.decimal):
                return f"line {number}: {_field_fault(text, column, field)}"
            if column == time and not _is_time(field, text):
                return (
                    f"line {number}: column `{text.names[column]}` holds {field[:40]!r}, no time within 292 years; "
                    "correct the line or its unit"
                )
    return None


def _is_time(field: str, text: Text) -> bool:
    number = _parse(field, text.layout.decimal)
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
    if text.layout.decimal == "." and _DECIMAL_COMMA.fullmatch(field):
        return f"{where}, a number with a decimal comma; declare `decimal: ','`"
    if text.layout.decimal == "," and _DECIMAL_POINT.fullmatch(field):
        return f"{where}, a number with a decimal point where a comma is declared; declare `decimal: '.'`"
    if text.delimiter != " " and len(field.split()) == len(text.names) > 1:
        return f"{where}; columns must be separated by one character"
    return f"{where}, not a number; correct the line, or name another column"
