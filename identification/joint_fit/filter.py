"""A first-order low-pass in the sensor, fitted beside everything else, and held against a delay by likelihood."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from .delay_hypotheses import either_side
from .latency import Lag, sooner, step_lag
from .noise import Whitener, fit_whitener
from .problem import Point, Problem, Signals
from .segments import predict_force
from .sensor import Lateness
from .solve import cost, minimise

FloatArray = NDArray[np.float64]

_ROUNDS, _DELAY_ROUNDS, _SIDES, _STEPS = 8, 4, 3, 4
_SETTLED = 0.1
_LARGEST_FACTOR = 2.5
_VAGUE = 30.0
# One that a driver computes from sample to sample already passes on the newest: it is early against that of a circuit.
_EARLY_SAMPLES = (0.0, 0.5, 1.0)
_MATTERS_SAMPLES, _MATTERS_S = 0.2, 2e-4
_SIGNIFICANT_STDS = 4.0
# −2 log L of one over the other: e^-12.5 to one that chance prefers the wrong one.
DECIDED = 25.0
_CLOCK_S = 0.03
_BETWEEN_SAMPLES = 0.03


def is_late(lag_s: float, std_s: float, period_s: float) -> bool:
    """Return whether a lag is there and matters: four deviations, and a fifth of a sample or 0.2 ms, what is less."""
    return lag_s > max(_SIGNIFICANT_STDS * std_s, min(_MATTERS_SAMPLES * period_s, _MATTERS_S))


def taken_for_filter(shifted_s: float) -> float:
    """Return how much of what was taken off the wrench's stamps may be the sensor's; 30 ms and more are a clock's."""
    return shifted_s if abs(shifted_s) < _CLOCK_S else 0.0


def filter_or_delay(
    problem: Problem, point: Point, force_n: FloatArray, lag: Lag, shifted_s: float
) -> tuple[Problem, Point, Lag]:
    """Return the problem with a low-pass in its sensor where that explains a late wrench better than a delay.

    `force_n` (n,) is the force as it was read, with `shifted_s` taken off its stamps as a clock's offset. A delay moves
    all frequencies alike; a low-pass of corner ω moves them by atan(f/ω)/f and takes 1/√(1 + (f/ω)²) of them. Both are
    fitted with everything else, and each judged with a noise of its own.
    """
    period = problem.signals.period_s
    clock = taken_for_filter(shifted_s)
    if not is_late(lag.seconds + clock, lag.std_s, period):
        return problem, point, lag
    raw = replace(problem.signals, force_n=force_n, lag_std_s=0.0)
    there, best, whole = _deepest_delay(replace(problem, signals=raw), point, lag.seconds)
    fits = [
        _fitted_filter(
            problem, raw, point, Lateness(time_constant_s=lag.seconds + clock, delay_s=-clock - early * period)
        )
        for early in _EARLY_SAMPLES
    ]
    filtered, here, std, deepest = min(fits, key=lambda fit: fit[3])
    evidence = best - deepest
    if evidence < 0.0 and whole is None:
        return problem, point, replace(lag, evidence=evidence)
    if evidence < 0.0 and whole is not None:
        std = _BETWEEN_SAMPLES * period
        signals = replace(raw, force_n=sooner(force_n, whole), lag_std_s=std)
        late = Lag(seconds=whole * period, std_s=std, applied_s=whole * period, is_whole=True, evidence=evidence)
        return replace(problem, signals=signals), there, late
    constant = filtered.signals.lateness.time_constant_s
    return filtered, here, Lag(seconds=constant, std_s=std, applied_s=0.0, is_filter=True, evidence=evidence)


def _fitted_filter(
    problem: Problem, raw: Signals, point: Point, start: Lateness
) -> tuple[Problem, Point, float, float]:
    """Return the problem with a low-pass, its minimum, the deviation of the time constant, and the depth.

    The side of a whole number of samples on which the robot's delay lies and the time constant move each other.
    """
    filtered, here, std = replace(problem, signals=replace(raw, lateness=start)), point, 0.0
    for _ in range(_SIDES):
        filtered, here, std = fit_filter(filtered, here)
        here = _settled(filtered, here)
    return filtered, here, std, depth(filtered, here)


def _deepest_delay(problem: Problem, point: Point, lag_s: float) -> tuple[Point, float, int | None]:
    """Return the deepest fit with a delay, its depth, and how many whole samples it is, None for a part of one.

    A force that jumps with the held command keeps its jumps only where it is shifted by whole samples.
    """
    period = problem.signals.period_s
    lateness = Lateness(delay_s=lag_s)
    for _ in range(_DELAY_ROUNDS):
        problem = replace(problem, signals=replace(problem.signals, lateness=lateness, lag_std_s=0.0))
        step, std = step_lag(problem, point, (lateness.delay_s, _VAGUE * lag_s), lateness.delay_s)
        lateness = Lateness(delay_s=lateness.delay_s + float(np.clip(step, -period, period)))
        if abs(step) < _SETTLED * std:
            break
    about = lateness.delay_s / period
    wholes = sorted({int(np.floor(about)), int(np.ceil(about)), round(lag_s / period)})
    found = []
    for whole in (None, *(each for each in wholes if each > 0)):
        late = lateness if whole is None else Lateness(delay_s=whole * period)
        trial = replace(problem, signals=replace(problem.signals, lateness=late))
        there = _settled(trial, point)
        found.append((depth(trial, there), there, whole))
    best, there, whole = min(found, key=lambda each: each[0])
    return there, best, whole


def _settled(problem: Problem, point: Point) -> Point:
    """Return the minimum, on the deeper side of a robot's delay of whole samples, where the command's steps are."""
    own = whitened_by_itself(problem, minimise(problem, point, _STEPS)[0])
    return minimise(own, either_side(own, minimise(own, point, _STEPS)[0])[0], _STEPS)[0]


def fit_filter(problem: Problem, point: Point) -> tuple[Problem, Point, float]:
    """Fit the time constant of the problem's low-pass and all else; return its deviation [s], which is then doubted."""
    std = problem.signals.lateness.time_constant_s
    for _ in range(_ROUNDS):
        here = problem.signals.lateness.time_constant_s
        step, std = step_lag(problem, point, (here, _VAGUE * here), here)
        there = float(np.clip(here + step, here / _LARGEST_FACTOR, here * _LARGEST_FACTOR))
        lateness = replace(problem.signals.lateness, time_constant_s=there)
        problem = replace(problem, signals=replace(problem.signals, lateness=lateness, lag_std_s=0.0))
        point, _ = minimise(problem, point, _STEPS)
        if abs(there - here) < _SETTLED * std:
            break
    # Between its samples the force has the steps of the held command, which straight lines do not.
    std = float(np.hypot(std, _BETWEEN_SAMPLES * problem.signals.period_s))
    return replace(problem, signals=replace(problem.signals, lag_std_s=std)), point, std


def depth(problem: Problem, point: Point) -> float:
    """Return −2 log L but for a constant, each kind of span of the force whitened by what it leaves itself."""
    own = whitened_by_itself(problem, point)
    total = cost(own, point)
    for kind in (False, True):
        count = sum(len(s) for s in problem.segments if s.is_contact == kind)
        total += 2.0 * count * float(np.log((own.contact_noise if kind else own.free_noise).rms))
    return total


def whitened_by_itself(problem: Problem, point: Point) -> Problem:
    """Return the problem with the forces' whiteners fitted to what remains at a point."""
    left = forces_left(problem, point)
    return replace(
        problem,
        free_noise=_fitted(left[False], problem.free_noise),
        contact_noise=_fitted(left[True], problem.contact_noise),
    )


def forces_left(problem: Problem, point: Point) -> dict[bool, list[FloatArray]]:
    """Return predicted − measured force of every span in free motion (False) and in contact (True)."""
    signals, layout = problem.signals, problem.layout
    path, lateness = problem.path(point.values), problem.signals.lateness
    left: dict[bool, list[FloatArray]] = {False: [], True: []}
    for segment, nuisance in zip(problem.segments, point.nuisances, strict=True):
        predicted = predict_force(point.values, nuisance, segment, path, layout, signals.period_s)
        felt = lateness.shown(predicted, path, segment.slice, float(point.values[1]), signals.period_s)
        error = felt - signals.force_n[segment.slice]
        left[segment.is_contact].append(error[lateness.unknown(signals.period_s) :])
    return left


def _fitted(left: Sequence[FloatArray], before: Whitener) -> Whitener:
    return fit_whitener(left) if left else before
