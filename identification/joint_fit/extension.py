"""Whether a payload has a part that swings, or its coupling dry friction, and what that changes of the joint fit."""

from dataclasses import dataclass, replace

import numpy as np

from problems.arrays import FloatArray

from ..verdicts import TWO_SIDED, WEAK_SHARE
from .covariance import EXACT_SHARE, HIGHEST_PART_HZ, SHARPEST_DELAY_SAMPLES, UNSEEN_SHARE, widened
from .extended_fit import (
    MOST_RATIO,
    MOST_SHARE,
    ExtendedProblem,
    PayloadFit,
    PayloadKind,
    Score,
    beginning,
    beyond_noise,
    descended,
    explains_misfit,
    gained,
    linearised,
    mean_square,
    scorer,
    unexplained,
    with_more,
    with_own_noise,
)
from .latency import WrenchLatency
from .model import COUPLING_NAMES, robot_model
from .noise import Whitener
from .result import JointFit, JointSurface, PayloadPart, secant_of
from .solve import Block, Point, Problem

_FREQUENCIES, _LOWEST_HZ, _HIGHEST_SHARE = 24, 6.0, 0.4
_STARTS_HZ = (15.0, 22.0, 30.0, 38.0, 46.0, 55.0, 70.0)
_START_SHARE, _START_RATIO, _START_FRICTION_N, _NUDGE, _NUDGE_N = 0.08, 0.03, 0.3, 1e-3, 0.02
_STEPS, _TRIED = 15, 2
# Every start goes a few steps down, and the lowest of them all the way.
_FIRST_STEPS, _FOLLOWED = 3, 2
# −2 log L: a first look, what is kept open, and what is reported.
_WORTH_A_LOOK, _OPEN, _TOLD = 8.0, 30.0, 60.0
# The −2 log L that shows a part behind a held command where one mass leaves no more than the noise at rest may be.
_CLEAR = 200.0
# Of what a part moves, and of what friction does, whose law is not known, how well the move is known at best.
_MOVED_BY_PART, _MOVED_BY_FRICTION = 0.1, 0.8
# How well share, frequency, damping ratio and F_c are known at best: as far off they were in simulated cells, the path
# between the samples and the law of friction not being those of the fit.
_SHARE_KNOWN, _FREQUENCY_KNOWN, _RATIO_KNOWN, _FRICTION_KNOWN = 0.25, 0.03, 0.02, 0.2
_LEAST_SHARE, _AT_BOUND = 0.005, 0.98
# Of the misfit's mean square beyond the noise, what a payload that explains it leaves at most.
_LEFT_OPEN = 0.25
# A surface that follows the coupling keeps a tenth of its values at least.
_LEAST_LEFT = 0.1
_LATENCY_STDS, _LEAST_LATENCY, _FILTER_SHARE = 3.0, 0.1, 0.5


@dataclass(frozen=True, kw_only=True)
class Extended:
    """By how much a wider payload moves coupling and robot, (a,), and what their covariance (a, a) gains [SI].

    `move` is 0 where nothing is reported; `part` and `friction_n`, value and deviation, are what is, `latency` is the
    wrench's beside them. Where it `explains` the misfit, that covariance takes the place of the joint fit's. `is_wider`
    is False where one mass on one spring is enough. `unseen` (a,) is what a part may move that the log cannot show.
    `left_n` is the RMS that free motion leaves of the force beside what is reported.
    """

    move: FloatArray
    covariance: FloatArray
    latency: WrenchLatency
    unseen: FloatArray
    left_n: float
    is_wider: bool
    explains: bool = False
    part: PayloadPart | None = None
    friction_n: tuple[float, float] | None = None


def extend_payload(
    problem: Problem, point: Point, latency: WrenchLatency, *, quiet_rms_n: float, is_held: bool
) -> Extended:
    """Return what a part that swings, and dry friction in the coupling, change of a joint fit.

    Each is fitted to free motion beside everything else. Reported is what −2 log L prefers by 60 under the noise that
    it leaves, and only a part of less than three tenths of the mass and 15 % of critical damping, since a wider one
    may be anything. From 30 on, and where the part is none, the values stay, and hold the move in their deviations.
    What explains less than a quarter of the misfit beyond `quiet_rms_n` is no part. Where no command `is_held`, that,
    and what explains no more than the path within a sample may do, leaves the deviations, too: it is another misfit.
    Where no part is reported, the deviations hold one that the log cannot show (`unseen_by_log`).
    """
    period = problem.signals.period_s
    # What was taken for a latency may be the part's, or friction's.
    lag_s = max(_LATENCY_STDS * latency.std_s, abs(latency.applied_s))
    lag_s = _FILTER_SHARE * latency.seconds if latency.is_filter else lag_s
    of = ExtendedProblem(
        problem=problem,
        point=point,
        latency_std_samples=max(lag_s / period, _LEAST_LATENCY),
        quiet_rms_n=quiet_rms_n,
        is_held=is_held,
    )
    begun = here = beginning(of)
    moves, lags_s = _moved_by_yielding(of, begun), list[float]()
    rubbing = _friction(of, here)
    if rubbing is not None:
        share = _open_share(of, rubbing, begun, _MOVED_BY_FRICTION)
        moves.append(share * _moved(of, rubbing, begun))
        lags_s.append(share * _later_s(of, rubbing, begun))
        here = rubbing
    looks = _looks(of, here)
    unseen = unseen_by_log(of, here, looks)
    swinging, gain = _part(of, here, looks)
    if swinging is not None:
        # A shifted force is not exact between its samples, which looks like a part.
        is_clear = is_held and latency.applied_s == 0.0 and gain >= _CLEAR and beyond_noise(of, here) == 0.0
        is_needed = is_clear or explains_misfit(of, swinging, here)
        is_part = gain >= _TOLD and not _is_at_bound(of, swinging) and is_needed
        share = 1.0
        if is_part and rubbing is None:
            share = _open_share(of, swinging, here, _MOVED_BY_PART)
        elif rubbing is not None:
            # What friction leaves has no law either: a part counts by what it explains of that.
            share = float(np.sqrt(max(1.0 - unexplained(of, swinging, here), 0.0)))
        moves.append(share * _moved(of, swinging, here))
        lags_s.append(share * _later_s(of, swinging, here))
        here = swinging if is_part else here
    unseen = np.zeros(of.shared) if here.kind.part else unseen
    open_s = float(np.linalg.norm(lags_s)) if latency.is_filter else 0.0
    found = _extended(of, here, moves, replace(latency, std_s=float(np.hypot(latency.std_s, open_s))))
    found = replace(found, unseen=unseen, left_n=mean_square(of, here) ** 0.5, is_wider=bool(moves))
    # A filter that a driver computes leaves something, too, of which a part may explain most: none explains a filter.
    is_one = here.kind.part != here.kind.friction and (here.kind.friction or not latency.is_filter)
    return replace(found, explains=is_one and unexplained(of, here, begun) < _LEFT_OPEN)


def _moved_by_yielding(of: ExtendedProblem, begun: PayloadFit) -> list[FloatArray]:
    """Return what one deviation of how far the robot gives way moves, nothing where it does not."""
    signals, moves = of.problem.signals, []
    for std in signals.yielded_stds:
        further = replace(signals, yielded=std if signals.yielded is None else signals.yielded + std)
        other = replace(of, problem=replace(of.problem, signals=further))
        moves.append(_moved(of, beginning(other), begun))
    return moves


def _friction(of: ExtendedProblem, at: PayloadFit) -> PayloadFit | None:
    """Return the fit with dry friction, None where that is not clearly better."""
    kind, score = PayloadKind(friction=True), scorer(of, at)
    if score(with_more(of, at, kind, (0.0,)), with_more(of, at, kind, (_NUDGE_N,))).fall < _WORTH_A_LOOK:
        return None
    found = with_own_noise(of, descended(of, with_more(of, at, kind, (_START_FRICTION_N,)), _STEPS))
    # Less than the noise does not show in any one motion: it is what the path leaves.
    is_seen = found.theta[-1] > of.quiet_rms_n and (of.is_held or explains_misfit(of, found, at))
    return found if is_seen and gained(of, found, at) >= _TOLD else None


def _looks(of: ExtendedProblem, at: PayloadFit) -> list[tuple[Score, float]]:
    """Return what a thousandth of the mass that swings does to first order, with its frequency [Hz], for each."""
    kind, score = replace(at.kind, part=True), scorer(of, at)
    highest = min(HIGHEST_PART_HZ, _HIGHEST_SHARE / of.problem.signals.period_s)
    frequencies = np.geomspace(_LOWEST_HZ, highest, _FREQUENCIES).tolist()
    return [(score(*(_begun(of, at, kind, share, f) for share in (0.0, _NUDGE))), f) for f in frequencies]


def _begun(of: ExtendedProblem, at: PayloadFit, kind: PayloadKind, share: float, frequency_hz: float) -> PayloadFit:
    return with_more(of, at, kind, (share, float(np.log(frequency_hz)), _START_RATIO))


def unseen_by_log(of: ExtendedProblem, at: PayloadFit, looks: list[tuple[Score, float]]) -> FloatArray:
    """Return by how much a part that the log cannot show may move the shared parameters (a,) [SI], one deviation.

    Below its own frequency ω_2 a share μ of the mass gives way as the spring does: K_s looks softer by μ ω_0²/ω_2². Of
    each frequency the share is known as the log shows it, and 0 ± 5 % beforehand, which makes its mean and deviation.
    The frequency counts that moves K_s most, of those above ω_0: what swings slower than the payload itself is loose.
    """
    values = of.values(at.theta)
    units, own_hz = np.where(of.in_log, values, of.sizes), float(np.sqrt(values[0] / values[3])) / (2.0 * np.pi)
    moves = []
    for score in (each for each, frequency_hz in looks if frequency_hz >= min(own_hz, looks[-1][1])):
        beforehand = 1.0 / (1.0 + (score.std * _NUDGE / UNSEEN_SHARE) ** 2)
        mean, std = score.way * beforehand, score.std * beforehand**0.5
        moves.append(float(np.hypot(mean, std)) * score.follows[: of.shared] * units)
    return max(moves, key=lambda move: abs(float(move[0])))


def _part(
    of: ExtendedProblem, at: PayloadFit, found_by_score: list[tuple[Score, float]]
) -> tuple[PayloadFit | None, float]:
    """Return the best fit with a part and by how much it is better, None where that is not worth a look.

    Both under the noise that one mass leaves, coloured by what it does not explain, and under white noise; each begins
    at several frequencies. One inside its bounds goes before one at them.
    """
    kind = replace(at.kind, part=True)
    looks = sorted(found_by_score, key=lambda each: (each[0].fall, each[0].way, each[1]), reverse=True)
    # Beside friction what is left is no noise, and a first order says little.
    if looks[0][0].fall < _WORTH_A_LOOK and not at.kind.friction:
        return None, 0.0
    shares = [(float(np.clip(_NUDGE * score.way, 0.01, 0.15)), f) for score, f in looks[:_TRIED]]
    shares += [(_START_SHARE, f) for f in _STARTS_HZ if f < max(f for _, f in looks)]
    starts = [_begun(of, at, kind, share, f) for share, f in shares]
    rms = float(np.std(np.concatenate(of.errors(at.theta, at.own, at.kind))))
    found = []
    for noise in (at.noise, Whitener(coefficients=np.ones(1), rms=rms)):
        begun = [descended(of, replace(start, noise=noise), _FIRST_STEPS) for start in starts]
        lowest = sorted(begun, key=lambda end: end.cost)[:_FOLLOWED]
        ends = [descended(of, end, _STEPS - _FIRST_STEPS) for end in lowest]
        best = with_own_noise(of, min(ends, key=lambda end: end.cost))
        if of.is_held or explains_misfit(of, best, at):
            found.append((gained(of, best, at), best))
    if not found:
        return None, 0.0
    inside = [each for each in found if each[0] >= _TOLD and not _is_at_bound(of, each[1])]
    gain, best = max(inside or found, key=lambda each: each[0])
    return (best, gain) if gain >= _OPEN else (None, gain)


def _open_share(of: ExtendedProblem, more: PayloadFit, less: PayloadFit, least: float) -> float:
    """Return how much of a move is not known: by the part of the misfit's RMS that stays, and `least` at least."""
    return float(np.clip(np.sqrt(unexplained(of, more, less)), least, 1.0))


def _is_at_bound(of: ExtendedProblem, candidate: PayloadFit) -> bool:
    """Whether what swings is so light, so heavy, or damped so much, that it is no part; behind a filter, so little.

    What a driver's filter does between the samples looks like a part without any damping.
    """
    found = of.extension(candidate.theta, candidate.kind)
    is_light = found.mass_share < _LEAST_SHARE or (of.lags == 2 and found.damping_ratio == 0.0)
    return is_light or found.mass_share > _AT_BOUND * MOST_SHARE or found.damping_ratio > _AT_BOUND * MOST_RATIO


def _moved(of: ExtendedProblem, to: PayloadFit, since: PayloadFit) -> FloatArray:
    """Return by how much the shared parameters (a,) move from one fit to another [SI]."""
    return of.values(to.theta) - of.values(since.theta)


def _later_s(of: ExtendedProblem, to: PayloadFit, since: PayloadFit) -> float:
    """Return by how much the wrench's latency or time constant grows from one fit to another [s]."""
    return of.problem.signals.period_s * float(to.theta[of.shared] - since.theta[of.shared])


def _extended(of: ExtendedProblem, here: PayloadFit, moves: list[FloatArray], latency: WrenchLatency) -> Extended:
    covariance = sum((np.outer(move, move) for move in moves), np.zeros((of.shared, of.shared)))
    if here.kind == PayloadKind():
        none = np.zeros(of.shared)
        return Extended(move=none, covariance=covariance, latency=latency, unseen=none, left_n=0.0, is_wider=False)
    spread = _spread(of, here)
    stds, first = np.sqrt(np.diag(spread)), of.shared + of.lags
    units = np.where(of.in_log, of.values(here.theta), of.sizes)
    found, part = of.extension(here.theta, here.kind), None
    if here.kind.part:
        part = PayloadPart(
            mass_share=(found.mass_share, float(np.hypot(stds[first], _SHARE_KNOWN * found.mass_share))),
            frequency_hz=(found.frequency_hz, found.frequency_hz * float(np.hypot(stds[first + 1], _FREQUENCY_KNOWN))),
            damping_ratio=(found.damping_ratio, float(np.hypot(stds[first + 2], _RATIO_KNOWN))),
        )
    return Extended(
        move=of.values(here.theta) - of.point.values[: of.shared],
        covariance=covariance + spread[: of.shared, : of.shared] * np.outer(units, units) + np.diag(_least(of) ** 2),
        latency=_latency(of, here, latency, float(stds[of.shared])),
        unseen=np.zeros(of.shared),
        left_n=0.0,
        is_wider=True,
        part=part,
        friction_n=(found.friction_n, float(np.hypot(stds[-1], _FRICTION_KNOWN * found.friction_n)))
        if here.kind.friction
        else None,
    )


def _least(of: ExtendedProblem) -> FloatArray:
    """Return the deviations (a,) below which nothing is known, however much the log holds [SI]."""
    least = EXACT_SHARE * of.point.values[: of.shared]
    if of.shared > len(COUPLING_NAMES):
        least[-1] = SHARPEST_DELAY_SAMPLES * of.problem.signals.period_s
    return least


def _spread(of: ExtendedProblem, at: PayloadFit) -> FloatArray:
    """Return the covariance of θ (p, p), wider where the scores of pieces scatter: see `widened`.

    What is left beyond the noise at rest multiplies it, as χ² by its degrees of freedom: that has a law of its own.
    """
    rows, known = linearised(of, at).rows, of.prior(len(at.theta))[0]
    values, vectors = np.linalg.eigh(known)
    prior = (vectors * np.sqrt(np.maximum(values, 0.0))).T
    indices = np.arange(len(at.theta))
    blocks = [Block(residual=row[:, 0], jacobian=row[:, 1:], indices=indices, own=None) for row in rows]
    blocks.append(Block(residual=np.zeros(len(prior)), jacobian=prior, indices=indices, own=None))
    left = max(mean_square(of, at) / of.quiet_rms_n**2, 1.0)
    return left * widened(blocks, len(at.theta), of.problem.signals.period_s).covariance


def _latency(of: ExtendedProblem, here: PayloadFit, before: WrenchLatency, std_samples: float) -> WrenchLatency:
    """Return the wrench's latency as it is beside what is reported, with the deviation that it has there.

    That of a clock holds the whole move: it is taken out only where nothing else may be what looks like it.
    """
    period = of.problem.signals.period_s
    if before.is_whole:
        return before
    if before.is_filter:
        sensor, std_s = of.sensor_dynamics(here.theta), period * std_samples
        beside = replace(before, seconds=sensor.time_constant_s, advanced_s=-sensor.delay_s)
    else:
        beside = replace(before, seconds=before.applied_s + float(here.theta[of.shared]) * period)
        std_s = beside.seconds - before.seconds
    return replace(beside, std_s=float(np.hypot(before.std_s, std_s)))


def with_extension(fit: JointFit, found: Extended) -> JointFit:
    """Return the joint fit with what a wider payload changes.

    The surfaces follow as the covariance says they go with coupling and robot, and hold what a part that the log cannot
    show does in contact.
    """
    count = len(found.move)
    mine = fit.covariance[:count, :count]
    scale = 1.0 / np.sqrt(np.diag(mine))
    inverse = np.linalg.pinv(mine * np.outer(scale, scale), hermitian=True) * np.outer(scale, scale)
    follows = np.concatenate([np.eye(count), fit.covariance[count:, :count] @ inverse])
    values = fit.values + follows @ found.move
    values = np.maximum(values, _LEAST_LEFT * fit.values)
    covariance = fit.covariance + follows @ found.covariance @ follows.T
    reported = found.part is not None, found.friction_n is not None
    if found.explains:
        # The misfit of one mass on one spring, which made its deviations wider, is gone.
        covariance = covariance - follows @ mine @ follows.T
    beside = follows @ found.unseen
    # Contacts were fitted without the part, reported or not.
    apart = _unseen_in_contact(fit, found.unseen if found.part is None else found.move)
    covariance = covariance + np.outer(beside, beside) + np.diag(apart**2)
    stds = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    ci95 = {}
    for name, interval in fit.ci95.items():
        i = fit.names.index(name)
        ends = float(values[i]) + TWO_SIDED * float(stds[i]) * np.array([-1.0, 1.0])
        if not found.explains or i >= count:
            ends = np.array([min(interval[0], ends[0]), max(interval[1], ends[1])])
        ci95[name] = max(float(ends[0]), 0.0), float(ends[1])
    robot = slice(len(COUPLING_NAMES), count)
    # Friction and a part explain each other's force; beside a coupling without a value neither has one.
    is_unclear = any(reported) and (all(reported) or float(stds[0]) > WEAK_SHARE * float(values[0]))
    return replace(
        fit,
        values=values,
        covariance=covariance,
        ci95=ci95,
        robot=None if fit.robot is None else robot_model(values[robot]),
        surfaces=tuple(_followed(surface, values, covariance) for surface in fit.surfaces),
        quality=replace(fit.quality, wrench_lag_s=found.latency.seconds, wrench_lag_std_s=found.latency.std_s),
        latency=found.latency,
        part=None if is_unclear else found.part,
        friction_n=None if is_unclear else found.friction_n,
        is_payload_unclear=is_unclear,
    )


def _unseen_in_contact(fit: JointFit, unseen: FloatArray) -> FloatArray:
    """Return by how much a part that contacts do not hold may move each parameter (p,) in contact alone [SI].

    What makes K_s softer by a share ε makes the payload heavier by ε (K_s + K_e)/K_s where it swings on both springs:
    M_e takes that, or, from how fast the swing decays, the dampings do, of which contacts show B_e alone.
    """
    moved, share = np.zeros(len(fit.values)), abs(float(unseen[0] / fit.values[0]))
    for at in (surface.first_parameter for surface in fit.surfaces):
        heavier = share * float(1.0 + fit.values[at] / fit.values[0])
        moved[at + 1] = heavier * float(fit.values[1] + fit.values[2] + fit.values[at + 1])
        moved[at + 2] = heavier * float(fit.values[3])
    return moved


def _followed(surface: JointSurface, values: FloatArray, covariance: FloatArray) -> JointSurface:
    """Return a surface with the secant, and its deviation, of these values (p,) with their covariance (p, p)."""
    secant, std = secant_of(values, covariance, surface.first_parameter)
    return replace(surface, secant_n_per_m=secant, secant_std_n_per_m=std)
