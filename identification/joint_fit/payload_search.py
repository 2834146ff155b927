"""Search of dry friction in a payload's coupling, and of a part that swings on it, beside what the joint fit found."""

from dataclasses import replace

import numpy as np

from problems.arrays import FloatArray

from .covariance import HIGHEST_PART_HZ, UNSEEN_SHARE
from .extended_fit import (
    Score,
    beyond_noise,
    descended,
    explains_misfit,
    gained,
    mean_square,
    scorer,
    with_more,
    with_own_noise,
)
from .extended_problem import MOST_RATIO, MOST_SHARE, ExtendedProblem, PayloadFit, PayloadKind
from .noise import Whitener

_FREQUENCIES, _LOWEST_HZ, _HIGHEST_SHARE = 24, 6.0, 0.4
_STARTS_HZ = (15.0, 22.0, 30.0, 38.0, 46.0, 55.0, 70.0)
_START_SHARE, _START_RATIO, _NUDGE, _NUDGE_N = 0.08, 0.03, 1e-3, 0.02
# Friction begins at so many times what one mass leaves, and stops within so many seconds.
_START_FRICTION, _START_PROMPT, _START_STOPPING_S = (0.3, 1.0, 2.5), 0.9, (5e-4, 1.5e-3)
_STEPS, _TRIED = 15, 2
# Every start goes a few steps down, and the lowest of them all the way.
_FIRST_STEPS, _FOLLOWED = 3, 2
# −2 log L: a first look, what is kept open, and what is reported.
_WORTH_A_LOOK, OPEN, REPORTED = 8.0, 30.0, 60.0
_LEAST_SHARE, _AT_BOUND = 0.005, 0.98


def find_friction(of: ExtendedProblem, at: PayloadFit) -> PayloadFit | None:
    """Return the fit with dry friction, None where that is not clearly better."""
    kind, score = PayloadKind(friction=True), scorer(of, at)
    none, some = (with_more(of, at, kind, (n, _START_PROMPT, np.log(_START_STOPPING_S[0]))) for n in (0.0, _NUDGE_N))
    if score(none, some).fall < _WORTH_A_LOOK:
        return None
    # Noise coloured by what one mass leaves hides a good deal of friction.
    rms = mean_square(of, at) ** 0.5
    white = Whitener(coefficients=np.ones(1), rms=rms)
    begun = [
        descended(
            of,
            replace(with_more(of, at, kind, (times * rms, _START_PROMPT, np.log(stopping_s))), noise=white),
            _FIRST_STEPS,
        )
        for times in _START_FRICTION
        for stopping_s in _START_STOPPING_S
    ]
    lowest = sorted(begun, key=lambda end: end.cost)[:_FOLLOWED]
    ends = [descended(of, end, _STEPS) for end in lowest]
    found = with_own_noise(of, min(ends, key=lambda end: end.cost))
    # Less than the noise does not show in any one motion: it is what the path leaves.
    is_seen = found.theta[-3] > of.quiet_rms_n and (of.is_held or explains_misfit(of, found, at))
    return found if is_seen and gained(of, found, at) >= REPORTED else None


def look_for_part(of: ExtendedProblem, at: PayloadFit) -> list[tuple[Score, float]]:
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


def find_part(
    of: ExtendedProblem, at: PayloadFit, found_by_score: list[tuple[Score, float]]
) -> tuple[PayloadFit | None, float]:
    """Return the best fit with a part and by how much it is better, None where that is not worth a look.

    Under white noise and, without friction, under that which one mass leaves, coloured by what it does not explain;
    each begins at several frequencies. One inside its bounds goes before one at them.
    """
    kind = replace(at.kind, part=True)
    looks = sorted(found_by_score, key=lambda each: (each[0].fall, each[0].way, each[1]), reverse=True)
    is_noise = at.kind.friction and beyond_noise(of, at) == 0.0
    if looks[0][0].fall < (OPEN if is_noise else _WORTH_A_LOOK):
        return None, 0.0
    shares = [(float(np.clip(_NUDGE * score.way, 0.01, 0.15)), f) for score, f in looks[:_TRIED]]
    shares += [(_START_SHARE, f) for f in _STARTS_HZ if f < max(f for _, f in looks)]
    starts = [_begun(of, at, kind, share, f) for share, f in shares]
    rms = float(np.std(np.concatenate(of.errors(at.theta, at.own, at.kind))))
    found = []
    white = Whitener(coefficients=np.ones(1), rms=rms)
    for noise in (white,) if at.kind.friction else (at.noise, white):
        begun = [descended(of, replace(start, noise=noise), _FIRST_STEPS) for start in starts]
        lowest = sorted(begun, key=lambda end: end.cost)[:_FOLLOWED]
        ends = [descended(of, end, _STEPS - _FIRST_STEPS) for end in lowest]
        best = with_own_noise(of, min(ends, key=lambda end: end.cost))
        if of.is_held or explains_misfit(of, best, at):
            found.append((gained(of, best, at), best))
    if not found:
        return None, 0.0
    inside = [each for each in found if each[0] >= REPORTED and not is_at_bound(of, each[1])]
    gain, best = max(inside or found, key=lambda each: each[0])
    return (best, gain) if gain >= OPEN else (None, gain)


def is_at_bound(of: ExtendedProblem, candidate: PayloadFit) -> bool:
    """Whether what swings is so light, so heavy, or damped so much, that it is no part; behind a filter, so little.

    What a driver's filter does between the samples looks like a part without any damping.
    """
    found = of.extension(candidate.theta, candidate.kind)
    is_light = found.mass_share < _LEAST_SHARE or (of.lags == 2 and found.damping_ratio == 0.0)
    return is_light or found.mass_share > _AT_BOUND * MOST_SHARE or found.damping_ratio > _AT_BOUND * MOST_RATIO
