"""Poses of the tool at rest: mean wrench and orientation, their noise, and groups of like orientation."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from problems.arrays import FloatArray, IntArray

from ..errors import LogError
from ..signals.aligned import AlignedLog
from ..signals.recording import Recording
from ..signals.segments import Span
from ..signals.sweeps import batch_means

GRAVITY_B_M_S2 = np.array([0.0, 0.0, -9.80665])

SMALL_SWING_N = 3.0
"""Heavy payloads change the force of each axis by more than this (rms) as the tool turns; 0.7 kg at 60 degrees does."""
SAY_COMPENSATED = "say so with `wrench: {gravity_compensated: true}` in cell.yaml"
OUTLIER_DEVIATIONS = 6.0
"""A rest that is farther off than this many deviations of the others is left out."""
SMALLEST_SCATTER_N, SMALLEST_SCATTER_N_M = 0.05, 0.01
"""Of what rests leave, no less is taken as their scatter."""

_TRIM_S = 0.12
_SAME_POSE_RAD = np.radians(2.0)
_BATCHES = 8


@dataclass(frozen=True, kw_only=True)
class StaticPose:
    """Mean wrench over one rest, `gravity_S_m_s2`, `force_S_n`, `torque_S_n_m` (3,), and the noise within it.

    A torque that was not measured is NaN, and its deviation 0.

    `quaternion_xyzw` (4,) is the mean orientation, base from sensor; `time_s` the middle of the rest in the log, NaN
    where it has no time;
    `force_noise_n` the spread of the samples, `force_mean_std_n` and `torque_mean_std_n_m` that of their mean, with
    noise that is not white accounted for.
    """

    span: Span
    time_s: float
    quaternion_xyzw: FloatArray
    gravity_S_m_s2: FloatArray
    force_S_n: FloatArray
    torque_S_n_m: FloatArray
    force_noise_n: float
    force_mean_std_n: float
    torque_mean_std_n_m: float


def collect_static_poses(log: AlignedLog, still: tuple[Span, ...]) -> tuple[StaticPose, ...]:
    """Average the wrench over each rest, its edges trimmed."""
    trim = round(_TRIM_S / log.period_s)
    poses = []
    for rest in still:
        if len(rest) < 2 * trim + 10:
            continue
        span = Span(start=rest.start + trim, stop=rest.stop - trim)
        force, torque = log.force_S_n[span.slice], log.torque_S_n_m[span.slice]
        orientation = log.orientation_BS[span.slice].mean()
        poses.append(
            StaticPose(
                span=rest,
                time_s=float(0.5 * (log.time_s[span.start] + log.time_s[span.stop - 1])),
                quaternion_xyzw=np.asarray(orientation.as_quat()),
                gravity_S_m_s2=np.asarray(orientation.inv().apply(GRAVITY_B_M_S2)),
                force_S_n=force.mean(axis=0),
                torque_S_n_m=torque.mean(axis=0),
                force_noise_n=float(np.sqrt(np.mean(np.var(force, axis=0)))),
                force_mean_std_n=_mean_std(force),
                torque_mean_std_n_m=_mean_std(torque) if log.has_torque else 0.0,
            )
        )
    return tuple(poses)


def rows_as_poses(recording: Recording) -> tuple[StaticPose, ...]:
    """Take each row of a table of poses as a rest; how much the samples of one scattered is not known.

    Raises LogError where wrench and pose do not have as many rows, EstimateError where force or orientation are not
    raw and whole.
    """
    recording.require_raw()
    wrench, pose = recording.wrench, recording.pose
    if len(wrench.stamp_ns) != len(pose.stamp_ns):
        raise LogError(
            f"Tables of poses must have one row per pose each, found {len(wrench.stamp_ns)} in {wrench.topic} and "
            f"{len(pose.stamp_ns)} in {pose.topic}; give the rows that belong together."
        )
    turned = Rotation.from_quat(pose.quaternion_xyzw).inv()
    torque = wrench.torque_n_m if wrench.has_torque else np.full_like(wrench.force_n, np.nan)
    return tuple(
        StaticPose(
            span=Span(start=row, stop=row + 1),
            time_s=np.nan,
            quaternion_xyzw=pose.quaternion_xyzw[row],
            gravity_S_m_s2=gravity,
            force_S_n=wrench.force_n[row],
            torque_S_n_m=torque[row],
            force_noise_n=0.0,
            force_mean_std_n=0.0,
            torque_mean_std_n_m=0.0,
        )
        for row, gravity in enumerate(np.asarray(turned.apply(GRAVITY_B_M_S2)))
    )


def _mean_std(values: FloatArray) -> float:
    """Return the deviation of the mean of (n, 3) from that of batch means: slow noise averages out less than white."""
    batches = batch_means(values, _BATCHES)
    return float(np.sqrt(np.mean(np.var(batches, axis=0, ddof=1)) / _BATCHES))


def group_by_gravity(poses: Sequence[StaticPose]) -> IntArray:
    """Return a number per pose (n,) by the direction of gravity in S: within 2 degrees it is the same."""
    seen: list[FloatArray] = []
    numbers = []
    for pose in poses:
        direction = pose.gravity_S_m_s2 / np.linalg.norm(pose.gravity_S_m_s2)
        angles = [float(np.arccos(np.clip(direction @ other, -1.0, 1.0))) for other in seen]
        numbers.append(_join(angles, len(seen)))
        if numbers[-1] == len(seen):
            seen.append(direction)
    return np.array(numbers, dtype=np.int64)


def group_by_orientation(poses: Sequence[StaticPose]) -> IntArray:
    """Return a number per pose (n,) by its whole orientation: within 2 degrees it is the same."""
    seen: list[Rotation] = []
    numbers = []
    for pose in poses:
        turn = Rotation.from_quat(pose.quaternion_xyzw)
        angles = [float((turn.inv() * other).magnitude()) for other in seen]
        numbers.append(_join(angles, len(seen)))
        if numbers[-1] == len(seen):
            seen.append(turn)
    return np.array(numbers, dtype=np.int64)


def _join(angles: list[float], following: int) -> int:
    nearest = int(np.argmin(angles)) if angles else -1
    return nearest if nearest >= 0 and angles[nearest] <= _SAME_POSE_RAD else following


def group_shares(groups: IntArray) -> FloatArray:
    """Return a weight per pose (n,) such that every group weighs 1, however often it was visited."""
    _, inverse, counts = np.unique(groups, return_inverse=True, return_counts=True)
    return np.asarray(1.0 / counts[inverse])


def group_means(values: FloatArray, groups: IntArray) -> FloatArray:
    """Average the rows of (n, k) within each group, (groups, k) in the order of the groups' numbers."""
    return np.array([values[groups == number].mean(axis=0) for number in np.unique(groups)])


def weighted_median(values: FloatArray, weights: FloatArray) -> float:
    """Return the value (of n) that half of the weight lies below; the mean of two where it falls between them."""
    order = np.argsort(values)
    passed = np.cumsum(weights[order]) / np.sum(weights)
    low = int(np.searchsorted(passed, 0.5 - 1e-12))
    high = int(np.searchsorted(passed, 0.5 + 1e-12))
    return 0.5 * float(values[order[low]] + values[order[min(high, len(values) - 1)]])


def cross_matrix(vector: FloatArray) -> FloatArray:
    """Return the matrix of `vector` × (.) for (…, 3)."""
    x, y, z = np.moveaxis(np.asarray(vector), -1, 0)
    zero = np.zeros_like(x)
    rows = [[zero, -z, y], [z, zero, -x], [-y, x, zero]]
    return np.asarray(np.stack([np.stack(row, axis=-1) for row in rows], axis=-2))
