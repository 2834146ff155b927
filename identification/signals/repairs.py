"""Repairs of a recording: spikes of the wrench, commands that the logger lost."""

import math
from dataclasses import replace

import numpy as np
from scipy.interpolate import make_interp_spline
from scipy.spatial.transform import Rotation, Slerp

from problems.arrays import FloatArray

from ..result import Finding
from .aligned import find_gaps
from .recording import PoseSignal, Recording, WrenchSignal

_NOISES, _OTHERS = 12.0, 6.0
_AROUND, _FEWEST, _LONGEST_PERIOD_S = 8, 20, 2.5e-3
_TO_STD = 1.4826  # of a normal distribution, over its median absolute deviation
_ADVICE = "Check the sensor's cable, shield and driver; they were replaced by the mean of their neighbours."
_LOST = 1.5


def without_spikes(recording: Recording) -> tuple[Recording, tuple[Finding, ...]]:
    """Return the recording with single samples replaced that leave both neighbours, and come back.

    They must stand out by 12 noises (of second differences, as the median sample has it) and by six times what any
    other of the 12 samples around them leaves of a cubic through its own neighbours: near a resonance all of them do. A
    wrench below 400 Hz, which may show an impact in one sample, and an axis without noise (a deadband) are left alone.
    """
    wrench = recording.wrench
    if len(wrench.stamp_ns) < _FEWEST or float(np.median(np.diff(wrench.stamp_ns))) * 1e-9 > _LONGEST_PERIOD_S:
        return recording, ()
    forces, force_count = _replaced(wrench.force_n)
    torques, torque_count = _replaced(wrench.torque_n_m)
    count = force_count + torque_count
    if not count:
        return recording, ()
    clean: WrenchSignal = replace(wrench, force_n=forces, torque_n_m=torques)
    finding = Finding(
        code="spikes",
        severity="warning",
        message=f"Topic {wrench.topic} has {count} single values that jump away from both neighbours.",
        advice=_ADVICE,
    )
    return replace(recording, wrench=clean), (finding,)


def _replaced(values: FloatArray) -> tuple[FloatArray, int]:
    """Return values (n, 3) without spikes, and how many there were."""
    before, after = values[1:-1] - values[:-2], values[1:-1] - values[2:]
    second = before + after
    noise = _TO_STD * np.nanmedian(np.abs(second), axis=0)
    limit = np.where(noise > 0.0, _NOISES * noise, np.inf)
    # Away and back: both steps are large, of one sign, and alike.
    smaller = np.minimum(np.abs(before), np.abs(after))
    spikes = (before * after > 0.0) & (smaller > limit) & (np.abs(before - after) < smaller)
    for k, axis in np.argwhere(spikes).tolist():
        spikes[k, axis] = _stands_out(values[max(k + 1 - _AROUND, 0) : k + 2 + _AROUND, axis], min(k + 1, _AROUND))
    if not np.any(spikes):
        return values, 0
    clean = values.copy()
    clean[1:-1][spikes] = (0.5 * (values[:-2] + values[2:]))[spikes]
    return clean, int(np.count_nonzero(spikes))


def _stands_out(values: FloatArray, at: int) -> bool:
    """Return whether one of a few values leaves a cubic through its neighbours by far more than all others do."""
    left = np.abs(values[2:-2] - (4.0 * (values[1:-3] + values[3:-1]) - values[:-4] - values[4:]) / 6.0)
    # The cubics of the two on each side go through the suspect.
    others = np.delete(left, [i for i in range(at - 4, at + 1) if 0 <= i < len(left)])
    return 2 <= at < len(values) - 2 and bool(left[at - 2] > _OTHERS * np.max(others, initial=0.0))


def restore_commands(command: PoseSignal) -> PoseSignal:
    """Return the command with the messages that are missing between two others, up to a hole of the log.

    A message that the logger lost reached the robot all the same; holding the one before it would make the robot look
    slower. One that came late is followed by shorter steps, which make up for it: nothing is missing there. Positions
    by a cubic spline through the others, orientations by slerp.
    """
    stamps = command.stamp_ns
    steps = np.diff(stamps)
    if not len(steps):
        return command
    period = float(np.median(steps))
    lost = np.ones(len(steps), dtype=np.int64)
    for i in np.setdiff1d(np.flatnonzero(steps >= _LOST * period), find_gaps(stamps)):
        lost[i] = 1 + _missing(steps[i:] / period)
    where = np.flatnonzero(lost > 1)
    if not len(where):
        return command
    added = np.concatenate([stamps[i] + np.round(steps[i] * np.arange(1, lost[i]) / lost[i]) for i in where])
    every = np.sort(np.concatenate([stamps, added.astype(np.int64)]))
    known, wanted = (stamps - stamps[0]) * 1e-9, (every - stamps[0]) * 1e-9
    quaternions = np.full((len(every), 4), np.nan)
    if bool(np.all(np.isfinite(command.quaternion_xyzw))):
        quaternions = Slerp(known, Rotation.from_quat(command.quaternion_xyzw))(wanted).as_quat()
    return replace(
        command,
        stamp_ns=every,
        position_m=np.asarray(make_interp_spline(known, command.position_m, k=3)(wanted)),
        quaternion_xyzw=quaternions,
    )


def _missing(steps: FloatArray) -> int:
    """Return how many messages are missing in the first of these steps (n,), counted in periods.

    As many of the following steps as could make up for a late message are looked at.
    """
    excess = float(steps[0]) - 1.0
    following = steps[1 : 2 + math.ceil(excess)]
    made_up = float(np.sum(np.maximum(1.0 - following, 0.0)))
    return max(round(excess - made_up), 0)
