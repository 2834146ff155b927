"""Whether a touch was withdrawn before its peak: F^d turned round while the force was still rising."""

import numpy as np
from scipy.integrate import cumulative_trapezoid

from problems.arrays import FloatArray

from .signals import AxisSignals

_BEFORE_S, _AFTER_S, _LONGEST_S = 0.15, 0.3, 2.0
_FEWEST, _MOST_TRIED = 12, 100
# An admittance whose deadband, filters and lead are not known explains its own travel to this share.
_UNEXPLAINED = 0.02
# What a turn of F^d must explain of what one constant F^d leaves.
_EXPLAINED = 0.5


def is_withdrawn(axis: AxisSignals, sign: int, onset: int, peak: int, stop: int) -> bool:
    """Return whether F^d turned away from what is touched before the largest force; False where nothing shows it.

    F^d in the log shows it, else the command of an admittance: M_a dv/dt + B_a v = F^d + F, integrated twice over
    time, is linear in B_a/M_a, 1/M_a, F^d/M_a and its step, so that least squares show the step and, by trial of every
    instant, when.

    Parameters
    ----------
    axis
        Force [N] and command [m] of the axis.
    sign
        +1 where the payload presses towards +axis.
    onset, peak, stop
        The samples of the first and of the largest force, and the one behind the last.

    """
    desired = axis.desired_n[max(0, onset - 1) : peak + 1]
    if np.any(desired[:1] * desired < 0.0):
        return True
    if axis.commanded_m is None or stop >= len(axis.time_s) - 1:
        return False
    first = int(np.searchsorted(axis.time_s, axis.time_s[onset] - _BEFORE_S))
    last = min(
        int(np.searchsorted(axis.time_s, axis.time_s[stop] + _AFTER_S)),
        int(np.searchsorted(axis.time_s, axis.time_s[onset] + _LONGEST_S)),
    )
    if onset - first < 3 or last - first < _FEWEST or last <= stop:
        return False
    used = slice(first, last)
    turned_at = _turn(axis.time_s[used], sign * axis.commanded_m[used], -sign * axis.force_n[used])
    # A stiff robot lets the force fall in the very sample in which F^d turns.
    open_s = axis.period_s * max(1, (last - first) // _MOST_TRIED)
    return turned_at is not None and bool(turned_at <= axis.time_s[peak] + open_s)


def _turn(time: FloatArray, command: FloatArray, pressing: FloatArray) -> float | None:
    """Return when F^d of an admittance turned away from the touch [s], None where it did not."""
    since, travel = time - time[0], command - command[0]
    if not (np.all(np.isfinite(travel)) and travel[-1] < travel[-2] and travel[1] > 0.0):
        return None
    # v_0, B_a/M_a, 1/M_a and F^d/M_a; the travel alone is never differentiated.
    known = np.column_stack(
        [since, -_integral(travel, time), -_integral(_integral(pressing, time), time), 0.5 * since**2]
    )
    constant = _left(known, travel)[0]
    tried = [
        (*_left(np.column_stack([known, 0.5 * np.maximum(time - at, 0.0) ** 2]), travel), float(at))
        for at in time[1 : -1 : max(1, len(time) // _MOST_TRIED)]
    ]
    left, (_, damping, compliance, before, step), at = min(tried, key=lambda each: each[0])
    is_admittance = damping > 0.0 and compliance > 0.0 and left <= _UNEXPLAINED * float(np.ptp(travel))
    return at if is_admittance and before > 0.0 > before + step and left <= _EXPLAINED * constant else None


def _integral(values: FloatArray, time: FloatArray) -> FloatArray:
    return np.asarray(cumulative_trapezoid(values, time, initial=0.0))


def _left(columns: FloatArray, travel: FloatArray) -> tuple[float, FloatArray]:
    """Return the deviation that least squares leave of a travel (n,), and the factors of the columns (n, k)."""
    scale = np.linalg.norm(columns, axis=0)
    scale[scale == 0.0] = 1.0
    factors = np.linalg.lstsq(columns / scale, travel, rcond=None)[0] / scale
    return float(np.std(travel - columns @ factors)), np.asarray(factors)
