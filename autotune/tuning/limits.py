"""Choose the limits that the runtime enforces: what the certified contacts reach, with room, and why."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from autotune.errors import InfeasibleError, UsageError
from autotune.formats.controller_record import AxisPrediction, Controller
from autotune.formats.limits import (
    MOST_POSE_SPEED_M_S,
    MOST_POSE_SPEED_RAD_S,
    AxisLimits,
    Limits,
    LimitsNoise,
    LimitsSpec,
    ResidualPeaks,
)
from autotune.formats.problem import ProblemSpec
from autotune.formats.units import axis_units
from autotune.validation.followed_speed import NOISE_DEVIATIONS, FollowedSpeed, choose_followed, safe_speed
from autotune.validation.limits import (
    SAID,
    choose_axis_limits,
    choose_limits,
    commanded_motion,
    rounded_up,
    step_motion,
    unsafe_speed,
    with_residual,
)
from identification.result import Identified
from problems.arrays import FloatArray
from problems.text import rounded_down

from .first_contacts import FirstContacts, contacts_of
from .threshold import ASSUMED_NOISE_N

USUAL_TORQUE_NOISE_N_M, USUAL_POSITION_NOISE_M = 0.02, 5e-6


@dataclass(frozen=True, kw_only=True)
class LimitsSettings:
    """What is said of the limits, and the noise that they leave room for."""

    spec: LimitsSpec = field(default_factory=LimitsSpec)
    noise: LimitsNoise = field(
        default_factory=lambda: LimitsNoise(
            force_n=ASSUMED_NOISE_N, torque_n_m=USUAL_TORQUE_NOISE_N_M, position_m=USUAL_POSITION_NOISE_M
        )
    )


def limits_settings(identified: Identified, spec: ProblemSpec) -> LimitsSettings:
    """Return what a problem asks of the limits, with the identified noise, or that of a usual cell where none was."""
    sensor = identified.sensor
    force, left = sensor.force_noise_rms_n.value, sensor.gravity_residual_rms_n.value
    torque = None if sensor.torque_noise_rms_n_m is None else sensor.torque_noise_rms_n_m.value
    position = None if sensor.position_noise_rms_m is None else sensor.position_noise_rms_m.value
    noise = LimitsNoise(
        force_n=ASSUMED_NOISE_N if force is None else force,
        torque_n_m=USUAL_TORQUE_NOISE_N_M if torque is None else max(torque),
        position_m=USUAL_POSITION_NOISE_M if position is None else position,
        gravity_residual_n=left or 0.0,
    )
    return LimitsSettings(spec=spec.limits, noise=noise)


def with_limits(controller: Controller, settings: LimitsSettings) -> Controller:
    """Return the controller with its limits, and with the worst peaks under the residual weight that they allow.

    Raises UsageError where the problem asks for a limit that the certified contacts reach or that is of no tuned axis,
    InfeasibleError where no limit that lets them through keeps a led payload as slow as `contact_at_speed` asks.
    """
    reasons: dict[str, str] = {}
    axes = {name: _axis_limits(controller, name, settings.noise, reasons) for name in controller.axes}
    limits = _said(controller, choose_limits(controller, settings.noise, axes, reasons), settings.spec)
    if limits.pose_speed_m_s > MOST_POSE_SPEED_M_S or limits.pose_speed_rad_s > MOST_POSE_SPEED_RAD_S:
        raise UsageError(
            f"The pose is too noisy for a limit of its speed: with sensor.position_noise_rms_m of "
            f"{settings.noise.position_m:.3g} m it would be {limits.pose_speed_m_s:g} m/s and "
            f"{limits.pose_speed_rad_s:g} rad/s, where at most {MOST_POSE_SPEED_M_S:g} and {MOST_POSE_SPEED_RAD_S:g} "
            "are allowed; record a pose of less noise, or say limits.pose_speed_m_s and pose_speed_rad_s."
        )
    limited = replace(controller, limits=limits)
    _check_safe(limited)
    predicted = {name: _predicted(limited, name) for name in controller.axes}
    return replace(limited, predicted=predicted)


def _axis_limits(controller: Controller, name: str, noise: LimitsNoise, reasons: dict[str, str]) -> AxisLimits:
    """Return the limits of one axis; where `contact_at_speed` is asked, the robot is kept below the speed of that."""
    chosen = choose_axis_limits(controller, name, noise, largest_motion(controller, name), reasons)
    safe, units = safe_speed(controller, name), axis_units(name)
    if safe is None:
        return chosen
    speed, asked = safe
    found = _found_followed(controller, name, noise)
    reasons[f"axes.{name}.followed_speed"] = (
        f"up to {rounded_down(speed, 3):g} {units.speed} no contact exceeds {asked.max_force_n:g} {units.force} "
        f"(contact_at_speed), and the robot goes at most {found.share:.4g} times as fast; certified contacts reach "
        f"{found.contacts:.3g}, and {NOISE_DEVIATIONS:g} deviations of the noise {found.noise:.2g}"
    )
    reasons[f"axes.{name}.followed_lag_s"] = "of the lags around the robot's, that behind which these contacts go least"
    limit = max(rounded_down(speed / found.share, 3), rounded_up(found.reached))
    return replace(chosen, followed_speed=limit, followed_lag_s=found.lag_s)


def _found_followed(controller: Controller, name: str, noise: LimitsNoise) -> FollowedSpeed:
    return choose_followed(controller, name, noise, _commands(contacts_of(controller, name), controller, name))


def _predicted(controller: Controller, name: str) -> AxisPrediction:
    prediction = controller.predicted[name]
    force, share = with_residual(controller, name)
    worst = ResidualPeaks(
        force_n=force,
        peak_sensor_force_n=share * max(each.peak_sensor_force_n for each in prediction.scenarios),
        peak_contact_force_n=share * max(each.peak_contact_force_n for each in prediction.scenarios),
    )
    return replace(prediction, with_residual_weight=worst)


def largest_motion(controller: Controller, name: str) -> tuple[float, float]:
    """Return the largest speed and acceleration that one axis commands: at the start, free, and in every contact.

    The contacts are the predicted ones; the approach begins from rest with its whole force, with the file's deadband
    and without.
    """
    contacts = contacts_of(controller, name)
    found = [(0.0, 0.0), *_motions(contacts, controller, name)]
    return max(speed for speed, _ in found), max(acceleration for _, acceleration in found)


def _commands(contacts: FirstContacts, controller: Controller, name: str) -> Iterator[FloatArray]:
    scenarios = [each.scenario() for each in controller.predicted[name].scenarios]
    for scenario in dict.fromkeys(scenarios):
        yield contacts.run(scenario, None).command_m
    for command in contacts.starts(scenarios[:1]):
        yield np.concatenate([command[:1], command])


def _motions(contacts: FirstContacts, controller: Controller, name: str) -> Iterator[tuple[float, float]]:
    for command in _commands(contacts, controller, name):
        yield commanded_motion(command, controller.sample_time_s)
    # What passes the deadband at once, as a hand's force does.
    yield step_motion(controller, name, controller.axes[name].deadband)


def _said(controller: Controller, chosen: Limits, spec: LimitsSpec) -> Limits:
    """Put what the problem says in the place of what was chosen."""
    strangers = sorted(set(spec.axes) - set(controller.axes))
    if strangers:
        raise UsageError(f"limits.axes must name tuned axes, {', '.join(controller.axes)}; found {strangers[0]}.")
    reasons: dict[str, str] = dict(chosen.reasons)
    axes: dict[str, AxisLimits] = dict(chosen.axes)
    for name, asked in spec.axes.items():
        _check_reached(controller, name, asked)
        lag = axes[name].followed_lag_s
        if lag is None and "followed_speed" in asked:
            lag = _found_followed(controller, name, (chosen.noise or LimitsNoise())).lag_s
        axes[name] = replace(axes[name], **asked, followed_lag_s=lag)
        reasons |= {f"axes.{name}.{key}": SAID for key in asked}
    reasons |= dict.fromkeys(spec.values, SAID)
    further: dict[str, Any] = dict(spec.values)
    return replace(chosen, axes=axes, reasons=reasons, **further)


def _check_safe(controller: Controller) -> None:
    """Refuse limits that were chosen, and not said, above the speed up to which a contact is as gentle as asked."""
    limits = controller.limits
    for name in controller.axes:
        unsafe = unsafe_speed(controller, name)
        said = {limits.reasons.get(f"axes.{name}.{key}") for key in ("speed", "followed_speed")} if limits else {SAID}
        if limits is None or not unsafe or SAID in said:
            continue
        line = f"limits: {{axes: {{{name}: {{followed_speed: {limits.axes[name].followed_speed:g}}}}}}}"
        raise InfeasibleError(
            f"Axis {name}: {unsafe}. A lower limit would stop the robot in the certified contacts, in which it goes as "
            "fast, noise included. Have them go slower (a slower approach, a smaller upper bound of lead_s), ask less "
            "of contact_at_speed, or keep a led payload slower by other means and say the limit in "
            f"problem.yaml: {line}",
            to_paste=(line,),
        )


def _check_reached(controller: Controller, name: str, values: Mapping[str, float]) -> None:
    """Refuse a limit that the certified contacts reach."""
    reached = dict(zip(("speed", "acceleration"), largest_motion(controller, name), strict=True))
    if "followed_speed" in values:
        reached["followed_speed"] = _found_followed(controller, name, LimitsNoise()).contacts
    for key, value in values.items():
        if value <= reached[key]:
            raise UsageError(
                f"limits.axes.{name}.{key} must be above {reached[key]:.4g}, which the certified contacts of this "
                f"controller command, found {value:g}; raise it, or ask for a slower approach."
            )
