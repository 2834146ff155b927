"""Identification of logs whose weight was removed before recording: the robot, and the secant of a contact trace."""

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
from .robot.admittance_robot import identify_admittance_robots
from .signals.recording import AXES, Recording
from .touches.surfaces import identify_touches, no_contact
from .verdicts import missing, unidentifiable, unidentifiable_robot, unidentifiable_vector

_REMOVED = "gravity was removed before recording"


def identify_partial(recording: Recording, sample_time_s: Estimate) -> Identified:
    """Identify what a log without gravity shows: the robot through known gains, and the secant of a contact trace.

    A trace is a displacement since contact with its force; a pose in the base frame is taken as motion under the
    admittance. `sample_time_s` is handed on. Payload, coupling and sensor are unidentifiable, with findings of
    severity `error`. Raises EstimateError when nothing is identified.
    """
    findings: list[Finding] = [*_always_missing(recording)]
    robots: Mapping[str, RobotEstimate] = {}
    touched = identify_touches(recording)
    surfaces = touched.surfaces
    if recording.gains is not None or not recording.pose.is_displacement:
        found = identify_admittance_robots(recording)
        robots = found.robots
        findings += found.findings
    else:
        findings.append(
            missing(
                "no-command",
                "The log has neither a commanded pose nor the admittance gains, so neither the robot's response nor "
                "its delay can be determined.",
                "Record the position command, or declare `gains`.",
            )
        )
    findings += touched.findings
    if not robots and not touched.shows_more_than_a_hand:
        raise EstimateError(" ".join(f"{f.message} {f.advice}".strip() for f in findings if f.severity == "error"))
    if not surfaces:
        findings.append(no_contact(touched))
    return Identified(
        sample_time_s=sample_time_s,
        payload=PayloadEstimate(mass_kg=unidentifiable(note=_REMOVED), com_m=unidentifiable_vector(_REMOVED)),
        axes={axis: _axis(axis, robots, surfaces) for axis in AXES if axis in robots or axis in surfaces},
        sensor=_sensor(recording),
        findings=tuple(findings),
        timelines=(touched.timeline,),
    )


def _always_missing(recording: Recording) -> tuple[Finding, ...]:
    return (
        missing(
            "gravity-removed",
            f"Gravity is already removed from the force of topic {recording.wrench.topic}, so the payload's mass, its "
            "centre and the sensor's bias cannot be determined from it.",
            "Record the sensor's wrench before gravity compensation.",
        ),
        missing(
            "coupling",
            "The force that the payload's inertia makes is hidden by gravity compensation, deadband or the hand, so "
            "K_s, B_s and B_p cannot be determined.",
            "Record raw wrench and pose with a commanded sweep, hands off.",
        ),
    )


def _axis(
    axis: str, robots: Mapping[str, RobotEstimate], surfaces: Mapping[str, tuple[EnvironmentEstimate, ...]]
) -> AxisEstimate:
    none = unidentifiable(note=_REMOVED)
    without = unidentifiable_robot("neither command nor gains identify the robot on this axis")
    return AxisEstimate(
        coupling=CouplingEstimate(stiffness_n_per_m=none, damping_n_s_per_m=none),
        drag_n_s_per_m=none,
        environments=surfaces.get(axis, ()),
        robot=robots.get(axis, without),
    )


def _sensor(recording: Recording) -> SensorEstimate:
    wrench, none = recording.wrench, unidentifiable(note=_REMOVED)
    zeros = 100.0 * float(np.nanmean(wrench.force_n == 0.0))
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
