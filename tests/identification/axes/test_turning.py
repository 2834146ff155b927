"""Turning about one axis of the sensor: found, told apart from changes of pose, and read as motion along a path."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from identification.axes.straight import commanded_motion
from identification.axes.turning import find_turns, rests_after, unroll
from identification.errors import EstimateError
from identification.payload.static_poses import GRAVITY_B_M_S2
from identification.signals.aligned import align
from identification.signals.segments import Span, find_motion
from problems.arrays import FloatArray
from problems.model.axis_kind import LEVER_M
from tests.identification.synthetic import ramp, sweep
from tests.identification.turned import RATE_HZ, WEIGHTLESS, WORKING, recorded, to_and_fro, turns_of


@pytest.mark.parametrize("index", [0, 1, 2])
def test_turning_to_and_fro_is_found_with_its_angle_and_torque(index: int) -> None:
    angle = to_and_fro()
    torque = np.arange(3.0 * len(angle)).reshape(-1, 3)
    (turn,) = turns_of(recorded(np.outer(angle, np.eye(3)[index]), torque=torque))
    assert turn.name == ("rx", "ry", "rz")[index]
    assert turn.index == index
    assert len(turn.motion.spans) == 4
    np.testing.assert_allclose(turn.motion.direction_B, WORKING.as_matrix()[:, index], rtol=0.0, atol=1e-9)
    # From the middle of the longest span; rounding of quaternions is left.
    found = turn.motion.position_m
    np.testing.assert_allclose(found - found[0], angle, rtol=0.0, atol=1e-12)
    np.testing.assert_array_equal(turn.motion.force_n, torque[:, index])


@pytest.mark.parametrize(
    "turns",
    [
        np.outer(to_and_fro(), [0.6, 0.8, 0.0]),
        np.outer(to_and_fro(angle=0.9), [0.0, 1.0, 0.0]),
        np.outer(to_and_fro(times=1), [0.0, 1.0, 0.0]),
        np.outer(to_and_fro(angle=8e-3), [0.0, 1.0, 0.0]),
    ],
    ids=["between the axes", "a change of pose", "once there and back", "hardly at all"],
)
def test_turns_that_show_nothing_of_an_axis_are_left_alone(turns: FloatArray) -> None:
    assert turns_of(recorded(turns)) == ()


def test_a_motion_along_an_axis_is_no_turn() -> None:
    recording = recorded(np.zeros((len(to_and_fro()), 3)))
    moved = replace(recording.pose, position_m=recording.pose.position_m + np.outer(to_and_fro(), [1.0, 0.0, 0.0]))
    assert turns_of(replace(recording, pose=moved)) == ()


def test_only_a_turn_about_the_origin_of_the_sensor_counts() -> None:
    """Were the origin of S swung along, its acceleration would be taken for inertia."""
    centre = np.array([0.02, -0.01, 0.25])
    angle = to_and_fro()
    assert turns_of(recorded(np.outer(angle, [1.0, 0.0, 0.0]), centre_S_m=centre)) == ()


@pytest.mark.parametrize("tilt_rad", [0.8, 0.2])
def test_spans_in_another_working_orientation_are_left_out(tilt_rad: float) -> None:
    here = np.outer(to_and_fro(times=3), [0.0, 0.0, 1.0])
    tilt = np.outer(np.concatenate([ramp(400), np.ones(len(to_and_fro()))]), [tilt_rad, 0.0, 0.0])
    there = np.concatenate([np.zeros((400, 3)), np.outer(to_and_fro(), [0.0, 0.0, 1.0])])
    orientation = WORKING * Rotation.concatenate(
        [Rotation.from_rotvec(here), Rotation.from_rotvec(tilt) * Rotation.from_rotvec(there)]
    )
    still = recorded(np.zeros((len(orientation), 3)))
    (turn,) = turns_of(replace(still, pose=replace(still.pose, quaternion_xyzw=orientation.as_quat())))
    # All of the first, or all of the second working orientation; there is no axis that is common to both.
    sides = {span.start < len(here) for span in turn.motion.spans}
    assert len(sides) == 1


def test_a_slower_pose_is_interpolated_smoothly() -> None:
    """Straight turns between poses of 250 Hz would flatten a sweep of 50 Hz by up to (ω h)²/8 = 20 %."""
    angle = 5.0 * sweep(6.0, RATE_HZ)
    recording = recorded(np.outer(np.concatenate([np.zeros(400), angle, np.zeros(400)]), [0.0, 1.0, 0.0]))
    pose = recording.pose
    slow = replace(
        pose,
        stamp_ns=pose.stamp_ns[::2],
        position_m=pose.position_m[::2],
        quaternion_xyzw=pose.quaternion_xyzw[::2],
    )
    (turn,) = turns_of(replace(recording, pose=slow))
    found = turn.motion.position_m - turn.motion.position_m[0]
    fast = slice(400 + round(5.0 * RATE_HZ), 400 + round(5.6 * RATE_HZ))
    error = found[fast] - angle[fast.start - 400 : fast.stop - 400]
    # A cubic spline errs by (ω h)⁴/200 at most, some 1 %, where straight lines miss 20 %.
    assert np.max(np.abs(error)) < 0.02 * np.max(np.abs(angle[fast.start - 400 : fast.stop - 400]))


def test_an_unrolled_turn_is_a_path_at_the_lever() -> None:
    angle = to_and_fro()
    torque = np.outer(0.7 * angle, [0.0, 0.0, 1.0])
    recording = recorded(np.outer(angle, [0.0, 0.0, 1.0]), torque=torque)
    (turn,) = turns_of(recording)
    log = align(recording)
    straight = unroll(turn, recording, log)
    moved = straight.axis.position_m - straight.axis.position_m[0]
    np.testing.assert_allclose(moved, LEVER_M * angle, rtol=0.0, atol=1e-12)
    np.testing.assert_allclose(straight.axis.force_n, torque[:, 2] / LEVER_M, rtol=0.0, atol=1e-15)
    # Work is the same on both: the law behind K/lever², B/lever², M/lever².
    work = float(np.sum(straight.axis.force_n[:-1] * np.diff(moved)))
    assert work == pytest.approx(float(np.sum(torque[:-1, 2] * np.diff(angle))), abs=1e-12)
    assert straight.recording.command is not None
    commanded = commanded_motion(straight.recording, straight.recording.command, straight.log, straight.axis)
    assert np.ptp(commanded.command_m) == pytest.approx(0.06 * LEVER_M, rel=1e-9)
    np.testing.assert_allclose(commanded.command_m, commanded.position_m, rtol=0.0, atol=1e-12)


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize(("angle", "is_swept"), [(5.0 * sweep(6.0, RATE_HZ), True), (to_and_fro(times=3), False)])
def test_a_sweep_goes_to_and_fro_without_a_rest(angle: FloatArray, is_swept: bool, sign: float) -> None:
    rest = np.zeros(400)
    swept = np.concatenate([rest, angle, rest])
    # A sweep remains one beside larger turns from rest to rest.
    for turned in (swept, np.concatenate([swept, to_and_fro(angle=0.3)])):
        (turn,) = turns_of(recorded(np.outer(sign * turned, [0.0, 1.0, 0.0])))
        assert turn.is_swept is is_swept


def test_a_command_without_orientation_says_so() -> None:
    recording = recorded(np.outer(to_and_fro(), [0.0, 0.0, 1.0]))
    (turn,) = turns_of(recording)
    nowhere = replace(recording.pose, topic="/cmd", quaternion_xyzw=np.full((len(to_and_fro()), 4), np.nan))
    with pytest.raises(EstimateError, match=r"rz needs orientations, and topic /cmd has none"):
        unroll(turn, replace(recording, command=nowhere), align(recording))


def test_a_rest_belongs_to_the_span_that_ends_in_it() -> None:
    spans = (Span(start=10, stop=20), Span(start=40, stop=50))
    rests = (Span(start=0, stop=10), Span(start=20, stop=40), Span(start=50, stop=60), Span(start=70, stop=80))
    assert rests_after(spans, rests) == (rests[1], rests[2])
    assert rests_after(spans[:1], rests) == (rests[1],)


@pytest.mark.parametrize("index", [0, 1, 2])
def test_the_weights_stiffness_is_the_slope_of_its_moment(index: int) -> None:
    axis, com, mass = np.eye(3)[index], np.array([0.03, -0.05, 0.2]), 12.0
    loaded = replace(WEIGHTLESS, mass_kg=mass, com_S_m=com)
    recording = recorded(np.outer(to_and_fro(), axis))
    log = align(recording)
    (turn,) = find_turns(recording, log, find_motion(log), loaded)

    def moment(angle: float) -> float:
        down = (turn.reference_BS * Rotation.from_rotvec(angle * axis)).inv().apply(GRAVITY_B_M_S2)
        return float(np.cross(com, mass * down) @ axis)

    slope = (moment(1e-4) - moment(-1e-4)) / 2e-4
    # Central differences err by 1e-8/6 of the whole.
    assert turn.weight_n_m_per_rad == pytest.approx(-slope, rel=1e-6)
