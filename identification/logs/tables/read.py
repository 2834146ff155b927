"""Tables as series of numbers: CSV and Parquet."""

from collections.abc import Sequence
from pathlib import Path

from problems.errors import require_extra

from ...errors import LogError
from ...signals.recording import FloatArray, StampArray
from ..containers.channel import Channel
from ..containers.formats import head_of
from ..messages.series import Series
from .layout import NO_ROW, TableLayout
from .text import Text, look_at

_PARQUET_MAGIC = b"PAR1"

__all__ = ["TableLayout", "list_columns", "read_table"]


def list_columns(path: Path, layout: TableLayout | None = None) -> tuple[str, ...]:
    """Return the names of a table's columns, indices from 0 as text where it has none; raise LogError."""
    if _is_parquet(path):
        return _parquet_names(path)
    return look_at(path, layout or TableLayout()).names


def read_table(path: Path, layout: TableLayout) -> Series:
    """Read the columns of a layout with the time of each row; raise LogError where anything in them is wrong.

    `log_ns` is the time column rounded to nanoseconds, or counted from 0 with the sample rate; the channel is named
    after the file.
    """
    if layout.time is None and layout.sample_rate_hz is None:
        raise LogError(
            f"{path.name} is a table, whose time is not declared; in cell.yaml, `table`, name its time column "
            f"(`time`, of {_names(list_columns(path, layout))}) or give its `sample_rate_hz`."
        )
    kind = "parquet" if _is_parquet(path) else "csv"
    if kind == "parquet":
        from .parquet_file import read_parquet  # noqa: PLC0415 - an extra, and slow to import

        names = _parquet_names(path)
        chosen = [names[_index(path, names, column)] for column in layout.columns]
        time = None if layout.time is None else names[_index(path, names, layout.time)]
        values, log_ns, count = read_parquet(path, chosen, time, layout.time_unit)
    else:
        text = look_at(path, layout)
        columns = [_index(path, text.names, column) for column in layout.columns]
        values, log_ns = _read_csv(text, columns)
        count = len(values)
    if not count:
        raise LogError(f"{path.name} {NO_ROW}.")
    if log_ns is None:
        from .times import from_rate  # noqa: PLC0415 - an extra, and slow to import

        log_ns = from_rate(count, layout.sample_rate_hz or 0.0)
    return Series(
        channel=Channel(topic=path.name, type_name=kind, encoding="table", schema_encoding="", schema=b""),
        fields=layout.columns,
        log_ns=log_ns,
        stamp_ns=None,
        frame_ids=(),
        values=values[:, : len(layout.columns)],
    )


def _parquet_names(path: Path) -> tuple[str, ...]:
    require_extra("A Parquet file", "pyarrow", "tables")
    from .parquet_file import column_names  # noqa: PLC0415 - an extra, and slow to import

    return column_names(path)


def _read_csv(text: Text, columns: Sequence[int]) -> tuple[FloatArray, StampArray | None]:
    require_extra("A CSV file", "pyarrow", "tables")
    from .csv_file import read_csv  # noqa: PLC0415 - an extra, and slow to import

    if text.layout.time is not None:
        return read_csv(text, columns, _index(text.path, text.names, text.layout.time))
    # Some column must be read, if only for its length.
    return read_csv(text, columns or (0,), None)


def _index(path: Path, names: Sequence[str], column: str) -> int:
    """Return the index of a column that is named, or numbered where no column has that name."""
    found = [index for index, name in enumerate(names) if name == column]
    if len(found) == 1:
        return found[0]
    if found:
        places = ", ".join(map(str, found))
        raise LogError(
            f"{path.name} has {len(found)} columns named `{column}` (counted from 0: {places}); rename them."
        )
    if column.isdecimal() and int(column) < len(names):
        return int(column)
    raise LogError(f"{path.name} has no column `{column}`; its columns are: {_names(names)}.")


def _names(names: Sequence[str]) -> str:
    more = f" and {len(names) - 30} more" if len(names) > 30 else ""
    return ", ".join(names[:30]) + more


def _is_parquet(path: Path) -> bool:
    return head_of(path).startswith(_PARQUET_MAGIC)
