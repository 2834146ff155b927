"""How the columns of a table are to be read."""

from dataclasses import dataclass
from typing import Annotated

from problems.errors import ParameterError
from problems.frozen import NO_ENTRY, Rule

EXPONENT: dict[str, int] = {"s": 9, "ms": 6, "us": 3, "ns": 0}
"""Power of ten that makes nanoseconds of a unit of time."""
_LARGEST_COUNT = 10_000
NO_ROW = "holds the names of columns but no row; record again"


@dataclass(frozen=True, kw_only=True)
class TableLayout:
    """The wanted columns of a table, its time, and for CSV how it is written.

    `columns` are names, or indices from 0 as text where the table has no names. The time is the column `time`
    in `time_unit`, or the rows follow each other with `sample_rate_hz`, from 0. `delimiter`, `decimal`, `header_rows`
    (the first of which holds the names) and `encoding` are found out where they are None; lines that start with
    `comment` are left out, as are `skip_rows` lines before everything else. With `rows` "poses" each row
    is the mean of a rest in a pose of its own, and no time is asked. Raises ParameterError.
    """

    columns: Annotated[tuple[str, ...], NO_ENTRY] = ()
    time: Annotated[str | None, Rule(minLength=1)] = None
    time_unit: Annotated[str, Rule(enum=[*EXPONENT])] = "s"
    rows: Annotated[str, Rule(enum=["samples", "poses"])] = "samples"
    sample_rate_hz: Annotated[float | None, Rule(exclusiveMinimum=0)] = None
    delimiter: Annotated[str | None, Rule(minLength=1, maxLength=1)] = None
    decimal: Annotated[str | None, Rule(enum=[".", ","])] = None
    comment: Annotated[str, Rule(maxLength=8)] = ""
    skip_rows: Annotated[int, Rule(minimum=0)] = 0
    header_rows: Annotated[int | None, Rule(minimum=0)] = None
    encoding: Annotated[str | None, Rule(minLength=1)] = None

    @property
    def are_poses(self) -> bool:
        """Whether each row is the mean of a rest, without a time."""
        return self.rows == "poses"

    def __post_init__(self) -> None:
        if self.rows not in ("samples", "poses"):
            raise ParameterError("rows", self.rows, "samples or poses")
        if self.are_poses and (self.time is not None or self.sample_rate_hz is not None):
            name = "sample_rate_hz" if self.time is None else "time"
            raise ParameterError(name, getattr(self, name), "left out where each row is a pose at rest, which has none")
        if self.time_unit not in EXPONENT:
            raise ParameterError("time_unit", self.time_unit, "one of s, ms, us, ns")
        if self.sample_rate_hz is not None and not 0 < self.sample_rate_hz <= 1e9:
            raise ParameterError("sample_rate_hz", self.sample_rate_hz, "above 0 and at most 1e9")
        if self.time is not None and self.sample_rate_hz is not None:
            raise ParameterError("sample_rate_hz", self.sample_rate_hz, "left out where a time column is named")
        if self.decimal not in (None, ".", ","):
            raise ParameterError("decimal", self.decimal, "a point or a comma")
        if self.delimiter is not None and (
            len(self.delimiter) != 1 or not self.delimiter.isascii() or self.delimiter in "\r\n\"'.+-0123456789eE"
        ):
            raise ParameterError("delimiter", self.delimiter, "one ASCII character that is in no number")
        if self.delimiter is not None and self.delimiter == self.decimal:
            raise ParameterError("delimiter", self.delimiter, "another character than the decimal mark")
        if len(self.comment) > 8 or not self.comment.isascii() or any(mark in self.comment for mark in '\r\n"'):
            raise ParameterError("comment", self.comment, "at most 8 ASCII characters without quotes")
        for name, count in (("skip_rows", self.skip_rows), ("header_rows", self.header_rows)):
            if count is not None and not 0 <= count <= _LARGEST_COUNT:
                raise ParameterError(name, count, f"between 0 and {_LARGEST_COUNT}")
