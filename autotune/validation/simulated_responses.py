"""Free-space admittance, command noise and passive band from simulated sines and impulses, played tick by tick."""

import math
from collections.abc import Sequence
from copy import copy
from typing import Any

import numpy as np

from problems.arrays import FloatArray
from problems.model.controller import AdmittanceController
from problems.model.plant import FREE_SPACE, Plant, WrenchFilter, build_plant_matrices
from problems.model.robot import RobotModel
from problems.model.sampled import hold

from .replay import DifferenceEquation, robot_stepper, settling_samples

_FREQUENCIES = 5
_SETTLE_S = 2.0
_PERIODS = 2.0


def sampled_admittance(
    port: tuple[RobotModel, WrenchFilter],
    controller: AdmittanceController,
    sample_time_s: float,
    band_hz: tuple[float, float],
) -> float:
    """Return the smallest |V/F| [m/s/N] at five frequencies of the band, ends included, from simulated sines.

    A sine that passes the wrench's filter is a smaller sine.
    """
    robot, wrench = port
    frequencies = np.unique(np.geomspace(*band_hz, _FREQUENCIES))
    passed = np.abs(wrench.response(2.0 * np.pi * frequencies))
    found = [
        float(share) * _gain(robot, controller, sample_time_s, float(f))
        for f, share in zip(frequencies, passed, strict=True)
    ]
    return min(found)


def _gain(robot: RobotModel, controller: AdmittanceController, h: float, frequency_hz: float) -> float:
    law, step = DifferenceEquation(controller, h), robot_stepper(robot, h)
    samples = round((_SETTLE_S + _PERIODS / frequency_hz) / h)
    omega = 2.0 * np.pi * frequency_hz
    force = np.sin(omega * h * np.arange(samples))
    position = np.empty(samples)
    x = 0.0
    for k in range(samples):
        position[k] = x
        x = step(law.step(float(force[k]), x))
    # Least squares on the steady part: sine, cosine, drift and offset of the position.
    used = slice(round(_SETTLE_S / h), samples)
    t = h * np.arange(samples)[used]
    columns = np.column_stack([np.sin(omega * t), np.cos(omega * t), t, np.ones_like(t)])
    sine, cosine, _, _ = np.linalg.lstsq(columns, position[used], rcond=None)[0]
    return float(omega * np.hypot(sine, cosine))


_SHORTEST_S = 0.8
_PORT_S = 10.0
_RESOLUTION_HZ = 0.005
_NOT_SETTLED = 1e-6
# A real part this small beside |G| is rounding.
_NOTHING = 1e-9


def worst_speed_rms(plants: Sequence[Plant], law: AdmittanceController, sample_time_s: float) -> float:
    """Return the largest RMS of the commanded speed per RMS of white force noise [m/s per N], in contact and free.

    The squares of the response to a single tick of force add up to the variance under noise.
    """
    both = tuple(dict.fromkeys((*plants, *(plant.in_contact_with(FREE_SPACE) for plant in plants))))
    return float(np.max(speed_rms(both, law, sample_time_s)))


def speed_rms(plants: Sequence[Plant], law: AdmittanceController, sample_time_s: float) -> FloatArray:
    """Return the same for each plant (p,), touching all the time if it touches at all; the loops must be stable."""
    h = sample_time_s
    plant = _Plants(plants, h)
    # The difference equation adds and multiplies only: what it does to a number it does to each plant's.
    equation: Any = DifferenceEquation(law, h)
    direct = equation.gain * equation.weights[0] / equation.new
    last = squares = np.zeros(len(plants))
    for k in range(max(settling_samples(each, law, h, _SHORTEST_S) for each in plants)):
        tick = 1.0 if k == 0 else 0.0
        force, position = plant.force() + tick, plant.position()
        if np.any(plant.direct != 0.0):
            tried = np.asarray(copy(equation).step(force, position))
            force = force + plant.direct * tried / (1.0 - direct * plant.direct)
        command = np.asarray(equation.step(force, position))
        squares, last = squares + (command - last) ** 2, command
        plant.advance(command)
    return np.sqrt(squares) / h


class _Plants:
    """Plants of one robot order (p,), advanced together by a sample at a time, each with its own delay."""

    def __init__(self, plants: Sequence[Plant], h: float) -> None:
        matrices = [build_plant_matrices(plant, h) for plant in plants]
        late = [plant.loop_delay_s / h for plant in plants]
        self.whole = np.array([math.floor(each + _NOTHING) for each in late])
        fraction = [max(each - whole, 0.0) for each, whole in zip(late, self.whole, strict=True)]
        self.is_split = np.array(fraction) > _NOTHING
        before = [hold(m.a, m.b, share) for m, share in zip(matrices, fraction, strict=True)]
        after = [hold(m.a, m.b, 1.0 - share) for m, share in zip(matrices, fraction, strict=True)]
        self.before = np.array([phi for phi, _ in before]), np.array([gamma for _, gamma in before])
        self.after = np.array([phi for phi, _ in after]), np.array([gamma for _, gamma in after])
        self.c_force = np.array([m.c_force for m in matrices])
        self.c_position = np.array([m.c_position for m in matrices])
        self.d_force = np.array([m.d_force for m in matrices])
        # Without any delay the force at a tick depends on the command of that tick, which depends on it.
        self.direct = np.where((self.whole == 0) & ~self.is_split, self.d_force, 0.0)
        self.state = np.zeros(self.c_force.shape)
        self.rows = np.arange(len(plants))
        # The newest command first.
        self.commands = np.zeros((int(np.max(self.whole)) + 2, len(plants)))

    def force(self) -> FloatArray:
        """Return F, where the delay ends at a tick that of right after it; what the next command adds is `direct`."""
        age = np.where(self.is_split, self.whole, np.maximum(self.whole - 1, 0))
        held = (self.d_force - self.direct) * self.commands[age, self.rows]
        return np.asarray(np.sum(self.c_force * self.state, axis=1) + held)

    def position(self) -> FloatArray:
        """Return the flange's position."""
        return np.asarray(np.sum(self.c_position * self.state, axis=1))

    def advance(self, command: FloatArray) -> None:
        """Send a command and advance by a sample."""
        self.commands = np.vstack([command, self.commands[:-1]])
        older = np.where(self.is_split, self.commands[self.whole + 1, self.rows], 0.0)
        newer = self.commands[self.whole, self.rows]
        for (phi, gamma), held in ((self.before, older), (self.after, newer)):
            self.state = np.einsum("pij,pj->pi", phi, self.state) + gamma * held[:, None]


def passive_band_hz(
    port: tuple[RobotModel, WrenchFilter], law: AdmittanceController, sample_time_s: float, up_to_hz: float
) -> float:
    """Return up to where Re G ≥ 0, at most `up_to_hz`, G = V/F being the transform of the answer to a tick of force.

    The wrench's filter lies before that tick. 0 for a port that does not come to rest.
    """
    h = sample_time_s
    robot, wrench = port
    equation, step = DifferenceEquation(law, h), robot_stepper(robot, h)
    position = np.empty(math.ceil(_PORT_S / h))
    x = 0.0
    for k in range(len(position)):
        position[k] = x
        x = step(equation.step(1.0 if k == 0 else 0.0, x))
    moved = np.diff(position, prepend=0.0)
    if not np.max(np.abs(moved[-len(moved) // 10 :])) <= _NOT_SETTLED * np.max(np.abs(moved)):
        return 0.0
    count = 2 ** math.ceil(math.log2(max(1.0 / (_RESOLUTION_HZ * h), len(moved))))
    omega = 2.0 * np.pi * np.fft.rfftfreq(count, h)[1:]
    # The position is the sum of its moves, and the velocity its derivative below the Nyquist frequency.
    admittance = 1j * omega * np.fft.rfft(moved, count)[1:] / (1.0 - np.exp(-1j * omega * h))
    if not wrench.is_none:
        admittance = admittance * wrench.response(np.asarray(omega, dtype=np.float64))
    negative = np.flatnonzero(admittance.real < -_NOTHING * np.abs(admittance))
    fails = math.inf if not negative.size else float(omega[negative[0]]) / (2.0 * np.pi)
    return min(fails, up_to_hz)
