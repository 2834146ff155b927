"""Mass, centre of mass and sensor bias from poses at rest."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.special import stdtrit

from problems.arrays import BoolArray, FloatArray, IntArray

from ..errors import EstimateError, FewPosesError
from ..signals.aligned import AlignedLog
from ..signals.recording import turned_rad
from .pose_fit import BiasStep, PoseEquations, ResidualTerm, TermKind, find_bias_step, find_terms, robust_fit
from .static_poses import (
    GRAVITY_B_M_S2,
    SAY_COMPENSATED,
    SMALL_SWING_N,
    StaticPose,
    group_by_gravity,
    group_means,
)

# Gravity on the ground lies between 9.780 and 9.832 m/s²; the log does not say where it was recorded.
LOCAL_GRAVITY_STD = 0.0015
# How far a payload tilts in its coupling under its own weight, m g |c|/K_r, if it turns on it at some 40 Hz.
COM_TILT_STD_RAD = 1e-3

_FEWEST_POSES = 4
_LARGEST_CONDITION = 25.0
_SINGULAR = 1e8
_FARTHEST_COM_M = 1.5
_SMALLEST_MASS_KG = 0.1
_SIGNIFICANT_MASS = 3.0


_GAIN_SLOPES = {TermKind.AXIS_GAIN: 1.0, TermKind.LOAD_CURVE: 2.0}


@dataclass(frozen=True, kw_only=True)
class GravityFit:
    """The payload and the sensor at rest; standard deviations beside, in the sensor frame S.

    `covariance` (10, 10) is that of mass, centre of mass, force bias, torque bias, the unknown local gravity in the
    mass included. `condition` is that of the normalised force equations, `com_condition` that of the torque equations;
    `pose_count` counts distinct orientations; `rejected` rests did not fit (something touched the payload), `inliers`
    are the numbers of those that did. Where the sensor was tared between rests, the biases are those after it and
    `bias_step` shows what they were before. `terms` show what the misfit follows: what is significant among them is in
    the standard deviations. Without `has_torque` nothing is known of the centre of mass and the torque bias: both are 0
    with an infinite deviation.
    """

    mass_kg: float
    mass_std_kg: float
    com_S_m: FloatArray
    com_std_m: FloatArray
    force_bias_S_n: FloatArray
    force_bias_std_n: FloatArray
    torque_bias_S_n_m: FloatArray
    torque_bias_std_n_m: FloatArray
    covariance: FloatArray
    residual_rms_n: float
    torque_residual_rms_n_m: float
    noise_rms_n: float
    condition: float
    com_condition: float
    pose_count: int
    rejected: int
    inliers: tuple[int, ...]
    bias_step: BiasStep | None
    terms: tuple[ResidualTerm, ...]
    has_torque: bool = True

    @property
    def com_is_excited(self) -> bool:
        """Whether the poses distinguish all three components of the centre of mass from the torque bias."""
        return self.com_condition <= _LARGEST_CONDITION

    @property
    def gain_error_share(self) -> float:
        """By which share the force's scale may be wrong, from what the rests show to follow axis or load.

        The slope of q w|w| is twice its size over w; an axis of its own scale shows its share directly.
        """
        weight_n = self.mass_kg * float(np.linalg.norm(GRAVITY_B_M_S2))
        shares = [
            _GAIN_SLOPES[term.kind] * float(np.max(term.effect_n)) / weight_n
            for term in self.terms
            if term.kind in _GAIN_SLOPES and term.is_significant
        ]
        return max(shares, default=0.0)

    def compensated_force_S_n(self, log: AlignedLog) -> FloatArray:
        """Return the force (n, 3) without bias and weight."""
        weight = self.mass_kg * log.in_sensor_frame(GRAVITY_B_M_S2)
        force = log.force_S_n - self.force_bias_S_n
        force -= weight
        if self.bias_step is not None:
            force[: self.bias_step.sample] -= self.bias_step.force_before_S_n
        return force

    def compensated_torque_S_n_m(self, log: AlignedLog) -> FloatArray:
        """Return the torque about the sensor's origin (n, 3) without bias and weight."""
        weight = self.mass_kg * log.in_sensor_frame(GRAVITY_B_M_S2)
        torque = log.torque_S_n_m - self.torque_bias_S_n_m
        for part in log.parts:
            torque[part] -= np.cross(self.com_S_m, weight[part])
        if self.bias_step is not None:
            torque[: self.bias_step.sample] -= self.bias_step.torque_before_S_n_m
        return torque


def identify_gravity(poses: tuple[StaticPose, ...]) -> GravityFit:
    """Solve f = m g_S + b_f and τ = c × m g_S + b_τ by least squares over the poses, weeding out touched ones.

    Each distinct orientation counts once, however often it was visited: what one sensor does wrong in one orientation
    does not average out. Standard deviations come from the scatter of the orientations about the fit, never below what
    the noise allows, widened as Student's distribution asks so that two of them hold 95 %. Raises FewPosesError when
    the orientations do not separate mass from bias, EstimateError where the result is unphysical.
    """
    if not poses:
        raise FewPosesError(
            "Gravity identification needs rests of 0.4 s or more, and the tool is never at rest in this log; record "
            "6 to 12 poses of 1 s each, and check that positions are in metres and that nothing shakes the sensor."
        )
    groups = group_by_gravity(poses)
    if len(np.unique(groups)) < _FEWEST_POSES:
        raise FewPosesError(
            "Gravity identification needs at least 4 clearly different tool orientations, each at rest for 0.7 s or "
            f"more, found {len(np.unique(groups))}; record 6 to 12 poses of 1 s each, tilted 30 to 70 degrees about "
            f"two axes.{_maybe_compensated(poses)}"
        )
    equations = PoseEquations.of(poses)
    robust = robust_fit(equations, groups)
    split = find_bias_step(poses, groups, robust)
    early = np.arange(len(poses)) < (0 if split is None else split)
    if split is not None:
        equations = PoseEquations.of(poses, early=early)
        robust = robust_fit(equations, groups)
    keep = robust.keep
    if len(np.unique(groups[keep])) < _FEWEST_POSES:
        raise EstimateError(
            f"Of {len(poses)} rests, {np.count_nonzero(~keep)} do not fit one payload mass; record 6 to 12 poses "
            "at rest with nothing touching the payload."
        )
    return _finished(poses, equations, groups + len(poses) * early, keep, split)


@dataclass(frozen=True, kw_only=True)
class _Solution:
    """Parameters, covariance and residual rms of one set of equations, and their condition."""

    values: FloatArray
    covariance: FloatArray
    rms: float
    condition: float


def _finished(
    poses: tuple[StaticPose, ...],
    equations: PoseEquations,
    groups: IntArray,
    keep: BoolArray,
    split: int | None,
) -> GravityFit:
    kept = [pose for pose, good in zip(poses, keep, strict=True) if good]
    pull, twist = [pose.force_mean_std_n for pose in kept], [pose.torque_mean_std_n_m for pose in kept]
    force = _solve(equations.force_rows[keep], equations.force_n[keep], groups[keep], pull, 1)
    torque = _solve(equations.torque_rows[keep], equations.torque_n_m[keep], groups[keep], twist, 3)
    mass, mass_std = float(force.values[0]), float(np.sqrt(force.covariance[0, 0]))
    _check_mass(force.condition, mass, mass_std)
    step = equations.force_rows[keep][:, :, 4:] @ force.values[4:]
    terms = find_terms(kept, equations.force_n[keep] - step, groups[keep])
    com = torque.values[:3] / mass
    covariance = _joint_covariance(mass, com, force.covariance + _misled(terms, len(force.values)), torque.covariance)
    std = np.sqrt(np.diag(covariance))
    if torque.condition <= _LARGEST_CONDITION:
        _check_com(com, std[1:4], mass, mass_std)
    return GravityFit(
        mass_kg=mass,
        mass_std_kg=float(std[0]),
        com_S_m=com,
        com_std_m=std[1:4],
        force_bias_S_n=force.values[1:4],
        force_bias_std_n=std[4:7],
        torque_bias_S_n_m=torque.values[3:6],
        torque_bias_std_n_m=std[7:10],
        covariance=covariance,
        residual_rms_n=force.rms,
        torque_residual_rms_n_m=torque.rms,
        noise_rms_n=float(np.median([pose.force_noise_n for pose in kept])),
        condition=force.condition,
        com_condition=torque.condition,
        pose_count=len(np.unique(groups[keep] % len(poses))),
        rejected=len(poses) - len(kept),
        inliers=tuple(int(i) for i in np.flatnonzero(keep)),
        bias_step=None
        if split is None
        else BiasStep.between(poses[split - 1], poses[split], force.values[4:], torque.values[6:]),
        terms=terms,
        has_torque=bool(np.isfinite(kept[0].torque_S_n_m).all()),
    )


def _solve(
    rows: FloatArray, values: FloatArray, groups: IntArray, mean_std: list[float], gravity_columns: int
) -> _Solution:
    """Solve rows (n, 3, p) x = values (n, 3) by least squares over the means of the groups."""
    count = rows.shape[2]
    means = group_means(rows.reshape(len(rows), -1), groups).reshape(-1, count)
    target = group_means(values, groups).reshape(-1)
    scale = np.where(np.arange(count) < gravity_columns, np.linalg.norm(GRAVITY_B_M_S2), 1.0)
    condition = float(np.linalg.cond(means / scale)) if np.any(means) else np.inf
    if condition > _SINGULAR:
        nothing = np.full(count, np.inf)
        return _Solution(values=np.zeros(count), covariance=np.diag(nothing), rms=0.0, condition=np.inf)
    solution = np.asarray(np.linalg.lstsq(means, target, rcond=None)[0], dtype=np.float64)
    residual = target - means @ solution
    freedom = max(len(target) - count, 1)
    # The noise floor is known as it is; the scatter is itself estimated from few numbers.
    variance = max(
        float(residual @ residual) / freedom * float(stdtrit(freedom, 0.975) / 1.96) ** 2,
        float(np.median(np.square(mean_std))),
    )
    covariance = variance * np.linalg.inv(means.T @ means)
    widened = np.sqrt(np.maximum(_sandwich(means, residual) / np.diag(covariance), 1.0))
    return _Solution(
        values=solution,
        covariance=np.asarray(widened[:, None] * covariance * widened, dtype=np.float64),
        rms=float(np.sqrt(np.mean(residual**2))),
        condition=condition,
    )


def _sandwich(rows: FloatArray, residual: FloatArray) -> FloatArray:
    """Return the variances that hold when poses scatter unlike each other (HC3 of MacKinnon and White, by pose).

    An orientation that is off turns the weight, so it scatters across gravity and never along it.
    """
    inverse = np.linalg.inv(rows.T @ rows)
    meat = np.zeros_like(inverse)
    for block, misfit in zip(rows.reshape(-1, 3, rows.shape[1]), residual.reshape(-1, 3), strict=True):
        left = np.eye(3) - block @ inverse @ block.T
        # A pose that alone determines a parameter has no misfit of its own.
        score = block.T @ np.linalg.pinv(left, rcond=1e-6) @ misfit
        meat += np.outer(score, score)
    return np.asarray(np.diag(inverse @ meat @ inverse))


def _misled(terms: tuple[ResidualTerm, ...], size: int) -> FloatArray:
    """Return what has to be added to the covariance (size, size) of mass and bias for what the misfit follows."""
    added = np.zeros(size)
    for term in terms:
        if term.is_significant:
            added[0] += term.mass_shift_kg**2
            added[1:4] += term.bias_shift_n**2
    return np.diag(added)


def _joint_covariance(mass: float, com: FloatArray, force: FloatArray, torque: FloatArray) -> FloatArray:
    """Return the covariance of (m, c, b_f, b_τ) from those of (m, b_f) and (m c, b_τ).

    Local gravity scales m and m c alike: it is added to the mass and cancels in c. What the payload tilts in its
    coupling under its own weight moves c towards the hanging, by a share of its lever that no rest shows.
    """
    solved = np.zeros((10, 10))
    solved[np.ix_([0, 4, 5, 6], [0, 4, 5, 6])] = force[:4, :4]
    solved[np.ix_([1, 2, 3, 7, 8, 9], [1, 2, 3, 7, 8, 9])] = torque[:6, :6]
    if not np.all(np.isfinite(solved)):
        solved[~np.isfinite(solved)] = 0.0
        solved[1:4, 1:4] = solved[7:10, 7:10] = np.diag(np.full(3, np.inf))
        solved[0, 0] += (LOCAL_GRAVITY_STD * mass) ** 2
        return solved
    jacobian = np.eye(10)
    jacobian[1:4, 0] = -com / mass
    jacobian[1:4, 1:4] = np.eye(3) / mass
    covariance = jacobian @ solved @ jacobian.T
    covariance[0, 0] += (LOCAL_GRAVITY_STD * mass) ** 2
    covariance[1:4, 1:4] += COM_TILT_STD_RAD**2 * np.outer(com, com)
    return np.asarray(0.5 * (covariance + covariance.T))


def _check_mass(condition: float, mass_kg: float, std_kg: float) -> None:
    if condition > _LARGEST_CONDITION:
        raise FewPosesError(
            f"The poses are too alike to separate weight from sensor bias (condition number {condition:.0f}, at most "
            f"{_LARGEST_CONDITION:.0f}); record poses tilted by 30 to 70 degrees about two axes."
        )
    if abs(mass_kg) < _SMALLEST_MASS_KG or abs(mass_kg) < _SIGNIFICANT_MASS * std_kg:
        raise EstimateError(
            f"At rest the force hardly changes with the tool's orientation (it would be {mass_kg:.3f} ± {std_kg:.3f} "
            f"kg): gravity seems to have been taken off before recording; {SAY_COMPENSATED}, or record the raw wrench. "
            "Check the unit of the force too, if it is not the newton."
        )
    if mass_kg <= 0.0:
        raise EstimateError(
            f"The payload mass comes out as {mass_kg:.3f} kg; the sensor shows the opposite sign or the pose is not "
            "base from flange. Check the sign and the frame of the wrench."
        )


def _maybe_compensated(poses: tuple[StaticPose, ...]) -> str:
    """Return the hint that gravity may have been taken off, where at rest there is hardly a force."""
    smallest = min(float(np.linalg.norm(pose.force_S_n)) for pose in poses)
    if smallest > SMALL_SWING_N:
        return ""
    return (
        f" At rest the force is as small as {smallest:.2f} N: if gravity was taken off before recording, "
        f"{SAY_COMPENSATED}; motion and contacts can be read without it."
    )


def _check_com(com_m: FloatArray, std_m: FloatArray, mass_kg: float, mass_std_kg: float) -> None:
    away, vague = float(np.linalg.norm(com_m)), float(np.linalg.norm(std_m))
    if away > _FARTHEST_COM_M:
        raise EstimateError(
            f"The centre of mass comes out {away:.2f} m (± {vague:.2f} m) from the sensor for {mass_kg:.3f} ± "
            f"{mass_std_kg:.3f} kg, which no payload of this kind has; check the force and torque units and the sensor "
            "frame."
        )


def orientation_spread_rad(orientation: Rotation) -> float:
    """Return the largest turn away from the mean orientation."""
    return float(np.max(turned_rad(orientation.mean().as_quat(), orientation.as_quat())))
