"""From a recording to plant parameters: one driver over the estimators of this floor."""

from collections.abc import Mapping

import numpy as np

from .aligned import align, check_regular, find_gaps
from .axes import find_axes
from .axis_estimate import CellSignals, identify_axis
from .convention_choice import read_by_weight
from .frames import Frames
from .given import Given, settle_cell
from .gravity import identify_gravity
from .gravity_verdicts import com_estimate, gravity_findings, mass_estimate
from .inertia import InertiaFit, identify_inertia
from .recording import Recording
from .result import Estimate, Finding, Identified, InertiaEstimate, PayloadEstimate, Status
from .segments import find_motion
from .sensor import describe_sensor
from .verdicts import missing

_OBLIQUE_SHARE = 0.3


def identify_cell(
    recording: Recording, frames: Frames | None = None, given: Mapping[str, Given] | None = None
) -> Identified:
    """Estimate payload, sensor, and per axis robot, coupling and environments, each with a verdict.

    `frames` is what the cell declares (all the same where nothing is): the payload's weight is asked whether the
    declared signs, frames and quaternion order are true, and where only others fit, those are taken and named.
    `given` is what is known from elsewhere: priors of mass and period, and of the joint fit of every axis; names that
    are not of this recording are passed over (`given.check_names` refuses them). What the log does not tell is
    `unidentifiable` and named by a finding of severity `error`. Raises EstimateError when not even gravity can be told
    (nothing else can be without it), LogError when the channels do not fit together.
    """
    first = align(recording)
    read = read_by_weight(recording, first, find_motion(first), frames)
    recording, log, motion = read.recording, read.log, read.motion
    gravity = identify_gravity(read.poses)
    force = gravity.compensated_force_S_n(log)
    findings: list[Finding] = []
    travel = find_axes(log, motion, force)
    if travel.oblique_share > _OBLIQUE_SHARE:
        findings.append(_oblique(travel.oblique_share))
    if not travel.axes:
        findings.append(_no_travel())
    cell = CellSignals(
        recording=recording, log=log, motion=motion, gravity=gravity, force_S_n=force, given=dict(given or {})
    )
    axes = {}
    for axis in travel.axes:
        estimate, about_axis = identify_axis(cell, axis)
        axes[axis.name] = estimate
        findings += about_axis
    sensor, about_sensor = describe_sensor(read, gravity, frames)
    inertia = identify_inertia(log, motion, read.poses, gravity)
    found = Identified(
        sample_time_s=_sample_time(recording),
        payload=PayloadEstimate(
            mass_kg=mass_estimate(gravity), com_m=com_estimate(gravity), inertia_kg_m2=_inertia(inertia)
        ),
        axes=axes,
        sensor=sensor,
        findings=(
            *read.findings,
            *findings,
            *gravity_findings(gravity),
            *about_sensor,
            *inertia.findings,
        ),
    )
    return settle_cell(found, cell.given)


def _inertia(fit: InertiaFit) -> InertiaEstimate | None:
    """Return the tensor, None where no component is told."""
    if all(component.value is None for component in fit.components):
        return None
    xx, yy, zz, xy, xz, yz = fit.components
    return InertiaEstimate(xx=xx, yy=yy, zz=zz, xy=xy, xz=xz, yz=yz)


def _sample_time(recording: Recording) -> Estimate:
    source = recording.command if recording.command is not None else recording.wrench
    period = check_regular(source.topic, source.stamp_ns, keeps_holes=recording.keeps_holes)
    spread = float(np.std(np.delete(np.diff(source.stamp_ns), find_gaps(source.stamp_ns)))) * 1e-9
    note = f"period of `{source.topic}`, taken as the control period"
    return Estimate(
        value=period,
        std=spread / np.sqrt(len(source.stamp_ns)),
        status=Status.IDENTIFIED if recording.command is not None else Status.WEAK,
        method="header stamps",
        note=note,
    )


def _oblique(share: float) -> Finding:
    return Finding(
        code="oblique-motion",
        severity="warning",
        message=f"{100.0 * share:.0f} % of the travel went along none of the sensor frame's axes and was not used.",
        advice="Move along one axis of the tool at a time.",
    )


def _no_travel() -> Finding:
    return missing(
        "no-travel",
        "The tool never travels along one axis of the sensor frame with constant orientation, so neither robot, "
        "coupling nor environment can be told.",
        "Record a commanded sweep and contacts along one tool axis.",
    )
