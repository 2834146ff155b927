"""Parquet files, read by Arrow with the checksums of their pages verified; only the wanted columns are read.

A column of lists, all of one length, counts as a column for each entry: `q[0]`, `q[1]`, …
"""

import base64
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa  # type: ignore[import-untyped]  # the package carries no annotations
import pyarrow.compute as pc  # type: ignore[import-untyped]  # the package carries no annotations
import pyarrow.parquet  # type: ignore[import-untyped]  # the package carries no annotations

from problems.arrays import FloatArray

from ...errors import LogError
from ...signals.recording import StampArray
from .times import from_decimals, from_floats, from_integers

_FOREIGN = (pa.ArrowException, OSError, ValueError, KeyError, IndexError, TypeError, OverflowError, MemoryError)
_BATCH_ROWS = 65_536
_MOST_ENTRIES = 256
_KEPT_TYPES = (pa.float64(), pa.float32(), pa.int64())
"""Types that Parquet has as Arrow has them."""


@dataclass(frozen=True, kw_only=True)
class _Column:
    """A column of the file, or the entry `index` of its lists of `length`."""

    name: str
    index: int | None = None
    length: int = 1


def column_names(path: Path) -> tuple[str, ...]:
    """Return the names of the columns and of the entries of lists; raise LogError where the file is damaged."""
    with _opened(path) as file:
        return tuple(_columns(path, file))


def _columns(path: Path, file: pa.parquet.ParquetFile) -> Mapping[str, _Column]:
    """Return the columns by name; lists of more entries than 256 stay whole."""
    found: dict[str, _Column] = {}
    twice: list[str] = []
    for column in file.schema_arrow:
        length = _list_length(file, column) if _is_list(column.type) else 0
        whole = {column.name: _Column(name=column.name)}
        entries = {
            f"{column.name}[{i}]": _Column(name=column.name, index=i, length=length)
            for i in range(length if length <= _MOST_ENTRIES else 0)
        }
        twice += [name for name in entries or whole if name in found]
        found |= entries or whole
    if twice:
        raise LogError(f"{path.name} has several columns of one name: {', '.join(twice)}; rename them.")
    return found


def _is_list(kind: pa.DataType) -> bool:
    return bool(pa.types.is_list(kind) or pa.types.is_large_list(kind) or pa.types.is_fixed_size_list(kind))


def _list_length(file: pa.parquet.ParquetFile, column: pa.Field) -> int:
    """Return how many entries the first list of a column has, 0 where there is none or they are no numbers."""
    if not _is_number(column.type.value_type):
        return 0
    if pa.types.is_fixed_size_list(column.type):
        return int(column.type.list_size)
    for batch in file.iter_batches(_BATCH_ROWS, columns=[column.name], use_threads=False):
        lengths = pc.list_value_length(batch.column(column.name)).drop_null()
        if len(lengths):
            return int(lengths[0].as_py())
    return 0


def read_parquet(
    path: Path, columns: Sequence[str], time: str | None, unit: str
) -> tuple[FloatArray, StampArray | None, int]:
    """Return the values (n, len(columns)), NaN where a cell is empty, the times in ns of a column, and n.

    Timestamps and durations carry their own unit; other times are in `unit`. Raises LogError.
    """
    with _opened(path) as file:
        known = _columns(path, file)
        chosen = [known[name] for name in columns]
        wanted = list(dict.fromkeys((*(each.name for each in chosen), *(() if time is None else (time,)))))
        for each in chosen:
            if each.index is None:
                _check_number(path, each.name, file.schema_arrow.field(each.name).type)
        values: list[FloatArray] = []
        times: list[StampArray] = []
        count = 0
        for batch in file.iter_batches(_BATCH_ROWS, columns=wanted, use_threads=False):
            count += batch.num_rows
            values.append(np.empty((batch.num_rows, len(columns))))
            for index, each in enumerate(chosen):
                values[-1][:, index] = _entry(path, batch.column(each.name), each, count - batch.num_rows)
            if time is not None:
                times.append(_times(path, time, batch.column(time), unit, count - batch.num_rows))
        rows = file.metadata.num_rows
        if wanted and count != rows:
            raise LogError(f"{path.name} is damaged: it holds {count} rows, its footer counts {rows}; export it again.")
    numbers = np.concatenate(values) if values else np.empty((0, len(columns)))
    return (
        numbers,
        (np.concatenate(times) if times else np.zeros(0, dtype=np.int64)) if time is not None else None,
        rows,
    )


@contextmanager
def _opened(path: Path) -> Iterator[pa.parquet.ParquetFile]:
    try:
        with (
            path.open("rb") as source,
            pa.parquet.ParquetFile(source, page_checksum_verification=True, memory_map=False) as file,
        ):
            names = file.schema_arrow.names
            if len(set(names)) < len(names):
                twice = ", ".join(sorted({name for name in names if names.count(name) > 1}))
                raise LogError(f"{path.name} has several columns of one name: {twice}; rename them.")
            _check_footer(file)
            yield file
    except _FOREIGN as error:
        reason = " ".join(str(error).split())[:300] or type(error).__name__
        raise LogError(
            f"{path.name} is damaged or no Parquet file that can be read ({reason}); export it again."
        ) from error


def _check_footer(file: pa.parquet.ParquetFile) -> None:
    """Raise ValueError unless the footer, which has no checksum, agrees where it holds names and types twice."""
    stored = (file.metadata.metadata or {}).get(b"ARROW:schema")
    if stored is None:
        return
    read = list(file.schema_arrow)
    stored_fields = list(pa.ipc.read_schema(pa.py_buffer(base64.b64decode(stored))))
    if [field.name for field in read] != [field.name for field in stored_fields] or any(
        one.type != other.type for one, other in zip(read, stored_fields, strict=True) if other.type in _KEPT_TYPES
    ):
        raise ValueError("its footer holds two versions of the names or types of the columns")


def _is_number(kind: pa.DataType) -> bool:
    return bool(pa.types.is_integer(kind) or pa.types.is_floating(kind) or pa.types.is_decimal(kind))


def _check_number(path: Path, name: str, kind: pa.DataType) -> None:
    if not _is_number(kind.value_type if pa.types.is_dictionary(kind) else kind):
        raise LogError(f"Column `{name}` of {path.name} is of type {kind}, it must hold numbers; name another column.")


def _entry(path: Path, column: pa.Array, wanted: _Column, before: int) -> FloatArray:
    """Return the numbers (n,) of a column, or of one entry of its lists, NaN where a list is missing."""
    if wanted.index is None:
        return _numbers(column)
    lengths = pc.fill_null(pc.list_value_length(column), wanted.length)
    other = np.flatnonzero(lengths.to_numpy(zero_copy_only=False) != wanted.length)
    if other.size:
        raise LogError(
            f"Column `{wanted.name}` of {path.name} must hold lists of one length, found {wanted.length} entries and, "
            f"in row {before + int(other[0]) + 1}, {lengths[int(other[0])].as_py()}; name another column."
        )
    return _numbers(pc.list_element(column, wanted.index))


def _numbers(column: pa.Array) -> FloatArray:
    if pa.types.is_dictionary(column.type):
        column = column.dictionary_decode()
    numbers: FloatArray = column.cast(pa.float64(), safe=False).to_numpy(zero_copy_only=False)
    return numbers


def _times(path: Path, name: str, column: pa.Array, unit: str, before: int) -> StampArray:
    where = f"Column `{name}` of {path.name}"
    if column.null_count:
        first = before + column.is_null().to_pylist().index(True) + 1
        raise LogError(f"{where} has no time in row {first}; remove the row or record again.")
    kind = column.type
    try:
        if pa.types.is_timestamp(kind) or pa.types.is_duration(kind):
            return from_integers(_whole(column), kind.unit)
        if pa.types.is_integer(kind):
            return from_integers(_whole(column), unit)
        if pa.types.is_floating(kind):
            return from_floats(_numbers(column), unit)
        if pa.types.is_decimal(kind):
            return from_decimals(column, unit)
    except (OverflowError, pa.ArrowInvalid) as error:
        reason = " ".join(str(error).split())
        raise LogError(f"{where} holds {reason} from row {before + 1} on; check its time unit ({unit}).") from error
    raise LogError(f"{where} is of type {kind}, it must hold times: numbers, timestamps or durations.")


def _whole(column: pa.Array) -> StampArray:
    whole: StampArray = column.cast(pa.int64()).to_numpy(zero_copy_only=False)
    return whole
