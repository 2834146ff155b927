"""The rendered free-space admittance measured in time: push with a sine, read the steady velocity."""

import numpy as np

from problems.model.controller import AdmittanceController
from problems.model.plant import WrenchFilter
from problems.model.robot import RobotModel

from .replay import DifferenceEquation, robot_stepper

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
