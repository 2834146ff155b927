"""Parts and windows of logs that are too long to be in memory as a whole."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from ..errors import LogError, OutsideSpanError
from .read import LONGEST_WHOLE_S, WHOLE, WINDOW_S, LogSpan, first_instant, is_long, recorded_spans, window_bounds
from .roles.cell import Cell

# What recording clock and headers may drift apart in a day of a bad clock.
_MARGIN_NS = 10 * 10**9
_FIRST_S = (10.0, 100.0, 1000.0)


def located(paths: Sequence[Path], cell: Cell, span: LogSpan, *, salvage: bool = False) -> LogSpan:
    """Return a span of a log by stamps, and where it was recorded, so that no more is read than is asked for.

    Of `recorded_ns` the ends are those of the span as far as the clocks of header and recording go alike, and the
    log's own where the span has none. Raises OutsideSpanError where the log holds nothing of it, LogError for no log.
    """
    spans = recorded_spans(paths, cell, salvage=salvage)
    begin, end = min(start for start, _ in spans), max(stop for _, stop in spans)
    if span.is_whole:
        return LogSpan(recorded_ns=(begin, end + 1))
    zero_ns, zero_log_ns = _start(paths, cell, begin, end, salvage=salvage)
    first, last = span.bounds_ns(zero_ns)
    late = zero_log_ns - zero_ns
    recorded = (begin if first is None else max(begin, first + late), end + 1 if last is None else last + late + 1)
    recorded = (recorded[0], min(recorded[1], end + 1))
    if recorded[1] <= recorded[0]:
        raise OutsideSpanError(
            f"{', '.join(path.name for path in paths)} must hold messages from {span}, found none; it is "
            f"{(end - zero_log_ns) * 1e-9:.3f} s long and starts at @{zero_ns // 10**9}.{zero_ns % 10**9:09d} (with @ "
            "a time is a stamp)."
        )
    return LogSpan(start=_stamp(first), stop=_stamp(last), recorded_ns=recorded)


def _start(paths: Sequence[Path], cell: Cell, begin_ns: int, end_ns: int, *, salvage: bool) -> tuple[int, int]:
    """Return where wrench and pose have both begun, by their clock and as recorded."""
    for length_s in _FIRST_S:
        try:
            first = (begin_ns, begin_ns + round(1e9 * length_s))
            return first_instant(paths, cell, salvage=salvage, recorded_ns=first)
        except LogError:
            continue
    return first_instant(paths, cell, salvage=salvage, recorded_ns=(begin_ns, end_ns + 1))


def _stamp(stamp_ns: int | None) -> str | None:
    return None if stamp_ns is None else f"@{stamp_ns // 10**9}.{stamp_ns % 10**9:09d}"


@dataclass(frozen=True, kw_only=True)
class WindowSpan:
    """A window of a log: what is read of it, of which files, and its ends in seconds after the log's first message."""

    files: tuple[Path, ...]
    span: LogSpan
    start_s: float
    stop_s: float


def windows_of_part(
    paths: Sequence[Path],
    cell: Cell,
    span: LogSpan = WHOLE,
    *,
    width_s: float | None = None,
    salvage: bool = False,
    overlap_s: float = 0.0,
) -> tuple[WindowSpan, ...]:
    """Return the windows of a span of logs, of `width_s`; without, of ten minutes if the logs are long.

    A log that is not long has none, unless their width is said; a short span of a long one is one window. Each reads
    `overlap_s` of its neighbours too. Messages at the ends of a span are found by the recording clock with a margin,
    and cut by the log's own.

    Raises
    ------
    OutsideSpanError
        Nothing of the span is in the logs.
    LogError
        A file is no log.
    """
    if width_s is None and not is_long(paths, cell, salvage=salvage):
        return ()
    spans = recorded_spans(paths, cell, salvage=salvage)
    begin, overlap = min(first for first, _ in spans), round(1e9 * overlap_s)
    part = located(paths, cell, span, salvage=salvage)
    start, stop = part.recorded_ns or (0, 0)
    is_short = width_s is None and (stop - start) / 1e9 <= LONGEST_WHOLE_S
    bounds = window_bounds(start, stop - 1, (stop - start) / 1e9 if is_short else width_s or WINDOW_S)
    windows = []
    for k, (first, last) in enumerate(bounds):
        is_first, is_last = k == 0, k == len(bounds) - 1
        read = (max(first - (_MARGIN_NS if is_first else overlap), 0), last + (_MARGIN_NS if is_last else overlap))
        windows.append(
            WindowSpan(
                files=tuple(path for path, held in zip(paths, spans, strict=True) if _meet(held, read)),
                # Only the ends of the part are cut by the log's clock.
                span=LogSpan(
                    start=part.start if is_first else None, stop=part.stop if is_last else None, recorded_ns=read
                ),
                start_s=(first - begin) / 1e9,
                stop_s=(last - begin) / 1e9,
            )
        )
    return tuple(windows)


def _meet(held: tuple[int, int], read: tuple[int, int]) -> bool:
    return held[0] < read[1] and held[1] >= read[0]
