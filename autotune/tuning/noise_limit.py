"""What limits the noise of the command: the speed that somebody says, or the robot's own jitter at rest."""

import math
from collections.abc import Iterator, Mapping
from dataclasses import replace

from autotune.formats.problem import ProblemSpec
from autotune.formats.units import ROTATIONAL_AXES, axis_units
from identification.errors import EstimateError
from identification.result import Identified
from problems.design.problem import DesignProblem, NoiseLimit, Requirements
from problems.model.axis_kind import LEVER_M

_STRAIGHT, _TURNING = "requirements.command_noise", "rotational.requirements.command_noise"


def with_noise(spec: ProblemSpec, identified: Identified, name: str, sample_time_s: float) -> Requirements:
    """Return what is asked of an axis with the sensor's noise, and the limit from the robot where a share is asked.

    The sensor's noise is the identified one unless it is said. Raises EstimateError for what is not known.
    """
    asked, is_turning = spec.requirements, name in ROTATIONAL_AXES
    limit = asked.command_noise
    if spec.share_of_jitter is not None:
        limit = NoiseLimit(max_speed_rms_m_s=_jitter_speed(spec.share_of_jitter, identified, name, sample_time_s))
    if limit is None:
        return asked
    if limit.position_noise_rms_m is None:
        limit = replace(limit, position_noise_rms_m=find_position_noise(identified, name))
    if limit.force_noise_rms_n is not None:
        return replace(asked, command_noise=limit)
    noise = find_sensor_noise(identified, name)
    if noise is None:
        key, said = ("torque_noise_rms_n_m", _TURNING) if is_turning else ("force_noise_rms_n", _STRAIGHT)
        raise EstimateError(
            f"sensor.{key} is not identified, and the command's noise is limited; say {key} in {said} of problem.yaml."
        )
    return replace(asked, command_noise=replace(limit, force_noise_rms_n=noise))


def find_sensor_noise(identified: Identified, name: str) -> float | None:
    """Return the identified RMS [N or N·m] of the sensor's noise along an axis, None where it is not known."""
    sensor = identified.sensor
    if name not in ROTATIONAL_AXES:
        return sensor.force_noise_rms_n.value
    noises = None if sensor.torque_noise_rms_n_m is None else sensor.torque_noise_rms_n_m.value
    # The sensor's axes need not be those of the control frame: the noisiest is taken for all.
    return None if noises is None else max(noises)


def _jitter_speed(share: float, identified: Identified, name: str, sample_time_s: float) -> float:
    """Return a share of the speed [m/s or rad/s] that two poses at rest, a tick apart, seem to have: √2 σ / h.

    σ is the noise of one sample of the pose as logged; about an axis of rotation at a lever of 0.2 m.
    """
    noise = find_position_noise(identified, name)
    if noise is None:
        key, said = ("max_speed_rms_rad_s", _TURNING) if name in ROTATIONAL_AXES else ("max_speed_rms_m_s", _STRAIGHT)
        raise EstimateError(
            "sensor.position_noise_rms_m is not identified, and share_of_jitter asks for a share of it; "
            f"say {key} in {said} of problem.yaml."
        )
    return float(f"{share * jitter_speed(noise, sample_time_s):.6g}")


def jitter_speed(noise: float, sample_time_s: float) -> float:
    """Return the RMS speed that two poses at rest with this noise, a tick apart, seem to have: √2 σ / h."""
    return math.sqrt(2.0) * noise / sample_time_s


def jitter_source(noise: float, name: str, sample_time_s: float) -> str:
    """Return what the robot's jitter at rest is made of; `noise` [m], of axes that turn [rad]."""
    turning = name in ROTATIONAL_AXES
    micrometres, lever = 1e6 * noise * (LEVER_M if turning else 1.0), f" and a lever of {LEVER_M:g} m"
    return f"√2 · {micrometres:.3g} µm of pose noise per tick of {1e3 * sample_time_s:g} ms{lever if turning else ''}"


def find_position_noise(identified: Identified, name: str) -> float | None:
    """Return the identified RMS [m, or rad at a lever of 0.2 m] of the pose's noise, None where it is not known."""
    position = identified.sensor.position_noise_rms_m
    if position is None or position.value is None:
        return None
    return position.value / (LEVER_M if name in ROTATIONAL_AXES else 1.0)


def jitter_notes(problems: Mapping[str, DesignProblem], identified: Identified, spec: ProblemSpec) -> Iterator[str]:
    """Yield for each axis what the robot's jitter allows the noise of the command, where a share of it was asked."""
    share = spec.share_of_jitter
    for name, problem in problems.items():
        limit, noise = problem.requirements.command_noise, find_position_noise(identified, name)
        if noise is None or share is None or limit is None or (name in ROTATIONAL_AXES and _is_said(spec)):
            continue
        units = axis_units(name)
        yield (
            f"Axis {name}: the noise of the command is limited to {1e3 * limit.max_speed_rms_m_s:.3g} m{units.speed} "
            f"RMS, {share:g} of the robot's jitter at rest: {jitter_source(noise, name, problem.sample_time_s)}."
        )


def _is_said(spec: ProblemSpec) -> bool:
    return "command_noise" in spec.rotational.requirements
