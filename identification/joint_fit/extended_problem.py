"""Free motion of a joint fit with a wider payload: a part that swings, dry friction in the coupling, or both."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from problems.arrays import BoolArray, FloatArray

from .extended_payload import Extension, extended_force, own_forces
from .gradients import force_jacobian
from .model import COUPLING_NAMES
from .noise import Whitener
from .path import FlangePath, SensorDynamics, path_slope
from .rubbing_coupling import FinePath, fine_path, rubbed_force
from .segments import Segment, shared_indices
from .solve import Point, Problem, linearise, logarithmic, sizes_of

COUPLING = len(COUPLING_NAMES)
# Steps of differences and largest steps of a descent: K_s and the like in their sizes, latency in samples, then share,
# logarithm of the frequency and damping ratio of the part, F_c in N, κ and log τ.
_SMALL, _SMALL_LATENCY, _SMALL_FRICTION, _OWN_NUDGE_N = 1e-4, 1e-2, (1e-2, 1e-2, 1e-2), 0.1
_LARGEST, _LARGEST_PART, _LARGEST_FRICTION = 0.3, (0.05, 0.15, 0.03), (np.inf, 0.3, 0.7)
# Friction stops a slip at once, or in some milliseconds (τ [s]).
_STOPPING_S = 3e-5, 4e-3
MOST_SHARE, MOST_RATIO, _LOWEST_HZ, _HIGHEST_SHARE = 0.3, 0.15, 3.0, 0.45
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
    in samples; share, logarithm of the frequency [Hz] and damping ratio of a part; F_c [N], κ and the logarithm of τ
    [s] of friction. `quiet_rms_n` is the force's noise at rest, `is_held` whether the robot answers to a held command,
    so that its path is exact.
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
    def _robot_derivatives(self) -> tuple[FloatArray, ...]:
        """Slopes (robot, n) of every span's force by the robot's parameters, in their sizes."""
        problem, point, robot = self.problem, self.point, self.problem.layout.robot
        if self.shared == COUPLING:
            return tuple(np.zeros((0, len(s))) for s in self.segments)
        here, period = problem.path(point.values), problem.signals.period_s
        derivatives = [path_slope(here, point.values[robot], i, period) for i in range(self.shared - COUPLING)]
        found = []
        for index, segment in zip(self.spans, self.segments, strict=True):
            indices = shared_indices(segment, problem.layout, through_robot=True)
            nuisance = point.nuisances[index]

            def slope(parameter: int) -> FlangePath:
                return derivatives[parameter - COUPLING]

            rows = force_jacobian(point.values, nuisance, segment, here, slope, indices, problem.layout, period)[1]
            found.append(rows[COUPLING : self.shared] * self.sizes[COUPLING:, None])
        return tuple(found)

    @cached_property
    def _fine_paths(self) -> tuple[FinePath, ...]:
        """The path of every span in short steps."""
        path, period = self.problem.path(self.point.values), self.problem.signals.period_s
        return tuple(fine_path(path, segment.slice, period) for segment in self.segments)

    @cached_property
    def _known(self) -> tuple[FloatArray, FloatArray]:
        """What poses and priors say of θ, as JᵀJ and Jᵀr of the shared parameters."""
        matrix, gradient = np.zeros((self.shared, self.shared)), np.zeros(self.shared)
        for block in linearise(replace(self.problem, segments=()), replace(self.point, nuisances=())):
            if np.all(block.indices < self.shared):
                matrix[np.ix_(block.indices, block.indices)] += block.jacobian.T @ block.jacobian
                gradient[block.indices] += block.jacobian.T @ block.residual
        return matrix, gradient

    def prior(self, size: int) -> tuple[FloatArray, FloatArray]:
        """Return JᵀJ (p, p) and Jᵀr at θ = 0 (p,) of what is known of θ beside the force."""
        matrix, gradient = np.zeros((size, size)), np.zeros(size)
        matrix[: self.shared, : self.shared], gradient[: self.shared] = self._known
        for i in range(self.lags):
            matrix[self.shared + i, self.shared + i] = (self.latency_std_samples, LATENCY_SAMPLES)[i] ** -2.0
        return matrix, gradient

    def values(self, theta: FloatArray) -> FloatArray:
        """Return the shared parameters [SI]."""
        here, step = self.point.values[: self.shared], theta[: self.shared]
        return np.where(self.in_log, here * np.exp(np.where(self.in_log, step, 0.0)), here + step * self.sizes)

    def extension(self, theta: FloatArray, kind: PayloadKind) -> Extension:
        """Return the part and the friction of θ."""
        first = self.shared + self.lags
        of = Extension()
        if kind.friction:
            of = replace(of, friction_n=float(theta[-3]), prompt=float(theta[-2]), stopping_s=float(np.exp(theta[-1])))
        if not kind.part:
            return of
        share, log_frequency, ratio = theta[first : first + 3].tolist()
        return replace(of, mass_share=share, frequency_hz=float(np.exp(log_frequency)), damping_ratio=ratio)

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
        """Return the coupling's force of every span on the path of the joint fit, with friction in its short steps."""
        path, period = self.problem.path(self.point.values), self.problem.signals.period_s
        coupling, extension = self.values(theta)[:COUPLING], self.extension(theta, kind)
        if kind.friction:
            pairs = zip(self._fine_paths, own, strict=True)
            return [rubbed_force(coupling, extension, mine, fine, period) for fine, mine in pairs]
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
        for segment, coupled, derivatives in zip(self.segments, forces, self._robot_derivatives, strict=True):
            force = theta[COUPLING : self.shared] @ derivatives
            if len(coupled) == len(force):
                force = sensor.shown(coupled + force, path, segment.slice, damping, signals.period_s)
                if self.lags == 1:
                    force = force - theta[self.shared] * np.gradient(force)
            else:
                force = self._seen(theta, coupled, len(coupled) // len(force)) + sensor.felt(force, signals.period_s)
            out.append((force - signals.force_n[segment.slice])[known:])
        return out

    def _seen(self, theta: FloatArray, force: FloatArray, count: int) -> FloatArray:
        """Return what the sensor shows at the ticks (n,) of a force in `count` short steps a sample."""
        period, sensor = self.problem.signals.period_s, self.sensor_dynamics(theta)
        if self.lags == 1:
            sensor = replace(sensor, delay_s=sensor.delay_s + float(theta[self.shared]) * period)
        return sensor.felt(force, period / count, count)

    def own_derivatives(self, at: "PayloadFit") -> list[FloatArray]:
        """Return how every span's errors follow its own parameters (n, own)."""
        forces = self.forces(at.theta, at.own, at.kind)
        here = self.shown(at.theta, forces)
        nudges = _OWN_NUDGE_N * np.eye(len(at.own[0]))
        if at.kind.friction:
            nudged = [self.errors(at.theta, [own + step for own in at.own], at.kind) for step in nudges]
        else:
            path, period = self.problem.path(self.point.values), self.problem.signals.period_s
            coupling, extension = self.values(at.theta)[:COUPLING], self.extension(at.theta, at.kind)
            added = [own_forces(coupling, extension, path, segment.slice, period) for segment in self.segments]
            nudged = [
                self.shown(at.theta, [f + step @ more for f, more in zip(forces, added, strict=True)])
                for step in nudges
            ]
        return [np.array([(n[i] - error) / _OWN_NUDGE_N for n in nudged]).T for i, error in enumerate(here)]

    def cost(self, theta: FloatArray, own: Sequence[FloatArray], kind: PayloadKind, noise: Whitener) -> float:
        """Return the sum of squares of the whitened forces and of what else is known."""
        matrix, gradient = self.prior(len(theta))
        with np.errstate(over="ignore", invalid="ignore"):
            total = sum(float(np.sum(noise.apply(error) ** 2)) for error in self.errors(theta, own, kind))
        total += float(theta @ matrix @ theta + 2.0 * gradient @ theta)
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
            least, most = zip((0.0, np.inf), (0.0, 1.0), np.log(_STOPPING_S), strict=True)
            low, high = np.append(low, least), np.append(high, most)
        return low, high

    def steps(self, kind: PayloadKind) -> tuple[FloatArray, FloatArray]:
        """Return the steps of differences and the largest ones of a descent."""
        small = [*[_SMALL] * self.shared, *[_SMALL_LATENCY] * self.lags]
        large = [*[_LARGEST] * self.shared, *[1.0] * self.lags]
        if kind.part:
            small, large = [*small, *[_SMALL] * 3], [*large, *_LARGEST_PART]
        if kind.friction:
            small, large = [*small, *_SMALL_FRICTION], [*large, *_LARGEST_FRICTION]
        return np.array(small), np.array(large)
