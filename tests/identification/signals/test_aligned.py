"""Channels with clocks of their own, brought on one."""

import dataclasses

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from identification.errors import LogError
from identification.signals.aligned import Span, align, check_regular, longest_whole, whole_stretches
from identification.signals.recording import PoseSignal, Recording, WrenchSignal
from problems.arrays import FloatArray

Stamps = NDArray[np.int64]

START_NS = 1_700_000_000_000_000_000


def clock(rate_hz: float, seconds: float, *, shift_ns: int = 0) -> Stamps:
    stamps: Stamps = (
        START_NS + shift_ns + np.round(np.arange(round(rate_hz * seconds)) * 1e9 / rate_hz).astype(np.int64)
    )
    return stamps


def path(stamps: Stamps) -> FloatArray:
    t = (stamps - START_NS) * 1e-9
    return np.column_stack([0.05 * np.sin(2.0 * np.pi * t), 0.02 * np.cos(3.0 * t), 0.1 * t])


def turning(stamps: Stamps) -> Rotation:
    t = (stamps - START_NS) * 1e-9
    return Rotation.from_rotvec(np.column_stack([0.3 * t, np.zeros_like(t), np.zeros_like(t)]))


def force(stamps: Stamps) -> FloatArray:
    t = (stamps - START_NS) * 1e-9
    return np.column_stack([t, 2.0 * t, -t])


def recording(wrench: Stamps, pose: Stamps) -> Recording:
    return Recording(
        wrench=WrenchSignal(
            topic="/ft", frame_id="ft", stamp_ns=wrench, force_n=force(wrench), torque_n_m=-force(wrench)
        ),
        pose=PoseSignal(
            topic="/tcp", frame_id="base", stamp_ns=pose, position_m=path(pose), quaternion_xyzw=turning(pose).as_quat()
        ),
        command=None,
    )


def test_channels_on_one_clock_are_left_alone() -> None:
    stamps = clock(1250.0, 3.0)
    log = align(recording(stamps, stamps))
    np.testing.assert_array_equal(log.force_S_n, force(stamps))
    np.testing.assert_array_equal(log.position_B_m, path(stamps))
    assert log.period_s == pytest.approx(8e-4, rel=1e-12)
    assert log.start_ns == START_NS


@pytest.mark.parametrize(("wrench_hz", "pose_hz", "shift_ns"), [(1000.0, 500.0, 1_300_000), (500.0, 1250.0, -700_000)])
def test_the_pose_is_interpolated_at_the_wrenchs_stamps(wrench_hz: float, pose_hz: float, shift_ns: int) -> None:
    log = align(recording(clock(wrench_hz, 3.0), clock(pose_hz, 3.0, shift_ns=shift_ns)))
    at = START_NS + np.round((log.start_ns - START_NS) + log.time_s * 1e9).astype(np.int64)
    # A cubic spline errs by 5/384·h⁴·|x⁗| inside: 0.05 m·(2π)⁴·(2 ms)⁴/80 is 1e-11 m; its ends are some times worse.
    np.testing.assert_allclose(log.position_B_m, path(at), rtol=0.0, atol=1e-9)
    np.testing.assert_allclose(log.force_S_n, force(at), rtol=0.0, atol=1e-6)
    # Constant turning is what slerp is exact for.
    assert np.max((log.orientation_BS.inv() * turning(at)).magnitude()) < 1e-8
    assert log.pose_rate_hz == pytest.approx(pose_hz, rel=1e-6)
    assert 1.0 / log.period_s == pytest.approx(wrench_hz, rel=1e-6)


def test_only_the_time_that_both_cover_is_kept() -> None:
    log = align(recording(clock(500.0, 5.0), clock(500.0, 5.0, shift_ns=2_000_000_000)))
    assert log.start_ns == START_NS + 2_000_000_000
    assert log.time_s[-1] == pytest.approx(3.0, abs=0.005)


def test_stamps_that_jitter_are_put_on_a_uniform_clock() -> None:
    rng = np.random.default_rng(2)
    stamps = clock(500.0, 3.0)
    jittered = np.sort(stamps + rng.integers(-300_000, 300_000, len(stamps)))
    log = align(recording(jittered, stamps))
    assert np.ptp(np.diff(log.time_s)) < 1e-12
    at = START_NS + np.round((log.start_ns - START_NS) + log.time_s * 1e9).astype(np.int64)
    np.testing.assert_allclose(log.force_S_n, force(at), rtol=0.0, atol=2e-3)  # the ends lie up to 0.6 ms outside


@pytest.mark.parametrize("shift_s", [3.0, 60.0, -60.0])
def test_channels_that_do_not_overlap_are_refused(shift_s: float) -> None:
    with pytest.raises(LogError, match=r"Wrench and pose must cover the same time.*\(/ft, /tcp\).*count on one clock"):
        align(recording(clock(500.0, 4.0), clock(500.0, 4.0, shift_ns=int(shift_s * 1e9))))


@pytest.mark.parametrize("which", ["/ft", "/tcp"])
def test_a_hole_is_refused_and_reported_where_it_is(which: str) -> None:
    whole = clock(500.0, 6.0)
    holed = whole[(whole < START_NS + 2_000_000_000) | (whole >= START_NS + 2_500_000_000)]
    wrench, pose = (holed, whole) if which == "/ft" else (whole, holed)
    with pytest.raises(LogError, match=rf"`{which}` has a gap of 0\.502 s at 1\.998 s"):
        align(recording(wrench, pose))


def test_lost_single_messages_are_bridged() -> None:
    whole = clock(500.0, 4.0)
    thinned = np.delete(whole, [100, 101, 700, 1500])
    log = align(recording(thinned, whole))
    at = START_NS + np.round(log.time_s * 1e9).astype(np.int64)
    np.testing.assert_allclose(log.force_S_n, force(at), rtol=0.0, atol=1e-6)


def test_a_period_is_the_mean_unless_messages_were_lost() -> None:
    exact = clock(3000.0, 3.0)  # 333 333.3 ns: no stamp can say it, the mean can
    assert check_regular("/ft", exact) == pytest.approx(1.0 / 3000.0, rel=1e-7)
    thinned = np.delete(exact, np.arange(5, 8000, 7))
    assert check_regular("/ft", thinned) == pytest.approx(1.0 / 3000.0, rel=1e-5)


@pytest.mark.parametrize(("rate_hz", "is_slow"), [(4.0, False), (1.5, True)])
def test_a_pose_that_is_logged_twice_a_second_or_more_shows_how_the_robot_moves(rate_hz: float, is_slow: bool) -> None:
    slow = recording(clock(500.0, 6.0), clock(rate_hz, 6.0))
    if not is_slow:
        assert align(slow).pose_rate_hz == pytest.approx(rate_hz)
        return
    with pytest.raises(LogError, match=r"as the robot moves, found samples of /tcp 0\.667 s apart"):
        align(slow)


def test_a_topic_of_two_messages_is_no_signal() -> None:
    with pytest.raises(LogError, match="`/ft` has 2 messages; at least 3"):
        check_regular("/ft", clock(500.0, 1.0)[:2])


@pytest.mark.parametrize("shift_ns", [400_000, -400_000, 300_000_000 + 123_456])
def test_a_regular_wrench_keeps_its_samples_wherever_the_pose_begins(shift_ns: int) -> None:
    stamps = clock(1250.0, 3.0)
    noisy = np.random.default_rng(5).standard_normal((len(stamps), 3))
    whole = recording(stamps, clock(1250.0, 3.0, shift_ns=shift_ns))
    log = align(dataclasses.replace(whole, wrench=dataclasses.replace(whole.wrench, force_n=noisy)))
    first = int(np.searchsorted(stamps, log.start_ns))
    assert stamps[first] == log.start_ns
    # Stamps are rounded to 1 ns of 0.8 ms; half way between two samples noise would differ by its own size.
    np.testing.assert_allclose(log.force_S_n, noisy[first : first + len(log)], rtol=0.0, atol=1e-4)


def test_a_few_lost_messages_do_not_stretch_the_period() -> None:
    exact = clock(3000.0, 3.0)
    lost = np.delete(exact, np.arange(100, 8900, 1100))
    # 8 of 9000 messages: the plain mean would be 9e-4 too long, three samples at the end of the log.
    assert check_regular("/ft", lost) == pytest.approx(1.0 / 3000.0, rel=1e-8)


def salvaged(wrench: Stamps, pose: Stamps) -> Recording:
    return dataclasses.replace(recording(wrench, pose), keeps_holes=True)


def without(stamps: Stamps, start_s: float, stop_s: float) -> Stamps:
    since = (stamps - START_NS) * 1e-9
    return stamps[(since <= start_s) | (since >= stop_s)]


@pytest.mark.parametrize("which", ["/ft", "/tcp", "both"])
@pytest.mark.parametrize("pose_hz", [500.0, 250.0])
def test_a_hole_of_a_salvaged_log_is_kept_and_nothing_is_reported_in_it(which: str, pose_hz: float) -> None:
    wrench, pose = clock(500.0, 6.0), clock(pose_hz, 6.0)
    log = align(
        salvaged(
            without(wrench, 2.0, 2.5) if which != "/tcp" else wrench,
            without(pose, 2.0, 2.5) if which != "/ft" else pose,
        )
    )
    (hole,) = log.holes
    # Half a period on either side belongs to the last message before and the first after.
    assert log.time_s[hole.start] == pytest.approx(2.0, abs=1.01 / 500.0)
    assert log.time_s[hole.stop] == pytest.approx(2.5, abs=1.01 / 500.0)
    for values in (log.force_S_n, log.torque_S_n_m, log.position_B_m):
        assert np.all(np.isnan(values[hole.slice]))
    assert log.pieces == (Span(start=0, stop=hole.start), Span(start=hole.stop, stop=len(log)))
    for piece in log.pieces:
        at = START_NS + np.round(log.time_s[piece.slice] * 1e9).astype(np.int64)
        # As a log without holes: a cubic spline's ends, 0.05 m·(2π)⁴·(4 ms)⁴ at most; the last sample is held.
        np.testing.assert_allclose(log.position_B_m[piece.slice][:-2], path(at)[:-2], rtol=0.0, atol=2e-8)
        np.testing.assert_allclose(log.force_S_n[piece.slice][:-2], force(at)[:-2], rtol=0.0, atol=1e-6)
        assert np.max((log.orientation_BS[piece.slice].inv() * turning(at)).magnitude()[:-2]) < 1e-7
    assert log.period_s == pytest.approx(1.0 / 500.0, rel=1e-9)


def test_what_lies_across_a_hole_does_not_matter() -> None:
    stamps = without(clock(500.0, 6.0), 2.0, 2.5)
    whole = salvaged(stamps, stamps)
    late = (stamps - START_NS)[:, None] > 2.2e9
    thrown = dataclasses.replace(whole.pose, position_m=whole.pose.position_m + 5.0 * late)
    kept, moved = align(whole), align(dataclasses.replace(whole, pose=thrown))
    before = kept.pieces[0].slice
    np.testing.assert_array_equal(kept.position_B_m[before], moved.position_B_m[before])


def test_a_log_without_holes_is_the_same_salvaged_or_not() -> None:
    stamps, others = clock(500.0, 3.0), clock(250.0, 3.0)
    kept, usual = align(salvaged(stamps, others)), align(recording(stamps, others))
    assert kept.holes == ()
    np.testing.assert_array_equal(kept.position_B_m, usual.position_B_m)


def test_a_hole_adds_nothing_to_the_period() -> None:
    jitter = np.random.default_rng(3).integers(-300_000, 300_001, 3000)
    stamps = without(np.sort(clock(500.0, 6.0) + jitter), 2.0, 2.5003)
    # The mean over 5.5 s, in which the ends jitter by up to 0.6 ms in each piece.
    assert check_regular("/ft", stamps, keeps_holes=True) == pytest.approx(1.0 / 500.0, rel=2.2e-4)


def test_the_longest_time_without_a_hole_is_cut_out() -> None:
    stamps = clock(500.0, 10.0)
    whole = salvaged(without(without(stamps, 2.0, 2.5), 7.0, 7.2), without(stamps, 4.0, 4.1))
    cut = longest_whole(whole)
    for signal in (cut.wrench, cut.pose):
        assert (signal.stamp_ns[0] - START_NS) * 1e-9 == pytest.approx(4.1, abs=0.002)
        assert (signal.stamp_ns[-1] - START_NS) * 1e-9 == pytest.approx(7.0, abs=0.002)
    assert align(cut).holes == ()
    ends = [
        [round(1e-9 * float(each.wrench.stamp_ns[k] - START_NS), 1) for k in (0, -1)] for each in whole_stretches(whole)
    ]
    assert ends == [[4.1, 7.0], [7.2, 10.0], [0.0, 2.0], [2.5, 4.0]]
    unbroken = salvaged(stamps, stamps)
    assert longest_whole(unbroken) is unbroken


def test_a_slow_force_keeps_its_size_on_the_even_clock_and_its_zeros() -> None:
    """Straight lines between stamps that are off by up to half a period take a tenth of a swing of 25 Hz."""
    pose = clock(200.0, 10.0)
    late = np.round(2.4e6 * np.sin(np.arange(len(pose)))).astype(np.int64)
    wrench = pose + late
    time = (wrench - pose[0]) * 1e-9
    felt = np.column_stack([10.0 * np.sin(2.0 * np.pi * 25.0 * time), np.zeros(len(time)), np.zeros(len(time))])
    felt[(time > 4.0) & (time < 5.0)] = 0.0
    both = recording(wrench, pose)
    log = align(dataclasses.replace(both, wrench=dataclasses.replace(both.wrench, force_n=felt)))
    at = log.time_s + (log.start_ns - pose[0]) * 1e-9
    moving = (at > 0.5) & (at < 3.5)
    assert log.force_S_n[moving, 0] == pytest.approx(10.0 * np.sin(2.0 * np.pi * 25.0 * at[moving]), abs=0.6)
    assert np.all(log.force_S_n[(at > 4.05) & (at < 4.95)] == 0.0)
