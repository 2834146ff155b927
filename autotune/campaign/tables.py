"""The table of a campaign: a row for each run, as CSV and, with pyarrow, as Parquet."""

import csv
import io
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from autotune.errors import UsageError
from autotune.formats.atomic import write_atomic

from .manifest import TABLES
from .work import RunOutcome

# Columns that every release's tables have, and both kinds of file hold the names of columns as they are.
_ALWAYS = ("recorded_s", "certificate_holds")


def campaign_rows(outcomes: Sequence[RunOutcome]) -> tuple[list[str], list[list[Any]]]:
    """Return the columns and a row for each run; None where there is nothing.

    `reason` says why a run is refused, and why its certificate does not hold.
    """
    names = list(dict.fromkeys(name for each in outcomes for name in each.values))
    axes = list(dict.fromkeys(axis for each in outcomes for axis in each.peaks_n))
    columns = ["cell", "run", "recorded_s", "refused", "reason", "damage", "certificate_holds"]
    columns += [f"{name}{end}" for name in names for end in ("", ".std")]
    columns += [f"{axis}.peak_n.{when}" for axis in axes for when in ("before", "after", "at")]
    replayed = list(dict.fromkeys(axis for each in outcomes for axis in each.log_peaks_n))
    columns += [f"{axis}.log_peak_n.{when}" for axis in replayed for when in ("before", "after", "at")]
    rows = []
    for each in outcomes:
        holds = None if each.outside is None else not each.outside
        reason = " ".join(text for text in (each.reason, "; ".join(each.outside or ())) if text)
        said = (each.refused or None, reason or None, each.damage or None)
        row: list[Any] = [each.cell, each.run, each.recorded_s, *said, holds]
        row += [number for name in names for number in each.values.get(name, (None, None))]
        for shown, peaks, at in ((axes, each.peaks_n, each.peaks_at), (replayed, each.log_peaks_n, each.log_peaks_at)):
            row += [value for axis in shown for value in (*peaks.get(axis, (None, None)), at.get(axis))]
        rows.append(row)
    return columns, rows


def check_tables(folder: Path) -> None:
    """Raise UsageError where `write_tables` would replace a file that no campaign has written."""
    for path in (folder / name for name in TABLES):
        try:
            content = path.read_bytes() if path.is_file() else b""
        except OSError as error:
            raise UsageError(f"{path} cannot be read: {error.strerror or error}.") from error
        if content and not all(name.encode() in content for name in _ALWAYS):
            raise UsageError(
                f"{path} is no table of a campaign, and this one would replace it; move it, or name another folder "
                "for the results."
            )


def write_tables(folder: Path, outcomes: Sequence[RunOutcome]) -> tuple[Path, ...]:
    """Write `campaign.csv` and, where pyarrow is there, `campaign.parquet`; return what was written.

    Without pyarrow a `campaign.parquet` of an earlier run is removed: it would say something else.
    """
    csv_path, parquet_path = (folder / name for name in TABLES)
    columns, rows = campaign_rows(outcomes)
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows([["" if each is None else each for each in row] for row in rows])
    write_atomic(csv_path, text.getvalue())
    written = [csv_path]
    if find_spec("pyarrow") is None:
        parquet_path.unlink(missing_ok=True)
    else:
        write_atomic(parquet_path, _parquet(columns, rows))
        written.append(parquet_path)
    return tuple(written)


def _parquet(columns: Sequence[str], rows: Sequence[Sequence[Any]]) -> bytes:
    import pyarrow as pa  # type: ignore[import-untyped]  # noqa: PLC0415 - an extra
    import pyarrow.parquet as pq  # type: ignore[import-untyped]  # noqa: PLC0415

    table = pa.table({name: [row[i] for row in rows] for i, name in enumerate(columns)})
    sink = pa.BufferOutputStream()
    pq.write_table(table, sink)
    return bytes(sink.getvalue().to_pybytes())
