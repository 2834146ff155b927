"""Covariance, competing minima and profile-likelihood intervals of the joint fit."""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from problems.arrays import FloatArray

from ..verdicts import TWO_SIDED
from .latency import CompetingMinimum
from .solve import Block, Point, Problem, Summary, cost, information, linearise, minimise, sizes_of

_STEPS = 4
_DEEPER = 1.0
_KNOWN_SHARE, _OTHER_STIFFNESSES, _STEPS_FAR = 0.02, (0.15, 0.4, 2.5), 12
_OTHER_MASS_SHARE = 0.3
_WHOLE_S = 1e4
_PIECES_S = (0.1, 0.5, _WHOLE_S)
_DOUBTFUL_STDS = 20.0
_SMOOTH_SHARE, EXACT_SHARE = 0.003, 0.0003
_RESTING_SHARE, _MOVING_SHARE = 0.003, 0.02
_UNKNOWN_SHARE = 0.25
SHARPEST_DELAY_SAMPLES = 1e-3
# What swings on a payload, before anything is known of it: hardly more than a tenth of its mass, at up to 120 Hz.
UNSEEN_SHARE, HIGHEST_PART_HZ = 0.05, 120.0
_SWING_STIFFNESS_SHARE, _SWING_DAMPING_SHARE = 0.02, 0.1
_FREE_MISFITS, _CONTACT_MISFITS = 40, 10
# Where the profile over K_s is looked at, up to fifteen times softer and stiffer, and from which rise on it ends.
_APART, _PLACES, _RUN_OUT = 1.4, 8, 25.0
_LEVEL = 3.841  # the 95 % quantile of χ² with one degree of freedom
_PROFILE_STEPS = 3
_TRIES = 3


def deepest_stiffness(problem: Problem, point: Point) -> Point:
    """Return the deepest minimum over K_s, where it is not known to 2 %: a spring that hardly gives has several."""
    matrix, _ = information(linearise(problem, point), len(problem.layout))
    scale = 1.0 / np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    inverse = np.linalg.pinv(matrix * np.outer(scale, scale), hermitian=True) * np.outer(scale, scale)
    if inverse[0, 0] < _KNOWN_SHARE**2:
        return point
    best, here = point, cost(problem, point)
    for factor in _OTHER_STIFFNESSES:
        values = point.values.copy()
        values[0] *= factor
        values[1] *= min(factor, 1.0)
        other, there = minimise(problem, replace(point, values=values), _STEPS_FAR)
        if there < here - _DEEPER:
            best, here = other, there
    return best


def deepest_surfaces(problem: Problem, point: Point) -> tuple[Problem, Point]:
    """Return the point from which no other minimum of a surface (see `other_minima`) is deeper, all fitted again."""
    for i in range(problem.layout.surfaces):
        forces = forces_only(problem, point)
        here = cost(forces, point)
        for other, there in other_surfaces(forces, point, problem.layout.surface(i).start + 2):
            if there < here - _DEEPER:
                here, point = there, minimise(problem, other, _STEPS)[0]
    return problem, point


def forces_only(problem: Problem, point: Point) -> Problem:
    """Return the problem with the robot as it is at a point."""
    robot = tuple(range(problem.layout.robot.start, problem.layout.robot.stop))
    return replace(problem, pose_spans=(), fixed=robot, known_path=problem.path(point.values))


def other_surfaces(problem: Problem, point: Point, mass: int) -> list[tuple[Point, float]]:
    """Return minima beside this one and their depths: a surface, known by its M_e's index, without mass or with."""
    found = []
    if point.values[mass] > 0.0:
        massless = point.values.copy()
        massless[mass] = 0.0
        start = Point(values=massless, nuisances=point.nuisances)
        found.append(minimise(replace(problem, fixed=(*problem.fixed, mass)), start, _STEPS))
    heavy = point.values.copy()
    heavy[mass] = _OTHER_MASS_SHARE * point.values[3]
    heavy[mass - 1] = min(heavy[mass - 1], 0.05 * float(np.sqrt(heavy[mass - 2] * point.values[3])))
    found.append(minimise(problem, Point(values=heavy, nuisances=point.nuisances), _STEPS))
    return found


@dataclass(frozen=True, kw_only=True)
class Spread:
    """`covariance` (p, p) in scaled parameters; `plain` is the one that only noise makes; `widening` on a deviation."""

    covariance: FloatArray
    plain: FloatArray
    widening: float


def widened(blocks: Sequence[Block], count: int, period_s: float) -> Spread:
    """Return H⁻¹, H = JᵀJ of the whitened residuals, made larger where the scores Jᵀr scatter more than H says.

    Were the residuals white noise, the scores of pieces of 0.1 s, of 0.5 s and of whole spans would scatter by H.
    Directions in which they scatter by λ > (1 + √(p/n))², the largest that chance makes of n pieces and p parameters
    (Marchenko and Pastur 1967), have their variance multiplied by λ: a misfit that is no noise counts as n
    independent ones.
    """
    matrix, _ = information(blocks, count)
    scale = 1.0 / np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    values, vectors = np.linalg.eigh(matrix * np.outer(scale, scale))
    # What nothing shows gets a variance that no verdict can overlook.
    root = vectors / np.sqrt(np.maximum(values, 1e-12))
    factor = np.eye(count)
    for length_s in _PIECES_S:
        length = max(1, round(length_s / period_s))
        scores = np.concatenate([_scores(block, count, length) for block in blocks])
        factor = factor + _excess(scores * scale @ root)
    inner = root @ factor @ root.T * np.outer(scale, scale)
    inner += _systematic_errors(blocks, root @ root.T * np.outer(scale, scale), count)
    plain = root @ root.T * np.outer(scale, scale)
    widening = float(np.sqrt(np.max(np.diag(inner) / np.diag(plain))))
    return Spread(covariance=inner, plain=plain, widening=widening)


def _systematic_errors(blocks: Sequence[Block], covariance: FloatArray, count: int) -> FloatArray:
    """Return Σ δ δᵀ, δ the shift of all parameters by each force that the model may lack (`Block.systematic`)."""
    known = [b for b in blocks if b.systematic is not None]
    shift = np.zeros((count, max((b.systematic.shape[1] for b in known if b.systematic is not None), default=0)))
    for block in known:
        if block.systematic is not None:
            shift[block.indices] += block.jacobian.T @ block.systematic
    moved = covariance @ shift
    return np.asarray(moved @ moved.T)


def _scores(block: Block, count: int, length: int) -> FloatArray:
    """Return the score of every piece of a span, (pieces, p)."""
    terms = block.jacobian * block.residual[:, None]
    starts = np.arange(0, max(len(terms) - length // 2, 1), length)
    out = np.zeros((len(starts), count))
    out[:, block.indices] = np.add.reduceat(terms, starts, axis=0)
    return out


def _excess(scores: FloatArray) -> FloatArray:
    """Return Σ (λ − 1) v vᵀ over the directions in which standardised scores scatter beyond chance."""
    used = scores[np.any(scores != 0.0, axis=1)]
    if len(used) < 2:
        return np.zeros((scores.shape[1], scores.shape[1]))
    values, vectors = np.linalg.eigh(used.T @ used)
    limit = (1.0 + np.sqrt(scores.shape[1] / len(used))) ** 2
    return np.asarray((vectors * np.where(values > limit, values - 1.0, 0.0)) @ vectors.T)


def along_stiffness(problem: Problem, point: Point, blocks: Sequence[Block], spread: Spread) -> Spread:
    """Return the covariance by the profile likelihood over K_s, where its curvature does not know K_s to 2 %.

    A spring that hardly gives has many minima with little between them, each as sharp as if it were the only one. The
    second moments of log K_s, and of what moves with it, are those of e^(−Δ/2), Δ being the rise of −2 log L with all
    other parameters fitted again; beside them stays what all are uncertain by at one K_s. Of two such covariances the
    one with the larger deviation of K_s counts.
    """
    local = spread.covariance
    if local[0, 0] < _KNOWN_SHARE**2:
        return spread
    part, start = _part(problem, point, blocks, 0)
    sizes = sizes_of(point.values, problem.layout, problem.signals.period_s)
    floor, level = cost(part, start), float(local[0, 0] / spread.plain[0, 0])
    held, moves, rises = replace(part, fixed=(*part.fixed, 0)), [np.zeros(len(sizes))], [0.0]
    for way in (1, -1):
        at = start
        for place in range(1, _PLACES + 1):
            values = at.values.copy()
            values[0] = start.values[0] * _APART ** (way * place)
            at, there = minimise(held, replace(at, values=values), _PROFILE_STEPS)
            moves.append((at.values - point.values) / sizes)
            moves[-1][0] = way * place * np.log(_APART)
            rises.append((there - floor) / level)
            if not rises[-1] < _RUN_OUT:
                break
    shares = np.exp(-0.5 * (np.array(rises) - min(rises)))
    profile = np.einsum("k,ki,kj->ij", shares / np.sum(shares), np.array(moves), np.array(moves))
    if profile[0, 0] <= local[0, 0]:
        return spread
    covariance = local - np.outer(local[0], local[0]) / local[0, 0] + profile
    widening = float(np.sqrt(np.max(np.diag(covariance) / np.diag(spread.plain))))
    return replace(spread, covariance=covariance, widening=widening)


def other_minima(problem: Problem, point: Point, spread: Spread) -> Spread:
    """Return the covariance with what a second minimum adds: the same surface without a moving mass, or with one.

    Mass, damping and stiffness of a surface trade against each other along a bent valley, which may hold two minima
    of nearly the same depth. One that is worse by Δ in −2 log L has the share w = e^(−Δ/2)/(1 + e^(−Δ/2)) of the
    likelihood, and adds w δ δᵀ, δ from one minimum to the other, to the second moments.
    """
    layout = problem.layout
    forces = forces_only(problem, point)
    here = cost(forces, point)
    sizes = sizes_of(point.values, layout, problem.signals.period_s)
    covariance = spread.covariance.copy()
    for i in range(layout.surfaces):
        mass = layout.surface(i).start + 2
        deviation = float(np.sqrt(spread.covariance[mass, mass])) * sizes[mass]
        if point.values[mass] > _DOUBTFUL_STDS * deviation:
            continue
        for other, there in other_surfaces(forces, point, mass):
            share = float(np.exp(-0.5 * np.clip(there - here, -200.0, 200.0)))
            apart = (other.values - point.values) / sizes
            covariance += share / (1.0 + share) * np.outer(apart, apart)
    covariance += np.diag(_linear_no_more(problem, point, covariance, sizes))
    widening = float(np.sqrt(np.max(np.diag(covariance) / np.diag(spread.plain))))
    return Spread(covariance=covariance, plain=spread.plain, widening=widening)


def _linear_no_more(problem: Problem, point: Point, covariance: FloatArray, sizes: FloatArray) -> FloatArray:
    """Return variances for what no linear theory covers, in scaled parameters.

    Of K_s, B_p, M_p, ω and ζ 0.03 %, which no sensor's scale is better than; without a command 0.3 % of the first
    three, for a path that is smooth between the ticks only by assumption; of K_e 0.3 % and of M_e 2 %. Where
    K_s or M_p is not known to a quarter, what lies behind them is not known at all: B_e to the critical damping, M_e
    to the payload's mass. An environment that may still swing when it is touched again is not the one at rest of the
    model: the share of the swing that is left counts as a share of B_e's critical damping, M_e and K_e.
    """
    share = np.zeros(len(point.values))
    share[[0, 2, 3]] = EXACT_SHARE if problem.layout.robot_order else _SMOOTH_SHARE
    share[problem.layout.robot.start : problem.layout.robot.stop - 1] = EXACT_SHARE
    out = (share * point.values / sizes) ** 2
    unknown = max(covariance[0, 0], covariance[3, 3]) > _UNKNOWN_SHARE**2
    for i in range(problem.layout.surfaces):
        first = problem.layout.surface(i).start
        k_e, b_e, m_e = (float(v) for v in point.values[first : first + 3])
        left = _swing_left(problem, i, b_e, m_e)
        critical, mass = 2.0 * np.sqrt(k_e * point.values[3]), point.values[3]
        out[first] = (_SWING_STIFFNESS_SHARE * left) ** 2 + _RESTING_SHARE**2
        out[first + 1] = ((1.0 if unknown else _SWING_DAMPING_SHARE * left) * critical / sizes[first + 1]) ** 2
        out[first + 2] = ((mass if unknown else (left + _MOVING_SHARE) * m_e) / sizes[first + 2]) ** 2
    return out


def _swing_left(problem: Problem, surface: int, damping: float, mass: float) -> float:
    """Return the largest share of a swing, e^(−B_e t/(2 M_e)), that is left after the pauses t between contacts."""
    mine = sorted((s.start, s.stop) for s in problem.segments if s.surface == surface)
    pauses = [later[0] - earlier[1] for earlier, later in itertools.pairwise(mine)]
    if mass <= 0.0 or not pauses:
        return 0.0
    return float(np.exp(-0.5 * damping / mass * max(min(pauses), 0) * problem.signals.period_s))


def with_competing_minimum(
    problem: Problem, point: Point, spread: Spread, competing: CompetingMinimum | None, *, blurred: bool
) -> Spread:
    """Return the covariance with what a competing minimum adds, as in `other_minima`.

    A delay is known to 0.001 samples at best. At a step of the command beside a tick the force jumps, of which a
    derivative knows nothing. A command that is `blurred` over every sample costs ω h²/8 of the delay and, of ω, half of
    what that is of its own time constant.
    """
    covariance = spread.covariance.copy()
    if problem.layout.robot_order:
        first, last = problem.layout.robot.start, problem.layout.robot.stop - 1
        turned = float(point.values[first]) * problem.signals.period_s / 8.0 if blurred else 0.0
        # The delay's unit is the period, that of ω is itself.
        covariance[last, last] += SHARPEST_DELAY_SAMPLES**2 + turned**2
        covariance[first, first] += (0.5 * turned * float(point.values[first]) * problem.signals.period_s) ** 2
    if competing is not None:
        apart = competing.point.values - point.values
        apart = apart / sizes_of(point.values, problem.layout, problem.signals.period_s)
        covariance += competing.share * np.outer(apart, apart)
    return replace(spread, covariance=covariance)


def count_misfits(problem: Problem, spread: Spread, noise_ratio: tuple[float, float]) -> Spread:
    """Return the covariance with what exceeds the noise counted as a few misfits, 40 in free motion, 10 a contact.

    `noise_ratio` are residual RMS over the force's noise at rest, in free motion and in contact. N samples whose mean
    square exceeds 1 by e, beyond chance (four deviations, √(2/N) each), multiply variances by 1 + e N/(misfits):
    those of the surfaces by what contacts have more than free motion, and all by what free motion has; that only
    where no pose noise comes in, which makes the residual larger without a misfit.
    """
    counts = [sum(len(s) for s in problem.segments if s.is_contact == kind) for kind in (False, True)]
    free, contact = noise_ratio[0] ** 2, noise_ratio[1] ** 2 / max(noise_ratio[0] ** 2, 1.0)
    contacts = sum(s.is_contact for s in problem.segments)
    factor = np.ones(len(problem.layout))
    if problem.layout.robot_order and problem.signals.smoother.taps is None:
        factor *= _factor(free, counts[0], _FREE_MISFITS)
    factor[problem.layout.robot.stop :] *= _factor(contact, counts[1], _CONTACT_MISFITS * contacts)
    covariance = spread.covariance * np.outer(factor, factor)
    return replace(spread, covariance=covariance, widening=spread.widening * float(np.max(factor)))


def _factor(mean_square: float, count: int, misfits: int) -> float:
    if count == 0:
        return 1.0
    excess = max(mean_square - 1.0 - 4.0 * float(np.sqrt(2.0 / count)), 0.0)
    return float(np.sqrt(1.0 + excess * count / misfits))


def bounded_intervals(
    problem: Problem, point: Point, blocks: Sequence[Block], spread: Spread
) -> dict[str, tuple[float, float]]:
    """Return 95 % intervals by name of the dampings and masses that lie within 1.96 deviations of 0.

    The profile of −2 log L over the parameter, all others fitted again, is compared with the 95 % quantile of χ²(1),
    times the square of what `widened` did to the deviation. For a surface only its own contacts are computed again;
    what all other spans say is their quadratic form.
    """
    layout = problem.layout
    sizes = sizes_of(point.values, layout, problem.signals.period_s)
    linear = [1, 2] + [layout.surface(i).start + k for i in range(layout.surfaces) for k in (1, 2)]
    out = {}
    for index in linear:
        std = float(np.sqrt(spread.covariance[index, index])) * float(sizes[index])
        if point.values[index] > TWO_SIDED * std:
            continue
        part, start = _part(problem, point, blocks, index)
        level = _LEVEL * float(spread.covariance[index, index] / spread.plain[index, index])
        floor = cost(part, start)
        upper = _crossing(part, start, index, float(point.values[index]) + TWO_SIDED * std, level, floor)
        at_zero = _profiled(part, start, index, 0.0) - floor
        lower = 0.0
        if at_zero > level:
            lower = float(point.values[index]) * (1.0 - float(np.sqrt(level / at_zero)))
        out[layout.names[index]] = (lower, max(upper, float(point.values[index])))
    return out


def _part(problem: Problem, point: Point, blocks: Sequence[Block], index: int) -> tuple[Problem, Point]:
    """Return the spans that are computed again, the others being summed up."""
    layout, first = problem.layout, problem.layout.robot.stop
    surface = (index - first) // 3 if index >= first else None
    kept = [i for i, s in enumerate(problem.segments) if surface is None or s.surface == surface]
    matrix, _ = information([b for i, b in enumerate(blocks) if i not in kept], len(layout))
    values, vectors = np.linalg.eigh(matrix)
    summary = Summary(root=(vectors * np.sqrt(np.maximum(values, 0.0))).T, values=point.values)
    part = replace(
        problem,
        segments=tuple(problem.segments[i] for i in kept),
        pose_spans=(),
        priors=(),
        fixed=tuple(range(layout.robot.start, layout.robot.stop)),
        known_path=problem.path(point.values),
        summary=summary,
    )
    return part, Point(values=point.values, nuisances=tuple(point.nuisances[i] for i in kept))


def _profiled(part: Problem, start: Point, index: int, value: float) -> float:
    values = start.values.copy()
    values[index] = value
    held = replace(part, fixed=(*part.fixed, index))
    return minimise(held, Point(values=values, nuisances=start.nuisances), _PROFILE_STEPS)[1]


def _crossing(part: Problem, start: Point, index: int, guess: float, level: float, floor: float) -> float:
    """Return where the profile passes the level above the estimate: √Δ is nearly a straight line."""
    here, at = float(start.values[index]), guess
    for _ in range(_TRIES):
        rise = _profiled(part, start, index, at) - floor
        if rise <= 0.0 or not np.isfinite(rise):
            return float(np.inf)
        share = float(np.sqrt(level / rise))
        if abs(share - 1.0) < 0.05:
            break
        at = here + (at - here) * float(np.clip(share, 0.3, 3.0))
    return at
