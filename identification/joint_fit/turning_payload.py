"""Fit of free motion without what of the force only turns the payload on its coupling (`payload.turning`).

That part u of F moves the centre of mass and not the coupling, so K_s looks softer by as much as u follows F: with the
centre of mass off the axis by c about m c²/I of it. F − u is the force of a payload that does not turn, behind a flange
at x + w with K_s w + B_s dw/dt = u. Drag to the ground is no force of the sensor: where it acts off the centre of mass,
u holds something that follows the speed, and is left without it as slow motion shows it.
"""

from dataclasses import dataclass, replace

import numpy as np
import scipy
from scipy.interpolate import make_interp_spline

from problems.arrays import FloatArray

from .data import JointData
from .free_motion import STEPS_LATER, quiet_rests, with_fitted_noise
from .segments import run, segment_model
from .solve import Point, Problem, minimise

# A payload turns on its coupling more slowly than this; above is the torque's noise.
_HIGHEST_HZ, _HIGHEST_SHARE, _ORDER = 100.0, 0.4, 4
_ABOVE_NOISE, _LARGEST_SHARE = 3.0, 0.1
_MARGIN_S, _RAMP_S = 0.008, 0.004
# Drag is looked for below this share of the payload's own frequency, in spans of this length.
_SLOW, _LONG_S = 0.25, 1.0
# How well the move is known: the inertia to a few per cent, and the coupling that makes w of u.
_MOVE_KNOWN = 0.1


@dataclass(frozen=True, kw_only=True)
class WithoutTurning:
    """Data, problem and minimum without what turns; `move` (p,) is by how much the parameters moved [SI], or None."""

    data: JointData
    problem: Problem
    point: Point
    move: FloatArray | None = None

    @property
    def std(self) -> FloatArray | None:
        """What may be wrong of the move, (p,) [SI], None without one."""
        return None if self.move is None else _MOVE_KNOWN * self.move


def take_out_turning(data: JointData, problem: Problem, point: Point) -> WithoutTurning:
    """Return the fit of the spans in free motion without what turns, as it is where the torque does not show that.

    What is more than a tenth of the force is no correction of a payload on one spring, and stays.
    """
    kept = WithoutTurning(data=data, problem=problem, point=point)
    rests = quiet_rests(data)
    if data.turning_n is None or not rests or not problem.segments:
        return kept
    turning = _without_drag(_smoothed(data.turning_n, data.period_s), problem, point)
    noise = float(np.std(np.concatenate([turning[rest] - np.mean(turning[rest]) for rest in rests])))
    seen, force = (
        np.concatenate([signal[s.slice] for s in problem.segments]) for signal in (turning, problem.signals.force_n)
    )
    if not _ABOVE_NOISE * noise < float(np.std(seen)) < _LARGEST_SHARE * float(np.std(force)):
        return kept
    u = turning * _weights(problem, len(turning))
    moved = _as_path(u, point.values, data.period_s)
    signals = problem.signals
    if signals.command_m is not None:
        signals = replace(signals, yielded=moved if signals.yielded is None else signals.yielded + moved)
    force_n, position_m = data.force_n - u, data.position_m + moved[:, 0]
    problem = replace(problem, signals=replace(signals, force_n=force_n, position_m=position_m))
    problem = with_fitted_noise(problem, point)
    after, _ = minimise(problem, point, STEPS_LATER)
    data = replace(data, force_n=force_n, position_m=position_m)
    return WithoutTurning(data=data, problem=problem, point=after, move=after.values - point.values)


def _smoothed(signal: FloatArray, period_s: float) -> FloatArray:
    return np.asarray(scipy.signal.sosfiltfilt(_low_pass(_HIGHEST_HZ, period_s), signal))


def _low_pass(cutoff_hz: float, period_s: float) -> FloatArray:
    """Return a filter as sections, below what a slow log can show whatever the fit says of the payload's frequency."""
    cutoff_hz = min(cutoff_hz, _HIGHEST_SHARE / period_s)
    return np.asarray(scipy.signal.butter(_ORDER, cutoff_hz, fs=1.0 / period_s, output="sos"))


def _without_drag(turning: FloatArray, problem: Problem, point: Point) -> FloatArray:
    """Return u (n,) without what follows the payload's speed in motion slower than a quarter of its own frequency."""
    period, speed = problem.signals.period_s, np.zeros(len(turning))
    own_hz = float(np.sqrt(point.values[0] / point.values[3])) / (2.0 * np.pi)
    slow = _low_pass(_SLOW * own_hz, period)
    path, margin, along, square = problem.path(point.values), _margin(period), 0.0, 0.0
    for segment, nuisance in zip(problem.segments, point.nuisances, strict=True):
        law = segment_model(point.values, nuisance, segment, path, problem.layout, period)
        mine = run(law, path.cut(segment.slice), segment).states[:, 1]
        first, last = max(segment.start - margin, 0), min(segment.stop + margin, len(speed))
        speed[first:last] = np.pad(mine, (segment.start - first, last - segment.stop), mode="edge")
        if len(segment) * period >= _LONG_S:
            seen, moved = (scipy.signal.sosfiltfilt(slow, each) for each in (turning[segment.slice], mine))
            along, square = along + float(seen @ moved), square + float(moved @ moved)
    return turning - (along / square if square > 0.0 else 0.0) * speed


def _margin(period_s: float) -> int:
    return max(round(_MARGIN_S / period_s), 2)


def _weights(problem: Problem, count: int) -> FloatArray:
    """Return 1 in the spans and a little around, 0 elsewhere, with ramps: beyond, something may touch the payload."""
    period = problem.signals.period_s
    margin, ramp = _margin(period), max(round(_RAMP_S / period), 1)
    inside = np.zeros(count)
    for each in problem.segments:
        inside[max(each.start - margin, 0) : each.stop + margin] = 1.0
    return np.convolve(inside, np.ones(ramp) / ramp, mode="same")


def _as_path(force_n: FloatArray, values: FloatArray, period_s: float) -> FloatArray:
    """Return w with K_s w + B_s w' = u, value and derivatives over factorials per sample (n, 4)."""
    top, bottom, *_ = scipy.signal.cont2discrete(([1.0], [float(values[1]), float(values[0])]), period_s, method="foh")
    path = make_interp_spline(np.arange(len(force_n)), scipy.signal.lfilter(np.ravel(top), bottom, force_n), k=5)
    ticks = np.arange(len(force_n))
    return np.column_stack([path(ticks, nu=order) / over for order, over in ((0, 1.0), (1, 1.0), (2, 2.0), (3, 6.0))])
