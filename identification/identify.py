"""Identification of plant parameters from one recording: the driver over all estimators."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from problems.arrays import FloatArray
from problems.progress import ProgressSlice, no_progress

from .axes.straight import Travel, find_axes
from .axes.turning import find_turns
from .axis_command import CellSignals
from .axis_estimate import AxisResult, axis_evidence, identify_axis
from .conventions.choice import ReadLog, read_by_weight
from .evidence import Evidence
from .fitted_timeline import (
    account_for_log,
    hand_findings,
    with_surfaces,
    with_unfitted_touches,
    without_surface,
)
from .given import Given, settle_cell
from .joint_fit.latency import find_wrench_filter
from .known_payload import KnownPayload, known_payload, read_with_known
from .partial import identify_partial
from .payload.gravity import GravityFit, identify_gravity
from .payload.gravity_verdicts import com_estimate, gravity_findings, mass_estimate
from .payload.inertia import InertiaFit, identify_inertia
from .payload.turning import turning_of_payload
from .rebuilt_command import rebuilt_command
from .result import (
    Estimate,
    Finding,
    Identified,
    InertiaEstimate,
    PayloadEstimate,
    SensorEstimate,
    Status,
    WrenchFilterEstimate,
)
from .robot.admittance_estimates import AdmittanceRobots, identify_admittance_robots
from .robot.admittance_motion import with_compensated_force
from .robot.logged_command import restore_commands
from .sensor import at_rest_only, describe_sensor, identify_from_rows
from .signals.aligned import AlignedLog, align, check_regular, without_wrench
from .signals.recording import Frames, PoseSignal, Recording, find_gaps, unmeasured
from .signals.segments import MotionSpans, find_motion
from .signals.spikes import without_spikes
from .turn_estimate import identify_turn, is_change_of_pose, unidentified_turn
from .verdicts import missing

_OBLIQUE_SHARE = 0.3
_QUARTZ_SHARE = 1e-5
# Of the work of a log with one axis; measured, and of no other use than to say how it goes on.
_WEIGHING_SHARE, _AXES_SHARE = 0.17, 0.77
_ABOUT = "about the origin of the sensor frame, not the centre of mass"


def identify_cell(
    recording: Recording, frames: Frames | None = None, given: Mapping[str, Given] | None = None
) -> Identified:
    """Estimate payload, sensor, and per axis robot, coupling and environments, each with a verdict.

    What the log does not show is `unidentifiable` and named by a finding of severity `error`.

    Parameters
    ----------
    recording
        Wrench, pose and, where there are, command and admittance gains, in SI on their own stamps.
    frames
        What the cell declares; None declares nothing. The payload's weight checks the declared signs, frames and
        quaternion order: where only others fit, those are taken and named.
    given
        Prior knowledge of mass, period and parameters of an axis, by name. Names that are not of this recording are
        passed over (`given.check_names` refuses them).

    Raises
    ------
    EstimateError
        Not even gravity can be determined, without which nothing else can.
    LogError
        The channels do not fit together.

    """
    return identify_with_evidence(recording, frames, given)[0]


def identify_with_evidence(
    recording: Recording,
    frames: Frames | None = None,
    given: Mapping[str, Given] | None = None,
    progress: Callable[[float], None] | None = None,
    known: Sequence[KnownPayload] = (),
    *,
    with_signals: bool = True,
) -> tuple[Identified, Evidence | None]:
    """Return what `identify_cell` does, and the signals that it rests on; None where it has no wrench over time.

    Parameters
    ----------
    recording, frames, given
        As of `identify_cell`.
    progress
        Receives the share of the work (0 to 1) that was done since the last call.
    known
        Payloads of other logs of the cell, in the place of that of a log whose rests show none: the first one that its
        force at rest agrees with.
    with_signals
        Whether the evidence holds the signals. Without, the logged wrench takes no memory while the axes are fitted.

    Raises
    ------
    PayloadChangedError
        With `known`: the force at rest agrees with a payload up to some rest, or from it on.

    """
    report, given = progress if progress is not None else no_progress, given or {}
    partial = _identify_incomplete(recording, frames, given)
    if partial is not None:
        report(1.0)
        found = settle_cell(partial, given)
        return found, _wrench_as_logged(recording) if found.timelines else None
    weighed = [_weighed(recording, frames, known, report)]
    # Of a long log the wrench as it was logged, and what was restored of it, are a tenth of what is in memory.
    del recording
    return _identify(weighed.pop(), given, report, with_signals=with_signals)


@dataclass(frozen=True, kw_only=True)
class _Weighed:
    """A log as its weight reads it, with what it says of payload and sensor; the logged wrench is left out of it."""

    read: ReadLog
    payload: KnownPayload
    inertia: InertiaFit
    sensor: SensorEstimate
    about_spikes: tuple[Finding, ...]
    about_payload: tuple[Finding, ...]
    about_sensor: tuple[Finding, ...]


def _identify(
    weighed: _Weighed, given: Mapping[str, Given], report: Callable[[float], None], *, with_signals: bool
) -> tuple[Identified, Evidence]:
    read, payload, inertia = weighed.read, weighed.payload, weighed.inertia
    gravity = payload.gravity
    cell, about_robots = _signals(read, gravity, gravity.compensated_force_S_n(read.log), inertia, given)
    if not with_signals:
        read = replace(read, log=without_wrench(read.log))
        cell, weighed = replace(cell, log=read.log), replace(weighed, read=read)
    travel = find_axes(cell.log, read.motion, cell.force_S_n)
    results, about_axes = _identify_axes(cell, travel, inertia, lambda share: report(_AXES_SHARE * share))
    accounted, timeline = with_unfitted_touches(cell, results, *account_for_log(cell, results, gravity.mass_kg))
    late, about_late = _late_wrench(results, read.recording, cell.log.period_s)
    report(1.0 - _WEIGHING_SHARE - _AXES_SHARE)
    found = Identified(
        sample_time_s=_sample_time(read.recording),
        payload=PayloadEstimate(
            mass_kg=mass_estimate(gravity), com_m=com_estimate(gravity), inertia_kg_m2=_inertia(inertia)
        ),
        axes={name: with_surfaces(axis.estimate, accounted.surfaces[name]) for name, axis in results.items()},
        sensor=replace(weighed.sensor, wrench_filter=late),
        findings=(
            *weighed.about_spikes,
            *read.findings,
            *about_robots,
            *without_surface(about_axes, accounted),
            *accounted.findings,
            *hand_findings(timeline),
            *weighed.about_payload,
            *weighed.about_sensor,
            *about_late,
            *inertia.findings,
        ),
        timelines=(timeline,),
    )
    evidence = _evidence(cell, gravity, results if with_signals else {})
    return settle_cell(found, cell.given), replace(evidence, payload=payload)


def _signals(
    read: ReadLog, gravity: GravityFit, force: FloatArray, inertia: InertiaFit, given: Mapping[str, Given]
) -> tuple[CellSignals, tuple[Finding, ...]]:
    """Return what the axes of a weighed log share, and what its gains show of the robot."""
    recording, log, motion = read.recording, read.log, read.motion
    robots, rebuilt = _led_robots(recording, log, motion, force)
    cell = CellSignals(
        recording=recording,
        log=log,
        motion=motion,
        gravity=gravity,
        noise_rms_n=gravity.noise_rms_n,
        rest_residual_n=gravity.residual_rms_n,
        force_S_n=force,
        given=dict(given),
        robots=robots.robots,
        rebuilt=rebuilt,
        turns=find_turns(recording, log, motion, gravity),
        turning_S_n=turning_of_payload(log, force, gravity, inertia),
    )
    return cell, robots.findings


def _weighed(
    recording: Recording, frames: Frames | None, known: Sequence[KnownPayload], report: Callable[[float], None]
) -> _Weighed:
    """Return the log as its weight reads it, with the payload that its rests show, else a known one."""
    if recording.command is not None:
        recording = replace(recording, command=restore_commands(recording.command))
    recording, about_spikes = without_spikes(recording)
    log = align(recording)
    motion = find_motion(log)
    if known:
        read, payload = read_with_known(recording, log, motion, frames, known)
    else:
        read = read_by_weight(recording, log, motion, frames)
        payload = known_payload(read, identify_gravity(read.poses))
    report(_WEIGHING_SHARE / 2.0)
    inertia = identify_inertia(read.log, read.motion, read.poses, payload.gravity)
    sensor, about_sensor = describe_sensor(read, payload.gravity, frames)
    report(_WEIGHING_SHARE / 2.0)
    left = unmeasured(len(read.recording.wrench.stamp_ns))
    wrench = replace(read.recording.wrench, force_n=left, torque_n_m=left)
    return _Weighed(
        read=replace(read, recording=replace(read.recording, wrench=wrench)),
        payload=payload,
        inertia=inertia,
        sensor=sensor,
        about_spikes=about_spikes,
        about_payload=(payload.finding(),) if known else tuple(gravity_findings(payload.gravity)),
        about_sensor=about_sensor,
    )


def _late_wrench(
    results: Mapping[str, AxisResult], recording: Recording, period_s: float
) -> tuple[WrenchFilterEstimate | None, tuple[Finding, ...]]:
    """Return the wrench's low-pass or delay that the axes show, and what to say of it."""
    latencies = {name: axis.fit.latency for name, axis in results.items() if axis.fit is not None}
    return find_wrench_filter(latencies, recording.wrench_shifted_s, period_s)


def _identify_incomplete(recording: Recording, frames: Frames | None, given: Mapping[str, Given]) -> Identified | None:
    """Identify what a log without gravity, times or positions shows; None for one that has them."""
    if recording.wrench.gravity_compensated:
        return identify_partial(recording, _sample_time(recording), given)
    if recording.rows_are_poses:
        return identify_from_rows(recording, frames)
    if recording.pose.has_position:
        return None
    recording, about_spikes = without_spikes(recording)
    log = align(recording)
    read = read_by_weight(recording, log, find_motion(log), frames)
    gravity = identify_gravity(read.poses)
    sensor, about_sensor = describe_sensor(read, gravity, frames)
    return at_rest_only(gravity, sensor, _sample_time(recording), (*about_spikes, *read.findings, *about_sensor))


def _wrench_as_logged(recording: Recording) -> Evidence | None:
    """Gather what a picture of a log without weight shows, from where its time line begins."""
    wrench, pose = recording.wrench, recording.pose
    inside = (wrench.stamp_ns >= pose.stamp_ns[0]) & (wrench.stamp_ns <= pose.stamp_ns[-1])
    stamps = wrench.stamp_ns[inside]
    if len(stamps) < 2 or not wrench.measured_axes or recording.keeps_holes:
        return None
    return Evidence(
        start_ns=int(stamps[0]),
        period_s=float(stamps[-1] - stamps[0]) * 1e-9 / (len(stamps) - 1),
        raw_S_n=wrench.force_n[inside],
        compensated_S_n=None,
        raw_torque_S_n_m=wrench.torque_n_m[inside],
        compensated_torque_S_n_m=None,
        axes={},
    )


def _evidence(cell: CellSignals, gravity: GravityFit, results: Mapping[str, AxisResult]) -> Evidence:
    """Gather what the pictures of this log show, of a log without its wrench what is not drawn."""
    return Evidence(
        start_ns=cell.log.start_ns,
        period_s=cell.log.period_s,
        raw_S_n=cell.log.force_S_n,
        compensated_S_n=cell.force_S_n,
        raw_torque_S_n_m=cell.log.torque_S_n_m,
        compensated_torque_S_n_m=gravity.compensated_torque_S_n_m(cell.log),
        axes={name: axis_evidence(axis) for name, axis in results.items()},
        gain_error_share=gravity.gain_error_share,
    )


def _identify_axes(
    cell: CellSignals, travel: Travel, inertia: InertiaFit, report: Callable[[float], None]
) -> tuple[dict[str, AxisResult], list[Finding]]:
    """Estimate every axis along which, or about which, the tool moved."""
    findings = list[Finding]()
    if travel.oblique_share > _OBLIQUE_SHARE:
        findings.append(_oblique(travel.oblique_share))
    if not travel.axes and not cell.turns:
        findings.append(_no_travel())
    share = 1.0 / max(len(travel.axes) + len(cell.turns), 1)
    axes = {}
    for axis in travel.axes:
        part = ProgressSlice(report, share)
        axes[axis.name] = identify_axis(cell, axis, part)
        part.finish()
    for turn in cell.turns:
        part = ProgressSlice(report, share)
        turned = identify_turn(cell, turn, inertia, part)
        # Where no other axis is seen, what is missing of this one is said.
        if turned is None or (axes and is_change_of_pose(turn, turned)):
            findings.append(unidentified_turn(turn))
        else:
            axes[turn.name] = turned
        part.finish()
    return axes, [*findings, *(finding for axis in axes.values() for finding in axis.findings)]


def _led_robots(
    recording: Recording, log: AlignedLog, motion: MotionSpans, force_S_n: FloatArray
) -> tuple[AdmittanceRobots, PoseSignal | None]:
    """Return what the admittance's gains show of the robot where no command was logged, and the command they make."""
    if recording.command is not None or recording.gains is None:
        return AdmittanceRobots(robots={}, findings=()), None
    compensated = with_compensated_force(recording, log, force_S_n)
    robots = identify_admittance_robots(compensated)
    return robots, rebuilt_command(compensated, robots.beside, log, motion)


def _inertia(fit: InertiaFit) -> InertiaEstimate | None:
    """Return the tensor, None where no component is known."""
    if all(component.value is None for component in fit.components):
        return None
    xx, yy, zz, xy, xz, yz = (
        replace(each, note="; ".join(filter(None, (_ABOUT, each.note)))) for each in fit.components
    )
    return InertiaEstimate(xx=xx, yy=yy, zz=zz, xy=xy, xz=xz, yz=yz)


def _sample_time(recording: Recording) -> Estimate:
    source = recording.command if recording.command is not None else recording.wrench
    period = check_regular(source.topic, source.stamp_ns, keeps_holes=recording.keeps_holes)
    spread = float(np.std(np.delete(np.diff(source.stamp_ns), find_gaps(source.stamp_ns)))) * 1e-9
    note = f"period of `{source.topic}`, taken as the control period"
    return Estimate(
        value=period,
        # No clock counts better than its quartz, however little stamps scatter.
        std=max(spread / np.sqrt(len(source.stamp_ns)), _QUARTZ_SHARE * period) if spread > 0.0 else 0.0,
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
        "coupling nor environment can be determined.",
        "Record a commanded sweep and contacts along one tool axis.",
    )
