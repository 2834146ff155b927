"""Header stamps of a channel: rate, jitter, gaps, and what makes them unusable."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from problems.arrays import FloatArray

from ...result import Finding
from ...signals.medians import median
from ...signals.recording import LARGEST_GAP_PERIODS, StampArray

HOLE = "hole"
"""Code of the warning of holes: pauses of the recorder, and lost messages."""
_LOST_PERIODS = 1.5
_LOST_DEVIATIONS = 6.0
_JITTER_SHARE = 0.1
_FOLDED_PERIODS = 1.5
_FEWEST_FOLDED = 8
_MOSTLY = 0.9
_LISTED_HOLES = 5
_CLOCK_ADVICE = "Keep the clock from being set during a recording (NTP, PTP, a restarted driver), and record again."
_ADVICE = "Record with the sensor driver's own clock in the header and one publisher per topic."
_JITTER_ADVICE = "Stamp where the sample is taken, not where it is published."
_TABLE_ADVICE = "Export the time with all its digits and the rows in their order, or declare `sample_rate_hz` instead."


@dataclass(frozen=True, kw_only=True)
class StampReport:
    """Steps between stamps: median `period_s`, their standard deviation and worst departure from it (gaps left out).

    `gaps` lists (index of the message after the gap, length in s); `lost` is how many messages would fill them.
    """

    count: int
    period_s: float
    jitter_std_s: float
    jitter_worst_s: float
    gaps: tuple[tuple[int, float], ...]
    lost: int


def report_stamps(stamp_ns: StampArray) -> StampReport:
    """Measure the steps of (n,) stamps, n ≥ 2."""
    steps = np.diff(stamp_ns)
    period = median(steps)
    scatter = 1.4826 * median(np.abs(steps - period))
    # A late message makes a long step and a short one; a lost one makes a long step only.
    limit = max(_LOST_PERIODS * period, period + _LOST_DEVIATIONS * scatter)
    long = np.flatnonzero(steps > limit) if period > 0.0 else np.zeros(0, dtype=np.int64)
    around = steps[np.minimum(long + 1, len(steps) - 1)]
    made_up = (around < 0.6 * period) & (steps[long] + around < 2.6 * period)
    gaps = long[~made_up]
    regular = np.delete(steps, gaps) if len(gaps) < len(steps) else steps
    departure = regular - period
    return StampReport(
        count=len(stamp_ns),
        period_s=period * 1e-9,
        jitter_std_s=float(np.std(departure)) * 1e-9,
        jitter_worst_s=float(np.max(np.abs(departure))) * 1e-9,
        gaps=tuple((int(i) + 1, float(steps[i]) * 1e-9) for i in gaps),
        lost=int(np.sum(np.round(steps[gaps] / period) - 1)) if len(gaps) else 0,
    )


def stamp_faults(
    topic: str,
    stamp_ns: StampArray,
    since_start_s: FloatArray,
    *,
    keeps_holes: bool = False,
    is_table: bool = False,
) -> Iterator[Finding]:
    """Yield what is wrong with stamps (n,): zero, constant, backwards, repeated; gaps and jitter.

    They are those of headers or the times of a table, which is what the messages speak of. `since_start_s` (n,) is
    when each message was recorded. With `keeps_holes` (a salvaged log) a long gap is a warning: it is kept as a hole.
    """
    name = f"times of table {topic}" if is_table else f"header stamps of topic {topic}"
    advice = _TABLE_ADVICE if is_table else _ADVICE
    if stamp_ns.size < 2:
        yield Finding.error(
            "too-few-messages", f"Topic {topic} holds {stamp_ns.size} message(s).", "Record the whole run."
        )
        return
    if bool(np.all(stamp_ns == stamp_ns[0])):
        what = "zero" if stamp_ns[0] == 0 else f"the same ({stamp_ns[0] / 1e9:.9f} s)"
        yield Finding.error("constant-stamps", f"All {stamp_ns.size} {name} are {what}.", advice)
        return
    if bool(np.any(stamp_ns <= 0)):
        when = since_start_s[stamp_ns <= 0]
        yield Finding.error(
            "zero-stamps", f"Topic {topic} has {when.size} header stamps of zero or less, {_at(when)}.", _ADVICE
        )
    steps = np.diff(stamp_ns)
    back = steps < 0
    if bool(np.any(back)):
        when = since_start_s[1:][back]
        yield Finding.error(
            "backwards-stamps",
            f"{when.size} {name} go backwards, {_at(when)}, by up to {-float(steps.min()) * 1e-9:.6f} s.",
            advice if is_table else _CLOCK_ADVICE,
        )
    # What a clock that was set back stamped twice explains the duplicates there.
    folded = np.zeros(len(steps), dtype=np.bool_)
    for start, stop in _find_folds(steps):
        folded[start:stop] = True
        yield Finding.error(
            "backwards-stamps",
            f"The {name} go back by about {(stamp_ns[stop] - stamp_ns[start]) * 1e-9:.3f} s: "
            f"the time from {since_start_s[start]:.3f} to {since_start_s[stop]:.3f} s after the start of the log is "
            "covered twice, by two messages in each period. The clock of the recording went back too.",
            _CLOCK_ADVICE,
        )
    repeated = (steps == 0) & ~folded
    if bool(np.any(repeated)):
        when = since_start_s[1:][repeated]
        yield Finding.error(
            "duplicate-stamps",
            f"{when.size} {name} repeat the one before, {_at(when)}.",
            advice,
        )
    if bool(np.all(steps > 0)) and not bool(np.any(folded)):
        report = report_stamps(stamp_ns)
        yield from _uneven(topic, report, since_start_s, keeps_holes=keeps_holes)
        yield from _jitter(name, report, advice if is_table else _JITTER_ADVICE)


def _find_folds(steps: StampArray) -> Iterator[tuple[int, int]]:
    """Yield the runs of steps (start, stop) in which two messages fall into each period, as when a clock is set back.

    A topic that is published twice does so all along; what was held up comes in a bunch after a gap.
    """
    if len(steps) < _FEWEST_FOLDED or bool(np.any(steps < 0)):
        return
    period = median(steps)
    paired = steps[:-1] + steps[1:] < _FOLDED_PERIODS * period
    edges = np.flatnonzero(np.diff(np.concatenate([[False], paired, [False]]).astype(np.int8)))
    for start, stop in edges.reshape(-1, 2).tolist():
        if stop - start < _FEWEST_FOLDED or stop - start > _MOSTLY * len(steps):
            continue
        if bool(np.all(steps[max(start - 1, 0) : stop + 1] < _FOLDED_PERIODS * period)):
            yield start, stop + 1


def _uneven(topic: str, report: StampReport, since_start_s: FloatArray, *, keeps_holes: bool) -> Iterator[Finding]:
    holes = [gap for gap in report.gaps if gap[1] > LARGEST_GAP_PERIODS * report.period_s]
    if holes and keeps_holes:
        starts = [float(since_start_s[index - 1]) for index, _ in holes]
        spans = tuple((start, start + length) for start, (_, length) in zip(starts, holes, strict=True))
        said = _kept([topic], spans)
        yield Holes(
            code=said.code, severity=said.severity, message=said.message, advice=said.advice, topic=topic, spans_s=spans
        )
    gaps = [gap for gap in report.gaps if not (keeps_holes and gap in holes)]
    if gaps:
        severe = bool(holes) and not keeps_holes
        when = since_start_s[[index - 1 for index, _ in gaps]]
        longest, length = max(gaps, key=lambda gap: gap[1])
        lost = sum(round(gap / report.period_s) - 1 for _, gap in gaps)
        yield Finding(
            code="dropped-samples",
            severity="error" if severe else "warning",
            message=f"Topic {topic} lacks about {lost} messages in {len(gaps)} gaps, {_at(when)}; the longest lasts "
            f"{length:.4f} s from {since_start_s[longest - 1]:.3f} s (period {report.period_s:.6f} s).",
            advice="Record again without losing messages, cut the log there, or read it with `--windows 10min`, which "
            "leaves out what is around a pause."
            if severe
            else "Single lost messages are interpolated; record to a faster disk or fewer topics.",
        )


@dataclass(frozen=True, kw_only=True)
class Holes(Finding):
    """The warning of the holes of a topic, each from when to when [s] after the start of the log."""

    topic: str
    spans_s: tuple[tuple[float, float], ...]


def _kept(topics: Sequence[str], spans_s: Sequence[tuple[float, float]]) -> Finding:
    """Return the warning of holes that are the same in all of some topics."""
    places = ", ".join(f"{stop - start:.3f} s from {start:.3f} s" for start, stop in spans_s[:_LISTED_HOLES])
    more = f" and {len(spans_s) - _LISTED_HOLES} more" if len(spans_s) > _LISTED_HOLES else ""
    named = f"Topic {topics[0]} has" if len(topics) == 1 else f"Topics {', '.join(topics)} have"
    return Finding.warning(
        HOLE,
        f"{named} {len(spans_s)} hole(s) in which nothing is known: {places}{more} after the start of "
        f"the log, {sum(stop - start for start, stop in spans_s):.3f} s in all. Nothing is interpolated across them; "
        "what happens behind one up to the next rest is not used.",
        "Check that what a parameter needs (rests, sweep, contacts) lies outside, or record again.",
    )


def with_holes_once(findings: Sequence[Finding]) -> list[Finding]:
    """Return findings with one warning for all topics that have the same holes, in the place of the first of them."""
    groups: list[list[Holes]] = []
    for found in findings:
        if isinstance(found, Holes):
            group = next((group for group in groups if _are_same_holes(group[0], found)), None)
            if group is None:
                groups.append([found])
            elif found not in group:
                group.append(found)
    of = {id(group[0]): group for group in groups}
    kept = [each for each in findings if not isinstance(each, Holes) or id(each) in of]
    return [_joined(of[id(each)]) if isinstance(each, Holes) else each for each in kept]


def _are_same_holes(one: Holes, other: Holes) -> bool:
    """Return whether each hole of one overlaps that of the other; sampled at other rates they differ a little."""
    pairs = zip(one.spans_s, other.spans_s, strict=False)
    return len(one.spans_s) == len(other.spans_s) and all(
        max(a[0], b[0]) < min(a[1], b[1]) and max(a[1] - a[0], b[1] - b[0]) < 2.0 * min(a[1] - a[0], b[1] - b[0])
        for a, b in pairs
    )


def _joined(group: Sequence[Holes]) -> Finding:
    spans = zip(*(each.spans_s for each in group), strict=True)
    together = [(min(start for start, _ in each), max(stop for _, stop in each)) for each in spans]
    return _kept([*dict.fromkeys(each.topic for each in group)], together)


def _jitter(name: str, report: StampReport, advice: str) -> Iterator[Finding]:
    if report.jitter_std_s > _JITTER_SHARE * report.period_s:
        yield Finding.warning(
            "stamp-jitter",
            f"The {name} jitter: steps of {1e3 * report.period_s:.3f} ms with a "
            f"standard deviation of {1e3 * report.jitter_std_s:.3f} ms, at worst "
            f"{1e3 * report.jitter_worst_s:.3f} ms off.",
            advice,
        )


def _at(when: FloatArray) -> str:
    last = f" and the last {when[-1]:.3f} s" if when.size > 1 else ""
    return f"the first {when[0]:.3f} s{last} after the start of the log"
