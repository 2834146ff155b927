"""Pose and twist of one motion agree; a unit, sign, frame or sequence that is declared wrongly does not."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from identification.logs.checks.consistency import turn_findings, twist_findings
from identification.signals.recording import PoseSignal, TwistSignal

TIME = np.arange(0.0, 8.0, 0.005)
STAMPS = (TIME * 1e9).astype(np.int64) + 10**18
AXIS = np.array([0.6, 0.0, 0.8])
START = Rotation.from_rotvec([2.0, 1.0, 0.5])


def angle(time: np.ndarray[tuple[int], np.dtype[np.float64]]) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    return 0.8 * np.sin(0.9 * time)


POSE = PoseSignal(
    topic="/pose",
    frame_id="base",
    stamp_ns=STAMPS,
    position_m=np.column_stack([0.1 * np.sin(TIME), 0.05 * np.cos(2.0 * TIME), 0.02 * TIME]),
    quaternion_xyzw=(Rotation.from_rotvec(angle(TIME)[:, None] * AXIS) * START).as_quat(),
)
# The exact derivatives, in base axes: the turn is about one axis that is fixed there.
TWIST = TwistSignal(
    topic="/twist",
    frame_id="base",
    stamp_ns=STAMPS[::4] + 1_000_000,
    linear_m_s=np.column_stack([0.1 * np.cos(TIME), -0.1 * np.sin(2.0 * TIME), np.full(TIME.size, 0.02)])[::4],
    angular_rad_s=(0.72 * np.cos(0.9 * TIME)[:, None] * AXIS)[::4],
)


def test_one_motion_reported_twice_agrees() -> None:
    assert list(twist_findings(POSE, TWIST)) == []
    assert list(turn_findings(POSE)) == []


@pytest.mark.parametrize("factor", [0.78, 1e3, -1.0])
def test_a_factor_is_reported(factor: float) -> None:
    wrong = replace(TWIST, linear_m_s=TWIST.linear_m_s * factor)
    found = list(twist_findings(POSE, wrong))
    assert len(found) == 1
    assert "The translation that the twist of /twist gives differs" in found[0].message
    # The clocks are 1 ms apart: 1e-3 of a motion of 2 rad/s.
    assert f"times {1.0 / factor:.3f} it fits" in found[0].message


def test_angular_velocity_in_tool_axes_is_reported() -> None:
    orientation = Rotation.from_quat(POSE.quaternion_xyzw[::4])
    wrong = replace(TWIST, angular_rad_s=orientation.inv().apply(np.array(TWIST.angular_rad_s)))
    found = list(twist_findings(POSE, wrong))
    assert len(found) == 1
    assert "The rotation" in found[0].message
    assert "no factor mends it" in found[0].message


def test_rates_of_angles_are_no_angular_velocity() -> None:
    # A tool that points down and does not turn, given by angles Z-Y-Z: both outer angles run along.
    still = replace(POSE, quaternion_xyzw=np.tile(Rotation.from_euler("Y", np.pi).as_quat(), (TIME.size, 1)))
    found = list(twist_findings(still, replace(TWIST, linear_m_s=TWIST.linear_m_s)))
    assert ["The rotation" in finding.message for finding in found] == [True]


def test_what_happened_in_a_hole_of_the_log_is_not_judged() -> None:
    kept, kept_twist = (abs(1e-9 * (each.stamp_ns - STAMPS[0]) - 3.9) > 1.7 for each in (POSE, TWIST))
    pose = replace(
        POSE, stamp_ns=STAMPS[kept], position_m=POSE.position_m[kept], quaternion_xyzw=POSE.quaternion_xyzw[kept]
    )
    twist = replace(
        TWIST,
        stamp_ns=TWIST.stamp_ns[kept_twist],
        linear_m_s=TWIST.linear_m_s[kept_twist],
        angular_rad_s=TWIST.angular_rad_s[kept_twist],
    )
    # Across the hole the tool turns by 54 degrees; a line between the twists beside it misses its way by far.
    (last,) = np.flatnonzero(np.diff(pose.stamp_ns) > 10**9)
    before, after = (Rotation.from_quat(pose.quaternion_xyzw[k]) for k in (last, last + 1))
    assert float((after * before.inv()).magnitude()) > 0.5
    assert list(turn_findings(pose)) == []
    assert list(twist_findings(pose, twist)) == []


def test_a_robot_at_rest_is_not_accused() -> None:
    noise = np.random.default_rng(0).standard_normal((TIME.size, 3)) * 1e-6
    still = replace(POSE, position_m=noise, quaternion_xyzw=np.tile(START.as_quat(), (TIME.size, 1)))
    silent = replace(TWIST, linear_m_s=TWIST.linear_m_s * 0.0, angular_rad_s=TWIST.angular_rad_s * 0.0)
    assert list(twist_findings(still, silent)) == []


def test_what_is_not_measured_is_not_compared() -> None:
    wrong = replace(TWIST, linear_m_s=TWIST.linear_m_s * 2.0, angular_rad_s=TWIST.angular_rad_s * 2.0)
    assert list(twist_findings(replace(POSE, measured_axes=("x", "y")), wrong)) == []
    assert len(list(twist_findings(replace(POSE, measured_axes=("x", "y", "z")), wrong))) == 1


def test_signals_that_do_not_overlap_are_not_compared() -> None:
    assert list(twist_findings(POSE, replace(TWIST, stamp_ns=TWIST.stamp_ns + 10**12))) == []


def test_a_quaternion_of_the_wrong_order_jumps() -> None:
    # Turned through half a turn about z in small steps, then read as if w came first and with the canonical sign.
    turn = Rotation.from_rotvec(np.linspace(3.0, 3.3, 50)[:, None] * [0.0, 0.1, 0.99])
    right = replace(POSE, stamp_ns=STAMPS[:50], position_m=POSE.position_m[:50], quaternion_xyzw=turn.as_quat())
    assert list(turn_findings(right)) == []
    leap = np.array(right.quaternion_xyzw)
    leap[25:] = leap[25:, [3, 0, 1, 2]]
    found = list(turn_findings(replace(right, quaternion_xyzw=leap)))
    assert [finding.code for finding in found] == ["orientation-jumps"]
    assert "1 times, the first 0.125 s" in found[0].message
