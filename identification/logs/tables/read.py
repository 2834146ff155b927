"""Tables as series of numbers, and a table as a log of one channel whose fields are its columns: CSV and Parquet."""

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from problems.arrays import FloatArray
from problems.errors import require_extra

from ...errors import LogError, listed
from ...result import Finding
from ...signals.recording import StampArray
from ..containers.channel import Channel, ChannelInfo, Held, Survey
from ..containers.formats import head_of
from ..messages.decode import JointNames, Series, Wanted
from .layout import NO_ROW, TableLayout
from .text import Text, look_at

TIME_UNDECLARED = "time-undeclared"
_PARQUET_MAGIC = b"PAR1"

_FEWEST_ROUNDED = 20
_FINEST_NS = 1000
_COARSE_SHARE = 0.02
_SLACK = 1.05
_FEWEST_STEPS = 100
_LONGEST_PERIOD_S, _SHORTEST_PERIOD_S = 0.2, 1e-5
_SAME_SPAN = 2.0
_STAND_IN_HZ = 1.0
"""Counts the rows of a table without a time; no time is derived from it."""


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
    if layout.are_poses:
        layout = replace(layout, rows="samples", sample_rate_hz=_STAND_IN_HZ)
    if layout.time is None and layout.sample_rate_hz is None:
        raise LogError(
            f"{path.name} is a table, whose time is not declared; in cell.yaml, `table`, name its time column "
            f"(`time`, of {_names(list_columns(path, layout))}), give its `sample_rate_hz`, or say `rows: poses` where "
            "each row is the mean of a rest."
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
    return read_csv(text, columns, None)


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


@dataclass(frozen=True, kw_only=True)
class RoundedTimes:
    """Stamps (n,) on the even clock that the rounded ones come from, its rate, and what they were rounded to."""

    even_ns: StampArray
    rate_hz: float
    quantum_ns: int


def find_rounding(stamp_ns: StampArray) -> RoundedTimes | None:
    """Return the even clock of which stamps (n,) are the rounded readings; None where there is none, or no need of it.

    All steps are multiples of one quantum that is no small share of the period, and no stamp is off a straight line by
    more than rounding or cutting digits off explains. A lost row, or a clock that is not even, departs from the line.
    """
    if len(stamp_ns) < _FEWEST_ROUNDED:
        return None
    steps = np.diff(stamp_ns)
    quantum = int(np.gcd.reduce(steps))
    if int(steps.min()) < 0 or int(steps.min()) == int(steps.max()) or quantum < _FINEST_NS:
        return None
    since = (stamp_ns - stamp_ns[0]).astype(np.float64)
    rows = np.arange(len(stamp_ns)) - 0.5 * (len(stamp_ns) - 1)
    period = float(rows @ since) / float(rows @ rows)
    line = since.mean() + period * rows
    if quantum < _COARSE_SHARE * period or float(np.ptp(since - line)) > _SLACK * quantum:
        return None
    even: StampArray = stamp_ns[0] + np.rint(line).astype(np.int64)
    return RoundedTimes(even_ns=even, rate_hz=1e9 / period, quantum_ns=quantum)


class TableLog:
    """A CSV or Parquet file; without a declared time its columns can be listed but not read."""

    def __init__(self, path: Path, layout: TableLayout | None, recorded_ns: tuple[int, int] | None = None) -> None:
        self.path = path
        self._recorded_ns = recorded_ns
        self._layout = layout or TableLayout()
        self._is_timed = self._layout.time is not None or self._layout.sample_rate_hz is not None
        self.columns = list_columns(path, self._layout)

    @cached_property
    def units(self) -> tuple[str, ...]:
        """What a second line of the header writes below each name, nothing where there is none."""
        if _is_parquet(self.path):
            return ()
        header = look_at(self.path, self._layout).header
        return header[1] if len(header) > 1 and len(header[1]) == len(self.columns) else ()

    @cached_property
    def infos(self) -> tuple[ChannelInfo, ...]:
        """The one channel."""
        log_ns = self._times.log_ns
        span_s = float(log_ns[-1] - log_ns[0]) / 1e9
        is_timed = span_s > 0 and self._is_timed
        return (
            ChannelInfo(channel=self._times.channel, count=int(log_ns.size), is_timed=is_timed, columns=self.columns),
        )

    @cached_property
    def survey(self) -> Survey:
        """What the table holds."""
        channel, log_ns = self._times.channel, self._times.log_ns
        held = Held(channel=channel, count=int(log_ns.size), first_message=b"")
        start, end = (int(log_ns[0]), int(log_ns[-1])) if self._is_timed else (0, 0)
        return Survey(container=channel.type_name, held=(held,), start_ns=start, end_ns=end, findings=self.findings())

    @property
    def span_s(self) -> float | None:
        """How long the table is by its time column, None without one."""
        log_ns = self._times.log_ns
        return None if self._layout.time is None else float(log_ns.max() - log_ns.min()) * 1e-9

    @cached_property
    def _logged(self) -> Series:
        timed = self._layout
        if not (self._is_timed or timed.are_poses):
            timed = replace(timed, sample_rate_hz=_STAND_IN_HZ)
        return read_table(self.path, timed)

    @cached_property
    def _rounding(self) -> RoundedTimes | None:
        return None if self._layout.time is None else find_rounding(self._logged.log_ns)

    @property
    def _times(self) -> Series:
        return self._logged if self._rounding is None else replace(self._logged, log_ns=self._rounding.even_ns)

    def read(self, channels: Mapping[Channel, Wanted]) -> dict[Channel, Series]:
        """Read columns; raise LogError where one is not there or the time is not declared."""
        if not (self._is_timed or self._layout.are_poses) and any(wanted.fields for wanted in channels.values()):
            read_table(self.path, self._layout)  # says what is to be declared
        # The times are read once; with `poses` nothing is asked of them.
        bare = replace(self._layout, time=None, sample_rate_hz=None, rows="poses")
        read = {
            channel: replace(read_table(self.path, replace(bare, columns=wanted.fields)), log_ns=self._times.log_ns)
            if wanted.fields
            else self._times
            for channel, wanted in channels.items()
        }
        if self._recorded_ns is None:
            return read
        first, last = self._recorded_ns
        return {channel: each.part((each.log_ns >= first) & (each.log_ns < last)) for channel, each in read.items()}

    def frames(self, channel: Channel) -> tuple[tuple[str, str], ...]:
        """List no transforms: a table has none."""
        del channel
        return ()

    def transform(self, channel: Channel, pair: tuple[str, str]) -> Series:
        """Raise LogError: a table has no transforms."""
        raise LogError(f"{channel.topic} is a table and holds no transform of {pair[1]} in {pair[0]}.")

    def joint_names(self, channel: Channel, needed: Collection[str]) -> JointNames:
        """Return no names: the columns of a table are declared."""
        del channel, needed
        return JointNames(names=())

    def findings(self) -> tuple[Finding, ...]:
        """Report that checksums are missing, and the time, if it is not declared."""
        return (*_unprotected(self.path, self._logged.channel.type_name), *self._untimed(), *self._about_times())

    def close(self) -> None:
        """Nothing is open."""

    def _about_times(self) -> Iterator[Finding]:
        """Yield what a time column lost when it was written, and a unit that no control loop has."""
        if self._rounding is not None:
            yield Finding.info(
                "times-rounded",
                f"The times of {self.path.name} are rounded to {self._rounding.quantum_ns * 1e-6:g} ms; rows at "
                f"{self._rounding.rate_hz:.6g} Hz explain all of them and are taken to be there.",
                "Export the time with all its digits where the rows are not evenly spaced.",
            )
        steps = np.diff(self._logged.log_ns) * 1e-9 if self._layout.time is not None else np.zeros(0)
        period = float(np.median(steps)) if steps.size >= _FEWEST_STEPS else 0.0
        if period > _LONGEST_PERIOD_S or 0.0 < period < _SHORTEST_PERIOD_S:
            yield Finding.warning(
                "time-unit",
                f"The rows of {self.path.name} are {period:g} s apart by `time: {self._layout.time}` in "
                f"{self._layout.time_unit}, which no control loop logs.",
                "Declare `time_unit` (s, ms, us, ns) in cell.yaml if it is another.",
            )

    def _untimed(self) -> tuple[Finding, ...]:
        if self._is_timed or self._layout.are_poses:
            return ()
        return (
            Finding.error(
                TIME_UNDECLARED,
                f"{self.path.name} is a table, whose time is not declared; its columns are: {listed(self.columns)}.",
                "In cell.yaml name its time column (`table: {time: …}`), give its `sample_rate_hz`, or say "
                "`rows: poses` where each row is the mean of a rest.",
            ),
        )


def check_time_units(tables: Sequence[TableLog]) -> None:
    """Raise LogError where the times of two tables of one recording differ as their units do: 1000 times, or more."""
    spans = {table.path.name: span for table in tables if len(tables) > 1 and (span := table.span_s)}
    shortest, longest = (min(spans, key=spans.__getitem__), max(spans, key=spans.__getitem__)) if spans else ("", "")
    ratio = spans[longest] / spans[shortest] if spans else 1.0
    factor = 1000.0 ** round(np.log10(ratio) / 3.0)
    if factor > 1.0 and 1.0 / _SAME_SPAN < ratio / factor < _SAME_SPAN:
        raise LogError(
            f"Tables of one recording must count their times in the units that are declared; those of {longest} span "
            f"{spans[longest]:.6g} s, those of {shortest} {spans[shortest]:.6g} s, about {factor:g} times less. "
            f"Declare `tables: {{{longest}: {{time: …, time_unit: …}}, {shortest}: {{…}}}}` in cell.yaml."
        )


def _unprotected(path: Path, kind: str) -> tuple[Finding, ...]:
    checked = (
        "the checksums of its pages are verified where they are there, but most writers leave them out"
        if kind == "parquet"
        else "a CSV carries none"
    )
    return (
        Finding.info(
            "crc-absent",
            f"{path.name} may have no checksums (CRC): {checked}; a flipped bit may go unnoticed.",
            "Record MCAP with chunk CRCs where that is possible.",
        ),
    )
