"""Steps of the bias at rest: which of them the rests beside can tell, and that a hole is none."""

from dataclasses import replace

import numpy as np
import pytest

from identification.logs.checks.payload import check_payload, find_tare_jumps
from identification.signals.aligned import align
from identification.signals.recording import Recording
from problems.arrays import FloatArray

AFTER_ALL_POSES_S = 24.6
BETWEEN_POSES_S = 12.5
STEP_N = np.array([0.0, 0.0, -60.0])


def stepped(recording: Recording, at_s: float, step_n: FloatArray) -> Recording:
    wrench = recording.wrench
    since = (wrench.stamp_ns - wrench.stamp_ns[0]) * 1e-9
    return replace(recording, wrench=replace(wrench, force_n=wrench.force_n + step_n * (since >= at_s)[:, None]))


def holed(recording: Recording, start_s: float, stop_s: float) -> Recording:
    wrench = recording.wrench
    since = (wrench.stamp_ns - wrench.stamp_ns[0]) * 1e-9
    kept = (since < start_s) | (since > stop_s)
    cut = replace(
        wrench, stamp_ns=wrench.stamp_ns[kept], force_n=wrench.force_n[kept], torque_n_m=wrench.torque_n_m[kept]
    )
    return replace(recording, wrench=cut, keeps_holes=True)


def test_a_tare_after_all_poses_makes_the_contacts_unusable(demo_recording: Recording) -> None:
    (found,) = check_payload(stepped(demo_recording, AFTER_ALL_POSES_S, STEP_N))
    assert (found.code, found.severity) == ("tare-jump", "error")
    assert "at 24.60" in found.message
    message = [float(text) for text in found.message.split("(")[1].split(")")[0].split(", ")]
    # Means of 0.15 s on either side: 0.14 N/√188 each, five deviations.
    np.testing.assert_allclose(message, STEP_N, rtol=0.0, atol=5.0 * np.sqrt(2.0) * 0.14 / np.sqrt(188))


@pytest.mark.parametrize(("at_s", "step_n"), [(BETWEEN_POSES_S, STEP_N), (AFTER_ALL_POSES_S, STEP_N / 30.0)])
def test_a_tare_that_the_rests_show_or_that_no_contact_feels_is_a_warning(
    demo_recording: Recording, at_s: float, step_n: FloatArray
) -> None:
    (found,) = check_payload(stepped(demo_recording, at_s, step_n))
    assert (found.code, found.severity) == ("tare-jump", "warning")


def test_of_the_rest_in_which_the_sensor_is_tared_first_nothing_is_asked(demo_recording: Recording) -> None:
    (found,) = check_payload(stepped(demo_recording, 0.4, STEP_N))
    assert (found.code, found.severity) == ("tare-jump", "warning")


def test_two_large_jumps_are_more_than_the_rests_can_show(demo_recording: Recording) -> None:
    twice = stepped(stepped(demo_recording, 7.3, STEP_N), 17.7, STEP_N)
    found = check_payload(twice)
    assert [(each.code, each.severity) for each in found] == [("tare-jump", "error")] * 2


def test_a_step_across_a_hole_is_no_jump_with_a_time(demo_recording: Recording) -> None:
    across = holed(stepped(demo_recording, AFTER_ALL_POSES_S, STEP_N), 24.55, 24.65)
    assert find_tare_jumps(align(across)) == ()


def test_a_jump_beside_a_hole_is_found(demo_recording: Recording) -> None:
    beside = holed(stepped(demo_recording, AFTER_ALL_POSES_S, STEP_N), 20.0, 23.0)
    (jump,) = find_tare_jumps(align(beside))
    assert jump.time_s == pytest.approx(AFTER_ALL_POSES_S, abs=5e-3)
