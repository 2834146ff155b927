"""Times of a table's rows in whole nanoseconds, rounded once."""

import numpy as np
import pyarrow as pa  # type: ignore[import-untyped]  # the package carries no annotations

from ...signals.recording import FloatArray, StampArray
from .layout import EXPONENT
from .time_kernel import NO_NUMBER, TOO_LARGE, scaled

_LARGEST_NS = 2**63 - 1


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
