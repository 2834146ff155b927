"""A table as a log of one channel, whose fields are its columns."""

from collections.abc import Mapping
from dataclasses import replace
from functools import cached_property
from pathlib import Path

from ...errors import LogError, listed
from ...result import Finding
from ..containers.channel import Channel, Held, Survey
from ..messages.channel_info import ChannelInfo
from ..messages.series import Series, Wanted
from .read import TableLayout, list_columns, read_table

_STAND_IN_HZ = 1.0
"""Counts the rows of a table without a declared time; no time is derived from it."""


class TableLog:
    """A CSV or Parquet file; without a declared time its columns can be listed but not read."""

    def __init__(self, path: Path, layout: TableLayout | None) -> None:
        self.path = path
        self._layout = layout or TableLayout()
        self._is_timed = self._layout.time is not None or self._layout.sample_rate_hz is not None
        self.columns = list_columns(path, self._layout)

    @cached_property
    def infos(self) -> tuple[ChannelInfo, ...]:
        """The one channel."""
        log_ns = self._times.log_ns
        span_s = float(log_ns[-1] - log_ns[0]) / 1e9
        rate_hz = (log_ns.size - 1) / span_s if span_s > 0 and self._is_timed else None
        return (
            ChannelInfo(channel=self._times.channel, count=int(log_ns.size), rate_hz=rate_hz, columns=self.columns),
        )

    @cached_property
    def survey(self) -> Survey:
        """What the table holds."""
        channel, log_ns = self._times.channel, self._times.log_ns
        held = Held(channel=channel, count=int(log_ns.size), first_message=b"")
        start, end = (int(log_ns[0]), int(log_ns[-1])) if self._is_timed else (0, 0)
        return Survey(container=channel.type_name, held=(held,), start_ns=start, end_ns=end, findings=self.findings())

    @cached_property
    def _times(self) -> Series:
        timed = self._layout if self._is_timed else replace(self._layout, sample_rate_hz=_STAND_IN_HZ)
        return read_table(self.path, timed)

    def read(self, channels: Mapping[Channel, Wanted]) -> dict[Channel, Series]:
        """Read columns; raise LogError where one is not there or the time is not declared."""
        return {
            channel: read_table(self.path, replace(self._layout, columns=wanted.fields))
            if wanted.fields
            else self._times
            for channel, wanted in channels.items()
        }

    def frames(self, channel: Channel) -> tuple[tuple[str, str], ...]:
        """List no transforms: a table has none."""
        del channel
        return ()

    def transform(self, channel: Channel, pair: tuple[str, str]) -> Series:
        """Raise LogError: a table has no transforms."""
        raise LogError(f"{channel.topic} is a table and holds no transform of {pair[1]} in {pair[0]}.")

    def findings(self) -> tuple[Finding, ...]:
        """Report that checksums are missing, and the time, if it is not declared."""
        return (*_unprotected(self.path, self._times.channel.type_name), *self._untimed())

    def close(self) -> None:
        """Nothing is open."""

    def _untimed(self) -> tuple[Finding, ...]:
        if self._is_timed:
            return ()
        return (
            Finding(
                code="time-undeclared",
                severity="error",
                message=f"{self.path.name} is a table, whose time is not declared; its columns are: "
                f"{listed(self.columns)}.",
                advice="In cell.yaml name its time column (`table: {time: …}`) or give its `sample_rate_hz`.",
            ),
        )


def _unprotected(path: Path, kind: str) -> tuple[Finding, ...]:
    checked = (
        "the checksums of its pages are verified where they are there, but most writers leave them out"
        if kind == "parquet"
        else "a CSV carries none"
    )
    return (
        Finding(
            code="crc-absent",
            severity="info",
            message=f"{path.name} may have no checksums (CRC): {checked}; a flipped bit may go unnoticed.",
            advice="Record MCAP with chunk CRCs where that is possible.",
        ),
    )
