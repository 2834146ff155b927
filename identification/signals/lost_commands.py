"""Commands that the robot received and the logger lost; those that only came late are all there."""

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import make_interp_spline
from scipy.spatial.transform import Rotation, Slerp

from .aligned import find_gaps
from .recording import PoseSignal

_LOST = 1.5


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


def _missing(steps: NDArray[np.float64]) -> int:
    """Return how many messages are missing in the first of these steps (n,), counted in periods.

    As many of the following steps as could make up for a late message are looked at.
    """
    excess = float(steps[0]) - 1.0
    following = steps[1 : 2 + math.ceil(excess)]
    made_up = float(np.sum(np.maximum(1.0 - following, 0.0)))
    return max(round(excess - made_up), 0)
