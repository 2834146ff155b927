"""The equations of a payload at rest, fitted so that touched rests and a tare between rests do not move it."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .static_poses import StaticPose, cross_matrix, group_shares, weighted_median

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]
IntArray = NDArray[np.int64]

_ROUNDS = 50
_REFITS = 10
_OUTLIER_DEVIATIONS = 6.0
_SMALLEST_SCATTER_N = 0.05
_SMALLEST_SCATTER_N_M = 0.01
_FEWEST_BESIDE_STEP = 3
_NOISY = 4.0
_OFF = 10.0
_EXPLAINED = 0.4
_SMALLEST_STEP_N = 0.5


@dataclass(frozen=True, kw_only=True)
class BiasStep:
    """A change of the sensor's bias between two rests: what was on top of the bias before `sample`.

    `after_s` and `before_s` bound the time; the step is taken to lie in the middle of it.
    """

    sample: int
    after_s: float
    before_s: float
    force_before_S_n: FloatArray
    torque_before_S_n_m: FloatArray

    @classmethod
    def between(cls, last: StaticPose, first: StaticPose, force_n: FloatArray, torque_n_m: FloatArray) -> "BiasStep":
        """Return the step between the last rest before it and the first one after it."""
        return cls(
            sample=(last.span.stop + first.span.start) // 2,
            after_s=last.time_s,
            before_s=first.time_s,
            force_before_S_n=force_n,
            torque_before_S_n_m=torque_n_m,
        )


@dataclass(frozen=True, kw_only=True)
class PoseEquations:
    """Rows (n, 3, p) and values (n, 3) of f = m g + b_f and of τ = −[g]× m c + b_τ, a block of three per pose.

    Three more columns hold the bias that the `early` poses have on top.
    """

    force_rows: FloatArray
    force_n: FloatArray
    torque_rows: FloatArray
    torque_n_m: FloatArray

    @classmethod
    def of(cls, poses: Sequence[StaticPose], *, early: BoolArray | None = None) -> "PoseEquations":
        """Write down the equations of `poses`."""
        gravity = np.array([pose.gravity_S_m_s2 for pose in poses])
        bias = np.broadcast_to(np.eye(3), (len(poses), 3, 3))
        more = () if early is None else (early[:, None, None] * bias,)
        return cls(
            force_rows=np.concatenate([gravity[:, :, None], bias, *more], axis=2),
            force_n=np.array([pose.force_S_n for pose in poses]),
            torque_rows=np.concatenate([-cross_matrix(gravity), bias, *more], axis=2),
            torque_n_m=np.array([pose.torque_S_n_m for pose in poses]),
        )


@dataclass(frozen=True, kw_only=True)
class RobustFit:
    """Which poses fit (n,), the scatter of those, and the force's misfit (n,) of all about the first L1 fit."""

    keep: BoolArray
    scatter_n: float
    misfit_n: FloatArray

    def cost(self, shares: FloatArray, unit_n: float) -> float:
        """Return the weighted sum of the misfits in units between 1 and 10: a touched pose is no more than off."""
        return float(np.sum(shares * np.clip(self.misfit_n / unit_n, 1.0, _OFF)))


def robust_fit(equations: PoseEquations, groups: IntArray) -> RobustFit:
    """Fit force and torque by least absolute misfit, drop the poses beyond six deviations, repeat until none changes.

    Every group of poses weighs 1: contacts in one orientation do not outvote the others.
    """
    force, torque = equations.force_rows, equations.torque_rows
    keep = np.ones(len(groups), dtype=bool)
    scatter, first = 0.0, None
    for _ in range(_REFITS):
        shares = np.zeros(len(groups))
        shares[keep] = group_shares(groups[keep])
        pull = _misfit(force, equations.force_n, shares, _SMALLEST_SCATTER_N)
        twist = _misfit(torque, equations.torque_n_m, shares, _SMALLEST_SCATTER_N_M)
        scatter = max(1.4826 * weighted_median(pull[keep], shares[keep]), _SMALLEST_SCATTER_N)
        turning = max(1.4826 * weighted_median(twist[keep], shares[keep]), _SMALLEST_SCATTER_N_M)
        first = pull if first is None else first
        following = (pull < _OUTLIER_DEVIATIONS * scatter) & (twist < _OUTLIER_DEVIATIONS * turning)
        if np.array_equal(following, keep) or not np.any(following):
            break
        keep = following
    return RobustFit(keep=keep, scatter_n=scatter, misfit_n=np.zeros(0) if first is None else first)


def _misfit(rows: FloatArray, values: FloatArray, shares: FloatArray, floor: float) -> FloatArray:
    """Return the misfit (n,) about an L1 fit by reweighting; poses of share 0 take no part in it."""
    weights, misfit = shares, np.zeros(len(values))
    count = rows.shape[2]
    for _ in range(_ROUNDS):
        root = np.sqrt(weights)[:, None, None]
        solution = np.linalg.lstsq((rows * root).reshape(-1, count), (values * root[:, :, 0]).reshape(-1), rcond=None)[
            0
        ]
        previous, misfit = misfit, np.linalg.norm(values - rows @ solution, axis=1)
        if float(np.max(np.abs(misfit - previous))) < 1e-3 * floor:
            break
        weights = shares / np.maximum(misfit, floor)
    return np.asarray(misfit)


def find_bias_step(poses: Sequence[StaticPose], groups: IntArray, single: RobustFit) -> int | None:
    """Return the number of the first pose after a change of bias, where one explains most of the misfit.

    Both sides need three orientations: a contact, which shifts the force in one of them, is no step.
    """
    noise = float(np.median([pose.force_mean_std_n for pose in poses]))
    if bool(np.all(single.keep)) and single.scatter_n < _NOISY * max(noise, _SMALLEST_SCATTER_N):
        return None
    shares, best = group_shares(groups), (_EXPLAINED, 0)
    for split in range(1, len(poses)):
        before, after = np.unique(groups[:split]), np.unique(groups[split:])
        if min(len(before), len(after)) < _FEWEST_BESIDE_STEP:
            continue
        early = np.arange(len(poses)) < split
        fit = robust_fit(PoseEquations.of(poses, early=early), groups)
        left = fit.cost(shares, fit.scatter_n) / single.cost(shares, fit.scatter_n)
        best = min(best, (left, split))
    return best[1] if best[1] and _step_size(poses, groups, best[1]) > _SMALLEST_STEP_N else None


def _step_size(poses: Sequence[StaticPose], groups: IntArray, split: int) -> float:
    early = np.arange(len(poses)) < split
    equations = PoseEquations.of(poses, early=early)
    keep = robust_fit(equations, groups).keep
    rows, values = equations.force_rows[keep], equations.force_n[keep]
    if len(np.unique(groups[keep])) < _FEWEST_BESIDE_STEP:
        return 0.0
    solution = np.linalg.lstsq(rows.reshape(-1, rows.shape[2]), values.reshape(-1), rcond=None)[0]
    return float(np.linalg.norm(solution[4:]))
