"""Mass, centre of mass and sensor bias from poses at rest."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from .aligned import AlignedLog
from .errors import EstimateError
from .segments import Span

FloatArray = NDArray[np.float64]

GRAVITY_B_M_S2 = np.array([0.0, 0.0, -9.80665])
# Gravity on the ground lies between 9.780 and 9.832 m/s²; the log does not say where it was recorded.
LOCAL_GRAVITY_STD = 0.0015

_TRIM_S = 0.12
_SAME_POSE_RAD = np.radians(2.0)
_LARGEST_CONDITION = 25.0
_OUTLIER_DEVIATIONS = 6.0
_SMALLEST_SCATTER_N = 0.05
_FARTHEST_COM_M = 1.5
_SMALLEST_MASS_KG = 0.1


@dataclass(frozen=True, kw_only=True)
class StaticPose:
    """Mean wrench over one rest: `gravity_S_m_s2`, `force_S_n`, `torque_S_n_m` (3,), and the noise within it."""

    span: Span
    gravity_S_m_s2: FloatArray
    force_S_n: FloatArray
    torque_S_n_m: FloatArray
    force_noise_n: float


@dataclass(frozen=True, kw_only=True)
class GravityFit:
    """The payload and the sensor at rest; standard deviations beside, in the sensor frame S.

    `condition` is that of the normalised force equations; `pose_count` counts distinct orientations;
    `rejected` rests did not fit (something touched the payload).
    """

    mass_kg: float
    mass_std_kg: float
    com_S_m: FloatArray
    com_std_m: FloatArray
    force_bias_S_n: FloatArray
    force_bias_std_n: FloatArray
    torque_bias_S_n_m: FloatArray
    torque_bias_std_n_m: FloatArray
    residual_rms_n: float
    noise_rms_n: float
    condition: float
    pose_count: int
    rejected: int

    def compensated_force_S_n(self, log: AlignedLog) -> FloatArray:
        """Return the force (n, 3) without bias and weight."""
        weight = self.mass_kg * log.orientation_BS.inv().apply(GRAVITY_B_M_S2)
        return np.asarray(log.force_S_n - self.force_bias_S_n - weight)


def collect_static_poses(log: AlignedLog, still: tuple[Span, ...]) -> tuple[StaticPose, ...]:
    """Average the wrench over each rest, its edges trimmed."""
    trim = round(_TRIM_S / log.period_s)
    poses = []
    for rest in still:
        if len(rest) < 2 * trim + 10:
            continue
        span = Span(start=rest.start + trim, stop=rest.stop - trim)
        force, torque = log.force_S_n[span.slice], log.torque_S_n_m[span.slice]
        gravity = log.orientation_BS[span.slice].mean().inv().apply(GRAVITY_B_M_S2)
        poses.append(
            StaticPose(
                span=rest,
                gravity_S_m_s2=np.asarray(gravity),
                force_S_n=force.mean(axis=0),
                torque_S_n_m=torque.mean(axis=0),
                force_noise_n=float(np.sqrt(np.mean(np.var(force, axis=0)))),
            )
        )
    return tuple(poses)


def identify_gravity(poses: tuple[StaticPose, ...]) -> GravityFit:
    """Solve f = m g_S + b_f and τ = c × m g_S + b_τ by least squares over the poses, weeding out touched ones.

    Standard deviations come from the scatter of the poses about the fit, never below what the noise allows.
    Raises EstimateError when the orientations do not tell mass from bias, or the result is unphysical.
    """
    if not poses:
        raise EstimateError(
            "Gravity identification needs rests of 0.4 s or more, and the tool is never at rest in this log; record "
            "6 to 12 poses of 1 s each, and check that positions are in metres and that nothing shakes the sensor."
        )
    distinct = _distinct_count(poses)
    if distinct < 4:
        raise EstimateError(
            "Gravity identification needs at least 4 clearly different tool orientations, each at rest for 0.7 s or "
            f"more, found {distinct}; record 6 to 12 poses of 1 s each, tilted 30 to 70 degrees about two axes."
        )
    keep = np.ones(len(poses), dtype=bool)
    for _ in range(10):
        kept = [pose for pose, good in zip(poses, keep, strict=True) if good]
        solution = _solve_forces(kept, _robust_weights(kept))
        misfit = _misfit(poses, solution)
        scatter = max(1.4826 * float(np.median(misfit[keep])), _SMALLEST_SCATTER_N)
        following = misfit < _OUTLIER_DEVIATIONS * scatter
        if np.array_equal(following, keep):
            break
        keep = following
    kept = [pose for pose, good in zip(poses, keep, strict=True) if good]
    if _distinct_count(tuple(kept)) < 4:
        raise EstimateError(
            f"Of {len(poses)} rests, {len(poses) - len(kept)} do not fit one payload mass; record 6 to 12 poses "
            "at rest with nothing touching the payload."
        )
    return _finished(kept, rejected=len(poses) - len(kept), distinct=distinct)


def _distinct_count(poses: tuple[StaticPose, ...]) -> int:
    seen: list[FloatArray] = []
    for pose in poses:
        direction = pose.gravity_S_m_s2 / np.linalg.norm(pose.gravity_S_m_s2)
        if all(np.arccos(np.clip(direction @ other, -1.0, 1.0)) > _SAME_POSE_RAD for other in seen):
            seen.append(direction)
    return len(seen)


def _force_rows(poses: list[StaticPose]) -> tuple[FloatArray, FloatArray]:
    rows = np.concatenate([np.column_stack([pose.gravity_S_m_s2, np.eye(3)]) for pose in poses])
    return rows, np.concatenate([pose.force_S_n for pose in poses])


def _robust_weights(poses: list[StaticPose]) -> FloatArray:
    """Return weights of an L1 fit by reweighting: a few touched poses do not move it."""
    weights = np.ones(len(poses))
    for _ in range(50):
        misfit = _misfit(tuple(poses), _solve_forces(poses, weights))
        weights = 1.0 / np.maximum(misfit, _SMALLEST_SCATTER_N)
    return weights


def _solve_forces(poses: list[StaticPose], weights: FloatArray) -> FloatArray:
    rows, values = _force_rows(poses)
    root = np.sqrt(np.repeat(weights, 3))
    return np.asarray(np.linalg.lstsq(rows * root[:, None], values * root, rcond=None)[0])


def _misfit(poses: tuple[StaticPose, ...], solution: FloatArray) -> FloatArray:
    rows, values = _force_rows(list(poses))
    return np.asarray(np.linalg.norm((values - rows @ solution).reshape(-1, 3), axis=1))


def _finished(poses: list[StaticPose], *, rejected: int, distinct: int) -> GravityFit:
    rows, values = _force_rows(poses)
    scale = np.array([np.linalg.norm(GRAVITY_B_M_S2), 1.0, 1.0, 1.0])
    condition = float(np.linalg.cond(rows / scale))
    solution, covariance, residual = _least_squares(rows, values, _noise_floor(poses))
    mass = float(solution[0])
    _check(condition, mass)
    torque_rows = np.concatenate([np.hstack([-_cross(pose.gravity_S_m_s2), np.eye(3)]) for pose in poses])
    torques = np.concatenate([pose.torque_S_n_m for pose in poses])
    moment, moment_covariance, _ = _least_squares(torque_rows, torques, 0.0)
    com = moment[:3] / mass
    com_std = np.sqrt(np.diag(moment_covariance)[:3] / mass**2 + (com / mass) ** 2 * covariance[0, 0])
    if np.linalg.norm(com) > _FARTHEST_COM_M:
        raise EstimateError(
            f"The centre of mass comes out {np.linalg.norm(com):.2f} m from the sensor, which no payload of this kind "
            "has; check the force and torque units and the sensor frame."
        )
    return GravityFit(
        mass_kg=mass,
        mass_std_kg=float(np.hypot(np.sqrt(covariance[0, 0]), LOCAL_GRAVITY_STD * mass)),
        com_S_m=com,
        com_std_m=com_std,
        force_bias_S_n=solution[1:],
        force_bias_std_n=np.sqrt(np.diag(covariance)[1:]),
        torque_bias_S_n_m=moment[3:],
        torque_bias_std_n_m=np.sqrt(np.diag(moment_covariance)[3:]),
        residual_rms_n=float(np.sqrt(np.mean(residual**2))),
        noise_rms_n=float(np.median([pose.force_noise_n for pose in poses])),
        condition=condition,
        pose_count=distinct,
        rejected=rejected,
    )


def _check(condition: float, mass_kg: float) -> None:
    if condition > _LARGEST_CONDITION:
        raise EstimateError(
            f"The poses are too alike to tell weight from sensor bias (condition number {condition:.0f}, at most "
            f"{_LARGEST_CONDITION:.0f}); record poses tilted by 30 to 70 degrees about two axes."
        )
    if abs(mass_kg) < _SMALLEST_MASS_KG:
        raise EstimateError(
            f"The force hardly changes with the orientation (it would be {mass_kg:.3f} kg); gravity was already "
            "removed from this wrench, or its unit is not the newton. Record the raw wrench."
        )
    if mass_kg <= 0.0:
        raise EstimateError(
            f"The payload mass comes out as {mass_kg:.3f} kg; the sensor shows the opposite sign or the pose is not "
            "base from flange. Check the sign and the frame of the wrench."
        )


def _noise_floor(poses: list[StaticPose]) -> float:
    """Return the variance of one pose mean that sensor noise alone explains (noise taken as white)."""
    return float(np.median([pose.force_noise_n**2 / len(pose.span) for pose in poses]))


def _least_squares(
    rows: FloatArray, values: FloatArray, variance_floor: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return solution, covariance and residual of an ordinary least squares problem."""
    solution = np.asarray(np.linalg.lstsq(rows, values, rcond=None)[0], dtype=np.float64)
    residual = values - rows @ solution
    variance = max(float(residual @ residual) / max(len(values) - rows.shape[1], 1), variance_floor)
    covariance = np.asarray(variance * np.linalg.inv(rows.T @ rows), dtype=np.float64)
    return solution, covariance, residual


def _cross(vector: FloatArray) -> FloatArray:
    """Return the matrix of `vector` × (.)."""
    return np.array([[0.0, -vector[2], vector[1]], [vector[2], 0.0, -vector[0]], [-vector[1], vector[0], 0.0]])


def orientation_spread_rad(orientation: Rotation) -> float:
    """Return the largest turn away from the mean orientation."""
    return float(np.max((orientation.mean().inv() * orientation).magnitude()))
