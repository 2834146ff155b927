"""Whether pose and twist describe the same motion: units, frames and angles that were declared wrongly show here."""

from collections.abc import Iterator

import numpy as np
from scipy.integrate import cumulative_trapezoid
from scipy.spatial.transform import Rotation

from problems.arrays import FloatArray

from ...result import Finding
from ...signals.recording import AXES, PoseSignal, TwistSignal

_LAG_S = 0.2
"""Motion is compared over steps this long: rounding and delays of a few milliseconds do not matter then."""
_STEPS_PER_LAG = 4
_LARGEST_MISMATCH = 0.15
"""Share of the motion (root mean square) that may differ; a unit, a sign or a frame that is wrong differs by more."""
_STILL_M, _STILL_RAD = 1e-4, 1e-3
_FASTEST_TURN_RAD = 0.5
"""No robot turns its tool this far within one sample; a quaternion of the wrong order or a wrong angle does."""

_HOLE_PERIODS = 5
"""Across more sampling periods than this a log has a hole, in which a robot may turn as far as it likes."""


def turn_findings(pose: PoseSignal) -> Iterator[Finding]:
    """Yield a finding when the orientation jumps between samples."""
    if not {*AXES[3:]} <= {*pose.measured_axes} or len(pose.stamp_ns) < 2:
        return
    quaternion = pose.quaternion_xyzw
    cosine = np.clip(np.abs(np.sum(quaternion[1:] * quaternion[:-1], axis=1)), 0.0, 1.0)
    angle = 2.0 * np.arccos(cosine)
    step_ns = np.diff(pose.stamp_ns)
    jumps = np.flatnonzero((angle > _FASTEST_TURN_RAD) & (step_ns <= _HOLE_PERIODS * np.median(step_ns)))
    if jumps.size:
        seconds = (pose.stamp_ns[jumps[0] + 1] - pose.stamp_ns[0]) * 1e-9
        yield Finding.warning(
            "orientation-jumps",
            f"The orientation of topic {pose.topic} turns by more than "
            f"{np.degrees(_FASTEST_TURN_RAD):.0f} degrees within one sample {jumps.size} times, "
            f"the first {seconds:.3f} s after its start.",
            "Check `orientation_as` and the angle's unit in cell.yaml: order, Euler sequence, rotation vector.",
        )


def twist_findings(pose: PoseSignal, twist: TwistSignal) -> Iterator[Finding]:
    """Yield a finding for translation and for rotation where twist and pose differ in more than their noise."""
    start = pose.stamp_ns[0]
    pose_time, twist_time = (pose.stamp_ns - start) * 1e-9, (twist.stamp_ns - start) * 1e-9
    inside = (pose_time >= twist_time[0]) & (pose_time <= twist_time[-1])
    period = float(np.median(np.diff(pose_time)))
    lag = max(1, round(_LAG_S / period))
    # Steps that overlap by more hold the same twice.
    starts = np.flatnonzero(inside)[: -lag : max(1, lag // _STEPS_PER_LAG)]
    if not starts.size:
        return
    starts = starts[pose_time[starts + lag] - pose_time[starts] < (lag + _HOLE_PERIODS) * period]
    if not starts.size:
        return
    stops = starts + lag
    between = (pose_time[starts], pose_time[stops])
    if _both(pose, twist, AXES[:3]):
        moved = pose.position_m[stops] - pose.position_m[starts]
        integrated = _travelled(twist_time, twist.linear_m_s, *between)
        yield from _compared("translation", moved, integrated, _STILL_M, pose, twist)
    if _both(pose, twist, AXES[3:]):
        before, after = (Rotation.from_quat(pose.quaternion_xyzw[index]) for index in (starts, stops))
        integrated = _travelled(twist_time, twist.angular_rad_s, *between)
        yield from _compared("rotation", (after * before.inv()).as_rotvec(), integrated, _STILL_RAD, pose, twist)


def _both(pose: PoseSignal, twist: TwistSignal, axes: tuple[str, ...]) -> bool:
    return {*axes} <= {*pose.measured_axes} & {*twist.measured_axes}


def _travelled(time: FloatArray, velocity: FloatArray, starts: FloatArray, stops: FloatArray) -> FloatArray:
    """Return the integral of a velocity (n, 3) from each start to its stop."""
    travelled = cumulative_trapezoid(velocity, time, axis=0, initial=0.0)
    return np.column_stack([np.interp(stops, time, column) - np.interp(starts, time, column) for column in travelled.T])


def _compared(
    what: str, moved: FloatArray, integrated: FloatArray, still: float, pose: PoseSignal, twist: TwistSignal
) -> Iterator[Finding]:
    integrated_power = float(np.sum(integrated**2))
    power = max(float(np.sum(moved**2)), integrated_power)
    if np.sqrt(power / len(moved)) < still:
        return
    mismatch = float(np.sqrt(np.sum((moved - integrated) ** 2) / power))
    if mismatch <= _LARGEST_MISMATCH:
        return
    share = float(np.sum(moved * integrated)) / integrated_power if integrated_power > 0.0 else 0.0
    rest = float(np.sqrt(np.sum((moved - share * integrated) ** 2) / power))
    fits = f"times {share:.3f} it fits within {100 * rest:.0f} %" if rest < _LARGEST_MISMATCH else "no factor mends it"
    yield Finding.warning(
        "twist-disagrees",
        f"The {what} that the twist of {twist.topic} gives differs from that of the pose of {pose.topic} by "
        f"{100 * mismatch:.0f} % (root mean square over steps of {_LAG_S:g} s; {fits}).",
        "Check units, frames, `orientation_as` and clocks of both in cell.yaml.",
    )
