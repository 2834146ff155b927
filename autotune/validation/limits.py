"""Verify the limits of a controller file: the certified contacts stay within them, and the residual is in the peaks."""

from operator import attrgetter

import numpy as np
from numpy.typing import NDArray

from autotune.formats.controller_record import AxisDomain, Controller
from autotune.formats.records import ROTATIONAL_AXES
from autotune.formats.units import axis_units
from autotune.runtime.law import STANDARD_GRAVITY_M_S2
from problems.model.controller import AdmittanceController

from .peaks import Replays

FloatArray = NDArray[np.float64]

# As of a replayed contact: the peaks are products of those in the file.
_SAME_NUMBER = 1e-6
_KINDS = ("peak_sensor_force_n", "peak_contact_force_n")


def commanded_motion(command: FloatArray, sample_time_s: float) -> tuple[float, float]:
    """Return the largest speed and acceleration of a command (n,) at the ticks, as the runtime counts them."""
    speed = np.diff(command) / sample_time_s
    changes = np.diff(speed) / sample_time_s
    return float(np.max(np.abs(speed), initial=0.0)), float(np.max(np.abs(changes), initial=0.0))


def with_residual(controller: Controller, name: str) -> tuple[float, float]:
    """Return the residual that the start check allows along one axis, and by how much it raises every peak.

    The contact is linear while it lasts and one-sided, so its forces scale with what drives it: (F^d + r)/F^d.
    """
    limits, domain = controller.limits, controller.certificate.domain[name]
    if limits is None:
        return 0.0, 1.0
    residual = limits.rest_torque_n_m if name in ROTATIONAL_AXES else limits.rest_force_n
    speed = domain.approach_speed_m_s or 0.0
    force = domain.approach_force_n or speed * (controller.axes[name].damping + domain.drag_n_s_per_m)
    return residual, 1.0 + residual / force if force > 0.0 else 1.0


def verify_limits(
    controller: Controller, name: str, domain: AxisDomain, law: AdmittanceController
) -> tuple[str, list[str]]:
    """Return what was confirmed of the limits on one axis, and what is wrong; the contacts are replayed from rest."""
    limits, units = controller.limits, axis_units(name)
    if limits is None:
        return "the file has no limits (an earlier release); the runtime takes its defaults", []
    if not controller.predicted[name].scenarios:
        return "", []
    wrong = [*_sensor(controller), *_residual(controller, name)]
    replays = Replays(domain, law, controller.sample_time_s)
    speed = acceleration = 0.0
    scenarios = controller.predicted[name].scenarios
    for scenario in dict.fromkeys(max(scenarios, key=attrgetter(kind)).scenario() for kind in _KINDS):
        seen = replays.play(scenario)
        speed, acceleration = max(speed, seen.largest_speed_m_s), max(acceleration, seen.largest_acceleration_m_s2)
    asked = limits.axes[name]
    wrong += [
        f"limits.axes.{name}.{what} is {limit:.4g} {unit}, and certified contacts command {found:.4g}"
        for what, limit, found, unit in (
            ("speed", asked.speed, speed, units.speed),
            ("acceleration", asked.acceleration, acceleration, f"{units.speed}²"),
        )
        if found >= limit
    ]
    force, share = with_residual(controller, name)
    worst = share * max(each.peak_contact_force_n for each in scenarios)
    return (
        f"certified contacts command {speed:.3g} of {asked.speed:g} {units.speed} and {acceleration:.3g} of "
        f"{asked.acceleration:g} {units.speed}²; with {force:g} {units.force} of weight left over the worst peak is "
        f"{worst:.1f} {units.force}"
    ), wrong


def _sensor(controller: Controller) -> list[str]:
    """Say where the range of the sensor is less than weight, bias and the predicted peaks need."""
    limits, payload = controller.limits, controller.payload
    straight = [name for name in controller.axes if name not in ROTATIONAL_AXES]
    if limits is None or not straight:
        return []
    weight = payload.mass_kg * STANDARD_GRAVITY_M_S2 + max(abs(each) for each in payload.force_bias_n)
    needed = weight + max(
        share * each.peak_sensor_force_n
        for name in straight
        for share in (with_residual(controller, name)[1],)
        for each in controller.predicted[name].scenarios
    )
    if needed < limits.force_n:
        return []
    return [
        f"limits.force_n is {limits.force_n:g} N, and weight, bias and the worst predicted peak make {needed:.4g} N"
    ]


def _residual(controller: Controller, name: str) -> list[str]:
    """Say where the peaks with the residual are not what the others make them, or the residual moves by itself."""
    limits, gains, predicted = controller.limits, controller.axes[name], controller.predicted[name]
    told, units = predicted.with_residual_weight, axis_units(name)
    residual, share = with_residual(controller, name)
    if limits is None:
        return []
    wrong = []
    if residual > gains.deadband > 0.0:
        wrong.append(
            f"at the start {residual:g} {units.force} may be left over, more than the deadband of {gains.deadband:g}"
        )
    if told is None:
        return [*wrong, "the file predicts no peak with the weight that may be left over (with_residual_weight)"]
    for kind in _KINDS:
        expected = share * max(float(getattr(each, kind)) for each in predicted.scenarios)
        if float(getattr(told, kind)) < (1.0 - _SAME_NUMBER) * expected or told.force_n < residual:
            must = f"at least {expected:.4g} {units.force} with {residual:g} left over"
            wrong.append(f"with_residual_weight.{kind} must be {must}")
    return wrong
