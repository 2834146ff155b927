"""The flange's path between the ticks: the robot's answer to a held command, and what the pose shows beside it."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .joint_model import Hold, held, robot_path, robot_rate
from .joint_noise import Smoother

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class FlangePath:
    """The flange at the ticks of the whole log, time counted in samples.

    `drive` (n, m) is what `payload_step` takes: robot state, older and newer command, and Taylor coefficients of the
    rest; `position`, `velocity` (n,) right after the tick, `ends` (n, 4) position and velocity at both ends of the
    sample. `robot` are the rows of the robot's equation, None without a command; `misfit_m` is measured − robot.
    """

    drive: FloatArray
    position: FloatArray
    velocity: FloatArray
    ends: FloatArray
    robot: FloatArray | None
    hold: Hold
    misfit_m: FloatArray


def measured_path(position_m: FloatArray, smoother: Smoother) -> FlangePath:
    """Take the smoothed pose alone, by a cubic spline between the ticks."""
    rest = _taylor(smoother.spline(position_m))
    position, velocity = rest[:, 0], rest[:, 1]
    return FlangePath(
        drive=np.ascontiguousarray(rest),
        position=position,
        velocity=velocity,
        ends=_ends(position, velocity, velocity),
        robot=None,
        hold=Hold(older=1, fraction=0.0),
        misfit_m=position_m,
    )


def commanded_path(
    values: FloatArray, command_m: FloatArray, position_m: FloatArray, smoother: Smoother, period_s: float
) -> FlangePath:
    """Take the robot's exact answer to the held command, and beside it what the pose surely shows of another motion."""
    hold, rate = held(float(values[-1]), period_s), robot_rate(values, period_s)
    states = robot_path(values, command_m, period_s)
    count = len(command_m)
    older, newer = _late(command_m, hold.older), _late(command_m, hold.older - 1)
    misfit = position_m - states[:, 0]
    rest = np.zeros((count, 4))
    if smoother.taps is None:
        rest[:, 0] = np.mean(misfit)
    else:
        rest = _taylor(smoother.spline(misfit))
    acting = older if hold.fraction > 0.0 else newer
    order = states.shape[1]
    after = states @ rate[0, :order] + rate[0, order] * acting
    # What acts at the end of a sample has acted since its fraction.
    before = states[1:] @ rate[0, :order] + rate[0, order] * newer[:-1]
    position, velocity = states[:, 0] + rest[:, 0], after + rest[:, 1]
    return FlangePath(
        drive=np.column_stack([states, older, newer, rest]),
        position=position,
        velocity=velocity,
        ends=_ends(position, velocity, np.append(velocity[:1], before + rest[1:, 1])),
        robot=rate,
        hold=hold,
        misfit_m=misfit,
    )


def _ends(position: FloatArray, after: FloatArray, before: FloatArray) -> FloatArray:
    following = np.append(position[1:], position[-1] + after[-1])
    arriving = np.append(before[1:], after[-1])
    return np.column_stack([position, after, following, arriving])


def _late(command_m: FloatArray, samples: int) -> FloatArray:
    """Return the command (n,) a number of samples later; before its first value it is that one."""
    return command_m if samples == 0 else np.concatenate([np.full(samples, command_m[0]), command_m[:-samples]])


def _taylor(coefficients: FloatArray) -> FloatArray:
    """Return value and three derivatives over factorials at every tick of the cubic spline Σ c_k B(τ − k)."""
    c = np.pad(coefficients, (1, 2), mode="edge")
    before, here, after, beyond = c[:-3], c[1:-2], c[2:-1], c[3:]
    return np.column_stack(
        [
            (before + 4.0 * here + after) / 6.0,
            0.5 * (after - before),
            0.5 * (after - 2.0 * here + before),
            (beyond - 3.0 * after + 3.0 * here - before) / 6.0,
        ]
    )
