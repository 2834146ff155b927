"""Offset, drift and jumps of each header clock against the recording clock, and between channels."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from problems.arrays import FloatArray

from ...result import Finding
from ...signals.aligned import whole_stretches
from ...signals.medians import median
from ...signals.recording import Recording, StampArray
from .clock_offset import ClockOffset, OffsetVerdict, estimate_clock_offset

_WINDOWS = 80
_FEWEST_PER_WINDOW = 10
_FEWEST_WINDOWS = 4
_SIDE = 5
_STRETCHES = 4
_TRIMMED_DEVIATIONS = 4.0
_SMALLEST_JUMP_S = 1e-3
_JUMP_DEVIATIONS = 8.0
_JUMP_ERROR_S = 0.01
_JUMP_ERROR_PERIODS = 3.0
_FAR_S = 1.0
_OTHER_PACE_PPM, _OTHER_UNIT = 2e5, 100.0
_DRIFT_PPM = 200.0
_AGREE_DEVIATIONS = 4.0
_AGREE_S = 5e-3
_CERTAIN_S = 0.05


@dataclass(frozen=True, kw_only=True)
class ClockJump:
    """`size_s` by which the header clock moved against the recording clock (positive: forwards), at `time_s`.

    `in_header` says which of the two jumped: the header's, or (False) the recorder's, which does no harm.
    """

    time_s: float
    size_s: float
    in_header: bool


@dataclass(frozen=True, kw_only=True)
class ChannelClock:
    """Recording clock minus header clock of one channel, along the quickest messages (the lower envelope).

    `offset_s` ± `offset_std_s` at the middle of the log: the deviation is what messages usually need beyond the
    quickest, for nobody knows how long the quickest need. `drift_ppm` ± `drift_std_ppm`: the recording clock's gain.
    """

    topic: str
    offset_s: float
    offset_std_s: float
    drift_ppm: float
    drift_std_ppm: float
    jumps: tuple[ClockJump, ...]


def measure_clock(topic: str, stamp_ns: StampArray, log_ns: StampArray) -> ChannelClock | None:
    """Compare header stamps with the recording clock, (n,) each in order of recording.

    None for fewer than 8, and where they count in another unit, which other findings say.
    """
    count = len(stamp_ns)
    if count < 2 * _FEWEST_WINDOWS or _is_other_unit(stamp_ns, log_ns):
        return None
    base = int(log_ns[0]) - int(stamp_ns[0])
    late = ((log_ns - log_ns[0]) - (stamp_ns - stamp_ns[0])) * 1e-9
    time = (log_ns - log_ns[0]) * 1e-9
    windows = max(_FEWEST_WINDOWS, min(_WINDOWS, count // _FEWEST_PER_WINDOW))
    edges = np.linspace(0, count, windows + 1).astype(np.int64)
    low = np.minimum.reduceat(late, edges[:-1])
    middle = 0.5 * (time[edges[:-1]] + time[edges[1:] - 1])
    jumps = _jumps(time, stamp_ns, log_ns, late, low, edges)
    steps = np.array([jump.size_s for jump in jumps])
    at = np.array([jump.time_s for jump in jumps])
    # The header's jump forwards lowers the latency: put it back before a line is laid.
    undone = low + np.array([float(np.sum(steps[at < m])) for m in middle]) if jumps else low
    whole = np.array([not np.any((at >= time[a]) & (at <= time[b - 1])) for a, b in pairwise(edges)])
    whole = whole if np.count_nonzero(whole) >= _FEWEST_WINDOWS else np.ones(windows, dtype=bool)
    offset, slope, offset_std, slope_std = _line(middle[whole], undone[whole])
    spread = median(late - np.interp(time, middle, low))
    return ChannelClock(
        topic=topic,
        offset_s=base * 1e-9 + offset,
        offset_std_s=float(np.hypot(offset_std, max(spread, 0.0))),
        drift_ppm=1e6 * slope,
        drift_std_ppm=1e6 * slope_std,
        jumps=jumps,
    )


def _line(x: FloatArray, y: FloatArray) -> tuple[float, float, float, float]:
    """Return value at the middle, slope and their deviations; windows in which all messages were late are left out."""
    keep = np.ones(len(x), dtype=bool)
    mean = slope = scatter = 0.0
    for _ in range(8):
        centre = x - x[keep].mean()
        slope = float(centre[keep] @ y[keep] / max(float(centre[keep] @ centre[keep]), 1e-12))
        mean = float(y[keep].mean())
        rest = y - mean - slope * centre
        scatter = 1.4826 * float(np.median(np.abs(rest[keep] - np.median(rest[keep]))))
        following = rest < max(_TRIMMED_DEVIATIONS * scatter, 1e-9)
        if np.array_equal(following, keep) or np.count_nonzero(following) < _FEWEST_WINDOWS:
            break
        keep = following
    rms = float(np.sqrt(np.mean((y - mean - slope * (x - x[keep].mean()))[keep] ** 2)))
    scatter, n = max(scatter, rms), np.count_nonzero(keep)
    wide = max(float(np.std(x[keep])), 1e-12)
    return mean, slope, scatter / np.sqrt(n), scatter / (wide * np.sqrt(n))


def _jumps(
    time: FloatArray,
    stamp_ns: StampArray,
    log_ns: StampArray,
    late: FloatArray,
    low: FloatArray,
    edges: NDArray[np.int64],
) -> tuple[ClockJump, ...]:
    """Find steps of the lower envelope that stay: a stall of the recorder comes back, a clock that was set does not."""
    side = min(_SIDE, len(low) // 2)
    if side < 2:
        return ()
    drift = float(np.median(np.diff(low)))
    flat = low - drift * np.arange(len(low))
    noise = 1.4826 * float(np.median(np.abs(np.diff(flat))))
    needed = max(_SMALLEST_JUMP_S, _JUMP_DEVIATIONS * noise)
    views = np.lib.stride_tricks.sliding_window_view(flat, side)
    # The quickest of some windows on either side: what is late on one side only is no jump of a clock.
    quickest, usual = views.min(axis=1), np.median(views, axis=1)
    change, steady = quickest[side:] - quickest[:-side], usual[side:] - usual[:-side]
    mean = views.mean(axis=1)[side:] - views.mean(axis=1)[:-side]
    found: list[ClockJump] = []
    candidates = np.flatnonzero((np.abs(change) > needed) & (np.sign(change) * steady > 0.5 * needed))
    while candidates.size:
        best = int(candidates[np.argmax(np.abs(mean[candidates]))])
        found.append(_located(time, stamp_ns, log_ns, late, slice(edges[best + side - 1], edges[best + side + 1])))
        candidates = candidates[np.abs(candidates - best) > side]
    return tuple(sorted(found, key=lambda jump: jump.time_s))


def _located(time: FloatArray, stamp_ns: StampArray, log_ns: StampArray, late: FloatArray, near: slice) -> ClockJump:
    """Return where within two windows, how far, and which clock jumped: the one with the unusual step of its own."""
    piece = late[near]
    # The split that leaves the least absolute deviation on both sides.
    n = len(piece)
    splits = range(max(1, n // 10), n - max(1, n // 10), max(1, n // 200))
    at = min(
        splits,
        key=lambda k: float(
            np.abs(piece[:k] - np.median(piece[:k])).sum() + np.abs(piece[k:] - np.median(piece[k:])).sum()
        ),
    )
    rough = slice(max(1, at - n // 50 - 2), min(n, at + n // 50 + 3))
    at = rough.start + int(np.argmax(np.abs(np.diff(piece[rough.start - 1 : rough.stop]))))
    index = near.start + at
    size = float(piece[:at].min() - piece[at:].min())
    period = float(np.median(np.diff(stamp_ns))) * 1e-9
    header = (stamp_ns[index] - stamp_ns[index - 1]) * 1e-9 - period
    recorder = (log_ns[index] - log_ns[index - 1]) * 1e-9 - period
    return ClockJump(time_s=float(time[index]), size_s=size, in_header=abs(header) >= abs(recorder))


def clock_findings(clock: ChannelClock, period_s: float) -> tuple[Finding, ...]:
    """Say what is out of the ordinary about one channel's clock."""
    found = []
    if abs(clock.offset_s) > _FAR_S:
        found.append(
            Finding.info(
                "header-clock-off",
                f"The header clock of {clock.topic} is {abs(clock.offset_s):.3f} s "
                f"{'behind' if clock.offset_s > 0 else 'ahead of'} the recording clock.",
                "Only the header stamps are used, so this matters only where channels differ in it.",
            )
        )
    if abs(clock.drift_ppm) > _OTHER_PACE_PPM:
        found.append(
            Finding.warning(
                "recorded-anew",
                f"The header clock of {clock.topic} counts {1.0 - 1e-6 * clock.drift_ppm:.3g} s in a second of the "
                "recording clock: the log was written anew after it was recorded (filtered, converted, or played back "
                "at another speed).",
                "The header stamps are used; check that they are in seconds.",
            )
        )
    elif abs(clock.drift_ppm) > max(_DRIFT_PPM, 5.0 * clock.drift_std_ppm):
        found.append(
            Finding.warning(
                "header-clock-drift",
                f"The header clock of {clock.topic} runs {abs(clock.drift_ppm):.0f} ± "
                f"{clock.drift_std_ppm:.0f} ppm {'slower' if clock.drift_ppm > 0 else 'faster'} than the recorder's.",
                "Stamp with a disciplined clock: sample time and delay are as wrong as this.",
            )
        )
    for jump in clock.jumps:
        serious = jump.in_header and abs(jump.size_s) > max(_JUMP_ERROR_S, _JUMP_ERROR_PERIODS * period_s)
        found.append(
            Finding(
                code="header-clock-jump" if jump.in_header else "recording-clock-jump",
                severity="error" if serious else ("warning" if jump.in_header else "info"),
                message=f"The {'header' if jump.in_header else 'recording'} clock of {clock.topic} jumps by "
                f"{1e3 * (jump.size_s if jump.in_header else -jump.size_s):+.1f} ms, {jump.time_s:.3f} s after its "
                "first message.",
                advice="Switch off whatever sets the clock while recording, and record again."
                if jump.in_header
                else "",
            )
        )
    return tuple(found)


@dataclass(frozen=True, kw_only=True)
class ChannelTimes:
    """Header stamps and recording stamps (n,) of one channel in order of recording, one per row of its signal."""

    topic: str
    stamp_ns: StampArray
    log_ns: StampArray


@dataclass(frozen=True, kw_only=True)
class ClockDifference:
    """`first`'s header clock is ahead of `second`'s by `offset_s` ± `std_s`, by the recording clock."""

    first: str
    second: str
    offset_s: float
    std_s: float

    @property
    def agree(self) -> bool:
        """Return whether the difference is within what the latencies explain."""
        return abs(self.offset_s) <= max(_AGREE_DEVIATIONS * self.std_s, _AGREE_S)


@dataclass(frozen=True, kw_only=True)
class ClockReport:
    """What the clocks say, and the offset between wrench and pose."""

    channels: tuple[ChannelClock, ...]
    offset: ClockOffset
    findings: tuple[Finding, ...]

    @property
    def lag_left_s(self) -> tuple[float, float] | None:
        """Return how late the wrench still is against the pose, value and deviation, None where it is unknown.

        An offset that is too small to be one is left where it is, and counts as deviation: joint friction does that.
        """
        if self.offset.offset_s is None or self.offset.std_s is None:
            return None
        left = 0.0 if self.offset.verdict is OffsetVerdict.FOUND else self.offset.offset_s
        return 0.0, float(np.hypot(self.offset.std_s, left))

    @property
    def shifted_s(self) -> float:
        """Return what is to be taken off the wrench's stamps."""
        found = self.offset.verdict is OffsetVerdict.FOUND and self.offset.offset_s is not None
        return self.offset.offset_s if found and self.offset.offset_s is not None else 0.0


def check_clocks(recording: Recording, times: Sequence[ChannelTimes] = ()) -> ClockReport:
    """Measure all clocks of a recording, and the offset between wrench and pose where the motion determines it.

    `times` holds the channels that have header stamps (by topic; others than those of the recording are ignored). When
    the recording clock shows wrench and pose far apart, the offset is looked for there; if the motion does not
    determine it then, the finding is an error: the samples would be paired wrongly.
    """
    signals = {each.topic: each for each in (recording.command, recording.pose, recording.wrench) if each is not None}
    periods, clocks = {}, {}
    for each in times:
        signal = signals.get(each.topic)
        if signal is None or len(signal.stamp_ns) != len(each.log_ns):
            continue
        # The recording's own stamps: a declared offset is already taken out of them.
        clock = measure_clock(each.topic, signal.stamp_ns, each.log_ns)
        if clock is not None:
            clocks[each.topic] = clock
            periods[each.topic] = median(np.diff(signal.stamp_ns)) * 1e-9
    wrench, pose = clocks.get(recording.wrench.topic), clocks.get(recording.pose.topic)
    command = None if recording.command is None else clocks.get(recording.command.topic)
    between = [compare_clocks(first, pose) for first in (wrench, command) if first is not None and pose is not None]
    apart = between[0] if wrench is not None and pose is not None else None
    far = apart is not None and not apart.agree and abs(apart.offset_s) > _CERTAIN_S
    around = apart.offset_s if far and apart is not None else 0.0
    # Where the log has holes: from that of its longest stretches which shows it best.
    offsets = [
        estimate_clock_offset(each.wrench, each.pose, around_s=around)
        for each in whole_stretches(recording)[:_STRETCHES]
    ]
    offset = min(offsets, key=lambda each: np.inf if each.std_s is None else each.std_s)
    findings = [each for clock in clocks.values() for each in clock_findings(clock, periods[clock.topic])]
    findings += [_disagreement(each) for each in between if each is not apart and not each.agree]
    findings.append(_offset_finding(recording, offset, apart, far=far))
    return ClockReport(
        channels=tuple(clocks.values()),
        offset=offset,
        findings=tuple(findings),
    )


def _is_other_unit(stamp_ns: StampArray, log_ns: StampArray) -> bool:
    """Return whether stamps (n,) span a hundred times as much as the recording clock, or as little."""
    spans = float(np.ptp(stamp_ns)), float(np.ptp(log_ns))
    return not 1.0 / _OTHER_UNIT < spans[0] / max(spans[1], 1.0) < _OTHER_UNIT


def compare_clocks(first: ChannelClock, second: ChannelClock) -> ClockDifference:
    """Return how far two header clocks are apart; what the quickest message of each needed is not known."""
    return ClockDifference(
        first=first.topic,
        second=second.topic,
        offset_s=second.offset_s - first.offset_s,
        std_s=float(np.hypot(first.offset_std_s, second.offset_std_s)),
    )


def _offset_finding(recording: Recording, offset: ClockOffset, apart: ClockDifference | None, *, far: bool) -> Finding:
    if far and apart is not None and offset.verdict is OffsetVerdict.UNKNOWN:
        return Finding.error(
            "clocks-disagree",
            f"The header clocks of {apart.first} and {apart.second} are {apart.offset_s:+.3f} ± "
            f"{apart.std_s:.3f} s apart by the recording clock, and the exact offset is unknown: {offset.reason}.",
            f"Stamp both with one clock. {offset.advice}",
        )
    return offset.finding(recording.wrench.topic, recording.pose.topic)


def _disagreement(difference: ClockDifference) -> Finding:
    return Finding.warning(
        "command-clock",
        f"The header clocks of {difference.first} and {difference.second} are {difference.offset_s:+.4f} ± "
        f"{difference.std_s:.4f} s apart by the recording clock.",
        "Stamp command and pose with one clock: an offset between them looks like the robot's delay.",
    )
