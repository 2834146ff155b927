"""All channels on the wrench's clock."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import make_interp_spline
from scipy.spatial.transform import Rotation, Slerp

from .errors import LogError
from .recording import PoseSignal, Recording

FloatArray = NDArray[np.float64]

_SHORTEST_OVERLAP_S = 2.0
_LARGEST_GAP_PERIODS = 12.0
_REGULAR_SHARE = 0.05
_MOSTLY = 0.99


@dataclass(frozen=True, kw_only=True)
class AlignedLog:
    """Wrench and pose on one uniform clock: `time_s` (n,) from the first wrench stamp `start_ns`.

    `force_S_n`, `torque_S_n_m` (n, 3) raw in the sensor frame; `position_B_m` (n, 3); `orientation_BS` n rotations
    base from sensor (the sensor frame is the flange's); `pose_rate_hz` limits which frequencies mean something.
    """

    start_ns: int
    period_s: float
    time_s: FloatArray
    force_S_n: FloatArray
    torque_S_n_m: FloatArray
    position_B_m: FloatArray
    orientation_BS: Rotation
    pose_rate_hz: float

    def __len__(self) -> int:
        return len(self.time_s)


def align(recording: Recording) -> AlignedLog:
    """Interpolate the pose on a uniform clock of the wrench's rate, over the time that both cover.

    The clock starts at a wrench stamp, so that a regular wrench keeps its samples: between them its noise would be
    averaged. Position by cubic spline, orientation by slerp. Raises LogError when the channels do not overlap or have
    holes, EstimateError when wrench or pose are not as sensor and robot tell them (`Recording.require_raw`).
    """
    recording.require_raw()
    wrench, pose = recording.wrench, recording.pose
    start = max(wrench.stamp_ns[0], pose.stamp_ns[0])
    stop = min(wrench.stamp_ns[-1], pose.stamp_ns[-1])
    if stop - start < _SHORTEST_OVERLAP_S * 1e9:
        raise LogError(
            f"Wrench and pose must cover the same time for at least {_SHORTEST_OVERLAP_S:g} s, found "
            f"{max(0.0, float(stop - start) * 1e-9):.3f} s in common ({wrench.topic}, {pose.topic}); check "
            "that both header clocks are the same."
        )
    period = check_regular(wrench.topic, wrench.stamp_ns)
    pose_period = check_regular(pose.topic, pose.stamp_ns)
    start = wrench.stamp_ns[np.searchsorted(wrench.stamp_ns, start)]
    count = int((stop - start) * 1e-9 / period + 1e-6) + 1
    time = np.asarray(np.arange(count) * period, dtype=np.float64)
    wrench_time = (wrench.stamp_ns - start) * 1e-9
    pose_time = (pose.stamp_ns - start) * 1e-9
    return AlignedLog(
        start_ns=int(start),
        period_s=period,
        time_s=time,
        force_S_n=_interpolated(wrench_time, wrench.force_n, time, degree=1),
        torque_S_n_m=_interpolated(wrench_time, wrench.torque_n_m, time, degree=1),
        position_B_m=_interpolated(pose_time, pose.position_m, time, degree=3),
        orientation_BS=_turned(pose, pose_time, time),
        pose_rate_hz=1.0 / pose_period,
    )


def check_regular(topic: str, stamp_ns: NDArray[np.int64]) -> float:
    """Return the period [s], refusing holes in the data."""
    if len(stamp_ns) < 3:
        raise LogError(f"Topic `{topic}` has {len(stamp_ns)} messages; at least 3 are needed.")
    gaps = np.diff(stamp_ns)
    period = float(np.median(gaps))
    worst = int(np.argmax(gaps))
    if gaps[worst] > _LARGEST_GAP_PERIODS * period:
        raise LogError(
            f"Topic `{topic}` has a gap of {gaps[worst] * 1e-9:.3f} s at "
            f"{(stamp_ns[worst] - stamp_ns[0]) * 1e-9:.3f} s (its period is {period * 1e-9:.6f} s); record again "
            "without losing messages, or cut the log there."
        )
    # Free of the stamps' rounding is the mean over the log, once lost messages are counted.
    steps = gaps / period
    counts = np.round(steps)
    regular = np.abs(steps - counts) < _REGULAR_SHARE
    if counts.min() > 0 and np.mean(regular) > _MOSTLY:
        return 1e-9 * float(stamp_ns[-1] - stamp_ns[0]) / float(counts.sum())
    mean = float(stamp_ns[-1] - stamp_ns[0]) / (len(stamp_ns) - 1)
    return 1e-9 * (mean if abs(mean / period - 1.0) < 1e-3 else period)


def _interpolated(time: FloatArray, values: FloatArray, at: FloatArray, *, degree: int) -> FloatArray:
    if len(time) == len(at) and np.max(np.abs(time - at)) < 1e-9:
        return np.array(values)
    inside = np.clip(at, time[0], time[-1])
    return np.asarray(make_interp_spline(time, values, k=degree)(inside))


def _turned(pose: PoseSignal, pose_time: FloatArray, at: FloatArray) -> Rotation:
    orientation = Rotation.from_quat(pose.quaternion_xyzw)
    if len(pose_time) == len(at) and np.max(np.abs(pose_time - at)) < 1e-9:
        return orientation
    return Slerp(pose_time, orientation)(np.clip(at, pose_time[0], pose_time[-1]))
