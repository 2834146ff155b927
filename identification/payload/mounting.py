"""Mounting of the sensor on the flange and tilt of the base, from poses at rest."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.special import fdtrc, stdtrit

from problems.arrays import FloatArray

from ..result import Finding, Status, VectorEstimate
from .gravity import GravityFit
from .static_poses import GRAVITY_B_M_S2, StaticPose, cross_matrix, group_by_orientation, group_means

_FEWEST_ORIENTATIONS = 7
_LARGEST_STD_RAD = np.radians(0.5)
_SIGNIFICANCE = 1e-3
_ROUNDS = 12
_SMALLEST_SPREAD = 1e-9
_METHOD = "least squares of weight and its moment over static poses"


@dataclass(frozen=True, kw_only=True)
class MountingFit:
    """Rotation vector of the real sensor axes as seen from the assumed ones, and of the vertical in the base.

    `mounting_S_rad` (3) turns flange-from-sensor as assumed into what it is: R_FS exp(μ). `base_tilt_B_rad` (2) about x
    and y of the base turns its −z into the direction of gravity. Either is unidentifiable where the poses do not show
    it to half a degree, and its note says where it is consistent with none. `residual_rms_n` is what is left with
    both. The findings name what cell.yaml should declare.
    """

    mounting_S_rad: VectorEstimate
    base_tilt_B_rad: VectorEstimate
    residual_rms_n: float
    findings: tuple[Finding, ...]


@dataclass(frozen=True, kw_only=True)
class _Means:
    """Orientations (k), their wrenches (k, 3), and the deviation of force and torque that noise leaves.

    Without `has_torque` there are the equations of the force alone, without h and b_τ.
    """

    orientation_BS: Rotation
    force: FloatArray
    torque: FloatArray
    force_floor: float
    torque_floor: float
    has_torque: bool

    @property
    def freedom(self) -> int:
        """Equations less unknowns."""
        return 6 * len(self.force) - 15 if self.has_torque else 3 * len(self.force) - 9


def identify_mounting(
    poses: Sequence[StaticPose], gravity: GravityFit, mounting_FS: Rotation | None = None
) -> MountingFit:
    """Solve f = m g_S + b_f, τ = h × g_S + b_τ with g_S = exp(μ)ᵀ R_BSᵀ exp(β) g_B for m, h, b, μ and β at once.

    Only both at once, since a sensor that is turned and a base that leans look alike where the tool hardly turns; the
    covariance shows. `mounting_FS` is what the cell declares, for the text of the findings. The rests are those that
    `gravity` found free.
    """
    means = _free_means(poses, gravity)
    if means is None or gravity.bias_step is not None:
        return _nothing("needs seven free orientations under one sensor bias")
    fit = _solve(means)
    if fit is None:
        return _nothing("the poses do not separate the sensor's mounting from the base's tilt")
    values, covariance, freedom, rms = fit
    mounting, is_zero = _judged(values[:3], covariance[:3, :3], freedom)
    tilt, is_level = _judged(values[3:], covariance[3:, 3:], freedom)
    return MountingFit(
        mounting_S_rad=mounting,
        base_tilt_B_rad=tilt,
        residual_rms_n=rms,
        findings=_findings(mounting, is_zero, tilt, is_level, mounting_FS or Rotation.identity()),
    )


def _free_means(poses: Sequence[StaticPose], gravity: GravityFit) -> _Means | None:
    free = [poses[i] for i in gravity.inliers]
    groups = group_by_orientation(free)
    if len(np.unique(groups)) < _FEWEST_ORIENTATIONS:
        return None
    quaternions = np.array([pose.quaternion_xyzw for pose in free])
    return _Means(
        orientation_BS=Rotation.concatenate(
            [Rotation.from_quat(quaternions[groups == number]).mean() for number in np.unique(groups)]
        ),
        force=group_means(np.array([pose.force_S_n for pose in free]), groups),
        torque=group_means(np.array([pose.torque_S_n_m for pose in free]), groups),
        force_floor=float(np.median([pose.force_mean_std_n for pose in free])),
        torque_floor=float(np.median([pose.torque_mean_std_n_m for pose in free])),
        has_torque=gravity.has_torque,
    )


def _solve(means: _Means) -> tuple[FloatArray, FloatArray, int, float] | None:
    """Return (μ, β), their covariance, the degrees of freedom and the force's rms; None where the poses are too few.

    Gauss–Newton on (m, b_f, h, b_τ, μ, β): for given angles the rest is linear. Force and torque are weighed by what
    they leave.
    """
    count, kinds, freedom = len(means.force), 2 if means.has_torque else 1, means.freedom
    floors = np.array([means.force_floor, means.torque_floor][:kinds])
    angles, weights = np.zeros(5), np.ones(kinds)
    rows, residual = np.zeros((0, 0)), np.zeros(0)
    for _ in range(_ROUNDS):
        rows, residual = _linearised(means, angles, weights)
        scale = np.linalg.norm(rows, axis=0) + 1e-30
        if np.linalg.cond(rows / scale) > 1e7:
            return None
        step = np.linalg.lstsq(rows / scale, residual, rcond=None)[0] / scale
        angles = angles + np.clip(step[-5:], -0.3, 0.3)
        left = (residual - rows @ step).reshape(kinds, -1) / weights[:, None]
        spread = np.sqrt(np.sum(left**2, axis=1) / (freedom / kinds))
        weights = 1.0 / np.maximum(spread, floors).clip(min=_SMALLEST_SPREAD)
        if float(np.max(np.abs(step[-5:]))) < 1e-9:
            break
    rows, residual = _linearised(means, angles, weights)
    left = residual - rows @ np.linalg.lstsq(rows, residual, rcond=None)[0]
    covariance = max(1.0, float(left @ left) / freedom) * np.linalg.inv(rows.T @ rows)
    widened = np.sqrt(np.maximum(np.diag(_sandwich(rows, left, 3 * kinds)) / np.diag(covariance), 1.0))
    covariance = widened[:, None] * covariance * widened
    force = left[: 3 * count] / weights[0]
    return angles, np.asarray(covariance[-5:, -5:]), freedom, float(np.sqrt(np.mean(force**2)))


def _sandwich(rows: FloatArray, left: FloatArray, size: int) -> FloatArray:
    """Return the covariance that holds where the `size` misfits of a pose depend on each other (HC3, by pose).

    An orientation that is off turns force and moment together, and never along gravity.
    """
    inverse = np.linalg.inv(rows.T @ rows)
    meat = np.zeros_like(inverse)
    for block, misfit in zip(_by_pose(rows, size), _by_pose(left[:, None], size)[:, :, 0], strict=True):
        own = np.eye(size) - block @ inverse @ block.T
        score = block.T @ np.linalg.pinv(own, rcond=1e-6) @ misfit
        meat += np.outer(score, score)
    return np.asarray(inverse @ meat @ inverse)


def _by_pose(rows: FloatArray, size: int) -> FloatArray:
    """Regroup rows (forces of all poses, then torques if there are) into (k, size, p)."""
    return np.concatenate([*rows.reshape(size // 3, -1, 3, rows.shape[1])], axis=1)


def _linearised(means: _Means, angles: FloatArray, weights: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return rows for (m, b_f, h, b_τ) and the changes of (μ, β), and the wrench, both weighted; angles solved first.

    With g = exp(μ)ᵀ Rᵀ exp(β) g_B a small turn of the sensor changes g by g × δμ, one of the base by
    exp(μ)ᵀ Rᵀ (δβ × exp(β) g_B).
    """
    down = Rotation.from_rotvec([angles[3], angles[4], 0.0]).apply(GRAVITY_B_M_S2)
    to_sensor = (means.orientation_BS * Rotation.from_rotvec(angles[:3])).inv()
    gravity = np.asarray(to_sensor.apply(down))
    count = len(gravity)
    bias = np.broadcast_to(np.eye(3), (count, 3, 3))
    turned = np.concatenate(
        [cross_matrix(gravity), to_sensor.as_matrix() @ -cross_matrix(down)[:, :2]], axis=2
    )  # (count, 3, 5)
    force_rows = weights[0] * np.concatenate([gravity[:, :, None], bias], axis=2)
    if not means.has_torque:
        linear, wrench = force_rows.reshape(-1, 4), weights[0] * means.force.reshape(-1)
        mass = np.linalg.lstsq(linear, wrench, rcond=None)[0][0]
        return np.hstack([linear, weights[0] * mass * turned.reshape(-1, 5)]), np.asarray(wrench)
    nothing = np.zeros((count, 3, 3))
    force_rows = np.concatenate([force_rows, nothing, nothing], axis=2)
    torque_rows = np.concatenate([nothing[:, :, :1], nothing, -cross_matrix(gravity), bias], axis=2)
    linear = np.concatenate([force_rows, weights[1] * torque_rows]).reshape(-1, 10)
    wrench = np.concatenate([weights[0] * means.force, weights[1] * means.torque]).reshape(-1)
    solved = np.linalg.lstsq(linear, wrench, rcond=None)[0]
    force_turned = weights[0] * solved[0] * turned
    torque_turned = weights[1] * (cross_matrix(solved[4:7]) @ turned)
    rows = np.hstack([linear, np.concatenate([force_turned, torque_turned]).reshape(-1, 5)])
    return rows, np.asarray(wrench)


def _judged(values: FloatArray, covariance: FloatArray, freedom: int) -> tuple[VectorEstimate, bool | None]:
    """Return the angles with their verdict, and whether they are consistent with none."""
    std = np.sqrt(np.diag(covariance)) * float(stdtrit(freedom, 0.975) / 1.96)
    if float(np.max(std)) > _LARGEST_STD_RAD:
        shown = ", ".join(f"{np.degrees(each):.2g}" for each in std)
        note = f"standard deviations of {shown} degrees; record poses that differ more, turned about the vertical too"
        return VectorEstimate(value=None, std=None, status=Status.UNIDENTIFIABLE, method=_METHOD, note=note), None
    wald = float(values @ np.linalg.solve(covariance, values)) / len(values)
    is_zero = float(fdtrc(len(values), freedom, wald)) > _SIGNIFICANCE
    estimate = VectorEstimate(
        value=tuple(float(v) for v in values),
        std=tuple(float(s) for s in std),
        status=Status.IDENTIFIED,
        method=_METHOD,
        note="consistent with none" if is_zero else "",
    )
    return estimate, is_zero


def _nothing(note: str) -> MountingFit:
    unknown = VectorEstimate(value=None, std=None, status=Status.UNIDENTIFIABLE, method=_METHOD, note=note)
    return MountingFit(
        mounting_S_rad=unknown,
        base_tilt_B_rad=unknown,
        residual_rms_n=float("nan"),
        findings=(),
    )


def _findings(
    mounting: VectorEstimate, is_zero: bool | None, tilt: VectorEstimate, is_level: bool | None, R_FS: Rotation
) -> tuple[Finding, ...]:
    found = []
    if is_zero is False and mounting.value is not None and mounting.std is not None:
        real = (R_FS * Rotation.from_rotvec(mounting.value)).as_quat(canonical=True)
        found.append(
            Finding(
                code="sensor-turned",
                severity="warning",
                message=f"The sensor's axes are turned by {_degrees(mounting.value, mounting.std)} degrees about its "
                "x, y, z from where they were assumed.",
                advice=f"Check the mounting; declare `sensor: {{orientation: [{_numbers(real)}]}}` in cell.yaml.",
            )
        )
    if is_level is False and tilt.value is not None and tilt.std is not None:
        down = Rotation.from_rotvec([*tilt.value, 0.0]).apply([0.0, 0.0, -1.0])
        found.append(
            Finding(
                code="base-tilted",
                severity="warning",
                message=f"Gravity leans by {_degrees(tilt.value, tilt.std)} degrees about x and y of the base from "
                "where it was assumed.",
                advice=f"Level the base, or declare `gravity_direction: [{_numbers(down)}]` in cell.yaml.",
            )
        )
    return tuple(found)


def _degrees(values: Sequence[float], std: Sequence[float]) -> str:
    return ", ".join(f"{np.degrees(v):+.2f} ± {np.degrees(s):.2f}" for v, s in zip(values, std, strict=True))


def _numbers(values: FloatArray) -> str:
    return ", ".join(f"{float(value):.5f}" for value in values)
