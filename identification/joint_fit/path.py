"""Path of the flange between the ticks, and the sensor's low-pass and delay."""

import math
from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np
import scipy
from scipy.interpolate import CubicSpline, make_interp_spline

from problems.arrays import FloatArray

from .kernel import TINY, mark_robot, run_robot
from .model import Hold, held, held_step, robot_rate
from .noise import Smoother

_MARK_EVERY = 256
_FINER, _DIFFERENCE = 12, 1e-4
MOST_CUTS = 64
_DIED_AWAY, _LONGEST_S = 6.0, 0.1
# Coefficients of 1 to s³ of Lagrange's cubic through samples at s = 2, 1, 0 and −1.
_CUBIC = np.array([[0.0, -1.0, 0.0, 1.0], [0.0, 6.0, 3.0, -3.0], [6.0, -3.0, -6.0, 3.0], [0.0, -2.0, 3.0, -1.0]]) / 6.0
_TERMS = 20
# What a cubic spline does 128 samples away is 0.268¹²⁸ of it, less than any rounding.
_PART, _SPLINE_REACH = 2**15, 128


@dataclass(frozen=True, kw_only=True)
class RobotRun:
    """The robot's answer to the held command: its state at every 256th tick, from which any stretch is run again.

    All states of a long log, for each parameter that is moved, would be more than everything else that is held.
    """

    step: FloatArray
    command_m: FloatArray
    older: int
    marks: FloatArray

    def states(self, first: int, stop: int) -> FloatArray:
        """Return the robot's state (stop - first, order) at the ticks from `first` to before `stop`."""
        mark = first // _MARK_EVERY
        begin = mark * _MARK_EVERY
        return run_robot(self.step, self.command_m, self.older, self.marks[mark], begin, stop)[first - begin :]

    def acting(self, first: int, stop: int) -> tuple[FloatArray, FloatArray]:
        """Return the older and the newer command of each sample; before the first command it is that one."""
        ticks = np.arange(first, stop) - self.older
        return self.command_m[np.maximum(ticks, 0)], self.command_m[np.maximum(ticks + 1, 0)]


@dataclass(frozen=True, kw_only=True)
class PathSegment:
    """The flange at some ticks, time counted in samples.

    `drive` (n, m) is what `payload_step` takes: robot state, older and newer command, and Taylor coefficients of the
    rest; `ends` (n, 4) position and velocity right after the tick, and just before the next.
    """

    drive: FloatArray
    ends: FloatArray

    @property
    def position(self) -> FloatArray:
        """The position (n,) at the ticks."""
        return self.ends[:, 0]

    @property
    def velocity(self) -> FloatArray:
        """The velocity (n,) right after the ticks, in m per sample."""
        return self.ends[:, 1]


@dataclass(frozen=True, kw_only=True)
class FlangePath:
    """The flange's path over the log, worked out where a span asks for it.

    `run` is the robot's answer and `robot` the rows of its equation, both None without a command; `mean_m` is the mean
    of measured − robot. `yielded` (n, 4), value and derivatives over factorials, is how far the robot gives way to the
    payload, which `position_m` is without; behind a `smooth_command` (n,) it holds the robot's answer to that, too.
    `keeps` is how many cuts are kept for who asks again.
    """

    position_m: FloatArray
    smoother: Smoother
    mean_m: float
    run: RobotRun | None
    robot: FloatArray | None
    hold: Hold
    yielded: FloatArray | None = None
    smooth_command: FloatArray | None = None
    keeps: int = MOST_CUTS
    _cuts: dict[tuple[int, int], PathSegment] = field(default_factory=dict, init=False, repr=False, compare=False)

    def misfit(self, used: slice) -> FloatArray:
        """Return measured − robot [m] at the ticks of a slice."""
        measured = self.position_m[used]
        if self.run is None:
            return measured
        return np.asarray(measured - self.run.states(used.start, used.stop)[:: used.step, 0])

    def cut(self, used: slice) -> PathSegment:
        """Return the path at the ticks of a span."""
        key = used.start, used.stop
        found = self._cuts.pop(key, None)
        if found is None:
            found = self._cut(*key)
            for oldest in list(self._cuts)[: len(self._cuts) + 1 - self.keeps]:
                del self._cuts[oldest]
        self._cuts[key] = found
        return found

    def _cut(self, first: int, stop: int) -> PathSegment:
        # The last sample ends at a tick of its own, but for that of the log, which goes on as it began.
        beyond = min(stop + 1, len(self.position_m))
        count = stop - first
        rest = self._rest(first, beyond)
        if self.yielded is not None:
            rest = rest + self.yielded[first:beyond]
        drive = [rest[:count]]
        position, velocity = rest[:, 0], rest[:, 1]
        arriving = velocity[1:]
        if self.run is not None and self.robot is not None:
            states = self.run.states(first, beyond)
            older, newer = self.run.acting(first, beyond)
            of_state, of_command = self.robot[0, :-1], self.robot[0, -1]
            answer = states @ of_state
            # What acts at the end of a sample has acted since its fraction.
            arriving = answer[1:] + of_command * newer[: len(arriving)] + arriving
            position = states[:, 0] + position
            velocity = answer + of_command * (older if self.hold.fraction.real > 0.0 else newer) + velocity
            drive = [states[:count], older[:count, None], newer[:count, None], *drive]
        ends = np.empty((count, 4))
        ends[:, 0], ends[:, 1] = position[:count], velocity[:count]
        ends[: len(arriving), 2], ends[: len(arriving), 3] = position[1:], arriving
        if beyond == stop:
            ends[-1, 2:] = position[-1] + velocity[-1], velocity[-1]
        return PathSegment(drive=np.concatenate(drive, axis=1), ends=ends)

    def _rest(self, first: int, stop: int) -> FloatArray:
        """Return value and three derivatives over factorials (stop - first, 4) of what the pose shows beside."""
        if self.run is not None and self.smoother.taps is None:
            rest = np.zeros((stop - first, 4))
            rest[:, 0] = self.mean_m
            return rest
        last = len(self.position_m)
        low, high = max(first - 1, 0), min(stop + 2, last)
        half_width = self.smoother.half_width
        near = slice(max(low - half_width, 0), min(high + half_width, last))
        missing = near.start - (low - half_width), high + half_width - near.stop
        coefficients = self.smoother.spline(np.pad(self.misfit(near), missing, mode="edge"), self.mean_m)
        return _taylor(np.pad(coefficients, (low - (first - 1), stop + 2 - high), mode="edge"))


def measured_path(position_m: FloatArray, smoother: Smoother) -> FlangePath:
    """Take the smoothed pose alone, by a cubic spline between the ticks."""
    return FlangePath(
        position_m=position_m,
        smoother=smoother,
        mean_m=float(np.mean(position_m)),
        run=None,
        robot=None,
        hold=Hold(older=1, fraction=0.0),
    )


def commanded_path(
    values: FloatArray,
    command_m: FloatArray,
    position_m: FloatArray,
    smoother: Smoother,
    period_s: float,
    keeps: int = MOST_CUTS,
    yielded: FloatArray | None = None,
) -> FlangePath:
    """Take the robot's exact answer to the held command, and beside it what the pose surely shows of another motion.

    The robot is at rest at the first command. What it gives way to the payload, `yielded` (n, 4), is taken as it is.
    """
    position_m = position_m if yielded is None else position_m - yielded[:, 0]
    step, older = held_step(values, period_s)
    command, start = np.ascontiguousarray(command_m), np.zeros(len(step))
    start[0] = command[0]
    marks, mean = mark_robot(step, command, older, start, np.ascontiguousarray(position_m), _MARK_EVERY)
    return FlangePath(
        position_m=position_m,
        smoother=smoother,
        mean_m=mean,
        run=RobotRun(step=step, command_m=command, older=older, marks=marks),
        robot=robot_rate(values, period_s),
        hold=held(float(values[-1]), period_s),
        yielded=yielded,
        keeps=keeps,
    )


def smooth_path(
    values: FloatArray,
    command_m: FloatArray,
    position_m: FloatArray,
    smoother: Smoother,
    period_s: float,
    keeps: int = MOST_CUTS,
    yielded: FloatArray | None = None,
) -> FlangePath:
    """Take the robot's answer to a command (n,) that is smooth between its samples, and what the pose shows beside it.

    `yielded` (n, 4) is as in `commanded_path`.
    """
    answer = smooth_answer(values, command_m, period_s)
    if yielded is not None:
        answer = answer + yielded
    beside = position_m - answer[:, 0]
    return FlangePath(
        position_m=beside,
        smoother=smoother,
        mean_m=float(np.mean(beside)),
        run=None,
        robot=None,
        hold=Hold(older=1, fraction=0.0),
        yielded=answer,
        smooth_command=command_m,
        keeps=keeps,
    )


def smooth_answer(values: FloatArray, command_m: FloatArray, period_s: float) -> FloatArray:
    """Return the robot's answer to the cubic spline through a command (n,), (n, 4) as `FlangePath.yielded`.

    The robot is at rest at the first command. Between the ticks the answer is a cubic with place and speed of both.
    """
    omega, delay_s = float(values[0]), float(values[-1])
    poles = np.array([1.0, omega] if len(values) == 2 else [1.0, 2.0 * float(values[1]) * omega, omega**2])
    count, path = len(command_m), _spline_through(command_m.tobytes())
    ticks = np.arange((count - 1) * _FINER + 1) / _FINER
    late = path(np.clip(ticks - delay_s / period_s, 0.0, count - 1.0)) - command_m[0]
    answers = []
    for numerator in (poles[-1:], np.append(poles[-1:], 0.0)):
        b, a, _ = scipy.signal.cont2discrete((numerator, poles), period_s / _FINER, method="foh")
        answers.append(scipy.signal.lfilter(np.ravel(b), a, late)[::_FINER])
    place, speed = command_m[0] + answers[0], period_s * answers[1]
    out = np.column_stack([place, speed, np.zeros(count), np.zeros(count)])
    way = np.diff(place)
    out[:-1, 2] = 3.0 * way - 2.0 * speed[:-1] - speed[1:]
    out[:-1, 3] = speed[:-1] + speed[1:] - 2.0 * way
    return out


# Every path of a fit asks for the same one.
@lru_cache(maxsize=4)
def _spline_through(command: bytes) -> CubicSpline:
    values = np.frombuffer(command)
    return CubicSpline(np.arange(len(values)), values)


def path_slope(path: FlangePath, values: FloatArray, index: int, period_s: float) -> FlangePath:
    """Return the derivative of a commanded path by one of the robot's parameters, as a path of its own, exactly.

    The derivative s' of the robot's state s moves by S s' + S' (s, commands): (s', s) is the state of one more system
    under the same command. What the pose shows beside the robot is linear in it. Behind a smooth command it is a
    central difference.
    """
    if path.smooth_command is not None:
        return _smooth_slope(path, path.smooth_command, values, index, period_s)
    if path.run is None or path.robot is None:
        raise ValueError("A path without a command does not depend on the robot.")
    turned = [complex(value, TINY if i == index else 0.0) for i, value in enumerate(values)]
    step, row = held_step(turned, period_s)[0], robot_rate(turned, period_s)[0]
    order = len(step)
    both = np.zeros((2 * order, 2 * order + 2))
    both[:order, :order], both[:order, order:] = step.real[:, :order], step.imag / TINY
    both[order:, order:] = step.real
    command, nowhere, start = path.run.command_m, np.zeros(len(path.position_m)), np.zeros(2 * order)
    start[order] = command[0]
    marks, mean = mark_robot(both, command, path.run.older, start, nowhere, _MARK_EVERY)
    return FlangePath(
        position_m=nowhere,
        smoother=path.smoother,
        mean_m=mean,
        run=RobotRun(step=both, command_m=command, older=path.run.older, marks=marks),
        robot=np.concatenate([row.real[:-1], row.imag / TINY])[None],
        hold=path.hold,
        keeps=1,
    )


def _smooth_slope(
    path: FlangePath, command_m: FloatArray, values: FloatArray, index: int, period_s: float
) -> FlangePath:
    """Return the derivative of a path behind a smooth command by one of the robot's parameters."""
    step = np.zeros(len(values))
    step[index] = _DIFFERENCE * (period_s if index == len(values) - 1 else float(values[index]))
    ahead, behind = (smooth_answer(values + way * step, command_m, period_s) for way in (1.0, -1.0))
    slope = (ahead - behind) / (2.0 * step[index])
    return FlangePath(
        position_m=-slope[:, 0],
        smoother=path.smoother,
        mean_m=-float(np.mean(slope[:, 0])),
        run=None,
        robot=None,
        hold=path.hold,
        yielded=slope,
        keeps=1,
    )


def given_way(values: FloatArray, force_n: FloatArray, period_s: float) -> FloatArray:
    """Return how far a robot r(s) of stiffness 1 N/m gives way to forces (n,), (n, 4) as `FlangePath.yielded`.

    `values` are ω, (ζ,) T_d; the force, straight between the ticks, acts without the command's delay.
    """
    omega = float(values[0])
    poles = [1.0, omega] if len(values) == 2 else [1.0, 2.0 * float(values[1]) * omega, omega**2]
    b, a, _ = scipy.signal.cont2discrete(([poles[-1]], poles), period_s, method="foh")
    place, out = scipy.signal.lfilter(np.ravel(b), a, force_n - force_n[0]), np.empty((len(force_n), 4))
    # By parts: the equations of a long log's spline would be the most that is ever in memory.
    for first in range(0, len(place), _PART):
        ticks = np.arange(first, min(first + _PART, len(place)))
        near = np.arange(max(first - _SPLINE_REACH, 0), min(first + _PART + _SPLINE_REACH, len(place)))
        way = make_interp_spline(near, place[near], k=3)
        for k in range(4):
            out[ticks, k] = way(ticks, nu=k) / math.factorial(k)
    return out


def _taylor(c: FloatArray) -> FloatArray:
    """Return value and three derivatives over factorials (n, 4) of the cubic spline Σ c_k B(τ − k), c (n + 3,)."""
    before, here, after, beyond = c[:-3], c[1:-2], c[2:-1], c[3:]
    return np.column_stack(
        [
            (before + 4.0 * here + after) / 6.0,
            0.5 * (after - before),
            0.5 * (after - 2.0 * here + before),
            (beyond - 3.0 * after + 3.0 * here - before) / 6.0,
        ]
    )


@dataclass(frozen=True, kw_only=True)
class SensorDynamics:
    """The sensor shows F(t − delay) behind 1/(time_constant s + 1); a delay below zero is early."""

    time_constant_s: float = 0.0
    delay_s: float = 0.0

    def felt(self, forces: FloatArray, period_s: float, every: int = 1) -> FloatArray:
        """Return what the sensor shows of forces (…, n) that are smooth between the samples, from rest at the first.

        It is shown at every so manieth of these samples. Between the samples low-pass and shift take Lagrange's cubic
        through the four about them.
        """
        if self.time_constant_s > 0.0:
            forces = low_passed(forces, self.time_constant_s, period_s)
        return forces[..., ::every] if self.delay_s == 0.0 else _later(forces, self.delay_s / period_s, every)

    def shown(self, force: FloatArray, path: FlangePath, used: slice, damping: float, period_s: float) -> FloatArray:
        """Return what the sensor shows of a coupling's force (n,) at the ticks that jumps with a held command.

        A robot of one pole changes its speed with the command at once, `path.hold.fraction` of a sample after a tick,
        and the force with it by −B_s of that. Those steps are held, the rest of the force is smooth.
        """
        if self == SensorDynamics():
            return force
        if path.robot is None or path.robot[0, -1] == 0.0:
            return self.felt(force, period_s)
        drive, order = path.cut(used).drive, len(path.robot)
        step = drive[:, order + 1] - drive[:, order]
        jumps = -damping / period_s * float(path.robot[0, -1].real) * step
        before = np.concatenate([[0.0], np.cumsum(jumps[:-1])])
        fraction = float(path.hold.fraction.real)
        return self.felt(force - before, period_s) + self._held(before, jumps, fraction, period_s)

    def _held(self, before: FloatArray, jumps: FloatArray, fraction: float, period_s: float) -> FloatArray:
        """Return what is shown of a staircase, `before` (n,) at the ticks, that jumps a fraction of a sample later."""
        if self.time_constant_s > 0.0:
            keep = math.exp(-period_s / self.time_constant_s)
            late = 1.0 - math.exp(-(1.0 - fraction) * period_s / self.time_constant_s)
            pushed = np.concatenate([[0.0], (1.0 - keep) * before[:-1] + late * jumps[:-1]])
            shown = np.asarray(scipy.signal.lfilter([1.0], [1.0, -keep], pushed))
            return shown if self.delay_s == 0.0 else _later(shown, self.delay_s / period_s)
        ticks = np.arange(len(before)) - self.delay_s / period_s
        whole = np.floor(ticks)
        at = np.clip(whole.astype(np.intp), 0, len(before) - 1)
        return np.asarray(before[at] + np.where(ticks - whole >= fraction, jumps[at], 0.0) * (whole >= 0))

    def unknown(self, period_s: float) -> int:
        """Return how many samples of a span still show what was before it."""
        most = _DIED_AWAY * self.time_constant_s + max(self.delay_s, 0.0)
        return math.ceil(min(most, _LONGEST_S) / period_s)


def low_passed(forces: FloatArray, time_constant_s: float, period_s: float) -> FloatArray:
    """Return forces (…, n) behind 1/(τ s + 1), Lagrange's cubic between the samples, steady before the first.

    With a = h/τ a sample keeps e^(−a) of what was shown, and adds Σ c_k I_k, c_k being the cubic's coefficients and
    I_k = ∫_0^1 a e^(−a (1 − s)) s^k ds.
    """
    share = period_s / time_constant_s
    keep, b = math.exp(-share), _CUBIC @ _moments(share)
    # Beyond its ends the force goes on straight.
    before = 2.0 * forces[..., :1] - forces[..., 1:2]
    beyond = 2.0 * forces[..., -1:] - forces[..., -2:-1]
    newest, older = np.concatenate([forces[..., 2:], beyond], axis=-1), forces[..., :1]
    past = forces[..., 1:2], older, before
    state = [
        sum(weight * each for weight, each in zip(b[k:], past, strict=False)) + (keep * older if k == 1 else 0.0)
        for k in (1, 2, 3)
    ]
    shown = scipy.signal.lfilter(b, [1.0, -keep], newest, axis=-1, zi=np.concatenate(state, axis=-1))[0]
    return np.concatenate([older, shown], axis=-1)


def _moments(share: float) -> FloatArray:
    """Return I_0 to I_3 (4,) of `low_passed`: I_k = 1 − (k/a) I_(k−1), which cancels where a is small."""
    if share < 1.0:
        rows = [[math.factorial(k) / math.factorial(m + k + 1) for m in range(_TERMS)] for k in range(4)]
        return np.asarray(share * (np.array(rows) @ (-share) ** np.arange(_TERMS)))
    moments = [1.0 - math.exp(-share)]
    for k in range(1, 4):
        moments.append(1.0 - k / share * moments[-1])
    return np.array(moments)


def _later(forces: FloatArray, samples: float, every: int = 1) -> FloatArray:
    """Return forces (…, n) `samples` later, every so manieth; the ends are held."""
    whole = math.floor(samples)
    u = 1.0 - (samples - whole)  # where between the older sample (0) and the newer one (1)
    weights = (
        -u * (u - 1.0) * (u - 2.0) / 6.0,
        (u + 1.0) * (u - 1.0) * (u - 2.0) / 2.0,
        -(u + 1.0) * u * (u - 2.0) / 2.0,
        (u + 1.0) * u * (u - 1.0) / 6.0,
    )
    last = forces.shape[-1] - 1
    ticks = np.arange(0, last + 1, every) - whole - 1
    return np.asarray(sum(weight * forces[..., np.clip(ticks + k - 1, 0, last)] for k, weight in enumerate(weights)))
