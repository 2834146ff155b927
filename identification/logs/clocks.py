"""The clocks of a log: each channel's against the recording clock, the channels' against each other, and physics.

A reader calls `check_clocks` once, with the recording and with header and recording stamps of its channels; it hands
the findings on, refuses on those of severity `error`, and goes on with `report.recording`, whose wrench is on the
clock of pose and command.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..result import Finding
from ..signals.aligned import longest_whole
from ..signals.recording import Recording, StampArray
from .channel_clock import ChannelClock, clock_findings, measure_clock
from .clock_offset import ClockOffset, OffsetVerdict, apply_offset, estimate_clock_offset

_AGREE_DEVIATIONS = 4.0
_AGREE_S = 5e-3
_CERTAIN_S = 0.05


@dataclass(frozen=True, kw_only=True)
class ChannelTimes:
    """Header stamps and recording stamps (n,) of one channel in order of recording, one per row of its signal."""

    topic: str
    stamp_ns: StampArray
    log_ns: StampArray


@dataclass(frozen=True, kw_only=True)
class ClockDifference:
    """`first`'s header clock is ahead of `second`'s by `offset_s` ± `std_s`, as far as the recording clock tells."""

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
    """What the clocks say; `recording` has the offset between wrench and pose taken out where one was found."""

    channels: tuple[ChannelClock, ...]
    differences: tuple[ClockDifference, ...]
    offset: ClockOffset
    recording: Recording
    findings: tuple[Finding, ...]

    @property
    def lag_left_s(self) -> tuple[float, float] | None:
        """Return how late the wrench still is against the pose, value and deviation, None where nothing tells."""
        if self.offset.offset_s is None or self.offset.std_s is None:
            return None
        return (0.0 if self.offset.verdict is OffsetVerdict.FOUND else self.offset.offset_s), self.offset.std_s

    @property
    def shifted_s(self) -> float:
        """Return what was taken off the wrench's stamps."""
        found = self.offset.verdict is OffsetVerdict.FOUND and self.offset.offset_s is not None
        return self.offset.offset_s if found and self.offset.offset_s is not None else 0.0


def check_clocks(recording: Recording, times: Sequence[ChannelTimes] = ()) -> ClockReport:
    """Measure all clocks of a recording and take the offset between wrench and pose out where physics tells it.

    `times` holds the channels that have header stamps (by topic; others than those of the recording are ignored). When
    the recording clock shows wrench and pose far apart, the offset is looked for there; if physics does not tell it
    then, the finding is an error: the samples would be paired wrongly.
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
            periods[each.topic] = float(np.median(np.diff(signal.stamp_ns))) * 1e-9
    wrench, pose = clocks.get(recording.wrench.topic), clocks.get(recording.pose.topic)
    command = None if recording.command is None else clocks.get(recording.command.topic)
    between = [compare_clocks(first, pose) for first in (wrench, command) if first is not None and pose is not None]
    apart = between[0] if wrench is not None and pose is not None else None
    far = apart is not None and not apart.agree and abs(apart.offset_s) > _CERTAIN_S
    around = apart.offset_s if far and apart is not None else 0.0
    whole = longest_whole(recording)
    offset = estimate_clock_offset(whole.wrench, whole.pose, around_s=around)
    findings = [each for clock in clocks.values() for each in clock_findings(clock, periods[clock.topic])]
    findings += [_disagreement(each) for each in between if each is not apart and not each.agree]
    findings.append(_offset_finding(recording, offset, apart, far=far))
    return ClockReport(
        channels=tuple(clocks.values()),
        differences=tuple(between),
        offset=offset,
        recording=apply_offset(recording, offset),
        findings=tuple(findings),
    )


def compare_clocks(first: ChannelClock, second: ChannelClock) -> ClockDifference:
    """Return how far two header clocks are apart; what the quickest message of each needed is not known."""
    return ClockDifference(
        first=first.topic,
        second=second.topic,
        offset_s=second.offset_s - first.offset_s,
        std_s=float(np.hypot(first.offset_std_s, second.offset_std_s)),
    )


def _offset_finding(recording: Recording, offset: ClockOffset, apart: ClockDifference | None, *, far: bool) -> Finding:
    if far and apart is not None and offset.verdict is OffsetVerdict.UNTOLD:
        return Finding(
            code="clocks-disagree",
            severity="error",
            message=f"The header clocks of {apart.first} and {apart.second} are {apart.offset_s:+.3f} ± "
            f"{apart.std_s:.3f} s apart by the recording clock, and the exact offset cannot be told: {offset.reason}.",
            advice=f"Stamp both with one clock. {offset.advice}",
        )
    return offset.finding(recording.wrench.topic, recording.pose.topic)


def _disagreement(difference: ClockDifference) -> Finding:
    return Finding(
        code="command-clock",
        severity="warning",
        message=f"The header clocks of {difference.first} and {difference.second} are {difference.offset_s:+.4f} ± "
        f"{difference.std_s:.4f} s apart by the recording clock.",
        advice="Stamp command and pose with one clock: an offset between them cannot be told from the robot's delay.",
    )
