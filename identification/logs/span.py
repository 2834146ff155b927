"""The part of a log that is read: from and to a time after its start, or a stamp."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation

import numpy as np
from numpy.typing import NDArray

from problems.errors import ParameterError

from ..errors import OutsideSpanError
from ..result import Finding
from ..signals.recording import StampArray
from .messages.decode import Series
from .roles.registry import Role

Instant = float | str
"""Seconds after the start of a log, as a number or text; with @ in front a stamp in seconds, as GNU date writes it."""
_LARGEST_NS = 2**62
_HELD = frozenset({Role.GAINS, Role.DESIRED_FORCE})
"""Roles whose last value goes on until there is another."""


def _parsed(name: str, instant: Instant | None) -> tuple[int, bool] | None:
    """Return the nanoseconds of an instant, and whether they are those of a stamp."""
    if instant is None:
        return None
    text = str(instant).strip()
    is_stamp = text.startswith("@")
    try:
        number = Decimal(text.removeprefix("@")).scaleb(9)
        if not number.is_finite() or abs(number) > _LARGEST_NS or number < 0:
            raise InvalidOperation
    except InvalidOperation as error:
        must = "seconds after the log's start (12.5), or with @ a stamp in seconds (@1700000012.5)"
        raise ParameterError(name, instant, must) from error
    return round(number), is_stamp


@dataclass(frozen=True, kw_only=True)
class LogSpan:
    """From `start` to `stop`; None is the log's own. A log starts where both its wrench and its pose have begun.

    Raises ParameterError for what is no time, and where `stop` is not after `start`.
    """

    start: Instant | None = None
    stop: Instant | None = None

    def __post_init__(self) -> None:
        first, last = _parsed("from", self.start), _parsed("to", self.stop)
        if first is not None and last is not None and first[1] == last[1] and last[0] <= first[0]:
            raise ParameterError("to", self.stop, f"after the beginning, {self.start}")

    @property
    def has_stamps(self) -> bool:
        """Whether an end is a stamp, which says of several recordings where it lies."""
        return any(str(each).strip().startswith("@") for each in (self.start, self.stop))

    @property
    def is_whole(self) -> bool:
        """Whether all of a log is read."""
        return self.start is None and self.stop is None

    def covers(self, stamp_ns: StampArray, zero_ns: int) -> NDArray[np.bool_]:
        """Return which stamps (n,) are in it, in a log that starts at `zero_ns`."""
        inside = np.ones(stamp_ns.size, dtype=np.bool_)
        for name, instant in (("from", self.start), ("to", self.stop)):
            parsed = _parsed(name, instant)
            if parsed is not None:
                limit = parsed[0] + (0 if parsed[1] else zero_ns)
                inside &= stamp_ns >= limit if name == "from" else stamp_ns <= limit
        return inside

    def __str__(self) -> str:
        first, last = (f"{each:.9g}" if isinstance(each, float) else each for each in (self.start, self.stop))
        return f"{'its start' if first is None else f'{first} s'} to {'its end' if last is None else f'{last} s'}"


WHOLE = LogSpan()


def cut_roles(
    parts: Sequence[dict[Role, Series]], stamps: Sequence[Mapping[Role, StampArray]], span: LogSpan, name: str
) -> tuple[list[dict[Role, Series]], tuple[Finding, ...]]:
    """Return what the parts of a recording hold within a span, without parts that lie outside, and say so.

    `stamps` are those of each role and part on their clocks. Raises OutsideSpanError where nothing is left of a role.
    """
    if span.is_whole:
        return list(parts), ()
    main = [role for role in (Role.WRENCH, Role.POSE) if role in parts[0]]
    zero = max(min(int(part[role][0]) for part in stamps) for role in main)
    end = max(int(part[role][-1]) for part in stamps for role in main)
    kept = []
    for part, times in zip(parts, stamps, strict=True):
        inside = {role: span.covers(times[role], zero) for role in part}
        if all(bool(inside[role].any()) for role in main):
            kept.append({role: series.part(_held(role, inside[role])) for role, series in part.items()})
    empty = [series.topic for part in kept for series in part.values() if not series.log_ns.size]
    if empty or not kept:
        what = f"of topic {empty[0]}" if empty else "of wrench and pose"
        raise OutsideSpanError(
            f"{name} must hold messages {what} from {span}, found none; it is {(end - zero) * 1e-9:.3f} s long and "
            f"starts at @{zero // 10**9}.{zero % 10**9:09d} (with @ a time is a stamp)."
        )
    return kept, (_span_finding(span, name),)


def cut_series(series: Series, span: LogSpan, zero_ns: int) -> Series:
    """Return what a channel holds within a span, by its header stamps where it has them."""
    return series.part(span.covers(series.times_ns, zero_ns))


def _held(role: Role, inside: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return which rows (n,) of a role are of a span: also the one that still holds where it begins."""
    before = np.flatnonzero(~inside[: int(np.argmax(inside))] if inside.any() else ~inside)
    if role in _HELD and before.size:
        inside = inside.copy()
        inside[before[-1]] = True
    return inside


def _span_finding(span: LogSpan, name: str) -> Finding:
    return Finding.info("part-read", f"Of {name} only {span} is read.", "Times are counted from there.")
