"""Header clocks against the recording clock: offset, drift, jumps, and what two of them make of each other."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from identification.logs.checks.clock_offset import OffsetVerdict
from identification.logs.checks.clocks import (
    ChannelClock,
    ChannelTimes,
    check_clocks,
    clock_findings,
    compare_clocks,
    measure_clock,
)
from identification.signals.recording import Recording, shifted

Stamps = NDArray[np.int64]
H_S = 8e-4


def times(
    *,
    seed: int = 0,
    count: int = 40_000,
    offset_s: float = 0.3,
    ppm: float = 0.0,
    latency_s: float = 2e-4,
    jumps: tuple[tuple[float, float], ...] = (),
    stalls: tuple[tuple[float, float], ...] = (),
) -> tuple[Stamps, Stamps]:
    """Header and recording stamps: latencies fall off exponentially, a stall holds messages back until it ends."""
    rng = np.random.default_rng(seed)
    t = np.arange(count) * H_S
    log = t * (1.0 + 1e-6 * ppm) + offset_s + rng.exponential(latency_s, count)
    for start, stop in stalls:
        inside = (t >= start) & (t < stop)
        log[inside] = np.maximum(log[inside], stop + offset_s)
    header = t + sum((size * (t >= at) for at, size in jumps), np.zeros(count))
    in_order = np.maximum.accumulate(log)
    return 10**18 + np.round(header * 1e9).astype(np.int64), 10**18 + np.round(in_order * 1e9).astype(np.int64)


def measured(topic: str, stamps: tuple[Stamps, Stamps]) -> ChannelClock:
    clock = measure_clock(topic, *stamps)
    assert clock is not None
    return clock


def test_the_offset_is_that_of_the_quickest_messages() -> None:
    clock = measured("/ft", times(latency_s=2e-3, offset_s=-54.0))
    # A message waits for the one before, so that the quickest of 500 is some 50 µs late; the median one 2 ms.
    assert clock.offset_s == pytest.approx(-54.0, abs=1e-4)
    assert 1e-3 < clock.offset_std_s < 4e-3
    assert clock.jumps == ()


def test_a_log_that_was_written_anew_is_reported_from_a_clock_that_drifts() -> None:
    stamps, log = times(count=2000)
    [anew] = clock_findings(measured("/ft", (stamps, log[0] + (log - log[0]) // 60)), H_S)
    assert (anew.code, anew.severity) == ("recorded-anew", "warning")
    assert "counts 60 s in a second of the recording clock" in anew.message


@pytest.mark.parametrize("factor", [1e3, 1e-3])
def test_a_mistaken_unit_is_no_log_that_was_written_anew(factor: float) -> None:
    stamps, log = times(count=2000)
    assert measure_clock("/ft", stamps[0] + ((stamps - stamps[0]) * factor).astype(np.int64), log) is None


@pytest.mark.parametrize("ppm", [-300.0, -20.0, 0.0, 50.0])
def test_drift_is_measured_within_its_deviation(ppm: float) -> None:
    clocks = [measured("/ft", times(seed=seed, ppm=ppm)) for seed in range(12)]
    scores = np.array([(clock.drift_ppm - ppm) / clock.drift_std_ppm for clock in clocks])
    # Twelve unit normals: the root mean square lies between 0.5 and 1.6 but for one case in a thousand.
    assert 0.5 < np.sqrt(np.mean(scores**2)) < 1.6


@pytest.mark.parametrize("size_s", [-0.2, 0.004, 0.05])
def test_a_header_clock_that_was_set_is_reported_where_and_how_far(size_s: float) -> None:
    clock = measured("/ft", times(jumps=((17.0, size_s),), ppm=20.0))
    (jump,) = clock.jumps
    assert jump.in_header
    assert jump.time_s == pytest.approx(17.0, abs=0.02)
    assert jump.size_s == pytest.approx(size_s, abs=2e-4)  # the latencies' size
    assert clock.drift_ppm == pytest.approx(20.0, abs=2.0)
    (found,) = clock_findings(clock, H_S)
    assert (found.code, found.severity) == ("header-clock-jump", "warning" if size_s == 0.004 else "error")


def test_a_stall_of_the_recorder_is_no_jump() -> None:
    clock = measured("/ft", times(stalls=((5.0, 5.4), (20.0, 20.3))))
    assert clock.jumps == ()
    assert clock.offset_s == pytest.approx(0.3, abs=1e-4)


def test_no_jump_is_seen_where_there_is_none() -> None:
    rng = np.random.default_rng(1)
    for seed in range(40):
        count, latency = int(10 ** rng.uniform(1.5, 4.5)), 10 ** rng.uniform(-5, -2.3)
        assert measured("/ft", times(seed=seed, count=count, latency_s=latency)).jumps == ()


def test_two_header_clocks_agree_within_their_latencies() -> None:
    pose = measured("/tcp", times(seed=1, latency_s=1e-3))
    near = compare_clocks(measured("/ft", times(seed=2, latency_s=2e-3)), pose)
    far = compare_clocks(measured("/ft", times(seed=3, offset_s=0.25)), pose)
    assert near.agree
    assert not far.agree
    # The wrench's clock is 50 ms ahead when its messages seem to take 50 ms less.
    assert far.offset_s == pytest.approx(0.05, abs=1e-3)


def test_few_messages_show_nothing_about_a_clock() -> None:
    assert measure_clock("/ft", *times(count=5)) is None


def channel_times(recording: Recording, *, wrench_ahead_s: float = 0.0) -> list[ChannelTimes]:
    rng = np.random.default_rng(3)
    ahead = {recording.wrench.topic: wrench_ahead_s}
    assert recording.command is not None
    return [
        ChannelTimes(
            topic=signal.topic,
            stamp_ns=signal.stamp_ns,
            log_ns=signal.stamp_ns
            - round(ahead.get(signal.topic, 0.0) * 1e9)
            + np.round(rng.exponential(3e5, len(signal.stamp_ns))).astype(np.int64),
        )
        for signal in (recording.wrench, recording.pose, recording.command)
    ]


def test_clocks_far_apart_are_brought_together_by_both_methods(demo_recording: Recording) -> None:
    wrench, ahead_s = demo_recording.wrench, 37.2518
    moved = replace(demo_recording, wrench=replace(wrench, stamp_ns=wrench.stamp_ns + round(ahead_s * 1e9)))
    report = check_clocks(moved, channel_times(moved, wrench_ahead_s=ahead_s))
    assert report.offset.verdict is OffsetVerdict.FOUND
    assert report.offset.offset_s is not None
    assert report.offset.std_s is not None
    assert abs(report.offset.offset_s - ahead_s) < 4.0 * report.offset.std_s
    assert report.offset.std_s < 0.25 * H_S
    late_ns = shifted(moved.wrench, report.shifted_s).stamp_ns - demo_recording.wrench.stamp_ns
    assert np.max(np.abs(late_ns)) < 1e9 * 4.0 * report.offset.std_s
    assert [each.code for each in report.findings] == ["header-clock-off", "clock-offset"]


def test_clocks_far_apart_that_physics_cannot_bring_together_are_an_error(demo_recording: Recording) -> None:
    wrench = demo_recording.wrench
    silent = replace(
        wrench,
        stamp_ns=wrench.stamp_ns + 10**9,
        force_n=np.random.default_rng(0).standard_normal(wrench.force_n.shape),
    )
    moved = replace(demo_recording, wrench=silent)
    report = check_clocks(moved, channel_times(moved, wrench_ahead_s=1.0))
    assert report.offset.verdict is OffsetVerdict.UNKNOWN
    assert [(each.code, each.severity) for each in report.findings] == [("clocks-disagree", "error")]
    assert report.shifted_s == 0.0


def test_a_command_on_another_clock_is_reported(demo_recording: Recording) -> None:
    given = channel_times(demo_recording)
    late = replace(given[2], log_ns=given[2].log_ns + 30_000_000)
    codes = {each.code: each for each in check_clocks(demo_recording, [*given[:2], late]).findings}
    assert codes["command-clock"].severity == "warning"
    assert "robot's delay" in codes["command-clock"].advice
    assert codes["clocks-agree"].severity == "info"
