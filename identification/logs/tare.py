"""Steps of the sensor's bias while the robot stands still: somebody pressed tare, or the driver did."""

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import maximum_filter1d

from ..result import Finding
from ..signals.aligned import AlignedLog
from ..signals.constant_runs import BoolArray, find_runs
from ..signals.frames import turned_rad
from ..signals.recording import FloatArray
from ..signals.segments import low_pass

_STILL_M_S = 1.5e-3
_STILL_RAD_S = 0.02
_POSE_BAND_HZ = 10.0
_SIDE_S = 0.15
_FEWEST = 8
_STEP_S = 4e-3
_NOISE_FACTOR = 8.0
_SMALLEST = np.array([0.3, 0.3, 0.3, 0.03, 0.03, 0.03])
_QUIET_SHARE = 0.15


@dataclass(frozen=True, kw_only=True)
class TareJump:
    """A step of the wrench at rest, `time_s` after the start of the aligned log: `force_n`, `torque_n_m` (3,)."""

    time_s: float
    force_n: FloatArray
    torque_n_m: FloatArray

    def finding(self, topic: str) -> Finding:
        """Say it."""
        force = ", ".join(f"{value:+.2f}" for value in self.force_n)
        torque = ", ".join(f"{value:+.3f}" for value in self.torque_n_m)
        return Finding(
            code="tare-jump",
            severity="warning",
            message=f"The wrench of {topic} steps by ({force}) N and ({torque}) N·m at {self.time_s:.3f} s while the "
            "robot stands still and nothing rings: its bias was set there.",
            advice="Tare before recording, not during it, or cut the log there.",
        )


def find_tare_jumps(log: AlignedLog) -> tuple[TareJump, ...]:
    """Find steps within 4 ms (or one sample) between two quiet stretches of a wrench, the pose still all along.

    A contact or a hand takes longer, moves the robot or leaves a swing behind.
    """
    wrench = np.hstack([log.force_S_n, log.torque_S_n_m])
    side, width = max(_FEWEST, round(_SIDE_S / log.period_s)), max(1, round(_STEP_S / log.period_s))
    if len(wrench) < 2 * side + width + 2:
        return ()
    noise = np.nanmedian(np.abs(np.diff(wrench, n=2, axis=0)), axis=0) / (0.6745 * np.sqrt(6.0))
    least = np.maximum(_NOISE_FACTOR * noise, _SMALLEST)
    steep = find_runs(np.any(np.abs(wrench[width:] - wrench[:-width]) > least, axis=1))
    still = _still(log)
    found = []
    for start, stop in zip(steep.starts.tolist(), steep.stops.tolist(), strict=True):
        first, last = start - side, stop + width + side
        if stop - start > 2 * width or first < 0 or last > len(wrench) or not bool(np.all(still[first:last])):
            continue
        # The step lies between the last sample that the first steep difference starts from and the last one's end.
        jump = _jump(wrench[first:start], wrench[stop + width : last], noise, least)
        if jump is not None:
            time = float(log.time_s[(start + stop + width) // 2])
            found.append(TareJump(time_s=time, force_n=jump[:3], torque_n_m=jump[3:]))
    return tuple(found)


def _still(log: AlignedLog) -> BoolArray:
    """Return where the pose alone shows no motion."""
    velocity = np.gradient(low_pass(log.position_B_m, log.period_s, _POSE_BAND_HZ), log.period_s, axis=0)
    lag = max(1, round(0.02 / log.period_s))
    quaternion = log.orientation_BS.as_quat()
    turned = turned_rad(quaternion[:-lag], quaternion[lag:])
    turning = maximum_filter1d(np.concatenate([turned, np.zeros(lag)]), 2 * lag + 1) / (lag * log.period_s)
    return np.asarray((np.linalg.norm(velocity, axis=1) < _STILL_M_S) & (turning < _STILL_RAD_S))


def _jump(before: FloatArray, after: FloatArray, noise: FloatArray, least: FloatArray) -> FloatArray | None:
    """Return the step between two stretches, None unless both are flat for its size."""
    change = np.asarray(after.mean(axis=0) - before.mean(axis=0))
    if not bool(np.any(np.abs(change) > least)):
        return None
    swing = np.maximum(before.std(axis=0), after.std(axis=0))
    allowed = np.hypot(2.0 * noise, _QUIET_SHARE * np.max(np.abs(change) / least) * least)
    return change if bool(np.all(swing < allowed)) else None
