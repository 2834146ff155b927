"""Fit the offset between the clocks of wrench and pose to the weight of the payload in the turning sensor frame."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import BSpline, make_interp_spline

from problems.arrays import FloatArray, IntArray

from ...payload.static_poses import GRAVITY_B_M_S2
from ...signals.aligned import AlignedLog
from ...signals.recording import turn_vectors_rad
from ...signals.segments import low_pass

_BAND_HZ = 8.0
_GRID_HZ = 240.0
_SMOOTH_HZ = 40.0
_TURNING_RAD_S = 0.03
_PAUSE_S = 0.15
_EDGE_S = 0.1
_SMALLEST_TURN_RAD = np.radians(4.0)
_FEWEST_TURNS = 3
_COLUMNS, _LAGS = 24, 3
_COARSE_STEP_S = 8e-3
_COARSE_EVERY = 6
_RIDGE = 1e-10
_ROUNDS = 8
_PIECE = 1024
_OUTLIER_FACTOR = 5.0
_SMALLEST_SCATTER_N = 0.03
_POOR_FIT = 0.15
# A payload on a damped mount lags by B/K·(ω/ω_n)²; so does one damped by 10 % with its resonance at 10 Hz.
_MOUNT_LAG_S3 = 2.0 * 0.1 / (2.0 * np.pi * 10.0) ** 3
_METHOD = "weight in the turning sensor frame"
_ADVICE = "Tilt the tool to 6 or more orientations, 30 to 70 degrees apart, in about a second each, hands off."


@dataclass(frozen=True, kw_only=True)
class OffsetEstimate:
    """The wrench's clock is ahead of the pose's by `offset_s` ± `std_s` (one deviation); `spans` of motion say so."""

    offset_s: float
    std_s: float
    spans: int
    method: str


@dataclass(frozen=True, kw_only=True)
class NoEstimate:
    """Why one kind of motion says nothing, and what to record instead."""

    reason: str
    advice: str


@dataclass(frozen=True, kw_only=True)
class _Turning:
    """What the fit needs: force (n, 3) at `time_s` (n,) within turn `turn` (n,), and the filtered `signals` of t.

    They are g − a (3), α× + ω×ω× (9), v (3) and ω (3), of which Φ is made, and the base's axes in S (9); a ramp over
    the log has slope `ramp`.
    """

    signals: BSpline
    ramp: float
    time_s: FloatArray
    force_n: FloatArray
    turn: IntArray

    def part(self, keep: NDArray[np.bool_] | slice) -> "_Turning":
        return replace(self, time_s=self.time_s[keep], force_n=self.force_n[keep], turn=self.turn[keep])

    def rows(self, offset_s: float, derivative: int = 0) -> FloatArray:
        """Return Φ(t − T) or its time derivative, (3n, 24)."""
        at = self.time_s - offset_s
        ramp = (self.ramp * at - 1.0, np.full(len(at), self.ramp), np.zeros(len(at)))[derivative]
        return _columns(np.asarray(self.signals(at, derivative)), float(derivative == 0), ramp).reshape(-1, _COLUMNS)

    def pieces(self) -> Iterator["_Turning"]:
        """Yield a part after the other: all rows of a minute at once would be more than the log itself."""
        for first in range(0, len(self.time_s), _PIECE):
            yield self.part(slice(first, first + _PIECE))

    def solve(self, offset_s: float) -> FloatArray:
        """Return θ at a fixed offset."""
        return _least_squares(np.column_stack([piece.rows(offset_s), piece.force_n.ravel()]) for piece in self.pieces())

    def residual(self, offset_s: float, found: FloatArray) -> FloatArray:
        """Return what (θ, 0, lags) leave of the force at an offset, (n, 3)."""
        theta = found[:_COLUMNS]
        fitted = [(piece.joint(offset_s, theta) @ found).reshape(-1, 3) for piece in self.pieces()]
        return np.asarray(self.force_n - np.concatenate(fitted))

    def joint(self, offset_s: float, theta: FloatArray) -> FloatArray:
        """Return the derivatives of the force by θ, T and the lag along each axis of the base, (3n, 28)."""
        rows, slope = self.rows(offset_s), self.rows(offset_s, 1) @ theta
        own = np.concatenate([np.zeros(6), theta[6:18], np.zeros(6)])  # what the payload does to the force
        signals = np.asarray(self.signals(self.time_s - offset_s))
        rate, axes = signals[:, 15:18], signals[:, 18:].reshape(-1, 3, 3)
        changes = np.cross(rate, (rows @ own).reshape(-1, 3)) + (self.rows(offset_s, 1) @ own).reshape(-1, 3)
        lagging = -axes * np.einsum("nik,ni->nk", axes, changes)[:, None, :]
        return np.column_stack([rows, -slope, lagging.reshape(-1, _LAGS)])


def offset_from_turning(log: AlignedLog, longest_s: float) -> OffsetEstimate | NoEstimate:
    """Fit f(t) = Φ(t − T) θ where the tool turns; T is the offset, θ what a payload may be.

    Φ θ = b + ḃ t + G (g_S − a_S) − α × mc − ω × (ω × mc) − D v_S − ω × d: bias with its drift, weight and inertia of
    the payload (G is m times what the sensor's gains, cross-talk and mounting make of it), drag per axis and drag of
    turning (it looks like a delay where gravity keeps its direction in the sensor frame, so it is estimated with it).
    Where drag to the ground holds the payload and the coupling gives, F lags along each axis of the base, F +
    (B_p/K_s) dF/dt being what a stiff coupling would show. There the weight does not change but the inertia's force
    does, which looks like a delay of all; the three B_p/K_s are estimated beside T. All signals go through one
    zero-phase low-pass. Turns that do not fit (contact, hand) are left out; the standard deviation comes from the
    scatter between turns, and is never below what a mount's damping hides.
    """
    prepared = _prepare(log, longest_s)
    if prepared is None or len(np.unique(prepared.turn)) < _FEWEST_TURNS:
        return NoEstimate(
            reason=f"the tool turns fewer than {_FEWEST_TURNS} times by {np.degrees(_SMALLEST_TURN_RAD):.0f} degrees",
            advice=_ADVICE,
        )
    offset = _coarse(prepared, longest_s)
    kept = prepared
    for _ in range(_ROUNDS):
        offset, found = _refined(kept, offset)
        following = prepared.part(_fitting(prepared, offset, found))
        if len(following.time_s) == len(kept.time_s):
            break
        kept = following
    return _judged(prepared, kept, offset, longest_s)


def _judged(prepared: _Turning, kept: _Turning, offset: float, longest_s: float) -> OffsetEstimate | NoEstimate:
    used, turns = len(np.unique(kept.turn)), len(np.unique(prepared.turn))
    if used < max(_FEWEST_TURNS, 0.5 * turns):
        return NoEstimate(
            reason=f"the force follows the weight of one payload in {used} of {turns} turns", advice=_ADVICE
        )
    if abs(offset) > 0.95 * longest_s:
        return NoEstimate(reason=f"no offset within {longest_s:.2f} s explains the force while turning", advice=_ADVICE)
    found = _fitted(kept, offset, kept.solve(offset))
    residual = kept.residual(offset, found)
    swing = kept.force_n - kept.force_n.mean(axis=0)
    share = float(np.linalg.norm(residual)) / max(float(np.linalg.norm(swing)), 1e-12)
    if share > _POOR_FIT:
        return NoEstimate(
            reason=f"{100 * share:.0f} % of the force while turning is no payload's weight", advice=_ADVICE
        )
    std = _standard_deviation(kept, offset, found[:_COLUMNS], residual)
    return OffsetEstimate(
        offset_s=offset, std_s=float(np.hypot(std, _mount_lag(kept, offset))), spans=used, method=_METHOD
    )


def _prepare(log: AlignedLog, longest_s: float) -> _Turning | None:
    """Bring everything on a coarser grid behind one low-pass, and pick the turns."""
    step = max(1, round(1.0 / (_GRID_HZ * log.period_s)))
    period = step * log.period_s

    def smooth(values: FloatArray) -> FloatArray:
        return np.ascontiguousarray(low_pass(values, log.period_s, _SMOOTH_HZ)[::step])

    turned = log.orientation_BS.inv()
    gravity, position = smooth(np.asarray(turned.apply(GRAVITY_B_M_S2))), smooth(log.position_B_m)
    rate = smooth(_body_rate(log))
    velocity_B = np.gradient(position, period, axis=0)
    coarse = turned[::step]
    velocity = np.asarray(coarse.apply(velocity_B))
    acceleration = np.asarray(coarse.apply(np.gradient(velocity_B, period, axis=0)))
    spin = _cross(rate)
    turning = (_cross(np.gradient(rate, period, axis=0)) + spin @ spin).reshape(-1, 9)
    signals = np.concatenate(
        [gravity - acceleration, turning, velocity, rate, coarse.as_matrix().reshape(-1, 9)], axis=1
    )
    time, turn = log.time_s[::step], _number_turns(rate, period)
    edge = longest_s + 3.0 / _BAND_HZ
    inside = (turn >= 0) & (time > time[0] + edge) & (time < time[-1] - edge)
    if not np.any(inside):
        return None
    return _Turning(
        signals=make_interp_spline(time, low_pass(signals, period, _BAND_HZ), k=3),
        ramp=2.0 / float(time[-1]),
        time_s=time[inside],
        force_n=low_pass(smooth(log.force_S_n), period, _BAND_HZ)[inside],
        turn=turn[inside],
    )


def _body_rate(log: AlignedLog) -> FloatArray:
    """Return ω in S [rad/s], (n, 3), by central differences."""
    quaternion = log.orientation_BS.as_quat()
    inner = turn_vectors_rad(quaternion[:-2], quaternion[2:]) / (2.0 * log.period_s)
    return np.concatenate([inner[:1], inner, inner[-1:]])


def _columns(signals: FloatArray, one: float, ramp: FloatArray) -> FloatArray:
    """Return Φ (n, 3, 24) for b (3), ḃ (3, per length of the log), G (9), mc (3), D (3), d (3)."""
    count, axes = len(signals), np.arange(3)
    out = np.zeros((count, 3, _COLUMNS))
    out[:, axes, axes] = one
    out[:, axes, 3 + axes] = ramp[:, None]
    for i in range(3):
        out[:, i, 6 + 3 * i : 9 + 3 * i] = signals[:, :3]
    out[:, :, 15:18] = -signals[:, 3:12].reshape(-1, 3, 3)
    out[:, axes, 18 + axes] = -signals[:, 12:15]
    out[:, :, 21:] = -_cross(signals[:, 15:18])
    return out


def _cross(vectors: FloatArray) -> FloatArray:
    """Return the matrices of `vectors` × (.), (n, 3, 3)."""
    x, y, z = vectors.T
    zero = np.zeros(len(vectors))
    return np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=1).reshape(-1, 3, 3)


def _number_turns(rate: FloatArray, period: float) -> IntArray:
    """Return for each sample which turn it belongs to, with a little of the rest around it, or −1."""
    speed = np.linalg.norm(low_pass(rate, period, _BAND_HZ), axis=1)
    padded = np.concatenate([[False], speed > _TURNING_RAD_S, [False]])
    starts, stops = np.flatnonzero(~padded[:-1] & padded[1:]), np.flatnonzero(padded[:-1] & ~padded[1:])
    number = np.full(len(speed), -1)
    if not starts.size:
        return number
    apart = (starts[1:] - stops[:-1]) * period > _PAUSE_S
    firsts, lasts = starts[np.concatenate([[True], apart])], stops[np.concatenate([apart, [True]])]
    edge, count = round(_EDGE_S / period), 0
    for first, last in zip(firsts, lasts, strict=True):
        if np.sum(speed[first:last]) * period > _SMALLEST_TURN_RAD:
            span = slice(max(0, first - edge), last + edge)
            number[span] = count
            count += 1
    return number


def _least_squares(blocks: Iterable[FloatArray]) -> FloatArray:
    """Return the least squares solution, of least norm, of rows with their values behind them, given block by block.

    The triangle of all rows is that of the triangle so far and the next block; its singular values cost less than
    those of all.
    """
    triangle = np.empty((0, 0))
    for block in blocks:
        rows = np.concatenate([triangle, block]) if triangle.size else block
        triangle = np.asarray(np.linalg.qr(rows, mode="r"))
    return np.asarray(np.linalg.lstsq(triangle[:, :-1], triangle[:, -1], rcond=1e-10)[0])


def _coarse(turning: _Turning, longest_s: float) -> float:
    """Return the best offset on a grid, by normal equations: they need not be exact here."""
    some = turning.part(slice(None, None, _COARSE_EVERY))
    force = some.force_n.ravel()

    def explained(offset: float) -> float:
        rows = some.rows(offset)
        rows = rows / np.maximum(np.linalg.norm(rows, axis=0), 1e-12)
        projected = rows.T @ force
        return float(projected @ np.linalg.solve(rows.T @ rows + _RIDGE * np.eye(_COLUMNS), projected))

    grid = np.arange(-longest_s, longest_s + 1e-9, _COARSE_STEP_S).tolist()
    return float(max(grid, key=explained))


def _refined(turning: _Turning, offset: float) -> tuple[float, FloatArray]:
    """Return offset and (θ, 0, lags) by Gauss and Newton: Φ(t − T − dT) θ ≈ Φ θ − dT Φ' θ."""
    found = turning.solve(offset)
    for _ in range(10):
        found = _fitted(turning, offset, found[:_COLUMNS])
        change = float(np.clip(found[_COLUMNS], -_COARSE_STEP_S, _COARSE_STEP_S))
        offset += change
        found[_COLUMNS] = 0.0
        if abs(change) < 1e-7:
            break
    return offset, found


def _fitted(turning: _Turning, offset: float, theta: FloatArray) -> FloatArray:
    """Return θ, the change of T and the lags that explain the force best, about an offset and θ."""
    return _least_squares(
        np.column_stack([piece.joint(offset, theta), piece.force_n.ravel()]) for piece in turning.pieces()
    )


def _fitting(turning: _Turning, offset: float, found: FloatArray) -> NDArray[np.bool_]:
    """Return the samples of the turns that one payload explains."""
    residual = turning.residual(offset, found)
    count = int(turning.turn.max()) + 1
    energy = np.bincount(turning.turn, np.sum(residual**2, axis=1), count)
    size = np.bincount(turning.turn, minlength=count)
    rms = np.sqrt(energy / np.maximum(size, 1))
    limit = _OUTLIER_FACTOR * max(float(np.median(rms[size > 0])), _SMALLEST_SCATTER_N)
    return np.asarray(rms[turning.turn] < limit)


def _standard_deviation(turning: _Turning, offset: float, theta: FloatArray, residual: FloatArray) -> float:
    """Return the standard deviation of T, the larger of two: residuals correlated within each turn, or by the filter.

    The first sums what each turn adds to the estimate (few turns underestimate their own scatter, hence the factor);
    the second counts 2 B independent values per second in residuals of bandwidth B.
    """
    joints = [piece.joint(offset, theta) for piece in turning.pieces()]
    inverse = np.linalg.pinv(sum(joint.T @ joint for joint in joints), hermitian=True, rcond=1e-14)
    score = np.sum(np.concatenate([joint @ inverse[:, _COLUMNS] for joint in joints]).reshape(-1, 3) * residual, axis=1)
    sums = np.bincount(np.unique(turning.turn, return_inverse=True)[1], score)
    between = len(sums) / max(len(sums) - _FEWEST_TURNS + 1, 1) * float(np.sum(sums**2))
    period = float(np.median(np.diff(turning.time_s)))
    samples_per_value = max(1.0, 1.0 / (2.0 * _BAND_HZ * period))
    freedom = max(residual.size / samples_per_value - len(inverse), 1.0)
    variance = float(np.sum(residual**2)) / samples_per_value / freedom
    within = samples_per_value * variance * float(inverse[_COLUMNS, _COLUMNS])
    return float(np.sqrt(max(between, within)))


def _mount_lag(turning: _Turning, offset: float) -> float:
    """Return what the mount's damping may delay the force by at the rate at which the weight turns."""
    first, second = (turning.signals(turning.time_s - offset, order)[:, :3] for order in (1, 2))
    return float(_MOUNT_LAG_S3 * np.sum(second**2) / max(float(np.sum(first**2)), 1e-12))
