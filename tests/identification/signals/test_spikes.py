"""Spikes of the wrench go, impacts and noise stay."""

import dataclasses

import numpy as np
import pytest

from identification.signals.medians import column_medians
from identification.signals.recording import Recording
from identification.signals.spikes import without_pose_spikes, without_spikes


def test_spikes_are_replaced_and_counted(demo_recording: Recording) -> None:
    rng = np.random.default_rng(1)
    force = demo_recording.wrench.force_n.copy()
    at = np.sort(rng.choice(np.arange(5, len(force) - 5, 40), 200, replace=False))
    force[at, 0] += 80.0 * rng.choice([-1.0, 1.0], 200)
    spoilt = dataclasses.replace(demo_recording, wrench=dataclasses.replace(demo_recording.wrench, force_n=force))
    clean, (finding,) = without_spikes(spoilt)
    assert (finding.code, finding.severity) == ("spikes", "warning")
    assert "has 200 single values" in finding.message
    # The mean of two neighbours: their noise of 0.14 N, and what the motion bends within a sample.
    assert np.max(np.abs(clean.wrench.force_n - demo_recording.wrench.force_n)) < 5.0 * 0.14 * np.sqrt(1.5) + 0.2
    untouched = np.setdiff1d(np.arange(len(force)), at)
    np.testing.assert_array_equal(clean.wrench.force_n[untouched], force[untouched])


def test_a_log_without_spikes_stays_as_it_is(demo_recording: Recording) -> None:
    """Four impacts, a sweep to 55 Hz and 270,000 samples of noise."""
    clean, findings = without_spikes(demo_recording)
    assert clean is demo_recording
    assert findings == ()


def test_a_corner_where_dry_friction_turns_is_no_spike(demo_recording: Recording) -> None:
    """A spring's force turns smoothly; friction of 3 N, which turns with it, makes a peak of one sample of that."""
    force = demo_recording.wrench.force_n.copy()
    ticks = np.arange(400)
    swing = 40.0 * np.cos(2.0 * np.pi * ticks / 20.0)
    corner = np.where(ticks % 20 == 0, 3.0, np.where(ticks % 20 == 10, -3.0, 0.0))
    force[20000:20400, 0] = swing + corner
    cornered = dataclasses.replace(demo_recording, wrench=dataclasses.replace(demo_recording.wrench, force_n=force))
    clean, _ = without_spikes(cornered)
    np.testing.assert_array_equal(clean.wrench.force_n[20000:20400, 0], force[20000:20400, 0])


@pytest.mark.parametrize("samples_per_period", [4.3, 6.0, 9.7])
def test_a_vibration_near_the_sampling_rate_is_no_row_of_spikes(
    demo_recording: Recording, samples_per_period: float
) -> None:
    force = demo_recording.wrench.force_n.copy()
    ticks = np.arange(4000)
    burst = np.exp(-(((ticks - 2000) / 600.0) ** 2)) * np.sin(2.0 * np.pi * ticks / samples_per_period)
    force[20000:24000, 0] += 60.0 * burst
    shaking = dataclasses.replace(demo_recording, wrench=dataclasses.replace(demo_recording.wrench, force_n=force))
    assert without_spikes(shaking)[0] is shaking


def test_a_deadband_that_is_zero_most_of_the_time_has_no_spikes(demo_recording: Recording) -> None:
    force = np.where(
        np.abs(demo_recording.wrench.force_n - demo_recording.wrench.force_n[0]) < 20.0,
        0.0,
        demo_recording.wrench.force_n,
    )
    quiet = dataclasses.replace(demo_recording, wrench=dataclasses.replace(demo_recording.wrench, force_n=force))
    # Noise at the deadband's edge comes and goes by single samples.
    clean, _ = without_spikes(quiet)
    assert clean is quiet


def test_a_pose_that_is_off_for_one_sample_is_replaced_and_named(demo_recording: Recording) -> None:
    """A tenth of a metre in one of tens of thousands of samples, and half a turn in another."""
    pose = demo_recording.pose
    position, quaternion = pose.position_m.copy(), pose.quaternion_xyzw.copy()
    position[4321, 0] += 0.1
    quaternion[9876] = quaternion[9876][[3, 2, 1, 0]] * [1.0, -1.0, 1.0, -1.0]
    spoilt = dataclasses.replace(pose, position_m=position, quaternion_xyzw=quaternion)
    clean, (finding,) = without_pose_spikes(spoilt)
    assert (finding.code, finding.severity) == ("pose-spikes", "warning")
    when = (pose.stamp_ns[4321] - pose.stamp_ns[0]) * 1e-9
    assert "2 sample(s) that jump away" in finding.message
    assert f"{when:.3f} s" in finding.message
    # An arm that accelerates by 10 m/s² is this far from the mean of its neighbours.
    period = float(np.median(np.diff(pose.stamp_ns))) * 1e-9
    assert np.max(np.abs(clean.position_m - pose.position_m)) < 5.0 * period**2 + 1e-5
    assert np.max(np.abs(clean.quaternion_xyzw - pose.quaternion_xyzw)) < 1e-3


def test_a_pose_as_the_robot_moves_stays_as_it_is(demo_recording: Recording) -> None:
    """Impacts, a sweep, and the same logged at 50 Hz, where every sample is far from its neighbours."""
    pose = demo_recording.pose
    assert without_pose_spikes(pose) == (pose, ())
    coarse = dataclasses.replace(
        pose,
        stamp_ns=pose.stamp_ns[::25],
        position_m=pose.position_m[::25],
        quaternion_xyzw=pose.quaternion_xyzw[::25],
    )
    assert without_pose_spikes(coarse)[0] is coarse


@pytest.mark.parametrize("count", [1, 2, 41, 42])
def test_medians_of_columns_leave_out_what_is_no_number(count: int) -> None:
    values = np.random.default_rng(count).normal(size=(count, 3))
    np.testing.assert_array_equal(column_medians(values), np.median(values, axis=0))
    values[0, 1] = np.nan
    before = values.copy()
    if count > 1:
        np.testing.assert_array_equal(column_medians(values), np.nanmedian(values, axis=0))
    np.testing.assert_array_equal(values, before)
