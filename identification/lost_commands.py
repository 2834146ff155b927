"""Commands that the robot received and the logger lost."""

from dataclasses import replace

import numpy as np
from scipy.interpolate import make_interp_spline
from scipy.spatial.transform import Rotation, Slerp

from .aligned import find_gaps
from .recording import PoseSignal

_LOST = 1.5


def restore_commands(command: PoseSignal) -> PoseSignal:
    """Return the command with the messages that are missing between two others, up to a hole of the log.

    A message that the logger lost reached the robot all the same; holding the one before it would make the robot look
    slower. Positions by a cubic spline through the others, orientations by slerp.
    """
    stamps = command.stamp_ns
    steps = np.diff(stamps)
    if not len(steps):
        return command
    period = float(np.median(steps))
    lost = np.round(steps / period).astype(np.int64)
    lost[(steps < _LOST * period)] = 1
    lost[find_gaps(stamps)] = 1
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
