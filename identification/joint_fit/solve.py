"""Least-squares problem of the joint fit, and the Gauss-Newton steps that solve it."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cache

import numpy as np
from numpy.typing import NDArray

from problems.arrays import BoolArray, FloatArray

from .gradients import force_jacobian
from .model import ParameterLayout
from .noise import Smoother, Whitener
from .path import (
    MOST_CUTS,
    FlangePath,
    SensorDynamics,
    commanded_path,
    low_passed,
    measured_path,
    path_slope,
    smooth_path,
)
from .segments import Segment, predict_force, shared_indices

_KEPT = 2
_MOST_HALVINGS = 6
_CONVERGED = 1e-3
_LARGEST_LOG_STEP = 0.7
_ROBOT_HZ = 5.0


class Paths:
    """The flange's paths that were asked for last: most questions of a descent leave the robot as it is."""

    def __init__(self) -> None:
        self._kept: dict[bytes, FlangePath] = {}

    def of(self, robot: FloatArray, signals: "Signals") -> FlangePath:
        """Return the path for robot parameters (ω, (ζ,) T_d), or that of the pose alone where there are none."""
        key = robot.tobytes()
        found = self._kept.pop(key, None)
        if found is None:
            found = signals.path_of(robot)
            for oldest in list(self._kept)[: 1 - _KEPT]:
                del self._kept[oldest]
        self._kept[key] = found
        return found


@dataclass(frozen=True, kw_only=True)
class Signals:
    """One axis on one clock: flange position, force without weight and bias, command; (n,) each, the last or None.

    `command_m[k]` is the command issued at or after tick k and before the next, or where it `is_smooth`, at tick k on a
    spline through all; `smoother` belongs to the pose. The
    force passes `sensor_dynamics`, whose time constant, or without one delay, may be off by `latency_std_s`; the pose
    was measured at tick `measured[0]` and every `measured[1]` ticks; `yielded` is that of `FlangePath`,
    each of `yielded_stds` (n, 4) what one deviation of a part of it moves. Without a held command the flange may take
    its speed `untimed_share` of half a sample early or late.
    """

    period_s: float
    position_m: FloatArray
    force_n: FloatArray
    command_m: FloatArray | None
    smoother: Smoother
    latency_std_s: float = 0.0
    sensor_dynamics: SensorDynamics = field(default_factory=SensorDynamics)
    measured: tuple[int, int] = (0, 1)
    yielded: FloatArray | None = None
    yielded_stds: tuple[FloatArray, ...] = ()
    is_smooth: bool = False
    untimed_share: float = 1.0
    paths: Paths = field(default_factory=Paths, init=False, repr=False, compare=False)

    def at_poses(self, span: slice) -> slice:
        """Return the ticks of a span at which the pose was measured."""
        first, every = self.measured
        return slice(span.start + (first - span.start) % every, span.stop, every)

    def path(self, values: FloatArray, layout: ParameterLayout) -> FlangePath:
        """Return the flange's path for robot parameters, which is kept for a while."""
        return self.paths.of(values[layout.robot], self)

    def path_of(self, robot: FloatArray, keeps: int = MOST_CUTS) -> FlangePath:
        """Return the flange's path for robot parameters (ω, (ζ,) T_d), that of the pose alone without them."""
        if self.command_m is None or robot.size == 0:
            return measured_path(self.position_m, self.smoother)
        of = smooth_path if self.is_smooth else commanded_path
        return of(robot, self.command_m, self.position_m, self.smoother, self.period_s, keeps, self.yielded)


@dataclass(frozen=True, kw_only=True)
class Point:
    """A value of everything: shared parameters, and each segment's own."""

    values: FloatArray
    nuisances: tuple[FloatArray, ...]


@dataclass(frozen=True, kw_only=True)
class Summary:
    """A quadratic form |root · u|² of all shared parameters about `values`, u counted as the steps are."""

    root: FloatArray
    values: FloatArray


@dataclass(frozen=True, kw_only=True)
class Problem:
    """What is fitted: force over `segments`, pose over `pose_spans`, with one whitener per kind of span.

    `priors` are (index, value, standard deviation); `fixed` are indices that stay as they are, and with the robot's
    among them `known_path` is the flange's path; `summary` represents other spans. No payload is lighter than
    `lightest_kg`: next to nothing, its own motion could not be distinguished from rounding. None is heavier than
    `heaviest_kg`.
    """

    signals: Signals
    layout: ParameterLayout
    segments: tuple[Segment, ...]
    pose_spans: tuple[slice, ...]
    free_noise: Whitener
    contact_noise: Whitener
    pose_noise: Whitener
    priors: tuple[tuple[int, float, float], ...] = ()
    fixed: tuple[int, ...] = ()
    known_path: FlangePath | None = None
    summary: Summary | None = None
    lightest_kg: float = 0.01
    heaviest_kg: float = np.inf

    def path(self, values: FloatArray) -> FlangePath:
        """Return the flange's path at these parameters."""
        return self.signals.path(values, self.layout) if self.known_path is None else self.known_path

    def noise(self, segment: Segment) -> Whitener:
        """Return the whitener of a segment's force."""
        return self.contact_noise if segment.is_contact else self.free_noise


def stiffest_seen_n_per_m(mass_kg: float, period_s: float) -> float:
    """Return the K_s at which a payload of this mass swings at half the sampling rate.

    Above it a sample shows the swinging of a softer spring as well (aliasing), so no K_s can be determined there.
    """
    return float(mass_kg * (np.pi / period_s) ** 2)


def sizes_of(values: FloatArray, layout: ParameterLayout, period_s: float) -> FloatArray:
    """Return a unit for every parameter: itself where it cannot vanish, else a tenth of what would be critical."""
    out = np.array(values, dtype=np.float64)
    mass = float(values[3])
    out[1] = out[2] = 0.2 * np.sqrt(float(values[0]) * mass)
    if layout.robot_order:
        out[layout.robot.stop - 1] = period_s
    for i in range(layout.surfaces):
        first = layout.surface(i).start
        out[first + 1] = 0.2 * np.sqrt(float(values[first]) * mass)
        out[first + 2] = 0.1 * mass
    return out


def logarithmic(layout: ParameterLayout) -> BoolArray:
    """Return which parameters are stepped in their logarithm: K_s, M_p, ω, ζ and K_e."""
    out = np.zeros(len(layout), dtype=bool)
    out[[0, 3]] = True
    out[layout.robot.start : layout.robot.stop - 1] = layout.robot_order > 0
    for i in range(layout.surfaces):
        out[layout.surface(i).start] = True
    return out


@dataclass(frozen=True, kw_only=True)
class Block:
    """One span, whitened: residual and derivatives by the scaled shared parameters, free of the span's own ones.

    `systematic` are forces that the model may lack, treated alike: see `_untimed`; the last one is the wrench's
    latency.
    """

    residual: FloatArray
    jacobian: FloatArray
    indices: NDArray[np.intp]
    own: tuple[FloatArray, FloatArray, FloatArray] | None  # R, Qᵀr, QᵀJ: how the span's own parameters follow
    systematic: FloatArray | None = None


def linearise(problem: Problem, point: Point) -> list[Block]:
    """Return the whitened residuals and derivatives of every span at a point: forces, then poses, then priors."""
    signals, layout = problem.signals, problem.layout
    sizes = sizes_of(point.values, layout, signals.period_s)
    here = problem.path(point.values)
    robot = range(layout.robot.start, layout.robot.stop)

    @cache
    def slope(index: int) -> FlangePath:
        return path_slope(here, point.values[layout.robot], index - robot.start, signals.period_s)

    blocks = [
        _force_block(problem, point.values, nuisance, segment, here, slope)
        for segment, nuisance in zip(problem.segments, point.nuisances, strict=True)
    ]
    if problem.pose_spans:
        indices = np.array(robot)
        for span in map(signals.at_poses, problem.pose_spans):
            misfit = here.misfit(span)
            gradients = [slope(i).misfit(span) * sizes[i] for i in robot]
            rows = np.array([misfit, *gradients, np.ones(len(misfit))]).T
            blocks.append(_block(problem.pose_noise.apply(rows), indices, 1))
    return blocks + _known(problem, point)


def _force_block(
    problem: Problem,
    values: FloatArray,
    nuisance: FloatArray,
    segment: Segment,
    here: FlangePath,
    slope: Callable[[int], FlangePath],
) -> Block:
    """Return a span's force on the flange's path, whose derivatives are `slope`: see `force_jacobian`."""
    signals, layout = problem.signals, problem.layout
    sizes = sizes_of(values, layout, signals.period_s)
    indices = shared_indices(segment, layout, through_robot=problem.known_path is None)
    period = signals.period_s
    predicted, jacobian = force_jacobian(values, nuisance, segment, here, slope, indices, layout, period)
    jacobian[: len(indices)] *= sizes[indices, None]
    if signals.sensor_dynamics != SensorDynamics():
        predicted = signals.sensor_dynamics.shown(predicted, here, segment.slice, float(values[1]), period)
        jacobian = signals.sensor_dynamics.felt(jacobian, period)
    lines = [(predicted - signals.force_n[segment.slice])[None], jacobian]
    if here.robot is None:
        lines.append(signals.untimed_share * _untimed(values, segment, here, signals.period_s))
    if signals.latency_std_s > 0.0:
        constant = signals.sensor_dynamics.time_constant_s
        moved = predicted if constant == 0.0 else low_passed(predicted, constant, period)
        lines.append((signals.latency_std_s / period * np.gradient(moved))[None])
    rows = problem.noise(segment).apply(np.concatenate(lines).T)[signals.sensor_dynamics.unknown(period) :]
    return _block(rows, indices, segment.nuisance_count)


def _known(problem: Problem, point: Point) -> list[Block]:
    """Return what priors and other spans' summary say, as blocks of their own."""
    sizes, blocks = sizes_of(point.values, problem.layout, problem.signals.period_s), []
    for index, value, std in problem.priors:
        one = np.array([[sizes[index] / std]])
        residual = np.array([(point.values[index] - value) / std])
        blocks.append(Block(residual=residual, jacobian=one, indices=np.array([index]), own=None))
    if problem.summary is not None:
        root = problem.summary.root
        residual = root @ _apart(problem, point.values)
        blocks.append(Block(residual=residual, jacobian=root, indices=np.arange(len(problem.layout)), own=None))
    return blocks


def _apart(problem: Problem, values: FloatArray) -> FloatArray:
    """Return how many steps away from the summary's centre the parameters are."""
    if problem.summary is None:
        return np.zeros(len(values))
    centre = problem.summary.values
    ratio = np.log(np.maximum(values, 1e-300) / np.maximum(centre, 1e-300))
    sizes = sizes_of(centre, problem.layout, problem.signals.period_s)
    return np.where(logarithmic(problem.layout), ratio, (values - centre) / sizes)


def _block(rows: FloatArray, indices: NDArray[np.intp], own_count: int) -> Block:
    """Split (residual, shared columns, own columns, systematic) and project the own ones out."""
    shared_end = 1 + len(indices)
    own_end = shared_end + own_count
    residual, shared, own = rows[:, 0], rows[:, 1:shared_end], rows[:, shared_end:own_end]
    q, r = np.linalg.qr(own)
    to_residual, to_shared = q.T @ residual, q.T @ shared
    systematic = rows[:, own_end:]
    return Block(
        residual=residual - q @ to_residual,
        jacobian=shared - q @ to_shared,
        indices=indices,
        own=(r, to_residual, to_shared),
        systematic=systematic - q @ (q.T @ systematic) if systematic.shape[1] else None,
    )


def _untimed(values: FloatArray, segment: Segment, path: FlangePath, period_s: float) -> FloatArray:
    """Return the force that is missed if the flange takes its speed half a sample advance_in_time or later, (2, n).

    Between the ticks the pose says nothing. A robot that follows a held command jumps in speed at every tick, by up to
    h (a + ω v); the coupling's damping passes that on. ω is taken as 2π·5 Hz, the damping for at least a twentieth of
    the critical one, since it is itself known by this.
    """
    damping = max(float(values[1]), 0.1 * float(np.sqrt(values[0] * values[3])))
    speed = path.cut(segment.slice).velocity / period_s
    acceleration = np.gradient(speed, period_s)
    return 0.5 * period_s * damping * np.array([acceleration, 2.0 * np.pi * _ROBOT_HZ * speed])


def information(blocks: Sequence[Block], count: int) -> tuple[FloatArray, FloatArray]:
    """Return JᵀJ (count, count) and Jᵀr (count,) over the spans, in scaled parameters."""
    matrix, gradient = np.zeros((count, count)), np.zeros(count)
    for block in blocks:
        matrix[np.ix_(block.indices, block.indices)] += block.jacobian.T @ block.jacobian
        gradient[block.indices] += block.jacobian.T @ block.residual
    return matrix, gradient


def cost(problem: Problem, point: Point) -> float:
    """Return the sum of squares of all whitened residuals; the pose's offsets are taken out."""
    signals, layout = problem.signals, problem.layout
    path = problem.path(point.values)
    total = 0.0
    for segment, nuisance in zip(problem.segments, point.nuisances, strict=True):
        predicted = predict_force(point.values, nuisance, segment, path, layout, signals.period_s)
        predicted = signals.sensor_dynamics.shown(
            predicted, path, segment.slice, float(point.values[1]), signals.period_s
        )
        error = problem.noise(segment).apply(predicted - signals.force_n[segment.slice])
        error = error[signals.sensor_dynamics.unknown(signals.period_s) :]
        with np.errstate(over="ignore"):  # a trial that runs away is worse than any
            total += float(error @ error)
    if layout.robot_order and problem.pose_spans:
        for span in problem.pose_spans:
            misfit = path.misfit(signals.at_poses(span))
            error = problem.pose_noise.apply(misfit - np.mean(misfit))
            total += float(error @ error) - len(error) * float(np.mean(error)) ** 2
    if problem.summary is not None:
        total += float(np.sum((problem.summary.root @ _apart(problem, point.values)) ** 2))
    total += sum(((float(point.values[i]) - value) / std) ** 2 for i, value, std in problem.priors)
    return total if np.isfinite(total) else np.inf


def minimise(problem: Problem, point: Point, most_steps: int) -> tuple[Point, float]:
    """Step to the least squares with steps halved until they help; parameters at a bound of 0 stay there if pushed."""
    count = len(problem.layout)
    now = cost(problem, point)
    if not np.isfinite(now):
        return point, now  # no slope leads out of numbers that ran away
    for _ in range(most_steps):
        blocks = linearise(problem, point)
        matrix, gradient = information(blocks, count)
        step = _bounded_step(problem, point, matrix, gradient)
        share, better = 1.0, False
        for _ in range(_MOST_HALVINGS):
            trial = _moved(problem, point, blocks, share * step, share)
            after = cost(problem, trial) if np.all(np.isfinite(trial.values)) else np.inf
            if after < now:
                better = True
                break
            share *= 0.35
        if not better:
            break
        gained, point, now = now - after, trial, after
        if gained < _CONVERGED:
            break
    return point, now


def _bounded_step(problem: Problem, point: Point, matrix: FloatArray, gradient: FloatArray) -> FloatArray:
    count = len(gradient)
    sizes = sizes_of(point.values, problem.layout, problem.signals.period_s)
    linear = ~logarithmic(problem.layout)
    scaled = point.values / sizes
    free = np.ones(count, dtype=bool)
    free[list(problem.fixed)] = False
    step = np.zeros(count)
    for _ in range(count):
        step[:] = 0.0
        inside = matrix[np.ix_(free, free)]
        # What the spans do not show to 30 of its sizes stays where it is: its derivatives may be nothing but rounding.
        ridge = 1e-10 * np.diag(inside) + 1e-3
        step[free] = -np.linalg.solve(inside + np.diag(ridge), gradient[free])
        at_bound = linear & (scaled <= 0.0)
        at_bound[3] = point.values[3] <= problem.lightest_kg
        blocked = free & at_bound & (step < 0.0)
        blocked[3] |= free[3] and point.values[3] >= problem.heaviest_kg and step[3] > 0.0
        if not np.any(blocked):
            break
        free &= ~blocked
    return step


def _moved(problem: Problem, point: Point, blocks: Sequence[Block], step: FloatArray, share: float) -> Point:
    """Return the point after a step; each span's own parameters follow, the larger ones of a logarithm are cut."""
    sizes = sizes_of(point.values, problem.layout, problem.signals.period_s)
    in_log = logarithmic(problem.layout)
    grown = point.values * np.exp(np.clip(step, -_LARGEST_LOG_STEP, _LARGEST_LOG_STEP))
    values = np.where(in_log, grown, np.maximum(point.values + step * sizes, 0.0))
    values[3] = np.clip(values[3], problem.lightest_kg, problem.heaviest_kg)
    nuisances = []
    for nuisance, block in zip(point.nuisances, blocks[: len(problem.segments)], strict=True):
        if block.own is None:
            nuisances.append(nuisance)
            continue
        r, to_residual, to_shared = block.own
        diagonal = np.abs(np.diag(r))
        if np.min(diagonal) < 1e-12 * np.max(diagonal):
            nuisances.append(nuisance)
            continue
        nuisances.append(nuisance - np.linalg.solve(r, share * to_residual + to_shared @ step[block.indices]))
    return replace(point, values=values, nuisances=tuple(nuisances))
