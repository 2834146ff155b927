"""Choose the limits that the runtime enforces: what the certified contacts reach, with room, and why."""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from autotune.errors import UsageError
from autotune.formats.controller_record import AxisPrediction, Controller
from autotune.formats.limits import MOST_REST_SAMPLES, AxisLimits, Limits, LimitsSpec, ResidualPeaks
from autotune.formats.problem import ProblemSpec
from autotune.formats.units import ROTATIONAL_AXES, axis_units
from autotune.runtime.law import STANDARD_GRAVITY_M_S2
from autotune.runtime.load import LEVER_M, REDUCED_SPEED_M_S
from autotune.validation.certified_requirements import asked_of
from autotune.validation.contacts import commanded_motion, with_residual
from identification.result import Identified
from problems.design.requirements import ContactAtSpeed
from problems.model.controller import controller_blocks

from .first_contacts import FirstContacts, contacts_of
from .threshold import ASSUMED_NOISE_N, NOISE_DEVIATIONS

# Room above what the certified contacts command, and what weight, bias and contact put on the sensor.
_ROOM = 2.0

USUAL_TORQUE_NOISE_N_M, USUAL_POSITION_NOISE_M = 0.02, 5e-6
_POSE_ABOVE_COMMAND, _LEAST_POSE_SPEED_M_S, _LEAST_POSE_SPEED_RAD_S = 4.0, 1.0, 5.0
_STALE_WRENCH_S, _STALE_POSE_S, _STALE_PERIODS = 0.02, 0.1, 10
_REST_S, _REST_SHARE, _REST_DEVIATIONS = 0.1, 0.2, 3.0
_LEAST_REST_N, _LEAST_REST_N_M, _COM_OFF_M = 1.0, 0.2, 0.02


@dataclass(frozen=True, kw_only=True)
class LimitsSettings:
    """What is said of the limits, and the noise that they leave room for: N, N·m and m RMS.

    `gravity_residual_n` is what the identified compensation left over in the poses of the log, N RMS.
    """

    spec: LimitsSpec = field(default_factory=LimitsSpec)
    force_noise_n: float = ASSUMED_NOISE_N
    torque_noise_n_m: float = USUAL_TORQUE_NOISE_N_M
    position_noise_m: float = USUAL_POSITION_NOISE_M
    gravity_residual_n: float = 0.0


def limits_settings(identified: Identified, spec: ProblemSpec) -> LimitsSettings:
    """Return what a problem asks of the limits, with the identified noise, or that of a usual cell where none was."""
    sensor = identified.sensor
    force, left = sensor.force_noise_rms_n.value, sensor.gravity_residual_rms_n.value
    torque = None if sensor.torque_noise_rms_n_m is None else sensor.torque_noise_rms_n_m.value
    position = None if sensor.position_noise_rms_m is None else sensor.position_noise_rms_m.value
    return LimitsSettings(
        spec=spec.limits,
        force_noise_n=ASSUMED_NOISE_N if force is None else force,
        torque_noise_n_m=USUAL_TORQUE_NOISE_N_M if torque is None else max(torque),
        position_noise_m=USUAL_POSITION_NOISE_M if position is None else position,
        gravity_residual_n=left or 0.0,
    )


def with_limits(controller: Controller, settings: LimitsSettings) -> Controller:
    """Return the controller with its limits, and with the worst peaks under the residual weight that they allow.

    Raises UsageError where the problem asks for a limit that the certified contacts reach or that is of no tuned axis.
    """
    limits = _said(controller, _choose(controller, settings), settings.spec)
    limited = replace(controller, limits=limits)
    predicted = {name: _predicted(limited, name) for name in controller.axes}
    return replace(limited, predicted=predicted)


def _predicted(controller: Controller, name: str) -> AxisPrediction:
    prediction = controller.predicted[name]
    force, share = with_residual(controller, name)
    worst = ResidualPeaks(
        force_n=force,
        peak_sensor_force_n=share * max(each.peak_sensor_force_n for each in prediction.scenarios),
        peak_contact_force_n=share * max(each.peak_contact_force_n for each in prediction.scenarios),
    )
    return replace(prediction, with_residual_weight=worst)


def _choose(controller: Controller, settings: LimitsSettings) -> Limits:
    """Return the limits that follow from the controller and its contacts, each with its reason."""
    reasons: dict[str, str] = {}
    h = controller.sample_time_s
    axes = {name: _axis(controller, name, settings, reasons) for name in controller.axes}
    straight = [axes[name].speed for name in axes if name not in ROTATIONAL_AXES]
    turning = [axes[name].speed for name in axes if name in ROTATIONAL_AXES]
    force, torque = _ranges(controller, reasons)
    pose = max([_LEAST_POSE_SPEED_M_S, *(_POSE_ABOVE_COMMAND * each for each in straight)])
    turn = max([_LEAST_POSE_SPEED_RAD_S, *(_POSE_ABOVE_COMMAND * each for each in turning)])
    noise = NOISE_DEVIATIONS * math.sqrt(2.0) * settings.position_noise_m / h
    said = f"{_POSE_ABOVE_COMMAND:g} times the limit of the command, at least"
    reasons["pose_speed_m_s"] = f"{said} {_LEAST_POSE_SPEED_M_S:g} m/s, and the noise of the pose"
    reasons["pose_speed_rad_s"] = f"{said} {_LEAST_POSE_SPEED_RAD_S:g} rad/s, and the noise of the pose"
    reasons["stale_wrench_s"] = f"noise changes a wrench in every period; {_STALE_PERIODS} periods and 20 ms at least"
    reasons["stale_pose_s"] = f"a coarse pose follows a slow command late; {_STALE_PERIODS} periods and 0.1 s at least"
    reasons["rest_samples"] = f"{_REST_S:g} s, over which noise is averaged"
    rest_force, rest_torque = _rest(controller, settings, reasons)
    return Limits(
        force_n=force,
        torque_n_m=torque,
        axes=axes,
        pose_speed_m_s=_rounded_up(pose + noise),
        pose_speed_rad_s=_rounded_up(turn + noise / LEVER_M),
        stale_wrench_s=max(_STALE_WRENCH_S, _STALE_PERIODS * h),
        stale_pose_s=max(_STALE_POSE_S, _STALE_PERIODS * h),
        rest_samples=max(1, min(MOST_REST_SAMPLES, round(_REST_S / h))),
        rest_force_n=rest_force,
        rest_torque_n_m=rest_torque,
        reasons=reasons,
    )


def _axis(controller: Controller, name: str, settings: LimitsSettings, reasons: dict[str, str]) -> AxisLimits:
    """Return the limits of the command of one axis: room above what the certified contacts command, and noise."""
    units, turns = axis_units(name), name in ROTATIONAL_AXES
    speed, acceleration = largest_motion(controller, name)
    noisy_speed, noisy_acceleration = _noise(controller, name, settings)
    least = REDUCED_SPEED_M_S / LEVER_M if turns else REDUCED_SPEED_M_S
    said = f"{_ROOM:g} times what the certified contacts command"
    noise = f"{NOISE_DEVIATIONS:g} deviations of the noise"
    reasons[f"axes.{name}.speed"] = (
        f"{said}, {speed:.3g} {units.speed}, and {noise}, {noisy_speed:.2g}; at least {least:g} {units.speed}, the "
        "speed at which a robot is led by hand"
    )
    reasons[f"axes.{name}.acceleration"] = (
        f"{said}, {acceleration:.3g} {units.speed}², and {noise}, {noisy_acceleration:.2g}"
    )
    largest = _rounded_up(max(_ROOM * speed + noisy_speed, least))
    asked, per_speed = asked_of(controller, name).get("contact_at_speed"), controller.predicted[name].peak_per_speed
    if isinstance(asked, ContactAtSpeed) and per_speed is not None:
        safe, reached = per_speed.largest_speed(asked.max_force_n, asked.hand), speed + noisy_speed
        largest = min(largest, max(_rounded_down(safe), _rounded_up(reached)))
        reasons[f"axes.{name}.speed"] = (
            f"up to {safe:.3g} {units.speed} no contact exceeds {asked.max_force_n:g} {units.force} "
            f"(contact_at_speed); certified contacts command {speed:.3g}, and {noise}, {noisy_speed:.2g}"
        )
    return AxisLimits(
        speed=largest,
        acceleration=_rounded_up(_ROOM * acceleration + noisy_acceleration),
    )


def largest_motion(controller: Controller, name: str) -> tuple[float, float]:
    """Return the largest speed and acceleration that one axis commands: at the start, free, and in every contact.

    The contacts are the predicted ones; the approach begins from rest with its whole force, with the file's deadband
    and without.
    """
    contacts = contacts_of(controller, name)
    found = [(0.0, 0.0), *_motions(contacts, controller, name)]
    return max(speed for speed, _ in found), max(acceleration for _, acceleration in found)


def _motions(contacts: FirstContacts, controller: Controller, name: str) -> Iterator[tuple[float, float]]:
    h, scenarios = controller.sample_time_s, [each.scenario() for each in controller.predicted[name].scenarios]
    for scenario in dict.fromkeys(scenarios):
        yield commanded_motion(contacts.run(scenario, None).command_m, h)
    for command in contacts.starts(scenarios[:1]):
        yield commanded_motion(np.concatenate([command[:1], command]), h)
    # What passes the deadband at once, as a hand's force does.
    blocks = controller_blocks(contacts.law, h)
    step = float(blocks[0, 0] + blocks[1, 0]) * controller.axes[name].deadband
    yield step / h, step / h**2


def _noise(controller: Controller, name: str, settings: LimitsSettings) -> tuple[float, float]:
    """Return six deviations of the command's speed and acceleration under white noise of wrench and pose.

    Noise n at the input changes the command by its direct gain d: d √2 n/h of speed, d √6 n/h² of acceleration.
    """
    turns, h = name in ROTATIONAL_AXES, controller.sample_time_s
    blocks = controller_blocks(contacts_of(controller, name).law, h)
    force = float(blocks[0, 0] + blocks[1, 0])
    pose = float(blocks[4, 0] * blocks[2, 0]) + force * float(blocks[4, 1] * blocks[3, 0] * blocks[2, 0])
    noise = math.hypot(
        force * (settings.torque_noise_n_m if turns else settings.force_noise_n),
        pose * settings.position_noise_m / (LEVER_M if turns else 1.0),
    )
    return NOISE_DEVIATIONS * math.sqrt(2.0) * noise / h, NOISE_DEVIATIONS * math.sqrt(6.0) * noise / h**2


def _ranges(controller: Controller, reasons: dict[str, str]) -> tuple[float, float]:
    """Return the ranges of force and torque: twice what weight, bias and the worst contact put on the sensor."""
    payload, domains = controller.payload, controller.certificate.domain
    masses = [domains[name].payload_mass_kg[1] for name in controller.axes if name not in ROTATIONAL_AXES]
    weight = STANDARD_GRAVITY_M_S2 * max([payload.mass_kg, *masses])
    peak, turning = _worst(controller, turning=False), _worst(controller, turning=True)
    force = weight + math.hypot(*payload.force_bias_n) + peak
    torque = weight * math.hypot(*payload.com_m) + math.hypot(*payload.torque_bias_n_m) + turning + LEVER_M * peak
    reasons["force_n"] = (
        f"{_ROOM:g} times the {force:.4g} N of weight, bias and the worst predicted peak at the sensor; a smaller "
        "range of the sensor belongs into problem.yaml"
    )
    reasons["torque_n_m"] = (
        f"{_ROOM:g} times the {torque:.4g} N·m of weight, bias and the worst predicted peaks, a force at {LEVER_M:g} m"
    )
    if payload.set_in_cell:
        reasons["torque_n_m"] += "; centre of mass and bias are not known and count as 0, so a heavy tool needs more"
    return _rounded_up(_ROOM * force), _rounded_up(max(_ROOM * torque, _LEAST_REST_N_M))


def _worst(controller: Controller, *, turning: bool) -> float:
    names = [name for name in controller.axes if (name in ROTATIONAL_AXES) == turning]
    peaks = [each.peak_sensor_force_n for name in names for each in controller.predicted[name].scenarios]
    return max([0.0, *peaks])


def _rest(controller: Controller, settings: LimitsSettings, reasons: dict[str, str]) -> tuple[float, float]:
    """Return what the compensation may leave at the start: a share of the deadband, or what it left in the log."""
    identified = _REST_DEVIATIONS * settings.gravity_residual_n
    force = _within_deadband(controller, max(_LEAST_REST_N, identified), turning=False)
    reasons["rest_force_n"] = (
        f"{_REST_SHARE:g} of the deadband, or {_REST_DEVIATIONS:g} times the {settings.gravity_residual_n:.2g} N RMS "
        f"that the compensation left in the log, at least {_LEAST_REST_N:g} N; it adds to F^d in with_residual_weight"
    )
    if any(name in ROTATIONAL_AXES for name in controller.axes):
        reasons["rest_torque_n_m"] = f"{_REST_SHARE:g} of the deadband; it adds to the desired torque"
        return force, _within_deadband(controller, _LEAST_REST_N_M, turning=True)
    weight = STANDARD_GRAVITY_M_S2 * controller.payload.mass_kg
    reasons["rest_torque_n_m"] = f"no axis turns; the weight at {_COM_OFF_M:g} m from its centre, at least 1 N·m"
    return force, _rounded_up(max(1.0, _COM_OFF_M * weight))


def _within_deadband(controller: Controller, least: float, *, turning: bool) -> float:
    widths = [each.deadband for name, each in controller.axes.items() if (name in ROTATIONAL_AXES) == turning]
    width = min(widths, default=0.0)
    wanted = max(_REST_SHARE * width, least)
    return _rounded_up(min(wanted, width) if width > 0.0 else wanted)


def _said(controller: Controller, chosen: Limits, spec: LimitsSpec) -> Limits:
    """Put what the problem says in the place of what was chosen."""
    strangers = sorted(set(spec.axes) - set(controller.axes))
    if strangers:
        raise UsageError(f"limits.axes must name tuned axes, {', '.join(controller.axes)}; found {strangers[0]}.")
    reasons: dict[str, str] = dict(chosen.reasons)
    axes: dict[str, AxisLimits] = dict(chosen.axes)
    for name, asked in spec.axes.items():
        _check_reached(controller, name, asked)
        axes[name] = replace(axes[name], **asked)
        reasons |= {f"axes.{name}.{key}": "said in problem.yaml" for key in asked}
    reasons |= dict.fromkeys(spec.values, "said in problem.yaml")
    further: dict[str, Any] = dict(spec.values)
    return replace(chosen, axes=axes, reasons=reasons, **further)


def _check_reached(controller: Controller, name: str, values: Mapping[str, float]) -> None:
    """Refuse a limit that the certified contacts reach."""
    reached = dict(zip(("speed", "acceleration"), largest_motion(controller, name), strict=True))
    for key, value in values.items():
        if value <= reached[key]:
            raise UsageError(
                f"limits.axes.{name}.{key} must be above {reached[key]:.4g}, which the certified contacts of this "
                f"controller command, found {value:g}; raise it, or ask for a slower approach."
            )


def _rounded_up(value: float) -> float:
    """Return a number of two digits that is not below `value`."""
    scale = 10.0 ** (math.floor(math.log10(value)) - 1)
    return float(f"{math.ceil(value / scale * (1.0 - 1e-9)) * scale:.2g}")


def _rounded_down(value: float) -> float:
    """Return a number of two digits that is not above `value`."""
    scale = 10.0 ** (math.floor(math.log10(value)) - 1)
    return float(f"{math.floor(value / scale * (1.0 + 1e-9)) * scale:.2g}")
