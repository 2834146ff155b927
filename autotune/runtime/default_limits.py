"""The limits of a controller file that has none: wider than those that `optimize` chooses, and never none at all."""

import math
from collections.abc import Mapping
from typing import Any

from autotune.formats.limits import AxisLimits, Limits

from .law import STANDARD_GRAVITY_M_S2

# Sensor: this times what weight, bias and the worst predicted contact put on it.
_RANGE = 2.0
# The reduced speed of ISO 10218-1, at which a robot is led by hand; about a turning axis at a lever of 0.2 m.
REDUCED_SPEED_M_S, LEVER_M = 0.25, 0.2
_ABOVE_APPROACH = 2.0
# The command may gain this share of its largest speed in one period.
_SHARE_PER_PERIOD = 0.5
_LEAST_POSE_SPEED_M_S, _LEAST_POSE_SPEED_RAD_S, _ABOVE_COMMAND = 1.0, 5.0, 4.0
_STALE_WRENCH_S, _STALE_POSE_S = 0.05, 0.2
_REST_S, _MOST_REST_SAMPLES = 0.1, 100_000
# A centre of mass that is so far off, and the residual where no deadband says what is little.
_COM_OFF_M, _REST_FORCE_N, _LEAST_REST_TORQUE_N_M = 0.02, 1.0, 1.0


def default_limits(tree: Mapping[str, Any]) -> Limits:
    """Return the limits of a file that has none, from what it says of payload, approach and predicted peaks."""
    payload = tree["payload"]
    weight = payload["mass_kg"] * STANDARD_GRAVITY_M_S2
    lever = math.hypot(*payload["com_m"])
    force = weight + math.hypot(*payload["force_bias_n"]) + _worst_peak(tree, turning=False)
    torque = weight * lever + math.hypot(*payload["torque_bias_n_m"]) + _worst_peak(tree, turning=True)
    # A contact at a lever turns the sensor, whether that is tuned or not.
    torque += LEVER_M * (force - weight)
    axes = {name: _axis(tree, name) for name in tree["axes"]}
    straight = [axes[name].speed for name in axes if not name.startswith("r")]
    turning = [axes[name].speed for name in axes if name.startswith("r")]
    return Limits(
        force_n=max(_RANGE * force, _REST_FORCE_N),
        torque_n_m=max(_RANGE * torque, _LEAST_REST_TORQUE_N_M),
        axes=axes,
        pose_speed_m_s=max([_LEAST_POSE_SPEED_M_S, *(_ABOVE_COMMAND * each for each in straight)]),
        pose_speed_rad_s=max([_LEAST_POSE_SPEED_RAD_S, *(_ABOVE_COMMAND * each for each in turning)]),
        stale_wrench_s=_STALE_WRENCH_S,
        stale_pose_s=_STALE_POSE_S,
        rest_samples=max(1, min(_MOST_REST_SAMPLES, round(_REST_S / tree["sample_time_s"]))),
        rest_force_n=_smallest_deadband(tree, turning=False) or _REST_FORCE_N,
        rest_torque_n_m=_smallest_deadband(tree, turning=True) or max(_LEAST_REST_TORQUE_N_M, _COM_OFF_M * weight),
    )


def _axis(tree: Mapping[str, Any], name: str) -> AxisLimits:
    """Return the limits of the command of one axis."""
    turns = name.startswith("r")
    domain = tree["certificate"]["domain"][name]
    said = domain.get("approach_speed_rad_s" if turns else "approach_speed_m_s")
    force = domain.get("approach_torque_n_m" if turns else "approach_force_n")
    approach = said or (force or 0.0) / tree["axes"][name]["damping"]
    speed = max(REDUCED_SPEED_M_S / LEVER_M if turns else REDUCED_SPEED_M_S, _ABOVE_APPROACH * approach)
    return AxisLimits(speed=speed, acceleration=_SHARE_PER_PERIOD * speed / tree["sample_time_s"])


def _worst_peak(tree: Mapping[str, Any], *, turning: bool) -> float:
    key = "peak_sensor_torque_n_m" if turning else "peak_sensor_force_n"
    peaks: list[float] = [
        each[key]
        for name, predicted in tree["predicted"].items()
        if name.startswith("r") == turning
        for each in predicted["scenarios"]
    ]
    return max([0.0, *peaks])


def _smallest_deadband(tree: Mapping[str, Any], *, turning: bool) -> float:
    widths: list[float] = [gains["deadband"] for name, gains in tree["axes"].items() if name.startswith("r") == turning]
    return min(widths, default=0.0)
