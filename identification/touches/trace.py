"""The stiffness of one contact from force over travel: loading, hold and the first blow apart."""

from dataclasses import dataclass

import numpy as np

from problems.arrays import BoolArray, FloatArray

from ..errors import EstimateError
from ..signals.aligned import spans_of
from ..signals.contact_rule import CONTACT

_SMALLEST_TRAVEL_M = 2e-4
_FEWEST = 50
# Below a fifth of the peak a payload that rebounds is off the surface, and a deadband weighs most.
_LOADED_SHARE = 0.2
# A hold is where the trace stays longest at one depth, to this share of the deepest, for this share of the load.
_SAME_DEPTH_SHARE = 0.05
_HOLD_SHARE = 0.2
_SPIKE_RATIO = 2.0
_FALLEN_SHARE = 0.5
_BLOCKS = 12
# Loading ends where the depth first comes this near to the deepest.
_REACHED_SHARE = 0.95
_FEWEST_LOADING = 6


@dataclass(frozen=True, kw_only=True)
class Spike:
    """The first blow: its force, where it came, ∫(F − k x)dt, the momentum that no spring took, and where it ends.

    `stop` is the sample at which the force is least before it rises again.
    """

    force_n: float
    depth_m: float
    impulse_n_s: float
    stop: int


@dataclass(frozen=True, kw_only=True)
class TraceContact:
    """Force over displacement since contact. `secant_n_per_m` k minimises Σ(F − k x)² over the loaded samples.

    `secant_std_n_per_m` holds the scatter about it and what the place of the first touch does to it. On the loading,
    behind the first blow and until 95 % of the depth, `loading_n_per_m` lies in the middle between that k and force
    over displacement at the peak, and its deviation holds half of what is between them: what a spring leaves out.
    `hold_secant_n_per_m` is mean force over mean displacement of the hold, the longest stretch under load at one depth,
    None without one; `fit_error` RMS(F − k x) over RMS(F).
    """

    peak_force_n: float
    secant_n_per_m: float
    secant_std_n_per_m: float
    loading_n_per_m: float
    loading_std_n_per_m: float
    hold_secant_n_per_m: float | None
    touch_m: float
    fit_error: float
    spike: Spike | None


def identify_trace(
    displacement_m: FloatArray, pressing_n: FloatArray, period_s: float, onset_std_m: float | None = None
) -> TraceContact:
    """Fit k through the origin of displacement (n,), counted from contact, and pressing force (n,), both into the wall.

    Samples from a fifth of the peak force on count. `onset_std_m` is by how much the displacement's zero is open.
    Without it, or where the first sample is loaded already, the trace says where the contact began, and so does the
    force (the last sample below 5 % of the peak before the load): the difference between both secants goes into the
    deviation. Raises EstimateError where nothing presses, or too little.
    """
    x, force = displacement_m, pressing_n
    peak, depth = float(np.max(force, initial=0.0)), float(np.max(x, initial=0.0))
    loaded = (force > _LOADED_SHARE * peak) & (x > 0.0)
    if peak < CONTACT.smallest_trace_peak_n or depth < _SMALLEST_TRAVEL_M or np.count_nonzero(loaded) < _FEWEST:
        raise EstimateError(
            f"A force of {peak:.2f} N at most, over {1e3 * depth:.2f} mm into the surface, is no contact from which a "
            "stiffness can be determined; press with 20 N or more, and check `exerted_by` if the trace does press."
        )
    stiffness, scatter = _through_origin(x[loaded], force[loaded])
    first = int(np.argmax(loaded))
    before = np.flatnonzero(force[:first] < CONTACT.trace_share * peak)
    touch = int(before[-1]) if before.size else 0
    farther = x[touch]
    apart, open_m = 0.0, 0.0 if onset_std_m is None else onset_std_m
    if onset_std_m is None or first == 0:
        beyond = loaded & (x > farther)
        apart = _through_origin(x[beyond] - farther, force[beyond])[0] - stiffness if np.any(beyond) else np.inf
    scatter = float(np.hypot(scatter, stiffness * open_m / np.sqrt(float(np.mean(x[loaded] ** 2)))))
    misfit = force[loaded] - stiffness * x[loaded]
    spike = _spike(x, force, stiffness, touch, period_s)
    loading, open_n_per_m = _loading(x, force, loaded, 0 if spike is None else spike.stop)
    share = float(np.hypot(0.5 * apart / stiffness, open_m / max(float(np.max(x)), 1e-9)))
    return TraceContact(
        peak_force_n=peak,
        secant_n_per_m=stiffness,
        secant_std_n_per_m=float(np.hypot(scatter, apart)),
        loading_n_per_m=loading,
        loading_std_n_per_m=float(np.hypot(open_n_per_m, share * loading)),
        hold_secant_n_per_m=_hold_secant(x, force, loaded),
        touch_m=float(farther),
        fit_error=float(np.sqrt(np.mean(misfit**2) / np.mean(force[loaded] ** 2))),
        spike=spike,
    )


def _hold_secant(x: FloatArray, force: FloatArray, loaded: BoolArray) -> float | None:
    """Return mean force over mean displacement of the longest stretch under load at one depth, None without a hold."""
    depths = np.sort(x[loaded])
    width = _SAME_DEPTH_SHARE * float(depths[-1])
    counts = np.searchsorted(depths, depths + width, side="right") - np.arange(len(depths))
    low = float(depths[int(np.argmax(counts))])
    there = loaded & (x >= low) & (x <= low + width)
    hold = max(spans_of(there), key=len)
    if len(hold) < _HOLD_SHARE * np.count_nonzero(loaded):
        return None
    return float(np.mean(force[hold.slice]) / np.mean(x[hold.slice]))


def _through_origin(x: FloatArray, force: FloatArray) -> tuple[float, float]:
    """Return k of F = k x and its deviation, from sums of x (F − k x) over blocks much longer than a swing."""
    square = float(x @ x)
    stiffness = float(x @ force) / square
    sums = np.array([float(np.sum(part)) for part in np.array_split(x * (force - stiffness * x), _BLOCKS)])
    return stiffness, float(np.sqrt(np.sum(sums**2) * _BLOCKS / (_BLOCKS - 1)) / square)


def _spike(x: FloatArray, force: FloatArray, stiffness: float, touch: int, period_s: float) -> Spike | None:
    """Return the first blow: a maximum of more than twice k x, from which the force falls by half and more.

    It comes on the first half of the way: what falls behind the deepest relaxes.
    """
    after = force[touch:]
    highest = np.maximum.accumulate(after)
    fallen = np.flatnonzero((after < _FALLEN_SHARE * highest) & (highest > _LOADED_SHARE * float(np.max(force))))
    if not fallen.size:
        return None
    blow = slice(touch, touch + int(fallen[0]))
    top = touch + int(np.argmax(force[blow]))
    if force[top] < _SPIKE_RATIO * stiffness * max(float(x[top]), 0.0) or x[top] > _FALLEN_SHARE * np.max(x):
        return None
    return Spike(
        force_n=float(force[top]),
        depth_m=float(x[top]),
        impulse_n_s=float(np.sum(force[blow] - stiffness * x[blow]) * period_s),
        stop=_trough(force, touch + int(fallen[0])),
    )


def _trough(force: FloatArray, start: int) -> int:
    """Return the least force between a sample and the next one that is half as much again and more than it."""
    lowest = np.minimum.accumulate(force[start:])
    risen = np.flatnonzero((_FALLEN_SHARE * force[start:] > lowest) & (force[start:] > _LOADED_SHARE * np.max(force)))
    stop = start + (int(risen[0]) if risen.size else len(lowest))
    return start + int(np.argmin(force[start:stop]))


def _loading(x: FloatArray, force: FloatArray, loaded: BoolArray, start: int) -> tuple[float, float]:
    """Return the loading stiffness of the samples from `start` on, and half of what is between its two measures."""
    reached = int(np.argmax(x >= _REACHED_SHARE * np.max(x)))
    branch = np.flatnonzero(loaded[start : max(reached, start) + 1]) + start
    if len(branch) < _FEWEST_LOADING:
        branch = np.flatnonzero(loaded[start:]) + start
    if len(branch) < _FEWEST_LOADING:
        branch = np.flatnonzero(loaded)
    along = _through_origin(x[branch], force[branch])[0]
    behind = np.flatnonzero(loaded[start:]) + start
    top = int(behind[np.argmax(force[behind])]) if behind.size else int(np.argmax(np.where(loaded, force, 0.0)))
    at_peak = float(force[top] / x[top])
    return 0.5 * (along + at_peak), 0.5 * abs(at_peak - along)
