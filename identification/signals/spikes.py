"""Wrench and pose without the single samples that jump away from both neighbours."""

from dataclasses import replace

import numpy as np

from problems.arrays import BoolArray, FloatArray

from ..result import Finding
from .medians import column_medians, median
from .recording import PoseSignal, Recording, WrenchSignal
from .sweeps import goes_and_returns

_NOISES, _OTHERS = 12.0, 6.0
_AROUND, _FEWEST, _LONGEST_PERIOD_S = 8, 20, 2.5e-3
_LONGEST_POSE_PERIOD_S = 0.1
_TO_STD = 1.4826  # of a normal distribution, over its median absolute deviation
_ADVICE = "Check the sensor's cable, shield and driver; they were replaced by the mean of their neighbours."
# No arm accelerates like this; half an angular acceleration, as a quaternion's components change by half an angle.
_FASTEST_M_S2, _FASTEST_HALF_RAD_S2 = 100.0, 500.0


def without_spikes(recording: Recording) -> tuple[Recording, tuple[Finding, ...]]:
    """Return the recording with single samples replaced that leave both neighbours, and come back.

    They must stand out by 12 noises (of second differences, as the median sample has it) and by six times what any
    other of the 12 samples around them leaves of a cubic through its own neighbours: near a resonance all of them do. A
    wrench below 400 Hz, which may show an impact in one sample, and an axis without noise (a deadband) are left alone.
    """
    wrench = recording.wrench
    if len(wrench.stamp_ns) < _FEWEST or median(np.diff(wrench.stamp_ns)) * 1e-9 > _LONGEST_PERIOD_S:
        return recording, ()
    forces, torques = _spikes(wrench.force_n), _spikes(wrench.torque_n_m)
    count = int(np.count_nonzero(forces) + np.count_nonzero(torques))
    if not count:
        return recording, ()
    clean: WrenchSignal = replace(
        wrench, force_n=_bridged(wrench.force_n, forces), torque_n_m=_bridged(wrench.torque_n_m, torques)
    )
    finding = Finding(
        code="spikes",
        severity="warning",
        message=f"Topic {wrench.topic} has {count} single values that jump away from both neighbours.",
        advice=_ADVICE,
    )
    return replace(recording, wrench=clean), (finding,)


def without_pose_spikes(pose: PoseSignal) -> tuple[PoseSignal, tuple[Finding, ...]]:
    """Return the pose with single samples replaced that leave both neighbours as no arm could, and come back.

    As in the wrench they must stand out from noise and from all samples around them; beyond that, what takes a robot
    there and back within two periods must exceed 100 m/s² (1000 rad/s²), of which a pose below 10 Hz shows nothing.
    Quaternions have neighbouring signs already.
    """
    period = median(np.diff(pose.stamp_ns)) * 1e-9 if len(pose.stamp_ns) >= _FEWEST else np.inf
    if period > _LONGEST_POSE_PERIOD_S:
        return pose, ()
    places = _spikes(pose.position_m, 0.5 * _FASTEST_M_S2 * period**2)
    turns = _spikes(pose.quaternion_xyzw, 0.5 * _FASTEST_HALF_RAD_S2 * period**2)
    rows = np.flatnonzero(np.any(places, axis=1) | np.any(turns, axis=1))
    if not rows.size:
        return pose, ()
    position = _bridged(pose.position_m, places)
    quaternion = _bridged(pose.quaternion_xyzw, np.broadcast_to(np.any(turns, axis=1)[:, None], turns.shape))
    first_s = float(pose.stamp_ns[rows[0]] - pose.stamp_ns[0]) * 1e-9
    off = 1e3 * float(np.nanmax(np.linalg.norm(np.nan_to_num(position - pose.position_m), axis=1)))
    finding = Finding(
        code="pose-spikes",
        severity="warning",
        message=f"Topic {pose.topic} has {rows.size} sample(s) that jump away from both neighbours as no robot moves "
        f"(by up to {off:.3g} mm), the first {first_s:.3f} s after its start.",
        advice="Check the driver and the logger; they were replaced by the mean of their neighbours.",
    )
    quaternion = quaternion / np.linalg.norm(quaternion, axis=1, keepdims=True)
    return replace(pose, position_m=position, quaternion_xyzw=quaternion), (finding,)


def _spikes(values: FloatArray, least: float | None = None) -> BoolArray:
    """Return which values (n, k) are spikes, none of an axis that is not known.

    They are away from both neighbours by `least` too; without it an axis without noise has none. What jumps by no more
    than the neighbours' own steps is none: dry friction that turns makes a corner at a peak of the force.
    """
    found = np.zeros(values.shape, dtype=np.bool_)
    if least is not None and not goes_and_returns(values, least):
        return found
    known = np.flatnonzero(np.any(np.isfinite(values), axis=0))
    if not known.size:
        return found
    before, after = (values[1:-1, known] - values[shifted, known] for shifted in (slice(None, -2), slice(2, None)))
    smaller = np.minimum(np.abs(before), np.abs(after))
    noise = _TO_STD * column_medians(np.abs(before + after))
    limit = np.where(noise > 0.0, _NOISES * noise, np.inf) if least is None else np.maximum(_NOISES * noise, least)
    # Away and back: both steps are large, of one sign, and alike.
    suspects = (before * after > 0.0) & (smaller > limit) & (np.abs(before - after) < smaller)
    if not bool(np.any(suspects)):
        return found
    steps = np.abs(np.diff(values[:, known], axis=0))
    suspects &= smaller > np.pad(np.fmax(steps[:-3], steps[3:]), ((1, 1), (0, 0)))
    for row, index in np.argwhere(suspects).tolist():
        axis, k = known[index], row + 1
        found[k, axis] = _stands_out(values[max(k - _AROUND, 0) : k + 1 + _AROUND, axis], min(k, _AROUND))
    return found


def _bridged(values: FloatArray, spikes: BoolArray) -> FloatArray:
    """Return values (n, k) with the mean of both neighbours where a spike is."""
    if not np.any(spikes):
        return values
    clean = values.copy()
    inside = spikes[1:-1]
    clean[1:-1][inside] = (0.5 * (values[:-2] + values[2:]))[inside]
    return clean


def _stands_out(values: FloatArray, at: int) -> bool:
    """Return whether one of a few values leaves a cubic through its neighbours by far more than all others do."""
    left = np.abs(values[2:-2] - (4.0 * (values[1:-3] + values[3:-1]) - values[:-4] - values[4:]) / 6.0)
    # The cubics of the two on each side go through the suspect.
    others = np.delete(left, [i for i in range(at - 4, at + 1) if 0 <= i < len(left)])
    return 2 <= at < len(values) - 2 and bool(left[at - 2] > _OTHERS * np.max(others, initial=0.0))
