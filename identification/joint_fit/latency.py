"""Latency of the wrench: a clock offset, a delay or a first-order low-pass, fitted with all other parameters."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.interpolate import make_interp_spline

from problems.arrays import FloatArray

from ..result import Estimate, Finding, Status, WrenchFilterEstimate
from ..verdicts import judged, weak_at_best
from .noise import Whitener, fit_whitener
from .path import SensorDynamics
from .segments import predict_force
from .solve import Point, Problem, Signals, cost, information, linearise, minimise

_ROUNDS = 6
_STEPS = 4
_SETTLED = 0.1
_SIGNIFICANT_STDS, _FURTHER_STDS = 4.0, 2.0
_PIECE_S = 0.5
_BETWEEN_SAMPLES, _BLURRED_SAMPLES = 0.03, 0.06
_NEAR_SAMPLES = 0.05
_BESIDE_SAMPLES = 0.0005
_COMPETING_STEPS = 6
_FAST, _GONE = 0.5, 20.0
_FILTER_ROUNDS, _DELAY_ROUNDS, _SIDES, _FILTER_STEPS = 8, 4, 3, 4
_LARGEST_FACTOR = 2.5
_VAGUE = 30.0
# One that a driver computes from sample to sample already passes on the newest: it is early against that of a circuit.
_EARLY_SAMPLES = (0.0, 0.5, 1.0)
_MATTERS_SAMPLES, _MATTERS_S = 0.2, 2e-4
# −2 log L of one over the other: e^-12.5 to one that chance prefers the wrong one.
DECIDED = 25.0
_CLOCK_S = 0.03
_FILTER_BETWEEN_SAMPLES = 0.03
_METHOD = "maximum likelihood of pose and force, beside everything else"
_IDENTIFIED_SHARE, _WEAK_SHARE = 0.1, 0.5
_IDENTIFIED_SAMPLES = 0.2
_APART_STDS, _APART_SHARE = 5.0, 0.2


@dataclass(frozen=True, kw_only=True)
class WrenchLatency:
    """The force is stamped `seconds` ± `std_s` late; `applied_s` of it was taken out of the problem's force.

    Where `is_filter`, that is the time constant of a first-order low-pass, which the problem's prediction passes.
    Where `is_whole`, it is a number of samples that is deeper than what lies about it.
    Such a force is logged `advanced_s` too early beside it: by what was taken off its stamps as a clock's offset.
    `evidence` is by how much −2 log L prefers that to a delay, None where the two were not compared; `is_doubtful`
    where nothing explains all of the force.
    """

    seconds: float
    std_s: float
    applied_s: float
    is_filter: bool = False
    is_whole: bool = False
    evidence: float | None = None
    advanced_s: float = 0.0
    is_doubtful: bool = False


def fit_latency(
    problem: Problem,
    point: Point,
    force_n: FloatArray,
    prior: tuple[float, float],
    applied_s: float,
    *,
    blurred: bool,
) -> tuple[Problem, Point, WrenchLatency]:
    """Fit the wrench's latency, take it out where it shows, and fit all again.

    What is left of it counts as a systematic error. `force_n` (n,) is the force as logged, `prior` the latency's mean
    and deviation [s], `applied_s` what the problem's force is already shifted by. One Gauss-Newton step of the latency
    beside all other parameters, -F'(t) being what it does to the force, repeated while it moves. A latency within four
    deviations of 0 is left where it is: shifting interpolates the noise. `blurred`: the command is a mean
    over every sample.
    """
    period = problem.signals.period_s
    for _ in range(_ROUNDS):
        step, std = latency_step(problem, point, prior, applied_s)
        # Beside what a shift itself may cost, and friction may make, a first one must be clear.
        first = _SIGNIFICANT_STDS * float(np.hypot(std, _BETWEEN_SAMPLES * period))
        if abs(step) < (first if applied_s == 0.0 else _FURTHER_STDS * std):
            break
        applied_s += step
        signals = replace(problem.signals, force_n=advance_in_time(force_n, applied_s / period))
        problem = replace(problem, signals=signals)
        point, _ = minimise(problem, point, _STEPS)
        if abs(step) < _SETTLED * std:
            break
    step, std = _left(problem, point, prior, applied_s, blurred=blurred)
    seconds = applied_s + step
    if applied_s != 0.0 and not is_clear_latency(seconds, std):
        signals = replace(problem.signals, force_n=force_n)
        problem, applied_s = replace(problem, signals=signals), 0.0
        point, _ = minimise(problem, point, _STEPS)
    # What may be left: the deviation, and the part that was not worth a shift.
    left = float(np.hypot(std, seconds - applied_s))
    problem = replace(problem, signals=replace(problem.signals, latency_std_s=left))
    return problem, point, WrenchLatency(seconds=seconds, std_s=std, applied_s=applied_s)


def _left(
    problem: Problem, point: Point, prior: tuple[float, float], applied_s: float, *, blurred: bool
) -> tuple[float, float]:
    """Return what is left of the latency, and its deviation with what a shift itself costs [s]."""
    step, std = latency_step(problem, point, prior, applied_s)
    if blurred or applied_s != 0.0:
        # Between its samples the force has the steps of the held command, which no spline and no mean knows.
        std = float(np.hypot(std, (_BLURRED_SAMPLES if blurred else _BETWEEN_SAMPLES) * problem.signals.period_s))
    return step, std


def is_clear_latency(latency_s: float, std_s: float) -> bool:
    """Return whether a latency, late or early, is beyond what chance makes of none."""
    return abs(latency_s) > _SIGNIFICANT_STDS * std_s


def advance_in_time(force_n: FloatArray, samples: float) -> FloatArray:
    """Return the force (n,) that was logged `samples` later, by a cubic spline."""
    if samples == 0.0:
        return force_n
    ticks = np.arange(len(force_n), dtype=np.float64)
    return np.asarray(make_interp_spline(ticks, force_n, k=3)(np.clip(ticks + samples, 0.0, ticks[-1])))


def latency_step(problem: Problem, point: Point, prior: tuple[float, float], applied_s: float) -> tuple[float, float]:
    """Return by how much the latency should grow, and its deviation with all other parameters free [s].

    Scores of pieces of half a second that scatter by more than white residuals make the deviation larger: friction
    looks like a latency that is not the same everywhere.
    """
    mean, std = prior
    blocks = linearise(replace(problem, signals=replace(problem.signals, latency_std_s=std)), point)
    count = len(problem.layout)
    matrix, gradient = information(blocks, count)
    free = np.setdiff1d(np.arange(count), problem.fixed)
    coupled, own, slope = np.zeros(count), 1.0, (mean - applied_s) / std
    for block in blocks:
        if block.systematic is not None:
            column = block.systematic[:, -1]
            coupled[block.indices] += block.jacobian.T @ column
            own += float(column @ column)
            slope += float(column @ block.residual)
    scale = 1.0 / np.sqrt(np.maximum(np.diag(matrix)[free], 1e-300))
    inverse = np.linalg.pinv(matrix[np.ix_(free, free)] * np.outer(scale, scale), hermitian=True)
    inverse *= np.outer(scale, scale)
    follows, moves = np.zeros((2, count))
    follows[free], moves[free] = inverse @ coupled[free], inverse @ gradient[free]
    left = own - float(coupled @ follows)
    step = (slope - float(coupled @ moves)) / left
    scores, expected = 0.0, 1.0
    for block in blocks:
        if block.systematic is not None:
            alone = block.systematic[:, -1] - block.jacobian @ follows[block.indices]
            after = block.residual - block.jacobian @ moves[block.indices] - step * alone
            starts = np.arange(0, len(alone), max(1, round(_PIECE_S / problem.signals.period_s)))
            scores += float(np.sum(np.add.reduceat(alone * after, starts) ** 2))
            expected += float(alone @ alone)
    scatter = float(np.sqrt(max(scores / expected, 1.0)))
    return float(step * std), float(scatter * std / np.sqrt(left))


@dataclass(frozen=True, kw_only=True)
class CompetingMinimum:
    """Another minimum of nearly the same depth; `share` (0 to 1) is what it has of the likelihood of both."""

    point: Point
    share: float


def compare_delay_hypotheses(problem: Problem, point: Point) -> tuple[Point, CompetingMinimum | None]:
    """Return the better minimum of those on both sides of a delay of whole samples, and the other one.

    The velocity of a robot with one pole jumps with every step of its command, and the damping of the coupling turns
    that into a jump of the force. A delay just below a whole number of samples puts the step just before the tick, one
    just above it behind: the same force at all other times, but another one in the log. No derivative shows that jump.
    Of a robot with two poles the competing is that of one pole, where the second pole is fast. Behind a smooth command
    nothing jumps.
    """
    layout, period = problem.layout, problem.signals.period_s
    if problem.signals.is_smooth:
        return point, None
    if layout.robot_order == 2:
        return point, _one_pole(problem, point)
    if layout.robot_order != 1:
        return point, None
    index = layout.robot.stop - 1
    delay = float(point.values[index]) / period
    whole = float(np.round(delay))
    if abs(delay - whole) > _NEAR_SAMPLES or whole < 1.0:
        return point, None
    beside = whole + (_BESIDE_SAMPLES if delay <= whole else -_BESIDE_SAMPLES)
    held = replace(problem, fixed=(*problem.fixed, index))
    here, (there, there_cost) = point, minimise(held, _at(point, index, beside * period), _COMPETING_STEPS)
    here_cost = cost(problem, here)
    if there_cost < here_cost:
        here, there, here_cost, there_cost = there, here, there_cost, here_cost
    ratio = float(np.exp(-0.5 * min(there_cost - here_cost, 200.0)))
    return here, CompetingMinimum(point=there, share=ratio / (1.0 + ratio))


def _one_pole(problem: Problem, point: Point) -> CompetingMinimum | None:
    """Return the robot of one pole beside one whose second pole is so fast that it could be a delay 1/p as well."""
    robot, period = problem.layout.robot, problem.signals.period_s
    omega, zeta, delay = (float(v) for v in point.values[robot])
    if zeta <= 1.0:
        return None
    root = float(np.sqrt(zeta**2 - 1.0))
    slow, fast = omega / (zeta + root), omega * (zeta + root)
    if fast * period < _FAST:
        return None
    values = point.values.copy()
    gone = _GONE / period
    values[robot] = np.sqrt(slow * gone), 0.5 * (slow + gone) / np.sqrt(slow * gone), delay + 1.0 / fast
    # The place of the second pole is what is compared.
    held = replace(problem, fixed=(*problem.fixed, robot.start + 1))
    other, there = minimise(held, replace(point, values=values), _COMPETING_STEPS)
    ratio = float(np.exp(-0.5 * np.clip(there - cost(problem, point), -200.0, 200.0)))
    return CompetingMinimum(point=other, share=ratio / (1.0 + ratio))


def _at(point: Point, index: int, delay_s: float) -> Point:
    values = point.values.copy()
    values[index] = delay_s
    return replace(point, values=values)


def is_significant_latency(latency_s: float, std_s: float, period_s: float) -> bool:
    """Return whether a latency matters: above four deviations, and a fifth of a sample or 0.2 ms, what is less."""
    return latency_s > max(_SIGNIFICANT_STDS * std_s, min(_MATTERS_SAMPLES * period_s, _MATTERS_S))


def taken_for_filter(shifted_s: float) -> float:
    """Return how much of what was taken off the wrench's stamps may be the sensor's; 30 ms and more are a clock's."""
    return shifted_s if abs(shifted_s) < _CLOCK_S else 0.0


def filter_or_delay(
    problem: Problem, point: Point, force_n: FloatArray, latency: WrenchLatency, shifted_s: float
) -> tuple[Problem, Point, WrenchLatency]:
    """Return the problem with a low-pass in its sensor where that explains a late wrench better than a delay.

    `force_n` (n,) is the force as it was read, with `shifted_s` taken off its stamps as a clock's offset. A delay moves
    all frequencies alike; a low-pass of corner ω moves them by atan(f/ω)/f and takes 1/√(1 + (f/ω)²) of them. Both are
    fitted with everything else, and each judged with a noise of its own.
    """
    period = problem.signals.period_s
    clock = taken_for_filter(shifted_s)
    if not is_significant_latency(latency.seconds + clock, latency.std_s, period):
        return problem, point, latency
    raw = replace(problem.signals, force_n=force_n, latency_std_s=0.0)
    there, best, whole = _deepest_delay(replace(problem, signals=raw), point, latency.seconds)
    fits = [
        _fitted_filter(
            problem,
            raw,
            point,
            SensorDynamics(time_constant_s=latency.seconds + clock, delay_s=-clock - early * period),
        )
        for early in _EARLY_SAMPLES
    ]
    filtered, here, std, deepest = min(fits, key=lambda fit: fit[3])
    evidence = best - deepest
    if evidence < 0.0 and whole is None:
        return problem, point, replace(latency, evidence=evidence)
    if evidence < 0.0 and whole is not None:
        std = _FILTER_BETWEEN_SAMPLES * period
        signals = replace(raw, force_n=advance_in_time(force_n, whole), latency_std_s=std)
        late = WrenchLatency(
            seconds=whole * period, std_s=std, applied_s=whole * period, is_whole=True, evidence=evidence
        )
        return replace(problem, signals=signals), there, late
    dynamics = filtered.signals.sensor_dynamics
    late = WrenchLatency(
        seconds=dynamics.time_constant_s,
        std_s=std,
        applied_s=0.0,
        is_filter=True,
        evidence=evidence,
        advanced_s=-dynamics.delay_s,
    )
    return filtered, here, late


def _fitted_filter(
    problem: Problem, raw: Signals, point: Point, start: SensorDynamics
) -> tuple[Problem, Point, float, float]:
    """Return the problem with a low-pass, its minimum, the deviation of the time constant, and the depth.

    The side of a whole number of samples on which the robot's delay lies and the time constant move each other.
    """
    filtered, here, std = replace(problem, signals=replace(raw, sensor_dynamics=start)), point, 0.0
    for _ in range(_SIDES):
        filtered, here, std = fit_filter(filtered, here)
        here = _settled(filtered, here)
    return filtered, here, std, depth(filtered, here)


def _deepest_delay(problem: Problem, point: Point, latency_s: float) -> tuple[Point, float, int | None]:
    """Return the deepest fit with a delay, its depth, and how many whole samples it is, None for a part of one.

    A force that jumps with the held command keeps its jumps only where it is shifted by whole samples.
    """
    period = problem.signals.period_s
    sensor_dynamics = SensorDynamics(delay_s=latency_s)
    for _ in range(_DELAY_ROUNDS):
        problem = replace(problem, signals=replace(problem.signals, sensor_dynamics=sensor_dynamics, latency_std_s=0.0))
        step, std = latency_step(problem, point, (sensor_dynamics.delay_s, _VAGUE * latency_s), sensor_dynamics.delay_s)
        sensor_dynamics = SensorDynamics(delay_s=sensor_dynamics.delay_s + float(np.clip(step, -period, period)))
        if abs(step) < _SETTLED * std:
            break
    about = sensor_dynamics.delay_s / period
    wholes = sorted({int(np.floor(about)), int(np.ceil(about)), round(latency_s / period)})
    found = []
    for whole in (None, *(each for each in wholes if each > 0)):
        late = sensor_dynamics if whole is None else SensorDynamics(delay_s=whole * period)
        trial = replace(problem, signals=replace(problem.signals, sensor_dynamics=late))
        there = _settled(trial, point)
        found.append((depth(trial, there), there, whole))
    best, there, whole = min(found, key=lambda each: each[0])
    return there, best, whole


def _settled(problem: Problem, point: Point) -> Point:
    """Return the minimum, on the deeper side of a robot's delay of whole samples, where the command's steps are."""
    own = whitened_by_itself(problem, minimise(problem, point, _FILTER_STEPS)[0])
    return minimise(own, compare_delay_hypotheses(own, minimise(own, point, _FILTER_STEPS)[0])[0], _FILTER_STEPS)[0]


def fit_filter(problem: Problem, point: Point) -> tuple[Problem, Point, float]:
    """Fit the time constant of the problem's low-pass and all else; return its deviation [s], which is then doubted."""
    std = problem.signals.sensor_dynamics.time_constant_s
    for _ in range(_FILTER_ROUNDS):
        here = problem.signals.sensor_dynamics.time_constant_s
        step, std = latency_step(problem, point, (here, _VAGUE * here), here)
        there = float(np.clip(here + step, here / _LARGEST_FACTOR, here * _LARGEST_FACTOR))
        sensor_dynamics = replace(problem.signals.sensor_dynamics, time_constant_s=there)
        problem = replace(problem, signals=replace(problem.signals, sensor_dynamics=sensor_dynamics, latency_std_s=0.0))
        point, _ = minimise(problem, point, _FILTER_STEPS)
        if abs(there - here) < _SETTLED * std:
            break
    # Between its samples the force has the steps of the held command, which no cubic has.
    std = float(np.hypot(std, _FILTER_BETWEEN_SAMPLES * problem.signals.period_s))
    return replace(problem, signals=replace(problem.signals, latency_std_s=std)), point, std


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
    path, sensor_dynamics = problem.path(point.values), problem.signals.sensor_dynamics
    left: dict[bool, list[FloatArray]] = {False: [], True: []}
    for segment, nuisance in zip(problem.segments, point.nuisances, strict=True):
        predicted = predict_force(point.values, nuisance, segment, path, layout, signals.period_s)
        felt = sensor_dynamics.shown(predicted, path, segment.slice, float(point.values[1]), signals.period_s)
        error = felt - signals.force_n[segment.slice]
        # What the whitener has no past of shows nothing, and the payload's state at the beginning is free there.
        unseen = max(sensor_dynamics.unknown(signals.period_s), problem.noise(segment).order)
        left[segment.is_contact].append(error[unseen:])
    return left


def _fitted(left: Sequence[FloatArray], before: Whitener) -> Whitener:
    return fit_whitener(left) if left else before


def find_wrench_filter(
    latencies: Mapping[str, WrenchLatency], shifted_s: float, period_s: float
) -> tuple[WrenchFilterEstimate | None, tuple[Finding, ...]]:
    """Return the low-pass or the delay that the axes show, None where the wrench is not late by what matters.

    `latencies` are those of the fits by axis, after `shifted_s` was taken off the wrench's stamps. Where axes show
    different kinds, the one with more evidence counts; where they show different sizes, the latest one. What a wrench
    is early by is a clock's, not a filter's, and left out.
    """
    clock = taken_for_filter(shifted_s)
    whole = {
        n: latency if latency.is_filter else replace(latency, seconds=latency.seconds + clock)
        for n, latency in latencies.items()
    }
    late = {
        name: latency
        for name, latency in whole.items()
        # A filter was one when it was taken in; that it is known badly since takes it out of no loop.
        if latency.is_filter or is_significant_latency(latency.seconds, latency.std_s, period_s)
    }
    if not late:
        return None, ()
    evidence = sum(latency.evidence or 0.0 for latency in late.values())
    is_filter = evidence > 0.0 or all(latency.is_filter for latency in late.values())
    alike = {name: latency for name, latency in late.items() if latency.is_filter == is_filter} or late
    seconds, std, why = _together(alike)
    if abs(evidence) < DECIDED:
        why = f"a {'delay' if is_filter else 'low-pass'} explains it nearly as well"
    elif not is_filter and any(latency.is_doubtful for latency in alike.values()):
        why = "nothing explains all of the force, so it may be a low-pass"
    if is_filter:
        corner = 1.0 / (2.0 * np.pi * seconds)
        estimate = judged(
            corner, corner * std / seconds, method=_METHOD, identified=_IDENTIFIED_SHARE, weak=_WEAK_SHARE
        )
        found = WrenchFilterEstimate(corner_hz=weak_at_best(estimate, why) if why else estimate)
        described = f"passes a first-order low-pass of {corner:.3g} ± {corner * std / seconds:.2g} Hz"
    else:
        is_sharp = std < _IDENTIFIED_SAMPLES * period_s
        status = Status.IDENTIFIED if is_sharp and not why else Status.WEAK
        found = WrenchFilterEstimate(delay_s=Estimate(value=seconds, std=std, status=status, method=_METHOD, note=why))
        described = f"comes {1e3 * seconds:.3f} ± {1e3 * std:.2g} ms late"
    message = f"The wrench {described} (axis {', '.join(alike)}){f': {why}' if why else ''}. It is in the loop, and in "
    is_known = not why and Status.IDENTIFIED in {each.status for each in (found.corner_hz, found.delay_s) if each}
    about = Finding.info if is_known else Finding.warning
    return found, (about("wrench-filter", f"{message}`sensor.wrench_filter`.", ""),)


def _together(alike: Mapping[str, WrenchLatency]) -> tuple[float, float, str]:
    """Return mean and deviation of what the axes show, the largest where they disagree, and why it is weak then."""
    values = np.array([latency.seconds for latency in alike.values()])
    stds = np.array([latency.std_s for latency in alike.values()])
    weights = stds**-2.0
    mean = float(weights @ values / np.sum(weights))
    apart = float(np.max(values) - np.min(values))
    if apart > max(_APART_STDS * float(np.max(stds)), _APART_SHARE * mean):
        return float(np.max(values)), apart, "the axes disagree; the latest counts"
    squares = float(np.sum(weights * (values - mean) ** 2)) / max(len(values) - 1, 1)
    return mean, float(np.min(stds)) * max(1.0, float(np.sqrt(squares))), ""
