"""Whether a payload has a part that swings, or its coupling dry friction, and what that changes of the joint fit."""

from dataclasses import dataclass, replace

import numpy as np

from problems.arrays import FloatArray

from ..verdicts import TWO_SIDED, WEAK_SHARE
from .covariance import EXACT_SHARE, SHARPEST_DELAY_SAMPLES, widened
from .extended_fit import (
    Score,
    beginning,
    beyond_noise,
    explains_misfit,
    gained,
    linearised,
    mean_square,
    without,
)
from .extended_latency import SettledLatency, settle_latency
from .extended_problem import ExtendedProblem, PayloadFit, PayloadKind
from .latency import WrenchLatency
from .model import COUPLING_NAMES, robot_model
from .payload_search import REPORTED, find_friction, find_part, is_at_bound, look_for_part, unseen_by_log
from .result import JointFit, JointSurface, PayloadPart, secant_of
from .solve import Block, Point, Problem

# The −2 log L that shows a part behind a held command where one mass leaves no more than the noise at rest may be.
_CLEAR = 200.0
# Of what a part, and friction alone, move, how well the move is known at best.
_MOVED_BY_PART, _MOVED_BY_FRICTION = 0.1, 0.05
# How well share, frequency, damping ratio and F_c are known at best: as far off they were in simulated cells, the path
# between the samples and the law of friction not being those of the fit.
_SHARE_KNOWN, _FREQUENCY_KNOWN, _RATIO_KNOWN, _FRICTION_KNOWN = 0.25, 0.03, 0.02, 0.2
_FRICTION_LIKE_DRAG = 0.01
# Of the misfit's mean square beyond the noise, what a payload that explains it leaves at most.
_LEFT_OPEN = 0.25
# Friction and a part beside each other leave hardly more than the noise.
_NOTHING_LEFT = 1.5
# A surface that follows the coupling keeps a tenth of its values at least.
_LEAST_LEFT = 0.1
_LATENCY_STDS, _LEAST_LATENCY, _FILTER_SHARE = 3.0, 0.1, 0.5


@dataclass(frozen=True, kw_only=True)
class Extended:
    """By how much a wider payload moves coupling and robot, (a,), and what their covariance (a, a) gains [SI].

    `move` is 0 where nothing is reported; `part` and `friction_n`, value and deviation, are what is, `latency` is the
    wrench's beside them. Where it `explains` the misfit, that covariance takes the place of the joint fit's. `is_wider`
    is False where one mass on one spring is enough, `is_apart` where part and friction cannot be distinguished.
    `unseen` (a,) is what a part may move that the log cannot show. `left_n` is the RMS that free motion leaves of the
    force beside what is reported.
    """

    move: FloatArray
    covariance: FloatArray
    latency: WrenchLatency
    unseen: FloatArray
    left_n: float
    is_wider: bool
    explains: bool = False
    is_apart: bool = False
    part: PayloadPart | None = None
    friction_n: tuple[float, float] | None = None


def extend_payload(
    problem: Problem,
    point: Point,
    latency: WrenchLatency,
    *,
    quiet_rms_n: float,
    is_held: bool,
    force_n: FloatArray | None = None,
    shifted_s: float = 0.0,
) -> Extended:
    """Return what a part that swings, and dry friction in the coupling, change of a joint fit.

    Each is fitted to free motion beside everything else. Reported is what −2 log L prefers by 60 under the noise that
    it leaves, and only a part of less than three tenths of the mass and 15 % of critical damping, since a wider one
    may be anything. From 30 on, and where the part is none, the values stay, and hold the move in their deviations.
    What explains less than a quarter of the misfit beyond `quiet_rms_n` is no part. Where no command `is_held`, that,
    and what explains no more than the path within a sample may do, leaves the deviations, too: it is another misfit.
    Where no part is reported, the deviations hold one that the log cannot show (`unseen_by_log`). Of what both explain,
    the deviations hold as much as they leave of it, a tenth, or of friction alone a twentieth, at least. Beside
    friction the wrench's latency is settled anew from `force_n` (n,), the force as it was read, with `shifted_s` taken
    off its stamps.
    """
    of = _widened_problem(problem, point, latency, quiet_rms_n, is_held)
    begun = beginning(of)
    here = find_friction(of, begun) or begun
    looks = look_for_part(of, here)
    unseen = unseen_by_log(of, here, looks)
    here, left_open = _with_part(of, here, latency, looks)
    moves = [*_moved_by_yielding(of, begun), *(_moved(of, each, here) for each in left_open)]
    lags_s = [_later_s(of, each, here) for each in left_open]
    is_as_before, left, left_before = True, mean_square(of, here), mean_square(of, begun)
    if here.kind.friction and force_n is not None:
        settled = settle_latency(SettledLatency(of=of, fit=here, latency=latency), force_n, shifted_s)
        is_as_before = settled.latency is latency
        of, here, latency = settled.of, settled.fit, settled.latency
        left = mean_square(of, here)
    noise = quiet_rms_n**2
    unexplained_share = max(left - noise, 0.0) / max(left_before - noise, 1e-300)
    if here.kind != PayloadKind():
        known_at_best = _MOVED_BY_PART if here.kind.part else _MOVED_BY_FRICTION
        share = float(np.clip(np.sqrt(unexplained_share), known_at_best, 1.0))
        moves.append(share * _moved(of, here, begun))
        lags_s += [share * _later_s(of, here, begun)] if is_as_before else []
    open_s = float(np.linalg.norm(lags_s)) if latency.is_filter else 0.0
    found = _extended(of, here, moves, replace(latency, std_s=float(np.hypot(latency.std_s, open_s))))
    is_apart = here.kind.part and here.kind.friction and _is_apart(of, here)
    # A filter that a driver computes leaves something, too, of which a part may explain most: none explains a filter.
    is_one = here.kind.part != here.kind.friction and (here.kind.friction or not latency.is_filter)
    return replace(
        found,
        unseen=np.zeros(of.shared) if here.kind.part else unseen,
        left_n=left**0.5,
        is_wider=bool(moves),
        is_apart=is_apart,
        explains=(is_one or is_apart) and unexplained_share < _LEFT_OPEN,
    )


def _widened_problem(
    problem: Problem, point: Point, latency: WrenchLatency, quiet_rms_n: float, is_held: bool
) -> ExtendedProblem:
    """Return the problem with a latency as far open as a part, or friction, may have made it."""
    lag_s = max(_LATENCY_STDS * latency.std_s, abs(latency.applied_s))
    lag_s = _FILTER_SHARE * latency.seconds if latency.is_filter else lag_s
    return ExtendedProblem(
        problem=problem,
        point=point,
        latency_std_samples=max(lag_s / problem.signals.period_s, _LEAST_LATENCY),
        quiet_rms_n=quiet_rms_n,
        is_held=is_held,
    )


def _with_part(
    of: ExtendedProblem, here: PayloadFit, latency: WrenchLatency, looks: list[tuple[Score, float]]
) -> tuple[PayloadFit, list[PayloadFit]]:
    """Return the fit with a part where one is to be reported, else as it is, and those that stay open beside it."""
    swinging, gain = find_part(of, here, looks)
    if swinging is None:
        return here, []
    # A shifted force is not exact between its samples, which looks like a part.
    is_clear = of.is_held and latency.applied_s == 0.0 and gain >= _CLEAR and beyond_noise(of, here) == 0.0
    is_needed = is_clear or explains_misfit(of, swinging, here)
    is_reported = gain >= REPORTED and not is_at_bound(of, swinging) and is_needed
    return (swinging, []) if is_reported else (here, [swinging])


def _is_apart(of: ExtendedProblem, both: PayloadFit) -> bool:
    """Whether friction explains what a part does not, and nothing is left of the force but its noise."""
    alone = without(of, both, PayloadKind(part=True))
    return mean_square(of, both) ** 0.5 < _NOTHING_LEFT * of.quiet_rms_n and gained(of, both, alone) >= REPORTED


def _moved_by_yielding(of: ExtendedProblem, begun: PayloadFit) -> list[FloatArray]:
    """Return what one deviation of how far the robot gives way moves, nothing where it does not."""
    signals, moves = of.problem.signals, []
    for std in signals.yielded_stds:
        further = replace(signals, yielded=std if signals.yielded is None else signals.yielded + std)
        other = replace(of, problem=replace(of.problem, signals=further))
        moves.append(_moved(of, beginning(other), begun))
    return moves


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
        covariance=covariance
        + spread[: of.shared, : of.shared] * np.outer(units, units)
        + np.diag(_least(of, found.friction_n) ** 2),
        latency=_latency(of, here, latency, float(stds[of.shared])),
        unseen=np.zeros(of.shared),
        left_n=0.0,
        is_wider=True,
        part=part,
        friction_n=(found.friction_n, float(np.hypot(stds[-3], _FRICTION_KNOWN * found.friction_n)))
        if here.kind.friction
        else None,
    )


def _least(of: ExtendedProblem, friction_n: float) -> FloatArray:
    """Return the deviations (a,) below which nothing is known, however much the log holds [SI].

    Of friction a share may follow the speed as drag does.
    """
    least = EXACT_SHARE * of.point.values[: of.shared]
    speed = np.concatenate([of.problem.path(of.point.values).cut(s.slice).velocity for s in of.segments])
    rms = float(np.std(speed)) / of.problem.signals.period_s
    least[2] = float(np.hypot(least[2], _FRICTION_LIKE_DRAG * friction_n / max(rms, 1e-12)))
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
    # Friction and a part may explain each other's force; beside a coupling without a value neither has one.
    is_mixed = all(reported) and not found.is_apart
    is_unclear = any(reported) and (is_mixed or float(stds[0]) > WEAK_SHARE * float(values[0]))
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
