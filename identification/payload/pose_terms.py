"""What the misfit of the rests follows: time, the load on each axis, or its square."""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray
from scipy.special import fdtrc, stdtrit

from .static_poses import StaticPose, group_means

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

_SIGNIFICANCE = 1e-3
_FEWEST_SPARE = 4


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
    F test against the plain model. `mass_shift_kg` and `bias_shift_n` (3,) tell by how much the plain model is misled.
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
    # How far the axes lie apart tells how far their mean may be off; three of them tell it as Student's law says.
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
