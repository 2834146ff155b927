"""Fit of a swinging part of the payload and of dry friction in its coupling, beside what the joint fit found.

Each is taken in where free motion prefers it clearly; K_s, B_s, B_p, M_p and the robot then come from that fit.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from problems.arrays import BoolArray, FloatArray

from .extended_payload import OWN, OWN_WITH_PART, Extension, extended_force, own_forces
from .gradients import force_jacobian
from .model import COUPLING_NAMES
from .noise import Whitener, fit_whitener
from .path import FlangePath, SensorDynamics, path_slope
from .segments import Segment, shared_indices
from .solve import Point, Problem, linearise, logarithmic, sizes_of

_COUPLING = len(COUPLING_NAMES)
# Steps of differences and largest steps of a descent: K_s and the like in their sizes, latency in samples, then share,
# logarithm of the frequency and damping ratio of the part, and F_c in N.
_SMALL, _SMALL_LATENCY, _SMALL_FRICTION, _OWN_NUDGE_N = 1e-4, 1e-2, 1e-2, 0.1
_LARGEST, _LARGEST_PART = 0.3, (0.05, 0.15, 0.03)
MOST_SHARE, MOST_RATIO, _LOWEST_HZ, _HIGHEST_SHARE = 0.3, 0.15, 3.0, 0.45
_HALVINGS, _CONVERGED, _EASIEST, _DAMPING_STEP = 8, 0.05, 1e-6, 10.0
_STEPS_AGAIN, _ROUNDS = 8, 2
_LEAST_EXPLAINED, _PATH_TIMES = 0.25, 2.0
_BEYOND_DEVIATIONS = 3.0
_MOST_SAMPLES = 20_000
LATENCY_SAMPLES = 0.5


@dataclass(frozen=True, kw_only=True)
class PayloadKind:
    """Whether a payload with a part that swings, and with friction, is fitted."""

    part: bool = False
    friction: bool = False


@dataclass(frozen=True, kw_only=True)
class PayloadFit:
    """One fit: θ (p,) as `ExtendedProblem` orders it, each span's own parameters, the noise, and the sum of squares."""

    kind: PayloadKind
    theta: FloatArray
    own: tuple[FloatArray, ...]
    noise: Whitener
    cost: float


@dataclass(frozen=True, kw_only=True)
class ExtendedProblem:
    """Free motion of a joint fit about its minimum, the robot's path straight in its parameters.

    θ: how far K_s, B_s, B_p, M_p and the robot are from `point`, counted as the steps of the joint fit are (logarithms
    of what is positive, else in its sizes); the wrench's latency or time constant, and behind a filter its delay too,
    in samples; share, logarithm of the frequency [Hz] and damping ratio of a part; F_c [N] of friction. `quiet_rms_n`
    is the force's noise at rest, `is_held` whether the robot answers to a held command, so that its path is exact.
    """

    problem: Problem
    point: Point
    latency_std_samples: float
    quiet_rms_n: float
    is_held: bool

    @cached_property
    def spans(self) -> tuple[int, ...]:
        """Which spans in free motion are used: those with most force, up to 20,000 samples."""
        problem = self.problem
        free = [i for i, s in enumerate(problem.segments) if not s.is_contact]
        strength = {i: float(np.var(problem.signals.force_n[problem.segments[i].slice])) for i in free}
        used, left = list[int](), _MOST_SAMPLES
        for i in sorted(free, key=lambda i: -strength[i]):
            if not used or len(problem.segments[i]) <= left:
                used.append(i)
                left -= len(problem.segments[i])
        return tuple(sorted(used))

    @cached_property
    def segments(self) -> tuple[Segment, ...]:
        """The spans that are used."""
        return tuple(self.problem.segments[i] for i in self.spans)

    @cached_property
    def shared(self) -> int:
        """How many parameters are shared with the joint fit: coupling and robot."""
        return int(self.problem.layout.robot.stop)

    @cached_property
    def lags(self) -> int:
        """How many parameters the wrench's latency has."""
        return 2 if self.problem.signals.sensor_dynamics.time_constant_s > 0.0 else 1

    @cached_property
    def sizes(self) -> FloatArray:
        """Units of the shared parameters."""
        return sizes_of(self.point.values, self.problem.layout, self.problem.signals.period_s)[: self.shared]

    @cached_property
    def in_log(self) -> BoolArray:
        """Which of the shared parameters are counted in their logarithm."""
        return logarithmic(self.problem.layout)[: self.shared]

    @cached_property
    def _robot_slopes(self) -> tuple[FloatArray, ...]:
        """Slopes (robot, n) of every span's force by the robot's parameters, in their sizes."""
        problem, point, robot = self.problem, self.point, self.problem.layout.robot
        if self.shared == _COUPLING:
            return tuple(np.zeros((0, len(s))) for s in self.segments)
        here, period = problem.path(point.values), problem.signals.period_s
        slopes = [path_slope(here, point.values[robot], i, period) for i in range(self.shared - _COUPLING)]
        found = []
        for index, segment in zip(self.spans, self.segments, strict=True):
            indices = shared_indices(segment, problem.layout, through_robot=True)
            nuisance = point.nuisances[index]

            def slope(parameter: int) -> FlangePath:
                return slopes[parameter - _COUPLING]

            rows = force_jacobian(point.values, nuisance, segment, here, slope, indices, problem.layout, period)[1]
            found.append(rows[_COUPLING : self.shared] * self.sizes[_COUPLING:, None])
        return tuple(found)

    @cached_property
    def _known(self) -> tuple[FloatArray, FloatArray]:
        """What poses and priors say of θ, as JᵀJ and Jᵀr of the shared parameters."""
        matrix, slope = np.zeros((self.shared, self.shared)), np.zeros(self.shared)
        for block in linearise(replace(self.problem, segments=()), replace(self.point, nuisances=())):
            if np.all(block.indices < self.shared):
                matrix[np.ix_(block.indices, block.indices)] += block.jacobian.T @ block.jacobian
                slope[block.indices] += block.jacobian.T @ block.residual
        return matrix, slope

    def prior(self, size: int) -> tuple[FloatArray, FloatArray]:
        """Return JᵀJ (p, p) and Jᵀr at θ = 0 (p,) of what is known of θ beside the force."""
        matrix, slope = np.zeros((size, size)), np.zeros(size)
        matrix[: self.shared, : self.shared], slope[: self.shared] = self._known
        for i in range(self.lags):
            matrix[self.shared + i, self.shared + i] = (self.latency_std_samples, LATENCY_SAMPLES)[i] ** -2.0
        return matrix, slope

    def values(self, theta: FloatArray) -> FloatArray:
        """Return the shared parameters [SI]."""
        here, step = self.point.values[: self.shared], theta[: self.shared]
        return np.where(self.in_log, here * np.exp(np.where(self.in_log, step, 0.0)), here + step * self.sizes)

    def extension(self, theta: FloatArray, kind: PayloadKind) -> Extension:
        """Return the part and the friction of θ."""
        first = self.shared + self.lags
        friction = float(theta[-1]) if kind.friction else 0.0
        if not kind.part:
            return Extension(friction_n=friction)
        share, log_frequency, ratio = theta[first : first + 3].tolist()
        frequency = float(np.exp(log_frequency))
        return Extension(mass_share=share, frequency_hz=frequency, damping_ratio=ratio, friction_n=friction)

    def sensor_dynamics(self, theta: FloatArray) -> SensorDynamics:
        """Return the wrench's filter of θ; a latency without one is left to `_errors`."""
        known, h = self.problem.signals.sensor_dynamics, self.problem.signals.period_s
        if self.lags == 1:
            return known
        constant = max(known.time_constant_s + theta[self.shared] * h, 0.01 * known.time_constant_s)
        return SensorDynamics(time_constant_s=constant, delay_s=known.delay_s + theta[self.shared + 1] * h)

    def errors(self, theta: FloatArray, own: Sequence[FloatArray], kind: PayloadKind) -> list[FloatArray]:
        """Return predicted − measured force of every span, without the samples that show what was before it."""
        return self.shown(theta, self.forces(theta, own, kind))

    def forces(self, theta: FloatArray, own: Sequence[FloatArray], kind: PayloadKind) -> list[FloatArray]:
        """Return the coupling's force of every span on the path of the joint fit."""
        path, period = self.problem.path(self.point.values), self.problem.signals.period_s
        coupling, extension = self.values(theta)[:_COUPLING], self.extension(theta, kind)
        return [
            extended_force(coupling, extension, mine, path, segment.slice, period)
            for segment, mine in zip(self.segments, own, strict=True)
        ]

    def shown(self, theta: FloatArray, forces: Sequence[FloatArray]) -> list[FloatArray]:
        """Return `errors` of these `forces`: moved with the robot, as the sensor shows them, less what was measured."""
        path, signals = self.problem.path(self.point.values), self.problem.signals
        damping, sensor = float(self.values(theta)[1]), self.sensor_dynamics(theta)
        known = signals.sensor_dynamics.unknown(signals.period_s)
        out = []
        for segment, coupled, slopes in zip(self.segments, forces, self._robot_slopes, strict=True):
            force = coupled + theta[_COUPLING : self.shared] @ slopes
            force = sensor.shown(force, path, segment.slice, damping, signals.period_s)
            if self.lags == 1:
                force = force - theta[self.shared] * np.gradient(force)
            out.append((force - signals.force_n[segment.slice])[known:])
        return out

    def own_slopes(self, at: "PayloadFit") -> list[FloatArray]:
        """Return how every span's errors follow its own parameters (n, own)."""
        forces = self.forces(at.theta, at.own, at.kind)
        here = self.shown(at.theta, forces)
        nudges = _OWN_NUDGE_N * np.eye(len(at.own[0]))
        if at.kind.friction:
            nudged = [self.errors(at.theta, [own + step for own in at.own], at.kind) for step in nudges]
        else:
            path, period = self.problem.path(self.point.values), self.problem.signals.period_s
            coupling, extension = self.values(at.theta)[:_COUPLING], self.extension(at.theta, at.kind)
            added = [own_forces(coupling, extension, path, segment.slice, period) for segment in self.segments]
            nudged = [
                self.shown(at.theta, [f + step @ more for f, more in zip(forces, added, strict=True)])
                for step in nudges
            ]
        return [np.array([(n[i] - error) / _OWN_NUDGE_N for n in nudged]).T for i, error in enumerate(here)]

    def cost(self, theta: FloatArray, own: Sequence[FloatArray], kind: PayloadKind, noise: Whitener) -> float:
        """Return the sum of squares of the whitened forces and of what else is known."""
        matrix, slope = self.prior(len(theta))
        with np.errstate(over="ignore", invalid="ignore"):
            total = sum(float(np.sum(noise.apply(error) ** 2)) for error in self.errors(theta, own, kind))
        total += float(theta @ matrix @ theta + 2.0 * slope @ theta)
        return total if np.isfinite(total) else np.inf

    def bounds(self, kind: PayloadKind) -> tuple[FloatArray, FloatArray]:
        """Return the least and the largest θ."""
        low = np.full(self.shared + self.lags, -np.inf)
        low[1:3] = -self.point.values[1:3] / self.sizes[1:3]
        high = np.full(len(low), np.inf)
        if kind.part:
            highest = np.log(_HIGHEST_SHARE / self.problem.signals.period_s)
            low = np.append(low, [0.0, np.log(_LOWEST_HZ), 0.0])
            high = np.append(high, [MOST_SHARE, highest, MOST_RATIO])
        if kind.friction:
            low, high = np.append(low, 0.0), np.append(high, np.inf)
        return low, high

    def steps(self, kind: PayloadKind) -> tuple[FloatArray, FloatArray]:
        """Return the steps of differences and the largest ones of a descent."""
        small = [*[_SMALL] * self.shared, *[_SMALL_LATENCY] * self.lags]
        large = [*[_LARGEST] * self.shared, *[1.0] * self.lags]
        if kind.part:
            small, large = [*small, *[_SMALL] * 3], [*large, *_LARGEST_PART]
        return np.array([*small, *[_SMALL_FRICTION] * kind.friction]), np.array([*large, *[np.inf] * kind.friction])


@dataclass(frozen=True, kw_only=True)
class Linearised:
    """JᵀJ (p, p), Jᵀr (p,) without the spans' own parameters; whitened `rows` (n, 1 + p); how the own ones follow."""

    matrix: FloatArray
    slope: FloatArray
    rows: tuple[FloatArray, ...]
    own: tuple[tuple[FloatArray, FloatArray], ...]


def linearised(of: ExtendedProblem, at: PayloadFit) -> Linearised:
    """Return the problem's slopes at a candidate by differences, each span's own parameters projected out."""
    small = of.steps(at.kind)[0]
    forces = of.forces(at.theta, at.own, at.kind)
    here = of.shown(at.theta, forces)
    # Robot and latency act on the coupling's force; everything else changes it.
    behind = range(_COUPLING, of.shared + of.lags)
    moved = [
        of.shown(theta, forces if i in behind else of.forces(theta, at.own, at.kind))
        for i, theta in enumerate(at.theta + np.diag(small))
    ]
    matrix, slope = of.prior(len(at.theta))
    slope = slope + matrix @ at.theta
    rows, follows = [], []
    for i, (error, owned) in enumerate(zip(here, of.own_slopes(at), strict=True)):
        columns = [error, *((m[i] - error) / s for m, s in zip(moved, small, strict=True))]
        own = at.noise.apply(owned)
        white = at.noise.apply(np.array(columns).T)
        q, r = np.linalg.qr(own)
        taken = q.T @ white
        white = white - q @ taken
        matrix = matrix + white[:, 1:].T @ white[:, 1:]
        slope = slope + white[:, 1:].T @ white[:, 0]
        rows.append(white)
        follows.append((r, taken))
    return Linearised(matrix=matrix, slope=slope, rows=tuple(rows), own=tuple(follows))


def descended(of: ExtendedProblem, start: PayloadFit, most_steps: int) -> PayloadFit:
    """Return the minimum below a start (Levenberg and Marquardt), with its noise."""
    low, high = of.bounds(start.kind)
    largest, easing = of.steps(start.kind)[1], 1e-3
    now = replace(start, cost=of.cost(start.theta, start.own, start.kind, start.noise))
    for _ in range(most_steps):
        at = linearised(of, now)
        free = ~(((now.theta <= low) & (at.slope > 0.0)) | ((now.theta >= high) & (at.slope < 0.0)))
        scale = 1.0 / np.sqrt(np.maximum(np.diag(at.matrix)[free], 1e-12))
        inner, before = at.matrix[np.ix_(free, free)] * np.outer(scale, scale), now
        for _ in range(_HALVINGS):
            step = np.zeros(len(now.theta))
            step[free] = -scale * np.linalg.solve(inner + easing * np.eye(len(scale)), scale * at.slope[free])
            theta = np.clip(now.theta + np.clip(step, -largest, largest), low, high)
            moved = np.append(1.0, theta - now.theta)
            own = tuple(
                mine - np.linalg.lstsq(r, taken @ moved, rcond=None)[0]
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
    beside += [len(more.theta) - 1] if more.kind.friction and not kind.friction else []
    width = OWN_WITH_PART if kind.part else OWN
    return replace(more, kind=kind, theta=np.delete(more.theta, beside), own=tuple(o[:width] for o in more.own))


def unexplained(of: ExtendedProblem, more: PayloadFit, less: PayloadFit) -> float:
    """Return what `more` leaves of the misfit of `less` beyond the noise, as a share of the mean square."""
    before, after = (mean_square(of, each) for each in (less, more))
    noise = of.quiet_rms_n**2
    return max(after - noise, 0.0) / max(before - noise, 1e-300)


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
    """Return a candidate of another kind, with part (share, log frequency, ratio) or friction (F_c,) as a start."""
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
        along -= float(part @ (root.T @ here.slope))
        std = float(square**-0.5) if square > 0.0 else np.inf
        if not (square > 0.0 and along < 0.0):
            return Score(fall=0.0, way=0.0, std=std, follows=-(root @ part))
        return Score(fall=along**2 / square, way=-along / square, std=std, follows=-(root @ part))

    own_bases = [np.linalg.qr(at.noise.apply(owned))[0] for owned in of.own_slopes(at)]
    return score
