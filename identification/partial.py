"""Identification of logs whose weight was removed before recording: the robot, and the secant of a contact trace."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from .compensated import CompensatedAxes, identify_compensated_axes
from .errors import EstimateError, LogError
from .fitted_timeline import account_for_log, hand_findings, turning_spans, with_surfaces, without_surface
from .given import Given
from .result import (
    TICK_S,
    AxisEstimate,
    Covariance,
    EnvironmentEstimate,
    Estimate,
    Finding,
    Identified,
    PayloadEstimate,
    RobotEstimate,
    SensorEstimate,
    Status,
)
from .robot.admittance_estimates import AdmittanceRobots, identify_admittance_robots
from .signals.recording import AXES, Recording
from .touches.inertia import KnownMotion
from .touches.signals import axis_signals, offset_findings
from .touches.surfaces import Touched, identify_touches, no_contact
from .verdicts import (
    MASS_THAT_MOVES,
    missing,
    unidentifiable,
    unidentifiable_robot,
    unidentifiable_vector,
    weak_at_best,
    without_coupling,
)

# A contact lasts a second or less, and no sensor of force shows more than 20,000 samples of it.
_SLOWEST_S, _FASTEST_S = 0.5, 5e-5
_REMOVED = "gravity was removed before recording"


def identify_partial(
    recording: Recording, sample_time_s: Estimate, given: Mapping[str, Given] | None = None
) -> Identified:
    """Identify what a log without gravity shows: robot, coupling and moving mass, or the secant of a contact trace.

    The robot follows from the command, else from the admittance's gains and the force; coupling and moving mass from
    pose and force. A trace is a displacement since contact with its force. `sample_time_s` is handed on. The centre of
    mass and the sensor's bias are unidentifiable; what else is missing has a finding of severity `error`. Raises
    EstimateError when nothing is identified, LogError where half a second and more lies between forces, or hardly
    any time.
    """
    _check_rate(recording)
    recording = _with_orientation(recording)
    led = AdmittanceRobots(robots={}, findings=())
    if recording.command is None:
        led = identify_admittance_robots(recording)
    found = CompensatedAxes(axes={}, findings=())
    if recording.command is not None or not recording.pose.is_displacement:
        found = identify_compensated_axes(recording, led, given or {})
    found, touched = _touched(recording, found)
    axes = {
        axis: _axis(
            found.axes[axis].estimate if axis in found.axes else None,
            led.robots.get(axis),
            led.covariances.get(axis),
            touched.surfaces.get(axis, ()),
            touched.masses.get(axis),
        )
        for axis in AXES
        if axis in found.axes or axis in led.robots or axis in touched.surfaces or axis in touched.masses
    }
    mass = _moving_mass(axes)
    known_codes = {finding.code for finding in led.findings}
    about = [
        f for f in found.findings if f.code != "no-contact" and (f.code != "no-command" or f.code not in known_codes)
    ]
    offset = offset_findings(axis_signals(recording), recording.wrench.topic)
    findings = [_removed(recording, mass), *led.findings, *about, *offset, *touched.findings]
    if recording.wrench.measured_axes and not (led.robots or touched.shows_a_wall or mass.value is not None):
        findings.append(_assumed_sign(recording))
    has_wrench = bool(recording.wrench.measured_axes)
    if has_wrench and not any(finding.code == "coupling" for finding in about):
        findings[1:1] = _coupling_findings(axes)
    if not recording.pose.is_displacement and "rx" not in recording.pose.measured_axes:
        findings.append(_without_orientation(recording))
    if not led.robots and not touched.shows_more_than_a_hand and not any(map(_says_something, axes.values())):
        raise EstimateError(" ".join(f"{f.message} {f.advice}".strip() for f in findings if f.severity == "error"))
    if has_wrench and not any(axis.environments for axis in axes.values()):
        findings.append(no_contact(touched))
    return Identified(
        sample_time_s=_period(sample_time_s),
        payload=PayloadEstimate(mass_kg=mass, com_m=unidentifiable_vector(_REMOVED)),
        axes=axes,
        sensor=_sensor(recording),
        findings=tuple(findings),
        timelines=(touched.timeline,),
    )


def _check_rate(recording: Recording) -> None:
    """Raise LogError where forces are farther apart than contacts last, or closer than sensors sample: a wrong unit."""
    wrench = recording.wrench
    apart_s = float(np.median(np.diff(wrench.stamp_ns))) * 1e-9 if len(wrench.stamp_ns) > 1 else 0.0
    if wrench.measured_axes and apart_s > _SLOWEST_S:
        raise LogError(
            f"The wrench of topic {wrench.topic} must show contacts, found a sample every {apart_s:.3g} s; record at "
            f"100 Hz or more. If it was recorded {1e3 / apart_s:.4g} times a second, its times are in ms: say so "
            "(`table: {time_unit: ms}` in cell.yaml)."
        )
    if wrench.measured_axes and 0.0 < apart_s < _FASTEST_S:
        raise LogError(
            f"The wrench of topic {wrench.topic} must come as fast as sensors show it, found a sample every "
            f"{1e6 * apart_s:.3g} µs; check the unit of its times (`table: {{time_unit: s}}` in cell.yaml, where they "
            "are in seconds)."
        )


def _with_orientation(recording: Recording) -> Recording:
    """Return the recording with one orientation throughout where the pose has none."""
    pose = recording.pose
    if pose.is_displacement or "rx" in pose.measured_axes:
        return recording
    level = np.tile([0.0, 0.0, 0.0, 1.0], (len(pose.stamp_ns), 1))
    return replace(recording, pose=replace(pose, quaternion_xyzw=level))


def _touched(recording: Recording, found: CompensatedAxes) -> tuple[CompensatedAxes, Touched]:
    """Return the axes with the surfaces of all contacts, and the touches: by the fits, elsewhere by the force alone."""
    fitted = found.fitted
    if found.cell is None or not fitted:
        return found, identify_touches(recording)
    mass_kg = _moving_mass({name: axis.estimate for name, axis in fitted.items()}).value or 0.0
    accounted, timeline = account_for_log(found.cell, fitted, mass_kg)
    others = identify_touches(recording, KnownMotion(axes=frozenset(fitted), turning_s=turning_spans(timeline)))
    touches = sorted(
        (*timeline.touches, *others.timeline.touches),
        key=lambda touch: (touch.peak_s if touch.onset_s is None else touch.onset_s, touch.axis),
    )
    axes = {
        name: replace(axis, estimate=with_surfaces(axis.estimate, accounted.surfaces[name]))
        for name, axis in fitted.items()
    }
    about = (*without_surface(found.findings, accounted), *accounted.findings, *hand_findings(timeline))
    return replace(found, axes={**found.axes, **axes}, findings=about), replace(
        others, timeline=replace(timeline, touches=tuple(touches))
    )


def _period(sample_time_s: Estimate) -> Estimate:
    """Return the control period, weak where the log may be slower than the controller."""
    if sample_time_s.value is None or sample_time_s.value <= TICK_S:
        return sample_time_s
    return weak_at_best(sample_time_s, "the log's own period, which may be longer than the controller's")


def _assumed_sign(recording: Recording) -> Finding:
    """Say that nothing showed whose force it is: no held contact, no gains, no inertia."""
    return Finding.warning(
        "force-sign-assumed",
        f"Whether the wrench of topic {recording.wrench.topic} is that of payload and surroundings on the sensor is "
        "assumed, not found: the log shows no contact, no robot behind known gains, and no inertia of the payload.",
        "Check `exerted_by` of the wrench in cell.yaml, or hold a contact of 10 N or more for a second.",
    )


def _without_orientation(recording: Recording) -> Finding:
    return Finding.warning(
        "no-orientation",
        f"The pose of topic {recording.pose.topic} has no orientation, so it is taken as constant, and the axes of "
        "the wrench as those in which the position was logged.",
        "Record the whole pose, or check that the tool does not turn and that the wrench is in base axes.",
    )


def _says_something(axis: AxisEstimate) -> bool:
    known = axis.environments or axis.coupling.stiffness_n_per_m.value is not None
    return bool(known or axis.robot.bandwidth_hz.value is not None or axis.robot.delay_s.value is not None)


def _moving_mass(axes: Mapping[str, AxisEstimate]) -> Estimate:
    """Return the mass that moves, of the axis that knows it best."""
    known = [axis.mass_kg for axis in axes.values() if axis.mass_kg is not None and axis.mass_kg.value is not None]
    if not known:
        return unidentifiable(note=_REMOVED)
    best = min(known, key=lambda mass: np.inf if mass.std is None else mass.std)
    return replace(best, note=MASS_THAT_MOVES)


def _removed(recording: Recording, mass: Estimate) -> Finding:
    """Return what is not known without the weight: an error where the mass is not known from the motion either."""
    topic = recording.wrench.topic
    if not recording.wrench.measured_axes:
        return missing(
            "no-wrench",
            "The log has no wrench, so mass, coupling, sensor and surfaces cannot be determined; command and pose show "
            "the robot.",
            "Record the force/torque sensor with pose and command.",
        )
    if mass.value is None:
        return missing(
            "gravity-removed",
            f"Gravity is already removed from the force of topic {topic}, so the payload's mass, its centre and the "
            "sensor's bias cannot be determined from it.",
            "Record the sensor's wrench before gravity compensation.",
        )
    return Finding.warning(
        "gravity-removed",
        f"Gravity is already removed from the force of topic {topic}, so the payload's centre of mass and the sensor's "
        "bias cannot be determined from it; its mass is what moves.",
        "Record the sensor's wrench before gravity compensation to know both.",
    )


def _coupling_findings(axes: Mapping[str, AxisEstimate]) -> tuple[Finding, ...]:
    if any(axis.coupling.stiffness_n_per_m.value is not None for axis in axes.values()):
        return ()
    moved = any(axis.mass_kg is not None and axis.mass_kg.value is not None for axis in axes.values())
    return (
        missing(
            "coupling",
            "The payload is moved too slowly to swing on its coupling, so K_s, B_s and B_p cannot be determined."
            if moved
            else "The force that the payload's inertia makes is hidden by gravity compensation, deadband or the hand, "
            "so K_s, B_s and B_p cannot be determined.",
            "Record wrench and pose with a commanded sweep, hands off.",
        ),
    )


def _axis(
    found: AxisEstimate | None,
    led: RobotEstimate | None,
    covariance: Covariance | None,
    surfaces: tuple[EnvironmentEstimate, ...],
    mass: Estimate | None,
) -> AxisEstimate:
    """Join what pose, force and command show of an axis, what the gains show of its robot, and what was touched."""
    unknown = unidentifiable_robot("neither command nor gains identify the robot on this axis")
    axis = found or replace(without_coupling(unknown, _REMOVED), covariance=covariance)
    if mass is not None and (axis.mass_kg is None or axis.mass_kg.value is None):
        axis = replace(axis, mass_kg=mass)
    return replace(
        axis,
        # The joint fit knows a surface alone, a touch the surface in series with the coupling.
        environments=axis.environments or surfaces,
        robot=axis.robot if led is None or found is not None else led,
    )


def _sensor(recording: Recording) -> SensorEstimate:
    wrench, none = recording.wrench, unidentifiable(note=_REMOVED)
    zeros = 100.0 * float(np.mean(wrench.force_n == 0.0))
    known = None if wrench.deadband is None else wrench.deadband.force_n
    deadband = (
        unidentifiable(
            note=f"{zeros:.1f} % of the forces are exactly 0; the width cannot be determined from a moving log"
        )
        if known is None
        else Estimate(value=known, std=0.0, status=Status.GIVEN, note="declared in cell.yaml")
    )
    return SensorEstimate(
        force_bias_n=unidentifiable_vector(_REMOVED),
        torque_bias_n_m=unidentifiable_vector(_REMOVED),
        force_noise_rms_n=none,
        gravity_residual_rms_n=none,
        deadband_n=deadband,
    )
