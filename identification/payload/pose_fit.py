"""Robust regression over poses at rest, a tare between them, and what the residual follows."""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from scipy.special import fdtrc, stdtrit

from problems.arrays import BoolArray, FloatArray, IntArray

from .static_poses import (
    OUTLIER_DEVIATIONS,
    SMALLEST_SCATTER_N,
    SMALLEST_SCATTER_N_M,
    StaticPose,
    cross_matrix,
    group_means,
    group_shares,
    weighted_median,
)

_ROUNDS = 50
_REFITS = 10
_FEWEST_BESIDE_STEP = 3
_NOISY = 4.0
_OFF = 10.0
_EXPLAINED = 0.4
_SMALLEST_STEP_N = 0.5
_SIGNIFICANCE = 1e-3
_FEWEST_SPARE = 4


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

    Three more columns hold the bias that the `early` poses have on top. A torque that was not measured (NaN) says
    nothing: its equations are 0 = 0.
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
        torque = np.array([pose.torque_S_n_m for pose in poses])
        known = np.isfinite(torque)[:, :, None]
        return cls(
            force_rows=np.concatenate([gravity[:, :, None], bias, *more], axis=2),
            force_n=np.array([pose.force_S_n for pose in poses]),
            torque_rows=known * np.concatenate([-cross_matrix(gravity), bias, *more], axis=2),
            torque_n_m=np.nan_to_num(torque),
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
        pull = _misfit(force, equations.force_n, shares, SMALLEST_SCATTER_N)
        twist = _misfit(torque, equations.torque_n_m, shares, SMALLEST_SCATTER_N_M)
        scatter = max(1.4826 * weighted_median(pull[keep], shares[keep]), SMALLEST_SCATTER_N)
        turning = max(1.4826 * weighted_median(twist[keep], shares[keep]), SMALLEST_SCATTER_N_M)
        first = pull if first is None else first
        following = (pull < OUTLIER_DEVIATIONS * scatter) & (twist < OUTLIER_DEVIATIONS * turning)
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
    if bool(np.all(single.keep)) and single.scatter_n < _NOISY * max(noise, SMALLEST_SCATTER_N):
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


class TermKind(StrEnum):
    """What a term adds to f = m g + b; each value names the quantity that the misfit follows."""

    DRIFT = "time"
    AXIS_GAIN = "the axis that carries the load"
    LOAD_CURVE = "the square of the load"


@dataclass(frozen=True, kw_only=True)
class ResidualTerm:
    """One extension of f = m g + b, fitted beside it, per axis of S (3,).

    `coefficient` is the drift d [N/s] of b + d t, the masses [kg] that each axis shows of its own, or q [1/N] of
    w + q w|w| for the load w. `effect_n` is the largest force that it makes over the rests; `p_value` is that of the
    F test against the plain model. `mass_shift_kg` and `bias_shift_n` (3,) show by how much the plain model is misled.
    """

    kind: TermKind
    coefficient: FloatArray
    coefficient_std: FloatArray
    effect_n: FloatArray
    rms_before_n: float
    rms_after_n: float
    p_value: float
    mass_shift_kg: float
    bias_shift_n: FloatArray

    @property
    def is_significant(self) -> bool:
        """Whether chance alone would explain as much in less than one of a thousand cases."""
        return self.p_value < _SIGNIFICANCE


@dataclass(frozen=True, kw_only=True)
class _Rests:
    """What the terms are fitted to: gravity, force without a bias step (n, 3), time (n,), variance of a mean."""

    gravity: FloatArray
    force: FloatArray
    time: FloatArray
    floor: float


def find_terms(poses: Sequence[StaticPose], force_n: FloatArray, groups: IntArray) -> tuple[ResidualTerm, ...]:
    """Fit each extension to the rests that fit, as far as there are enough of them.

    `force_n` (n, 3) is their force with a bias step taken out. The load is compared between orientations, each of
    them once; time between all rests.
    """
    gravity = np.array([pose.gravity_S_m_s2 for pose in poses])
    time = np.array([pose.time_s for pose in poses])
    floor = float(np.median([pose.force_mean_std_n**2 for pose in poses]))
    rests = _Rests(gravity=gravity, force=force_n, time=time, floor=floor)
    grouped = _Rests(
        gravity=group_means(gravity, groups),
        force=group_means(force_n, groups),
        time=group_means(time[:, None], groups)[:, 0],
        floor=floor,
    )
    found = (_drift(rests), _axis_gain(grouped), _load_curve(grouped))
    return tuple(term for term in found if term is not None)


@dataclass(frozen=True, kw_only=True)
class _Pair:
    """The plain and the extended model: parameters, covariance, misfits, and the p-value of the extension."""

    plain: FloatArray
    extended: FloatArray
    std: FloatArray
    before: float
    after: float
    p_value: float


def _compare(rests: _Rests, extended: FloatArray, extra: int) -> _Pair | None:
    """Fit f = m g + b and a model with `extended` rows (n, 3, p), which has `extra` parameters more."""
    count = len(rests.force)
    plain = np.concatenate([rests.gravity[:, :, None], np.broadcast_to(np.eye(3), (count, 3, 3))], axis=2)
    values = rests.force.reshape(-1)
    freedom = len(values) - 4 - extra
    rows = extended.reshape(len(values), -1)
    scale = np.linalg.norm(rows, axis=0)
    if freedom < _FEWEST_SPARE or not np.all(scale > 0.0) or np.linalg.cond(rows / scale) > 1e6:
        return None
    first = np.linalg.lstsq(plain.reshape(len(values), 4), values, rcond=None)[0]
    second = np.linalg.lstsq(rows / scale, values, rcond=None)[0] / scale
    before = float(np.sum((values - plain.reshape(len(values), 4) @ first) ** 2))
    after = float(np.sum((values - rows @ second) ** 2))
    variance = max(after / freedom, rests.floor, 1e-18)
    inverse = np.linalg.inv((rows / scale).T @ (rows / scale))
    return _Pair(
        plain=np.asarray(first),
        extended=np.asarray(second),
        std=np.asarray(np.sqrt(variance * np.diag(inverse)) / scale),
        before=float(np.sqrt(before / len(values))),
        after=float(np.sqrt(after / len(values))),
        p_value=float(fdtrc(extra, freedom, max(0.0, before - after) / extra / variance)),
    )


def _diagonal(columns: FloatArray) -> FloatArray:
    """Return rows (n, 3, 3) with (n, 3) on their diagonals: each axis has a parameter of its own."""
    return np.asarray(columns[:, :, None] * np.eye(3))


def _plain_rows(rests: _Rests) -> FloatArray:
    bias = np.broadcast_to(np.eye(3), (len(rests.force), 3, 3))
    return np.concatenate([rests.gravity[:, :, None], bias], axis=2)


def _drift(rests: _Rests) -> ResidualTerm | None:
    past = rests.time - rests.time.mean()
    if not np.all(np.isfinite(past)):
        return None
    extension = _diagonal(np.repeat(past[:, None], 3, axis=1))
    pair = _compare(rests, np.concatenate([_plain_rows(rests), extension], axis=2), 3)
    if pair is None:
        return None
    effect = np.abs(pair.extended[4:]) * np.ptp(past)
    return _term(TermKind.DRIFT, pair, slice(4, 7), effect, pair.extended[0] - pair.plain[0], 0.5 * effect)


def _axis_gain(rests: _Rests) -> ResidualTerm | None:
    bias = np.broadcast_to(np.eye(3), (len(rests.force), 3, 3))
    pair = _compare(rests, np.concatenate([_diagonal(rests.gravity), bias], axis=2), 2)
    if pair is None:
        return None
    masses = pair.extended[:3]
    effect = np.abs(masses - pair.plain[0]) * np.max(np.abs(rests.gravity), axis=0)
    # How far the axes lie apart shows how far their mean may be off; three of them show it as Student's law says.
    spread = float(np.std(masses, ddof=1)) / np.sqrt(3.0) * float(stdtrit(2, 0.975) / 1.96)
    return _term(TermKind.AXIS_GAIN, pair, slice(0, 3), effect, spread, pair.extended[3:] - pair.plain[1:])


def _load_curve(rests: _Rests) -> ResidualTerm | None:
    first = np.linalg.lstsq(_plain_rows(rests).reshape(-1, 4), rests.force.reshape(-1), rcond=None)[0]
    load = first[0] * rests.gravity
    extension = _diagonal(load * np.abs(load))
    pair = _compare(rests, np.concatenate([_plain_rows(rests), extension], axis=2), 3)
    if pair is None:
        return None
    effect = np.abs(pair.extended[4:]) * np.max(load**2, axis=0)
    shift = pair.extended[:4] - pair.plain
    return _term(TermKind.LOAD_CURVE, pair, slice(4, 7), effect, float(shift[0]), shift[1:])


def _term(
    kind: TermKind, pair: _Pair, part: slice, effect: FloatArray, mass_shift: float, bias_shift: FloatArray
) -> ResidualTerm:
    return ResidualTerm(
        kind=kind,
        coefficient=pair.extended[part],
        coefficient_std=pair.std[part],
        effect_n=np.asarray(effect),
        rms_before_n=pair.before,
        rms_after_n=pair.after,
        p_value=pair.p_value,
        mass_shift_kg=abs(float(mass_shift)),
        bias_shift_n=np.abs(bias_shift),
    )
