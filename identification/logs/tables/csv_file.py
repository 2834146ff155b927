"""CSV files, converted by Arrow; only the wanted columns are kept."""

from collections.abc import Iterator, Sequence

import numpy as np
import pyarrow as pa  # type: ignore[import-untyped]  # the package carries no annotations
import pyarrow.compute as pc  # type: ignore[import-untyped]  # the package carries no annotations
import pyarrow.csv  # type: ignore[import-untyped]  # the package carries no annotations

from ...errors import LogError
from ...signals.recording import FloatArray, StampArray
from .csv_fault import first_fault
from .layout import NO_ROW
from .text import CutOffError, Rows, Text, unreadable
from .times import from_texts

_BLOCK_BYTES = 2**18
_EMPTY = tuple(" " * width for width in range(40))


def read_csv(text: Text, columns: Sequence[int], time: int | None) -> tuple[FloatArray, StampArray | None]:
    """Return the values (n, len(columns)), NaN where a cell is empty, and the times in ns of the column `time`.

    Raises LogError with the number of the first line at fault.
    """
    values: list[FloatArray] = []
    times: list[StampArray] = []
    kinds = {str(column): pa.float64() for column in columns}
    if time is not None:
        kinds[str(time)] = pa.string()
    try:
        for batch in _batches(text, kinds):
            values.append(np.empty((batch.num_rows, len(columns))))
            for index, column in enumerate(columns):
                values[-1][:, index] = _numbers(batch.column(str(column)), text.layout.decimal)
            if time is not None:
                times.append(_times(batch.column(str(time)), text))
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
    with (
        pa.PythonFile(Rows(text), mode="r") as stream,
        pa.csv.open_csv(
            stream,
            read_options=pa.csv.ReadOptions(
                column_names=[str(index) for index in range(len(text.names))],
                block_size=_BLOCK_BYTES,
                use_threads=False,
            ),
            parse_options=pa.csv.ParseOptions(delimiter=text.delimiter, ignore_empty_lines=False),
            convert_options=pa.csv.ConvertOptions(
                column_types=kinds,
                include_columns=list(kinds),
                null_values=list(_EMPTY),
                strings_can_be_null=True,
                decimal_point=text.layout.decimal,
            ),
        ) as reader,
    ):
        yield from reader


def _numbers(column: pa.Array, decimal: str) -> FloatArray:
    if pa.types.is_string(column.type):
        column = pc.replace_substring(column, decimal, ".").cast(pa.float64())
    numbers: FloatArray = column.to_numpy(zero_copy_only=False)
    return numbers


def _times(column: pa.Array, text: Text) -> StampArray:
    if column.null_count:
        raise ValueError("a time is missing")
    return from_texts(column, text.layout.time_unit, text.layout.decimal)
