"""What limits the noise of the command: the sensor's noise, and the speed that somebody says or the robot's jitter."""

import math
from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.integrate import cumulative_trapezoid

from autotune.formats.controller_record import Controller, admittance_controller
from autotune.formats.problem import ProblemSpec
from autotune.formats.units import ROTATIONAL_AXES, axis_units
from identification.errors import EstimateError
from identification.result import Identified
from problems.design.problem import DesignProblem, NoiseLimit, Requirements
from problems.model.axis_kind import LEVER_M
from problems.model.plant import FREE_SPACE
from problems.model.sampled import build_sampled_plant
from problems.stability.noise import command_speed_gain
from problems.stability.noise_spectrum import RelativeSpectrum

_STRAIGHT, _TURNING = "requirements.command_noise", "rotational.requirements.command_noise"
# How far the mean density up to a frequency may be from that of all, and where it is looked at.
_WHITE, _LOOKED_AT, _FAINTEST = 1.5, 2000, 1e-6
# Less is in the noise of the spectrum itself.
_WORTH_SAYING = 0.2


class NoiseOf(NamedTuple):
    """RMS of the measured noise of a sensor [N, N·m] and of the pose [m, rad], None where it is not known.

    `spectrum` is that of the sensor's where it is not white.
    """

    force: float | None
    position: float | None
    spectrum: RelativeSpectrum | None = None


UNKNOWN = NoiseOf(None, None)


def measured_noise(identified: Identified, name: str) -> NoiseOf:
    """Return what the log shows of the noise along an axis."""
    return NoiseOf(
        find_sensor_noise(identified, name),
        find_position_noise(identified, name),
        find_noise_spectrum(identified, name),
    )


def with_noise(spec: ProblemSpec, identified: Identified, name: str, sample_time_s: float) -> Requirements:
    """Return what is asked of an axis with the sensor's noise, and the limit from the robot where a share is asked.

    The sensor's noise is the identified one with its spectrum, or white and as large as is said. Raises EstimateError
    for what is not known.
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
    limit = replace(limit, force_noise_rms_n=noise, noise_spectrum=find_noise_spectrum(identified, name))
    return replace(asked, command_noise=limit)


def find_sensor_noise(identified: Identified, name: str) -> float | None:
    """Return the identified RMS [N or N·m] of the sensor's noise along an axis, None where it is not known."""
    sensor = identified.sensor
    if name not in ROTATIONAL_AXES:
        return sensor.force_noise_rms_n.value
    noises = None if sensor.torque_noise_rms_n_m is None else sensor.torque_noise_rms_n_m.value
    # The sensor's axes need not be those of the control frame: the noisiest is taken for all.
    return None if noises is None else max(noises)


def find_noise_spectrum(identified: Identified, name: str) -> RelativeSpectrum | None:
    """Return how the identified noise of the sensor along an axis is spread over frequency, None where it is white.

    It is white where its mean density up to no frequency above a twentieth of its band is half as much again as over
    all of the band, or less by as much: a law that passes ever less of higher frequencies then has at most 22 % more
    noise, or less, than with white noise. Below that a log has too few averages to tell. (docs/method.md)
    """
    logged = identified.sensor.noise
    if logged is None:
        return None
    density = np.array(logged.torque_n2_m2_per_hz if name in ROTATIONAL_AXES else logged.force_n2_per_hz)
    if len(density) < 2 or not density.any():
        return None
    # A filter has to have a logarithm; what is a millionth of the rest is none of it.
    density = np.maximum(density / np.mean(density), _FAINTEST)
    frequency = np.array(logged.frequency_hz)
    looked_at = np.linspace(0.0, frequency[-1], _LOOKED_AT + 1)
    power = cumulative_trapezoid(np.interp(looked_at, frequency, density), looked_at, initial=0.0)
    means = power[1:] / looked_at[1:] / (power[-1] / looked_at[-1])
    least, *_, most = np.sort(means[_LOOKED_AT // 20 :])
    if most < _WHITE and least > 1.0 / _WHITE:
        return None
    return RelativeSpectrum(
        frequency_hz=tuple(float(f"{each:.4g}") for each in frequency),
        relative_density=tuple(float(f"{each:.4g}") for each in density),
    )


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


def spectrum_notes(controller: Controller, problems: Mapping[str, DesignProblem]) -> Iterator[str]:
    """Yield for each axis what the sensor's noise makes of the command, where its spectrum is counted and matters.

    The larger of the nominal plant in contact and in free space is said.
    """
    for name, problem in problems.items():
        limit = problem.requirements.command_noise
        if limit is None or limit.noise_spectrum is None or not limit.force_noise_rms_n:
            continue
        law, nominal = admittance_controller(controller, name), problem.plants.nominal
        plants = [
            build_sampled_plant(each, problem.sample_time_s) for each in (nominal, nominal.in_contact_with(FREE_SPACE))
        ]
        logged, white = (
            limit.force_noise_rms_n * max(command_speed_gain(each, law, spectrum) for each in plants)
            for spectrum in (limit.noise_spectrum, None)
        )
        if abs(logged - white) > _WORTH_SAYING * white:
            unit = f"m{axis_units(name).speed}"
            yield (
                f"Axis {name}: the sensor's noise counts with its spectrum as logged, and makes {1e3 * logged:.3g} "
                f"{unit} RMS of the command on the nominal plant; white noise of its RMS would make {1e3 * white:.3g} "
                f"{unit}."
            )


def _is_said(spec: ProblemSpec) -> bool:
    return "command_noise" in spec.rotational.requirements
