"""How fast the robot goes as it follows the command: the limit of the speed behind a lag.

The robot goes at v = r e^(−s T_d) v^d. Behind a first-order lag τ the command's speed is v_f = v^d/(τ s + 1), so that
v = (τ s + 1) r e^(−s T_d) v_f: |v| is at most max |v_f| times the integral of that impulse response's magnitude, which
is 1 for a robot of one pole and its own τ.
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from autotune.formats.controller_record import Controller, admittance_controller
from autotune.formats.limits import LimitsNoise
from autotune.formats.units import ROTATIONAL_AXES
from autotune.runtime.load import LEVER_M
from problems.arrays import FloatArray
from problems.design.requirements import ContactAtSpeed
from problems.model.controller import controller_blocks
from problems.model.difference import ControlState, controller_step
from problems.model.hold import hold
from problems.model.robot import RobotModel

from .certified_requirements import asked_of
from .replay import robot_rates

# The robot's answer is looked at so often in a period, and until exp(-20) is left of its slowest part.
_SUBSTEPS, _DECAY_EXPONENTS, _MOST_PERIODS = 8, 20.0, 20_000
NOISE_DEVIATIONS = 6.0
"""A limit lies this many deviations of the noise above what is reached: one tick in 1e9 is beyond it."""
# Lags that are tried, in those of the robot.
_LAGS = (0.25, 0.5, 0.7, 0.85, 1.0, 1.2, 1.5)


def followed_speeds(speeds: FloatArray, weight: float, start: float = 0.0) -> FloatArray:
    """Return the speeds (n,) behind the lag, as the runtime counts them, from the steady speed `start` on."""
    found, last = np.empty(len(speeds)), start
    for i, speed in enumerate(speeds.tolist()):
        last += weight * (speed - last)
        found[i] = last
    return found


def robot_share(robot: RobotModel, sample_time_s: float, weight: float) -> float:
    """Return the largest speed of the robot over the largest behind the lag, an impulse response's sum of magnitudes.

    A command that steps by Δ makes the robot's speed Δ g(t), g the impulse response of r(s); between two ticks it is
    looked at in eighths.
    """
    rate, drive, output = robot_rates(robot, sample_time_s)
    step, _ = hold(rate, drive, 1.0 / _SUBSTEPS)
    slowest = -float(np.max(np.linalg.eigvals(rate).real))
    periods = min(_MOST_PERIODS, math.ceil(_DECAY_EXPONENTS / slowest) + 2)
    state, answer = drive.copy(), np.empty(periods * _SUBSTEPS + 1)
    for i in range(len(answer)):
        answer[i] = output @ state
        state = step @ state
    # (z^-1 of the lag taken back): v_k = (f_k − (1 − w) f_{k−1})/w. The end of a period counts as of the one before.
    after = np.concatenate([answer[:-1].reshape(periods, _SUBSTEPS), answer[_SUBSTEPS::_SUBSTEPS, None]], axis=1)
    before = np.concatenate([np.zeros((1, _SUBSTEPS + 1)), after[:-1]])
    return float(np.max(np.sum(np.abs(after - (1.0 - weight) * before), axis=0)) / weight)


def largest_share(controller: Controller, name: str, lag_s: float) -> float:
    """Return the largest `robot_share` of the nominal robot and of those at the corners of what is uncertain."""
    h, plants = controller.sample_time_s, controller.certificate.domain[name].plants
    robots = dict.fromkeys([plants.nominal.robot, *(each.plant(plants.nominal).robot for each in plants.corners())])
    return max(robot_share(robot, h, _weight(h, lag_s)) for robot in robots)


def _weight(h: float, lag_s: float) -> float:
    return -math.expm1(-h / lag_s)


def robot_lag_s(robot: RobotModel) -> float:
    """Return the lag τ of the robot's r(s) ≈ 1 − τ s at low frequencies; 0 where it leads."""
    num, den = (np.append(each, 0.0) for each in robot.ascending())
    return max(0.0, float(den[1] / den[0] - num[1] / num[0]))


def safe_speed(controller: Controller, name: str) -> tuple[float, ContactAtSpeed] | None:
    """Return the speed up to which no contact exceeds the force of `contact_at_speed`, and that; None if not asked."""
    asked, per_speed = asked_of(controller, name).get("contact_at_speed"), controller.predicted[name].peak_per_speed
    if not isinstance(asked, ContactAtSpeed) or per_speed is None:
        return None
    return per_speed.largest_speed(asked.max_force_n, asked.hand), asked


@dataclass(frozen=True, kw_only=True)
class FollowedSpeed:
    """What certified contacts and noise `reached` behind a lag, and the robot's largest speed as a share of that."""

    lag_s: float
    contacts: float
    noise: float
    share: float

    @property
    def reached(self) -> float:
        """The speed behind the lag that certified contacts reach under noise."""
        return self.contacts + self.noise


def choose_followed(
    controller: Controller, name: str, noise: LimitsNoise, contacts: Iterable[FloatArray]
) -> FollowedSpeed:
    """Return the lag, of those around the robot's own, behind which the robot is known to go least.

    `contacts` are the commands (n,) of the certified contacts, each from a steady speed on; a force that passes the
    deadband at once counts as one.
    """
    h = controller.sample_time_s
    runs = [np.diff(each) / h for each in contacts]
    whole = robot_lag_s(controller.certificate.domain[name].plants.nominal.robot)
    lags = dict.fromkeys(float(f"{max(part * whole, h):.2g}") for part in _LAGS)
    force, pose = _impulse_answers(controller, name, max(lags))
    runs.append(np.cumsum(np.append(0.0, controller.axes[name].deadband * force)))
    turns = name in ROTATIONAL_AXES
    of_force, of_pose = noise.torque_n_m if turns else noise.force_n, noise.position_m / (LEVER_M if turns else 1.0)
    found = []
    for lag in lags:
        weight = _weight(h, lag)
        reached = max(float(np.max(np.abs(followed_speeds(each, weight, each[0])))) for each in runs)
        shaken = [
            float(np.linalg.norm(size * followed_speeds(each, weight)))
            for size, each in ((of_force, force), (of_pose, pose))
        ]
        noisy = NOISE_DEVIATIONS * math.hypot(*shaken)
        share = largest_share(controller, name, lag)
        found.append(FollowedSpeed(lag_s=lag, contacts=reached, noise=noisy, share=share))
    return min(found, key=lambda each: each.reached * each.share)


def _impulse_answers(controller: Controller, name: str, lag_s: float) -> tuple[FloatArray, FloatArray]:
    """Return the command's speeds (n,) after a force of 1 N (N·m), and a pose of 1 m (rad), in one period alone."""
    h, law = controller.sample_time_s, admittance_controller(controller, name)
    times = [lag_s, law.mass_kg / law.damping_n_s_per_m, law.biquad_pole_s]
    times += [1.0 / law.velocity_filter_rad_per_s, 1.0 / law.acceleration_filter_rad_per_s]
    periods = min(_MOST_PERIODS, math.ceil(_DECAY_EXPONENTS * max(times) / h))
    blocks, answers = controller_blocks(law, h), []
    for force, position in ((1.0, 0.0), (0.0, 1.0)):
        state: ControlState = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
        commands = np.zeros(periods + 1)
        for k in range(periods):
            commands[k + 1], state = controller_step(blocks, state, force * (k == 0), position * (k == 0))
        answers.append(np.diff(commands) / h)
    return answers[0], answers[1]
