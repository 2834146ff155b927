"""Newton-Euler equations of the payload over moves that only the robot drives."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from problems.arrays import FloatArray, IntArray

from ..signals.aligned import AlignedLog
from ..signals.recording import turn_vectors_rad
from ..signals.segments import MotionSpans, Span, low_pass
from .gravity import GravityFit
from .static_poses import StaticPose, cross_matrix

_EDGE_S = 0.12
_BAND_HZ = 8.0
_RATE_BAND_HZ = 25.0
_TURNING_RAD_S = 0.1
_DRIVEN_SHARE = 0.3
_MARGIN_S = 0.5
_RESTS_FOR_NOISE = 6
_MOST_NOISE = 0.05


@dataclass(frozen=True, kw_only=True)
class MotionRows:
    """Rows (n, 6, 17) and values (n, 6), force then torque in S, over moves numbered by `move` (n,).

    The columns are m, h (3), I (xx, yy, zz, xy, xz, yz), what is left of the biases (6), and the lag of the wrench
    behind the pose. `noise` (6,) is the deviation that the sensor's noise leaves in a value. `attenuation` (10,) is the
    share of each of the first columns' power that is the pose's noise: by that much its parameter comes out too small.
    Columns that are mostly noise are 0.
    """

    rows: FloatArray
    values: FloatArray
    move: IntArray
    noise: FloatArray
    attenuation: FloatArray


def build_motion_rows(
    log: AlignedLog, motion: MotionSpans, poses: Sequence[StaticPose], gravity: GravityFit
) -> MotionRows | None:
    """Write F = m (g − a) − α × h − ω × (ω × h) and τ = h × (g − a) − I α − ω × I ω for the moves that turn the tool.

    a is that of the frame's origin, h = m c; I is about that origin; the weight is already taken off by `gravity`. Both
    sides pass the same filter at 8 Hz, so that the equations still hold. None if nothing turns freely.
    """
    rate = _turn_rate_S(log)
    spans = [span for span in motion.moving if _is_free_turn(span, log, motion, poses, gravity, rate)]
    if not spans:
        return None
    linear = log.in_sensor_frame(_acceleration_B(log))
    turning = np.gradient(rate, log.period_s, axis=0)
    edge, step = round(_EDGE_S / log.period_s), max(1, round(0.5 / (_BAND_HZ * log.period_s)))
    signals = _Signals(linear=linear, turning=turning, rate=rate, period_s=log.period_s)
    inner = [np.arange(max(0, span.start - edge), min(len(log), span.stop + edge), step) for span in spans]
    columns = np.concatenate([signals.columns(at) for at in inner])
    attenuation = _attenuation(columns, signals, motion, 2 * edge, step)
    columns[:, :, attenuation > _MOST_NOISE] = 0.0
    every = np.concatenate(inner)
    # Of a long log each of these, and what follows, is much of what is in memory.
    del linear, turning, rate, signals
    wrench = _smooth_wrench(log, motion, gravity, every)
    nuisance = np.broadcast_to(np.eye(6), (len(every), 6, 6))
    return MotionRows(
        rows=np.concatenate([columns, nuisance, wrench.lag[:, :, None]], axis=2),
        values=wrench.values,
        move=np.repeat(np.arange(len(spans)), [len(at) for at in inner]),
        noise=wrench.noise,
        attenuation=np.where(attenuation > _MOST_NOISE, 0.0, attenuation),
    )


@dataclass(frozen=True, kw_only=True)
class _SmoothWrench:
    """The filtered wrench without weight and bias at some samples, (n, 6), what a lag adds to it, and its `noise`."""

    values: FloatArray
    lag: FloatArray
    noise: FloatArray


def _smooth_wrench(log: AlignedLog, motion: MotionSpans, gravity: GravityFit, at: IntArray) -> _SmoothWrench:
    values, lag, noise = np.empty((len(at), 6)), np.empty((len(at), 6)), np.empty(6)
    # Column by column: the whole wrench of a long log, filtered twice, would be the most that is ever in memory.
    for first, compensated, measured in (
        (0, gravity.compensated_force_S_n, log.force_S_n),
        (3, gravity.compensated_torque_S_n_m, log.torque_S_n_m),
    ):
        free = compensated(log)
        for i in range(3):
            smooth = low_pass(free[:, i], log.period_s, _BAND_HZ)
            values[:, first + i] = smooth[at]
            noise[first + i] = np.median([np.std(smooth[rest.slice]) for rest in motion.still])
            raw = low_pass(measured[:, i], log.period_s, _BAND_HZ)
            lag[:, first + i] = -np.gradient(raw, log.period_s)[at]
        del free
    return _SmoothWrench(values=values, lag=lag, noise=noise)


@dataclass(frozen=True, kw_only=True)
class _Signals:
    """Accelerations a, α and rate ω (n, 3) in S."""

    linear: FloatArray
    turning: FloatArray
    rate: FloatArray
    period_s: float

    def columns(self, at: IntArray) -> FloatArray:
        """Return the filtered columns (k, 6, 10) of m, h and I at the samples `at` (k,)."""
        margin = round(_MARGIN_S / self.period_s)
        around = slice(max(0, int(at[0]) - margin), min(len(self.rate), int(at[-1]) + margin + 1))
        columns = _newton_euler(self.linear[around], self.turning[around], self.rate[around])
        filtered = low_pass(columns.reshape(len(columns), -1), self.period_s, _BAND_HZ)
        return filtered.reshape(columns.shape)[at - around.start]


def _attenuation(columns: FloatArray, signals: _Signals, motion: MotionSpans, edge: int, step: int) -> FloatArray:
    """Compare the columns' power (10,) at rest, which is noise, with that in the moves."""
    rests = sorted(motion.still, key=len)[-_RESTS_FOR_NOISE:]
    quiet = [np.arange(rest.start + edge, rest.stop - edge, step) for rest in rests if len(rest) > 2 * edge + step]
    if not quiet:
        return np.zeros(columns.shape[2])
    noise = np.mean(np.sum(np.concatenate([signals.columns(at) for at in quiet]) ** 2, axis=1), axis=0)
    return np.asarray(noise / np.maximum(np.mean(np.sum(columns**2, axis=1), axis=0), 1e-30))


def _acceleration_B(log: AlignedLog) -> FloatArray:
    """Return a (n, 3) of the frame's origin in B, smoothed without phase shift."""
    acceleration = np.empty((len(log), 3))
    for column, position in zip(acceleration.T, log.position_B_m.T, strict=True):
        smooth = low_pass(position, log.period_s, _RATE_BAND_HZ)
        column[:] = np.gradient(np.gradient(smooth, log.period_s), log.period_s)
    return acceleration


def _turn_rate_S(log: AlignedLog) -> FloatArray:
    """Return ω (n, 3) of the tool in S, smoothed without phase shift."""
    between = np.empty((len(log) - 1, 3))
    for part in log.parts:
        quaternions = log.orientation_BS[part.start : part.stop + 1].as_quat()
        between[part] = turn_vectors_rad(quaternions[:-1], quaternions[1:])
    between /= log.period_s
    # Differences lie between samples; their means lie on them again.
    rate = np.empty((len(log), 3))
    rate[0], rate[-1] = between[0], between[-1]
    rate[1:-1] = 0.5 * (between[1:] + between[:-1])
    del between
    return low_pass(rate, log.period_s, _RATE_BAND_HZ)


def _is_free_turn(
    span: Span,
    log: AlignedLog,
    motion: MotionSpans,
    poses: Sequence[StaticPose],
    gravity: GravityFit,
    rate: FloatArray,
) -> bool:
    """Return whether the tool turns from one free rest to another and takes no work from elsewhere.

    A payload that nobody drives gives back over a move what it took; one that a hand leads drives the robot.
    """
    if float(np.max(np.linalg.norm(rate[span.slice], axis=1))) < _TURNING_RAD_S:
        return False
    free = [poses[i].span for i in gravity.inliers]
    beside = [rest for rest in motion.still if rest.stop == span.start or rest.start == span.stop]
    if len(beside) < 2 or any(rest not in free for rest in beside):
        return False
    turned = log.orientation_BS[span.slice].inv()
    weight = gravity.mass_kg * turned.apply([0.0, 0.0, -9.80665])
    force = log.force_S_n[span.slice] - gravity.force_bias_S_n - weight
    torque = log.torque_S_n_m[span.slice] - gravity.torque_bias_S_n_m - np.cross(gravity.com_S_m, weight)
    power = np.sum(force * motion.velocity_S_m_s[span.slice], axis=1) + np.sum(torque * rate[span.slice], axis=1)
    smooth = low_pass(power, log.period_s, _BAND_HZ) if len(power) > 60 else power
    return float(np.sum(smooth)) < _DRIVEN_SHARE * float(np.sum(np.abs(smooth)))


def _newton_euler(linear: FloatArray, turning: FloatArray, rate: FloatArray) -> FloatArray:
    """Return the columns (n, 6, 10) of m, h and I for accelerations a, α and rate ω (n, 3) in S."""
    spin = cross_matrix(rate)
    columns = np.zeros((len(rate), 6, 10))
    columns[:, :3, 0] = -linear
    columns[:, :3, 1:4] = -(cross_matrix(turning) + spin @ spin)
    columns[:, 3:, 1:4] = cross_matrix(linear)
    columns[:, 3:, 4:] = -(_times(turning) + spin @ _times(rate))
    return columns


def _times(vector: FloatArray) -> FloatArray:
    """Return the matrices (n, 3, 6) that turn xx, yy, zz, xy, xz, yz into I times `vector` (n, 3)."""
    x, y, z = vector.T
    zero = np.zeros_like(x)
    rows = [[x, zero, zero, y, z, zero], [zero, y, zero, x, zero, z], [zero, zero, z, zero, x, y]]
    return np.asarray(np.stack([np.stack(row, axis=-1) for row in rows], axis=-2))
