"""Times of a table in nanoseconds: decimal text is rounded once to a whole number, with no double on the way."""

import numpy as np
import pyarrow as pa  # type: ignore[import-untyped]  # the package carries no annotations
from numpy.typing import NDArray

from problems.arrays import FloatArray
from problems.compiled import compiled

from ...signals.recording import StampArray
from .layout import EXPONENT

Bytes = NDArray[np.uint8]
SOUND, NO_NUMBER, TOO_LARGE = 0, 1, 2
_LARGEST = 2**63 - 1
_LONGEST_EXPONENT = 100_000
_LARGEST_NS = 2**63 - 1


@compiled
def scaled(data: Bytes, offsets: NDArray[np.int32], power: int, mark: int, found: StampArray) -> int:
    """Write text i, `data[offsets[i] : offsets[i + 1]]`, times 10^power into `found`; ties go to the even number.

    `mark` is the character of the decimal mark. Returns SOUND, or why the first text at fault cannot be converted.
    """
    for i in range(found.size):
        status = _number(data, offsets[i], offsets[i + 1], power, mark, found, i)
        if status != SOUND:
            return int(status)
    return SOUND


@compiled
def _number(data: Bytes, start: int, end: int, power: int, mark: int, found: StampArray, i: int) -> int:
    while start < end and _is_blank(data[start]):
        start += 1
    while end > start and _is_blank(data[end - 1]):
        end -= 1
    is_negative = start < end and data[start] == 45
    start += _has_sign(data, start, end)
    digits, before, stop = 0, -1, start
    while stop < end and (48 <= data[stop] <= 57 or (data[stop] == mark and before < 0)):
        if data[stop] == mark:
            before = digits
        else:
            digits += 1
        stop += 1
    exponent = _exponent(data, stop, end)
    if digits == 0 or exponent < -_LONGEST_EXPONENT:
        return NO_NUMBER
    value = _rounded(data, start, stop, mark, (digits if before < 0 else before) + exponent + power)
    if value < 0:
        return TOO_LARGE
    found[i] = -value if is_negative else value
    return SOUND


@compiled
def _rounded(data: Bytes, start: int, stop: int, mark: int, whole: int) -> int:
    """Return the number of which the first `whole` digits are before the point, or -1 where it is too large."""
    value, seen, first, rest = 0, 0, 0, 0
    for at in range(start, stop):
        if data[at] == mark:
            continue
        digit = int(data[at]) - 48
        if seen < whole:
            if value > (_LARGEST - digit) // 10:
                return -1
            value = value * 10 + digit
        elif seen == whole:
            first = digit
        else:
            rest |= digit
        seen += 1
    while seen < whole and value != 0:
        if value > _LARGEST // 10:
            return -1
        value *= 10
        seen += 1
    if first > 5 or (first == 5 and (rest != 0 or value % 2 == 1)):
        return -1 if value == _LARGEST else value + 1
    return value


@compiled
def _is_blank(character: int) -> bool:
    return character in (32, 9)


@compiled
def _has_sign(data: Bytes, start: int, end: int) -> int:
    return 1 if start < end and data[start] in (43, 45) else 0


@compiled
def _exponent(data: Bytes, start: int, end: int) -> int:
    """Return the exponent behind the digits, 0 without one, below -_LONGEST_EXPONENT where it is none."""
    none = -_LONGEST_EXPONENT - 1
    if start == end:
        return 0
    if data[start] != 101 and data[start] != 69:
        return none
    start += 1
    is_negative = start < end and data[start] == 45
    start += _has_sign(data, start, end)
    if start == end:
        return none
    value = 0
    for at in range(start, end):
        if data[at] < 48 or data[at] > 57:
            return none
        value = min(value * 10 + int(data[at]) - 48, _LONGEST_EXPONENT)
    return -value if is_negative else value


def from_texts(texts: pa.Array, unit: str, decimal: str = ".") -> StampArray:
    """Convert numbers written as text, without nulls, ties to the even nanosecond.

    Raises ValueError where one is no number, OverflowError beyond 292 years.
    """
    found = np.zeros(len(texts), dtype=np.int64)
    _, offsets, data = texts.buffers()
    if len(texts) and data is not None:
        ends = np.frombuffer(offsets, dtype=np.int32)[texts.offset : texts.offset + len(texts) + 1]
        status = scaled(np.frombuffer(data, dtype=np.uint8), ends, EXPONENT[unit], ord(decimal), found)
        if status == NO_NUMBER:
            raise ValueError("a time that is no number")
        if status == TOO_LARGE:
            raise OverflowError("a time beyond 292 years")
    return found


def from_decimals(values: pa.Array, unit: str) -> StampArray:
    """Convert decimals without nulls; raise OverflowError beyond 292 years.

    By their texts, as Arrow's own rounding of decimals does not always give the nearest.
    """
    return from_texts(values.cast(pa.string()), unit)


def from_floats(values: FloatArray, unit: str) -> StampArray:
    """Convert doubles; raise OverflowError where one is not finite or beyond 292 years.

    Whole and broken part are converted apart: their product with 1e9 would not hold the digits of both.
    """
    scale = 10 ** EXPONENT[unit]
    if not bool(np.all(np.abs(values) < _LARGEST_NS / scale)):
        raise OverflowError("a time that is not finite or beyond 292 years")
    whole = np.floor(values)
    broken: StampArray = np.rint((values - whole) * scale).astype(np.int64)
    return np.asarray(whole.astype(np.int64) * scale + broken)


def from_integers(values: StampArray, unit: str) -> StampArray:
    """Convert whole numbers; raise OverflowError beyond 292 years."""
    scale = 10 ** EXPONENT[unit]
    if values.size and max(abs(int(values.min())), abs(int(values.max()))) > _LARGEST_NS // scale:
        raise OverflowError("a time beyond 292 years")
    return np.asarray(values.astype(np.int64) * scale)


def from_rate(count: int, sample_rate_hz: float) -> StampArray:
    """Return the times of rows that follow each other with a rate, from 0."""
    return np.asarray(np.rint(np.arange(count) * (1e9 / sample_rate_hz)).astype(np.int64))
