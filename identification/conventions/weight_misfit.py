"""Misfit of the payload's weight under every convention hypothesis, and the direction of gravity that fits best."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from problems.arrays import BoolArray, FloatArray, IntArray

from ..payload.static_poses import (
    GRAVITY_B_M_S2,
    OUTLIER_DEVIATIONS,
    SMALLEST_SCATTER_N,
    SMALLEST_SCATTER_N_M,
    StaticPose,
    cross_matrix,
    group_means,
    group_shares,
    weighted_median,
)
from ..signals.recording import Frames

_Fit = Callable[[FloatArray, FloatArray, FloatArray], FloatArray]
QUARTER_TURNS = Rotation.create_group("O")
"""The 24 turns that take axes to axes."""
_ROUNDS = 40
_ALIKE = 1.5
_DIRECTION_ROUNDS = 30
_SMALLEST_N = 1e-3
_LARGEST_CONDITION = 100.0


@dataclass(frozen=True, kw_only=True)
class ConventionHypothesis:
    """How the logged orientation's numbers are taken, and by which quarter turn the sensor's axes are turned."""

    order: str
    inverted: bool
    turn: int

    @property
    def quarter_turn(self) -> Rotation:
        """The turn of the sensor's real axes as seen from the declared ones."""
        return QUARTER_TURNS[self.turn]

    @property
    def is_turned(self) -> bool:
        """Whether that is a turn at all."""
        return bool(self.quarter_turn.magnitude() > 0.1)

    def orientation(self, logged: Rotation, frames: Frames) -> Rotation:
        """Return base from sensor as this reads what was declared to be it."""
        flange = frames.R_WB.inv() * logged * frames.R_FS.inv()
        if self.order == "wxyz":
            flange = Rotation.from_quat(np.atleast_2d(flange.as_quat())[:, [1, 2, 3, 0]])
        if self.inverted:
            flange = flange.inv()
        return frames.R_WB * flange * frames.R_FS * self.quarter_turn


HYPOTHESES = tuple(
    ConventionHypothesis(order=order, inverted=inverted, turn=turn)
    for order in ("xyzw", "wxyz")
    for inverted in (False, True)
    for turn in range(len(QUARTER_TURNS))
)


@dataclass(frozen=True, kw_only=True)
class FreeMounting:
    """The turn of the sensor's axes, as seen from the declared ones, under which the force fits best of all turns.

    `hypothesis` says how the orientation's numbers are taken, `sign` is that of the force, `force_n2` what is left.
    """

    hypothesis: ConventionHypothesis
    sign: float
    turn: Rotation
    force_n2: float

    @property
    def is_as_declared(self) -> bool:
        """Whether nothing but the turn differs from what is declared."""
        return self.sign > 0.0 and not self.hypothesis.inverted and self.hypothesis.order == "xyzw"

    @property
    def angle_rad(self) -> float:
        """The angle to the nearest quarter turn."""
        return float(np.min((QUARTER_TURNS.inv() * self.turn).magnitude()))


@dataclass(frozen=True, kw_only=True)
class Scores:
    """Per hypothesis (r,): signed mass, sums of squares of force and torque over the orientations without outliers.

    `orientations` of them there are; `swing_n2` is the sum of squares of the force about its mean, `force_floor_n2` and
    `torque_floor_n2_m2` the variances of one mean that noise leaves.
    """

    mass_kg: FloatArray
    force_n2: FloatArray
    torque_n2_m2: FloatArray
    orientations: int
    swing_n2: float
    force_floor_n2: float
    torque_floor_n2_m2: float
    free_mounting: FreeMounting

    def log_likelihood_short(self) -> FloatArray:
        """Return by how much each hypothesis's log likelihood is short of the best one's, the noise's size left open.

        The noise is at least what the sensor shows within the rests, so that hypotheses within it are alike.
        """
        force, torque = 3 * self.orientations - 4, 3 * self.orientations - 6
        force_sum = np.maximum(self.force_n2, force * self.force_floor_n2)
        torque_sum = np.maximum(self.torque_n2_m2, torque * self.torque_floor_n2_m2)
        cost = 0.5 * force * np.log(force_sum) + 0.5 * torque * np.log(torque_sum)
        return np.asarray(cost - np.min(cost))

    def ratio(self, hypothesis: int, best: int) -> float:
        """Return the larger of the rms ratios of force and torque between two hypotheses, no rms below the noise's."""
        count = 3.0 * self.orientations
        force = np.maximum(self.force_n2, count * self.force_floor_n2)
        torque = np.maximum(self.torque_n2_m2, count * self.torque_floor_n2_m2)
        return float(np.sqrt(max(force[hypothesis] / force[best], torque[hypothesis] / torque[best])))


def score_hypotheses(poses: Sequence[StaticPose], groups: IntArray, frames: Frames) -> Scores:
    """Fit f = m g_S + b_f and τ = h × g_S + b_τ under every hypothesis, the mass of either sign.

    The hypotheses are compared over the rests that fit the one of least absolute misfit, each orientation once.
    """
    logged = Rotation.from_quat([pose.quaternion_xyzw for pose in poses])
    gravity = np.array(
        [hypothesis.orientation(logged, frames).inv().apply(GRAVITY_B_M_S2) for hypothesis in HYPOTHESES]
    )
    force = np.array([pose.force_S_n for pose in poses])
    # A torque that was not measured is alike under every hypothesis.
    torque = np.nan_to_num(np.array([pose.torque_S_n_m for pose in poses]))
    keep = _inliers(gravity, force, torque, group_shares(groups))
    groups = groups[keep]
    means = np.array([group_means(each[keep], groups) for each in gravity])
    force, torque = group_means(force[keep], groups), group_means(torque[keep], groups)
    even = np.ones((len(HYPOTHESES), len(force)))
    force_left, torque_left = _force_misfit(means, force, even), _torque_misfit(means, torque, even)
    return Scores(
        mass_kg=_mass(*_centred(means, force, even), even),
        force_n2=np.sum(force_left**2, axis=(1, 2)),
        torque_n2_m2=np.sum(torque_left**2, axis=(1, 2)),
        orientations=len(force),
        swing_n2=float(np.sum((force - force.mean(axis=0)) ** 2)),
        force_floor_n2=max(float(np.median([p.force_mean_std_n for p in poses])) ** 2, 1e-12),
        torque_floor_n2_m2=max(float(np.median([p.torque_mean_std_n_m for p in poses])) ** 2, 1e-14),
        free_mounting=_mount_freely(means, force),
    )


def _inliers(gravity: FloatArray, force: FloatArray, torque: FloatArray, shares: FloatArray) -> BoolArray:
    """Return which rests (n,) fit the hypothesis whose force misfits least in sum."""
    misfits = _least_absolute(gravity, force, shares, SMALLEST_SCATTER_N, fit=_force_misfit)
    best = int(np.argmin(np.sum(shares * misfits, axis=1)))
    twist = _least_absolute(gravity[best : best + 1], torque, shares, SMALLEST_SCATTER_N_M, fit=_torque_misfit)
    keep = np.ones(len(force), dtype=bool)
    for misfit, floor in ((misfits[best], SMALLEST_SCATTER_N), (twist[0], SMALLEST_SCATTER_N_M)):
        scatter = max(1.4826 * weighted_median(misfit, shares), floor)
        keep &= misfit < OUTLIER_DEVIATIONS * scatter
    return keep


def _least_absolute(
    gravity: FloatArray, values: FloatArray, shares: FloatArray, floor: float, *, fit: _Fit
) -> FloatArray:
    """Return the misfits (r, n) about L1 fits by reweighting."""
    weights = np.broadcast_to(shares, gravity.shape[:2])
    misfit = np.zeros(gravity.shape[:2])
    for _ in range(_ROUNDS):
        misfit = np.linalg.norm(fit(gravity, values, weights), axis=2)
        weights = shares / np.maximum(misfit, floor)
    return misfit


def _centred(gravity: FloatArray, values: FloatArray, weights: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Take the weighted means off gravity (r, n, 3) and values (n, 3): the bias is solved for so."""
    share = (weights / np.sum(weights, axis=1, keepdims=True))[:, :, None]
    centre = np.sum(share * gravity, axis=1, keepdims=True)
    return gravity - centre, values - np.sum(share * values, axis=1, keepdims=True)


def _mass(gravity: FloatArray, force: FloatArray, weights: FloatArray) -> FloatArray:
    """Return m (r,) of f = m g for centred gravity and force (r, n, 3)."""
    swing = np.sum(weights * np.sum(gravity**2, axis=2), axis=1)
    return np.asarray(np.sum(weights * np.sum(gravity * force, axis=2), axis=1) / np.maximum(swing, 1e-12))


def _force_misfit(gravity: FloatArray, values: FloatArray, weights: FloatArray) -> FloatArray:
    """Return f − m g − b (r, n, 3)."""
    swing, force = _centred(gravity, values, weights)
    return np.asarray(force - _mass(swing, force, weights)[:, None, None] * swing)


def _torque_misfit(gravity: FloatArray, values: FloatArray, weights: FloatArray) -> FloatArray:
    """Return τ − h × g − b (r, n, 3), h the first moment."""
    swing, torque = _centred(gravity, values, weights)
    rows = -cross_matrix(swing)
    normal = np.einsum("rn,rnji,rnjk->rik", weights, rows, rows)
    right = np.einsum("rn,rnji,rnj->ri", weights, rows, torque)
    # Rests about one axis leave a component of h open; the least one serves.
    moment = np.einsum("rik,rk->ri", np.linalg.pinv(normal, rcond=1e-9, hermitian=True), right)
    return np.asarray(torque - np.einsum("rnij,rj->rni", rows, moment))


def _mount_freely(gravity: FloatArray, force: FloatArray) -> FreeMounting:
    """Solve f = ±m Qᵀ g + b for the turn Q by the singular values of Σ f gᵀ (Kabsch 1976, Wahba's problem).

    Of hypotheses that leave alike little the declared one is returned.
    """
    centred = force - force.mean(axis=0)
    found = []
    for hypothesis, each in zip(HYPOTHESES, gravity, strict=True):
        if hypothesis.is_turned:
            continue
        swing = each - each.mean(axis=0)
        for sign in (1.0, -1.0):
            left, size, right = np.linalg.svd(sign * centred.T @ swing)
            handed = np.array([1.0, 1.0, np.linalg.det(left @ right)])
            mass = float(np.sum(size * handed)) / max(float(np.sum(swing**2)), 1e-12)
            turned = left @ np.diag(handed) @ right
            misfit = float(np.sum((centred - sign * mass * swing @ turned.T) ** 2))
            turn = Rotation.from_matrix(turned.T)
            found.append(FreeMounting(hypothesis=hypothesis, sign=sign, turn=turn, force_n2=misfit))
    best = min(found, key=lambda each: each.force_n2)
    declared = next(each for each in found if each.is_as_declared)
    return declared if declared.force_n2 < _ALIKE * best.force_n2 else best


@dataclass(frozen=True, kw_only=True)
class GravityDirection:
    """The direction (3,) of gravity in the frame of the poses, its angle to the declared one, and what it leaves."""

    direction_W: FloatArray
    angle_rad: float
    left_n: float


def find_gravity_direction(poses: Sequence[StaticPose]) -> GravityDirection | None:
    """Solve f = R_WSᵀ w + b for the weight w in W and the bias b, by least absolute deviations.

    Rests in contact weigh little that way; `left_n` is what the middle rest leaves. None where the orientations do not
    distinguish weight and bias.
    """
    to_sensor = Rotation.from_quat(np.array([pose.quaternion_xyzw for pose in poses])).inv().as_matrix()
    rows = np.concatenate([to_sensor, np.broadcast_to(np.eye(3), to_sensor.shape)], axis=2)
    force = np.array([pose.force_S_n for pose in poses])
    if np.linalg.cond(rows.reshape(-1, 6)) > _LARGEST_CONDITION:
        return None
    root, found, left = np.ones(len(poses)), np.zeros(6), np.zeros(len(poses))
    for _ in range(_DIRECTION_ROUNDS):
        weighted = root[:, None, None] * rows
        found = np.linalg.lstsq(weighted.reshape(-1, 6), (root[:, None] * force).reshape(-1), rcond=None)[0]
        left = np.linalg.norm(force - rows @ found, axis=1)
        root = 1.0 / np.sqrt(np.maximum(left, _SMALLEST_N))
    size = float(np.linalg.norm(found[:3]))
    if size <= 0.0:
        return None
    direction = found[:3] / size
    down = GRAVITY_B_M_S2 / np.linalg.norm(GRAVITY_B_M_S2)
    angle = float(np.arctan2(np.linalg.norm(np.cross(direction, down)), direction @ down))
    return GravityDirection(direction_W=direction, angle_rad=angle, left_n=float(np.median(left)))
