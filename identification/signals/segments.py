"""Spans of a log at rest and in motion."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import scipy
from scipy.interpolate import CubicSpline
from scipy.ndimage import uniform_filter1d

from problems.arrays import BoolArray, FloatArray, IntArray

from .aligned import AlignedLog, Span, edges_of, spans_of
from .contact_rule import CONTACT
from .medians import column_medians
from .sweeps import finite_rows, second_differences

__all__ = ["MotionSpans", "Span", "find_motion", "low_pass", "without_pauses", "without_short"]


_STILL_SPEED_M_S = 1.5e-3
_STILL_TURN_RAD_S = 0.02
_LONGEST_PAUSE_S = 0.12
_MOTION_BAND_HZ = 25.0
# A position so noisy that it must be smoothed more is none in metres; a push of 0.1 s would be smoothed away.
_SLOWEST_BAND_HZ = 5.0
# From the median of the absolute second difference of white noise, squared.
_TO_VARIANCE = 1.4826**2 / 6.0
_SHAKE_WINDOW_S = 0.12
_HOLE_MARGIN_S = 0.15
_FEWEST_FILTERED = 30
_SHAKE_FACTOR = 3.0
_SHAKE_FLOOR_N = 0.2


@dataclass(frozen=True, kw_only=True)
class MotionSpans:
    """`velocity_S_m_s` (n, 3) of the flange in the sensor frame, and what it says: `still` and `moving` spans."""

    velocity_S_m_s: FloatArray
    still: tuple[Span, ...]
    moving: tuple[Span, ...]


def low_pass(values: FloatArray, period_s: float, cutoff_hz: float) -> FloatArray:
    """Filter (n, …) along the first axis forwards and backwards: no phase shift, each stretch without NaN alone."""
    sections = _sections(min(cutoff_hz, 0.45 / period_s), 1.0 / period_s)
    known = finite_rows(values.reshape(len(values), -1))
    if bool(np.all(known)):
        return np.asarray(scipy.signal.sosfiltfilt(sections, values, axis=0))
    smooth = np.full(values.shape, np.nan)
    for span in spans_of(np.asarray(known)):
        if len(span) > _FEWEST_FILTERED:
            smooth[span.slice] = scipy.signal.sosfiltfilt(sections, values[span.slice], axis=0)
    return smooth


@lru_cache(maxsize=32)
def _sections(cutoff_hz: float, rate_hz: float) -> FloatArray:
    """Return the low-pass (2, 6): its design takes as long as filtering a second."""
    return np.asarray(scipy.signal.butter(3, cutoff_hz, fs=rate_hz, output="sos"))


def rate_of(values: FloatArray, period_s: float) -> FloatArray:
    """Return the derivative of (n,) by a cubic spline through each stretch without NaN.

    Central differences would take a fifth of what swings in six samples.
    """
    rate = np.full(len(values), np.nan)
    for span in spans_of(np.isfinite(values)):
        if len(span) > 1:
            ticks = np.arange(len(span)) * period_s
            rate[span.slice] = CubicSpline(ticks, values[span.slice])(ticks, nu=1)
    return rate


def find_motion(log: AlignedLog) -> MotionSpans:
    """Split the log into spans at rest (≥ 0.4 s) and spans of motion between them, neither across a hole of the log.

    Of a log without positions turning and force show what is a rest.
    MotionSpans ends 0.15 s off a hole: what is derived from it looks that far beyond a span.
    """
    smooth = low_pass(log.position_B_m, log.period_s, _quiet_band_hz(log))
    velocity_B = np.gradient(smooth, log.period_s, axis=0)
    velocity_S = log.in_sensor_frame(velocity_B)
    turning = _turn_rate(log)
    still = (turning < _STILL_TURN_RAD_S) & _quiet_force(log)
    if not np.all(np.isnan(velocity_B)):
        still &= np.linalg.norm(velocity_B, axis=1) < _STILL_SPEED_M_S
    # An oscillation passes through zero speed: short pauses belong to the motion, and rest has a least length.
    pause = max(1, round(_LONGEST_PAUSE_S / log.period_s))
    shortest = max(1, round(CONTACT.shortest_rest_s / log.period_s))
    rest, away = np.zeros(len(log), dtype=np.bool_), np.ones(len(log), dtype=np.bool_)
    for piece in log.pieces:
        moving = without_pauses(~still[piece.slice], 2 * pause)
        # The margin of a piece is too short to distinguish motion from a pause.
        moving[:pause] = moving[-pause:] = False
        rest[piece.slice] = without_short(~moving, shortest)
    margin = round(_HOLE_MARGIN_S / log.period_s)
    for hole in log.holes:
        away[max(0, hole.start - margin) : hole.stop + margin] = False
    return MotionSpans(velocity_S_m_s=velocity_S, still=spans_of(rest), moving=spans_of(~rest & away))


def _quiet_band_hz(log: AlignedLog) -> float:
    """Return up to which frequency white noise of the position makes a third of the speed that counts as still.

    Noise σ per coordinate, sampled every h, makes a speed of σ √(2 h (2π)² f³/3) below f.
    """
    second = second_differences(log.position_B_m[finite_rows(log.position_B_m)])
    variance = float(np.sum(column_medians(second.T) ** 2)) * _TO_VARIANCE if second.size else 0.0
    speed = variance * 2.0 * log.period_s * (2.0 * np.pi) ** 2 / 3.0
    quiet = ((_STILL_SPEED_M_S / 3.0) ** 2 / max(speed, 1e-30)) ** (1.0 / 3.0)
    return float(min(_MOTION_BAND_HZ, max(_SLOWEST_BAND_HZ, quiet)))


def without_pauses(mask: BoolArray, longest: int) -> BoolArray:
    """Fill stretches of at most `longest` samples between two in which `mask` (n,) holds."""
    starts, stops = edges_of(mask)
    apart = np.flatnonzero(starts[1:] - stops[:-1] > longest)
    return _mask_of(
        np.concatenate([starts[:1], starts[apart + 1]]), np.concatenate([stops[apart], stops[-1:]]), len(mask)
    )


def without_short(mask: BoolArray, shortest: int) -> BoolArray:
    """Leave out stretches of fewer than `shortest` samples."""
    starts, stops = edges_of(mask)
    long = stops - starts >= shortest
    return _mask_of(starts[long], stops[long], len(mask))


def _mask_of(starts: IntArray, stops: IntArray, count: int) -> BoolArray:
    steps = np.zeros(count + 1, dtype=np.int8)
    steps[starts], steps[stops] = 1, -1
    return np.asarray(np.cumsum(steps[:-1], dtype=np.int8).astype(np.bool_))


def _quiet_force(log: AlignedLog) -> BoolArray:
    """Return where the force does not shake: vibration above the band of the speed estimate shows here."""
    width = max(3, round(_SHAKE_WINDOW_S / log.period_s))
    shake = np.full(len(log), np.nan)
    for piece in log.pieces:
        force = log.force_S_n[piece.slice]
        mean = uniform_filter1d(force, width, axis=0)
        variance = uniform_filter1d(force**2, width, axis=0) - mean**2
        shake[piece.slice] = np.sqrt(np.maximum(variance, 0.0)).max(axis=1)
    return np.asarray(shake < _SHAKE_FACTOR * np.nanquantile(shake, 0.1) + _SHAKE_FLOOR_N)


def _turn_rate(log: AlignedLog) -> FloatArray:
    """Return the turning speed [rad/s], differenced over a few samples against encoder noise."""
    lag, half = log.lag, log.lag // 2
    rate = log.turned_rad / (lag * log.period_s)
    return np.concatenate([np.full(half, rate[0]), rate, np.full(lag - half, rate[-1])])
