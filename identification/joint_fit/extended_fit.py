"""Fit of a swinging part of the payload and of dry friction in its coupling, beside what the joint fit found.

Each is taken in where free motion prefers it clearly; K_s, B_s, B_p, M_p and the robot then come from that fit.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from problems.arrays import FloatArray

from .extended_payload import OWN, OWN_WITH_PART
from .extended_problem import COUPLING, ExtendedProblem, PayloadFit, PayloadKind
from .noise import fit_whitener

_HALVINGS, _CONVERGED, _EASIEST, _DAMPING_STEP = 8, 0.05, 1e-6, 10.0
_STEPS_AGAIN, _ROUNDS = 8, 2
_LEAST_EXPLAINED, _PATH_TIMES = 0.25, 2.0
_BEYOND_DEVIATIONS = 3.0


@dataclass(frozen=True, kw_only=True)
class Linearised:
    """JᵀJ (p, p), Jᵀr (p,) without the spans' own parameters; whitened `rows` (n, 1 + p); how the own ones follow."""

    matrix: FloatArray
    gradient: FloatArray
    rows: tuple[FloatArray, ...]
    own: tuple[tuple[FloatArray, FloatArray], ...]


def linearised(of: ExtendedProblem, at: PayloadFit) -> Linearised:
    """Return the problem's derivatives at a candidate by differences, each span's own parameters projected out."""
    small = of.steps(at.kind)[0]
    forces = of.forces(at.theta, at.own, at.kind)
    here = of.shown(at.theta, forces)
    # Robot and latency act on the coupling's force; everything else changes it.
    behind = range(COUPLING, of.shared + of.lags)
    moved = [
        of.shown(theta, forces if i in behind else of.forces(theta, at.own, at.kind))
        for i, theta in enumerate(at.theta + np.diag(small))
    ]
    matrix, gradient = of.prior(len(at.theta))
    gradient = gradient + matrix @ at.theta
    rows, follows = [], []
    for i, (error, owned) in enumerate(zip(here, of.own_derivatives(at), strict=True)):
        columns = [error, *((m[i] - error) / s for m, s in zip(moved, small, strict=True))]
        own = at.noise.apply(owned)
        white = at.noise.apply(np.array(columns).T)
        q, r = np.linalg.qr(own)
        taken = q.T @ white
        white = white - q @ taken
        matrix = matrix + white[:, 1:].T @ white[:, 1:]
        gradient = gradient + white[:, 1:].T @ white[:, 0]
        rows.append(white)
        follows.append((r, taken))
    return Linearised(matrix=matrix, gradient=gradient, rows=tuple(rows), own=tuple(follows))


def descended(of: ExtendedProblem, start: PayloadFit, most_steps: int) -> PayloadFit:
    """Return the minimum below a start (Levenberg and Marquardt), with its noise."""
    low, high = of.bounds(start.kind)
    largest, easing = of.steps(start.kind)[1], 1e-3
    now = replace(start, cost=of.cost(start.theta, start.own, start.kind, start.noise))
    for _ in range(most_steps):
        at = linearised(of, now)
        free = ~(((now.theta <= low) & (at.gradient > 0.0)) | ((now.theta >= high) & (at.gradient < 0.0)))
        scale = 1.0 / np.sqrt(np.maximum(np.diag(at.matrix)[free], 1e-12))
        inner, before = at.matrix[np.ix_(free, free)] * np.outer(scale, scale), now
        for _ in range(_HALVINGS):
            step = np.zeros(len(now.theta))
            step[free] = -scale * np.linalg.solve(inner + easing * np.eye(len(scale)), scale * at.gradient[free])
            theta = np.clip(now.theta + np.clip(step, -largest, largest), low, high)
            moved = np.append(1.0, theta - now.theta)
            own = tuple(
                mine - _eased(r, easing if now.kind.friction else 0.0) @ (taken @ moved)
                for mine, (r, taken) in zip(now.own, at.own, strict=True)
            )
            cost = of.cost(theta, own, now.kind, now.noise)
            if cost < now.cost:
                now = replace(now, theta=theta, own=own, cost=cost)
                break
            easing *= _DAMPING_STEP
        easing = max(easing / _DAMPING_STEP, _EASIEST)
        if before.cost - now.cost < _CONVERGED:
            break
    return now


def _eased(r: FloatArray, easing: float) -> FloatArray:
    """Return what solves r x = y by least squares, along shorter ways where friction bends them."""
    if easing == 0.0:
        return np.asarray(np.linalg.pinv(r))
    square = r.T @ r
    return np.asarray(np.linalg.solve(square + np.diag(easing * np.diag(square) + 1e-9 * np.trace(square)), r.T))


def with_own_noise(of: ExtendedProblem, candidate: PayloadFit) -> PayloadFit:
    """Return the candidate fitted again under the noise that it leaves itself."""
    for _ in range(_ROUNDS):
        noise = fit_whitener(of.errors(candidate.theta, candidate.own, candidate.kind))
        candidate = descended(of, replace(candidate, noise=noise), _STEPS_AGAIN)
    return candidate


def gained(of: ExtendedProblem, more: PayloadFit, less: PayloadFit) -> float:
    """Return by how much −2 log L prefers `more`, both fitted under the noise that it leaves.

    `less` is looked for from where it is and from where `more` ended: what the shared parameters win alone is no gain.
    """
    starts = less, without(of, more, less.kind)
    cost = min(descended(of, replace(start, noise=more.noise), _STEPS_AGAIN).cost for start in starts)
    return cost - more.cost


def without(of: ExtendedProblem, more: PayloadFit, kind: PayloadKind) -> PayloadFit:
    """Return the start of a fit of a smaller kind where one of a larger kind ended."""
    first = of.shared + of.lags
    beside = [*range(first, first + 3)] if more.kind.part and not kind.part else []
    beside += [*range(len(more.theta) - 3, len(more.theta))] if more.kind.friction and not kind.friction else []
    width = OWN_WITH_PART if kind.part else OWN
    return replace(more, kind=kind, theta=np.delete(more.theta, beside), own=tuple(o[:width] for o in more.own))


def mean_square(of: ExtendedProblem, at: PayloadFit) -> float:
    """Return the mean square of what a fit leaves of the force [N²]."""
    return float(np.mean(np.concatenate(of.errors(at.theta, at.own, at.kind)) ** 2))


def beyond_noise(of: ExtendedProblem, at: PayloadFit) -> float:
    """Return what a fit leaves of the force beyond the noise at rest [N²], 0 up to three deviations of it."""
    squares = np.concatenate(of.errors(at.theta, at.own, at.kind)) ** 2
    left = float(np.mean(squares))
    # At rest and in motion n samples each show a mean of squares, each with a deviation of √(2/n) of it.
    known = _BEYOND_DEVIATIONS * 2.0 * left / np.sqrt(len(squares))
    return left - of.quiet_rms_n**2 if left - of.quiet_rms_n**2 > known else 0.0


def explains_misfit(of: ExtendedProblem, more: PayloadFit, less: PayloadFit) -> bool:
    """Whether `more` explains a quarter at least of what `less` leaves beyond the noise, and more than its path may.

    Without a held command the path is not known within a sample, and a force on its mean there is off by h² F''/24.
    """
    beyond, explained = beyond_noise(of, less), mean_square(of, less) - mean_square(of, more)
    if beyond == 0.0 or explained <= _LEAST_EXPLAINED * beyond:
        return False
    if of.is_held:
        return True
    signals, errors = of.problem.signals, of.errors(less.theta, less.own, less.kind)
    known = signals.sensor_dynamics.unknown(signals.period_s)
    forces = [error + signals.force_n[s.slice][known:] for error, s in zip(errors, of.segments, strict=True)]
    off = np.concatenate([np.diff(force, 2) for force in forces]) / 24.0
    return explained > _PATH_TIMES**2 * float(np.mean(off**2))


def beginning(of: ExtendedProblem) -> PayloadFit:
    """Return the fit of one payload on one spring to the same spans."""
    size, own = of.shared + of.lags, tuple(of.point.nuisances[i][:OWN].copy() for i in of.spans)
    start = PayloadFit(kind=PayloadKind(), theta=np.zeros(size), own=own, noise=of.problem.free_noise, cost=np.inf)
    return descended(of, start, _STEPS_AGAIN)


def with_more(of: ExtendedProblem, at: PayloadFit, kind: PayloadKind, beside: tuple[float, ...]) -> PayloadFit:
    """Return a candidate of another kind, with part (share, log frequency, ratio) or friction (F_c, κ, log τ)."""
    first = of.shared + of.lags
    # Friction is behind the part.
    begins = first if kind.part and not at.kind.part else len(at.theta)
    theta = np.insert(at.theta, begins, beside)
    width = OWN_WITH_PART if kind.part else OWN
    own = tuple(np.concatenate([o, np.zeros(width - len(o))]) for o in at.own)
    return replace(at, kind=kind, theta=theta, own=own, cost=np.inf)


@dataclass(frozen=True, kw_only=True)
class Score:
    """To first order, what moving θ from one end to another does, everything else following.

    `fall` is by how much the sum of squares falls, `way` the share of the way that it takes; `std` is the deviation of
    that share, and `follows` (p,) by how much θ moves per whole way.
    """

    fall: float
    way: float
    std: float
    follows: FloatArray


def scorer(of: ExtendedProblem, at: PayloadFit) -> Callable[[PayloadFit, PayloadFit], Score]:
    """Return the function of what moving θ from one end to another does, everything in `at` following."""
    here = linearised(of, at)
    values, vectors = np.linalg.eigh(here.matrix)
    root = vectors / np.sqrt(np.maximum(values, 1e-9 * float(values[-1])))

    def score(begin: PayloadFit, end: PayloadFit) -> Score:
        square = along = 0.0
        coupled = np.zeros(len(at.theta))
        pairs = zip(of.errors(begin.theta, begin.own, begin.kind), of.errors(end.theta, end.own, end.kind), strict=True)
        for (first, last), rows, owned in zip(pairs, here.rows, own_bases, strict=True):
            column = at.noise.apply(last - first)
            column = column - owned @ (owned.T @ column)
            square += float(column @ column)
            along += float(column @ rows[:, 0])
            coupled += rows[:, 1:].T @ column
        part = root.T @ coupled
        square -= float(part @ part)
        along -= float(part @ (root.T @ here.gradient))
        std = float(square**-0.5) if square > 0.0 else np.inf
        if not (square > 0.0 and along < 0.0):
            return Score(fall=0.0, way=0.0, std=std, follows=-(root @ part))
        return Score(fall=along**2 / square, way=-along / square, std=std, follows=-(root @ part))

    own_bases = [np.linalg.qr(at.noise.apply(owned))[0] for owned in of.own_derivatives(at)]
    return score
