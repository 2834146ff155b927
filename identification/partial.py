"""Logs whose weight was removed before recording: no payload and no coupling, but what is left of robot and contact."""

from collections.abc import Mapping

import numpy as np

from .errors import EstimateError
from .result import (
    AxisEstimate,
    CouplingEstimate,
    EnvironmentEstimate,
    Estimate,
    Finding,
    Identified,
    PayloadEstimate,
    RobotEstimate,
    SensorEstimate,
    Status,
)
from .robot.admittance_estimates import identify_admittance_robots
from .signals.aligned import check_regular
from .signals.recording import AXES, Recording
from .timeline.trace import describe_trace, identify_trace
from .verdicts import missing, unidentifiable, unidentifiable_vector

_REMOVED = "gravity was removed before recording"


def identify_partial(recording: Recording, sample_time_s: Estimate) -> Identified:
    """Tell what a log without gravity tells: the robot through known gains, and the secant of a contact trace.

    A trace is a displacement since contact with its force; a pose in the base frame is taken as motion under the
    admittance. `sample_time_s` is handed on. Payload, coupling and sensor are unidentifiable, with findings of
    severity `error`. Raises EstimateError when nothing at all is told.
    """
    findings: list[Finding] = [*_always_missing(recording)]
    robots: Mapping[str, RobotEstimate] = {}
    surfaces: dict[str, EnvironmentEstimate] = {}
    if recording.gains is not None or not recording.pose.is_displacement:
        found = identify_admittance_robots(recording)
        robots = found.robots
        findings += found.findings
    else:
        findings.append(
            missing(
                "no-command",
                "The log has neither a commanded pose nor the admittance gains, so neither the robot's response nor "
                "its delay can be told.",
                "Record the position command, or declare `gains`.",
            )
        )
    if recording.pose.is_displacement:
        surfaces = _surfaces(recording, findings)
    if not robots and not surfaces:
        raise EstimateError(" ".join(f"{f.message} {f.advice}".strip() for f in findings if f.severity == "error"))
    if not surfaces:
        findings.append(
            missing(
                "no-contact",
                "Without the payload's mass and coupling a contact cannot be told from a hand, so no environment is "
                "told.",
                "Record the sensor's own wrench, with contacts, hands off.",
            )
        )
    return Identified(
        sample_time_s=sample_time_s,
        payload=PayloadEstimate(mass_kg=unidentifiable(note=_REMOVED), com_m=unidentifiable_vector(_REMOVED)),
        axes={axis: _axis(axis, robots, surfaces) for axis in AXES if axis in robots or axis in surfaces},
        sensor=_sensor(recording),
        findings=tuple(findings),
    )


def _always_missing(recording: Recording) -> tuple[Finding, ...]:
    return (
        missing(
            "gravity-removed",
            f"Gravity is already removed from the force of topic {recording.wrench.topic}, so the payload's mass, its "
            "centre and the sensor's bias cannot be told from it.",
            "Record the sensor's wrench before gravity compensation.",
        ),
        missing(
            "coupling",
            "The force that the payload's inertia makes is hidden by gravity compensation, deadband or the hand, so "
            "K_s, B_s and B_p cannot be told.",
            "Record raw wrench and pose with a commanded sweep, hands off.",
        ),
    )


def _surfaces(recording: Recording, findings: list[Finding]) -> dict[str, EnvironmentEstimate]:
    wrench, pose = recording.wrench, recording.pose
    period = check_regular(wrench.topic, wrench.stamp_ns, keeps_holes=recording.keeps_holes)
    surfaces = {}
    for i, axis in enumerate(AXES[:3]):
        if axis not in wrench.measured_axes or axis not in pose.measured_axes:
            continue
        inside = (wrench.stamp_ns >= pose.stamp_ns[0]) & (wrench.stamp_ns <= pose.stamp_ns[-1])
        start = int(pose.stamp_ns[0])
        displacement = np.interp(
            wrench.stamp_ns[inside] - start, pose.stamp_ns - start, np.array(pose.position_m[:, i], dtype=np.float64)
        )
        # Pressing towards +axis reads F < 0 (the payload's force on the flange).
        sign = 1.0 if abs(float(np.max(displacement))) >= abs(float(np.min(displacement))) else -1.0
        try:
            contact = identify_trace(sign * displacement, -sign * wrench.force_n[inside, i], period)
        except EstimateError as error:
            findings.append(Finding(code="no-contact", severity="warning", message=f"Axis {axis}: {error}", advice=""))
            continue
        surfaces[axis], about = describe_trace(contact, f"{axis}1")
        findings += about
    return surfaces


def _axis(axis: str, robots: Mapping[str, RobotEstimate], surfaces: Mapping[str, EnvironmentEstimate]) -> AxisEstimate:
    none = unidentifiable(note=_REMOVED)
    unknown = unidentifiable_vector("neither command nor gains tell the robot on this axis")
    without = RobotEstimate(
        numerator=unknown,
        denominator=unknown,
        delay_s=unidentifiable(note=unknown.note),
        bandwidth_hz=unidentifiable(note=unknown.note),
    )
    return AxisEstimate(
        coupling=CouplingEstimate(stiffness_n_per_m=none, damping_n_s_per_m=none),
        drag_n_s_per_m=none,
        environments=(surfaces[axis],) if axis in surfaces else (),
        robot=robots.get(axis, without),
    )


def _sensor(recording: Recording) -> SensorEstimate:
    wrench, none = recording.wrench, unidentifiable(note=_REMOVED)
    zeros = 100.0 * float(np.nanmean(wrench.force_n == 0.0))
    known = None if wrench.deadband is None else wrench.deadband.force_n
    deadband = (
        unidentifiable(note=f"{zeros:.1f} % of the forces are exactly 0; the width cannot be told from a moving log")
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
