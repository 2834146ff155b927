"""Axes of a log whose weight was removed before recording: robot from the command, coupling and moving mass."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from problems.arrays import FloatArray

from .axes.straight import AXIS_NAMES, AxisMotion, find_axes
from .axis_command import CellSignals
from .axis_estimate import AxisResult, identify_axis, identify_axis_robot
from .errors import LogError
from .given import Given
from .joint_fit.data import usual_coupling
from .payload.gravity import orientation_spread_rad
from .rebuilt_command import rebuilt_command
from .result import AxisEstimate, Finding
from .robot.admittance_estimates import AdmittanceRobots
from .robot.logged_command import restore_commands
from .signals.aligned import AlignedLog, edges_of, on_one_clock
from .signals.recording import AXES, AppliedDeadband, Recording, WrenchSignal
from .signals.segments import MotionSpans, find_motion
from .signals.spikes import without_spikes
from .touches.find import find_touches
from .touches.inertia import payload_force
from .touches.signals import axis_signals

_LONGEST_CROSSING_S = 0.1
# In drawn logs, deviations held the truth where up to a quarter was hidden, and no longer where a third was.
_MOST_HIDDEN = 0.3
_SMALLEST_TRAVEL_M = 2e-3
_LARGEST_TURN_RAD = np.radians(10.0)
_FEWEST_NOISE_SAMPLES = 50
# Written in one row, wrench and pose are as old as each other up to what a sensor's driver takes.
_LAG_OF_ONE_STAMP_S = (0.0, 3e-3)


@dataclass(frozen=True, kw_only=True)
class CompensatedAxes:
    """The axes along which the tool moved, by name, what to know about them, and the signals that they share."""

    axes: Mapping[str, AxisResult]
    findings: tuple[Finding, ...]
    cell: CellSignals | None = None

    @property
    def fitted(self) -> Mapping[str, AxisResult]:
        """Return the axes on which a fit behind the command, logged or rebuilt, knows moving mass and coupling."""
        if self.cell is None or self.cell.recording.keeps_holes:
            return {}
        if self.cell.recording.command is None and self.cell.rebuilt is None:
            return {}
        return {name: axis for name, axis in self.axes.items() if axis.fit is not None and _is_fitted(axis.estimate)}


def _is_fitted(estimate: AxisEstimate) -> bool:
    """Return whether moving mass and coupling are known."""
    mass = estimate.mass_kg
    return mass is not None and mass.value is not None and estimate.coupling.stiffness_n_per_m.value is not None


def identify_compensated_axes(
    recording: Recording, robots: AdmittanceRobots, given: Mapping[str, Given]
) -> CompensatedAxes:
    """Identify each straight axis without the payload's weight: r(s) and T_d, K_s, B_s, B_p, and M_p as what moves.

    The robot follows from command and pose, or is that of `robots`; the rest from pose and force in free motion. A
    deadband of known width is undone where the force is beyond it. Axes that are not measured count as at rest.
    """
    if recording.command is not None:
        recording = replace(recording, command=restore_commands(recording.command))
    findings: tuple[Finding, ...] = ()
    if recording.wrench.measured_axes:
        recording, findings = without_spikes(recording)
    try:
        complete = _complete(recording)
        log = on_one_clock(replace(complete, wrench=_restored(complete.wrench)))
    except LogError as error:
        return CompensatedAxes(axes={}, findings=(Finding.warning("no-motion", str(error), ""),))
    motion = find_motion(log)
    # What the sensor shows without a load is no force, of the touches neither.
    offset = {each.axis: each.offset_n for each in axis_signals(recording)}
    force = np.asarray(log.force_S_n - np.array([offset.get(name, 0.0) for name in AXIS_NAMES]))
    cell = CellSignals(
        recording=complete,
        log=log,
        motion=motion,
        gravity=None,
        noise_rms_n=_noise_n(force, motion),
        rest_residual_n=_left_at_rest_n(force, motion),
        force_S_n=force,
        given=dict(given),
        robots=robots.robots,
        rebuilt=rebuilt_command(recording, robots.beside, log, motion),
        coupled=_coupled(complete),
    )
    axes: dict[str, AxisResult] = {}
    measured = [name for name in AXIS_NAMES if name in recording.pose.measured_axes]
    if motion.still and _is_force_known(recording.wrench.deadband):
        straight = [axis for axis in find_axes(log, motion, force).axes if axis.name in measured]
        felt = [a for a in straight if a.name in recording.wrench.measured_axes and _is_mostly_felt(log, a, complete)]
        axes = {a.name: identify_axis(cell, a) for a in felt}
    if recording.command is not None:
        for axis in _other_axes(log, motion, force, [name for name in measured if name not in axes]):
            axes[axis.name] = identify_axis_robot(cell, axis)
    about = tuple(finding for axis in axes.values() for finding in axis.findings)
    return CompensatedAxes(axes=axes, findings=(*findings, *about), cell=cell)


def _coupled(recording: Recording) -> dict[str, FloatArray]:
    """Return K_s, B_s, B_p, M_p (4,) of the axes on which pushes without a hand show the payload's own force."""
    found = {}
    for axis in find_touches(axis_signals(recording)):
        own = payload_force(axis)
        if own is not None and own.mode is not None:
            omega, mass = 2.0 * np.pi * own.mode[0], own.mass_kg
            damping = 2.0 * own.mode[1] * omega * mass
            found[axis.signals.axis] = np.array([mass * omega**2, damping, own.drag_n_s_per_m, mass])
        elif own is not None:
            found[axis.signals.axis] = usual_coupling(own.mass_kg)
    return found


def _is_force_known(deadband: AppliedDeadband | None) -> bool:
    """Return whether the force can be had back: a subtractive deadband of unknown width hides how much it took."""
    return deadband is None or deadband.type == "threshold" or deadband.force_n is not None


def _is_mostly_felt(log: AlignedLog, axis: AxisMotion, recording: Recording) -> bool:
    """Return whether no deadband took so much of the force in motion that what is drawn across it would be fitted."""
    wrench = recording.wrench
    edges = [log.start_ns + 1e9 * log.time_s[[span.start, span.stop - 1]] for span in axis.spans]
    force = np.concatenate(
        [wrench.force_n[slice(*np.searchsorted(wrench.stamp_ns, each)), AXES.index(axis.name)] for each in edges]
    )
    return wrench.deadband is None or float(np.mean(force == 0.0)) <= _MOST_HIDDEN


def _complete(recording: Recording) -> Recording:
    """Return the recording with zeros for what was not measured, and with one orientation where there is none."""
    wrench, pose, command = recording.wrench, recording.pose, recording.command
    unknown = not np.isfinite(pose.quaternion_xyzw).all()
    level = Rotation.identity(len(pose.stamp_ns)).as_quat()
    is_one = np.array_equal(wrench.stamp_ns, pose.stamp_ns)
    return replace(
        recording,
        wrench_lag_s=_LAG_OF_ONE_STAMP_S if is_one and recording.wrench_lag_s is None else recording.wrench_lag_s,
        wrench=replace(wrench, force_n=np.nan_to_num(wrench.force_n), torque_n_m=np.nan_to_num(wrench.torque_n_m)),
        pose=replace(
            pose,
            position_m=np.nan_to_num(pose.position_m),
            quaternion_xyzw=level if unknown else pose.quaternion_xyzw,
            measured_axes=tuple(axis for axis in AXES if axis in AXES[:3] or axis in pose.measured_axes),
        ),
        command=None if command is None else replace(command, position_m=np.nan_to_num(command.position_m)),
    )


def _restored(wrench: WrenchSignal) -> WrenchSignal:
    """Return the wrench before the deadband, straight lines across it where it was crossed within 0.1 s."""
    deadband = wrench.deadband
    if deadband is None:
        return wrench
    width = (deadband.force_n or 0.0) if deadband.type == "subtractive" else 0.0
    out = wrench.force_n + width * np.sign(wrench.force_n)
    longest = max(round(_LONGEST_CROSSING_S * 1e9 / float(np.median(np.diff(wrench.stamp_ns)))), 1)
    for column in out.T:
        starts, stops = edges_of(column == 0.0)
        for start, stop in zip(starts.tolist(), stops.tolist(), strict=True):
            if start > 0 and stop < len(column) and stop - start <= longest:
                column[start - 1 : stop + 1] = np.linspace(column[start - 1], column[stop], stop - start + 2)
    return replace(wrench, force_n=out, deadband=None)


def _noise_n(force_S_n: FloatArray, motion: MotionSpans) -> float:
    """Return the noise of the force, from second differences at rest where it is not swallowed by a deadband."""
    spans = [s for s in motion.still if bool(np.any(force_S_n[s.slice]))] or list(motion.moving)
    parts = [force_S_n[s.slice][np.any(force_S_n[s.slice] != 0.0, axis=1)] for s in spans]
    second = [np.diff(part, n=2, axis=0) for part in parts if len(part) > _FEWEST_NOISE_SAMPLES]
    return max(float(np.median([np.std(each) for each in second])) / np.sqrt(6.0) if second else 0.0, 1e-3)


def _left_at_rest_n(force_S_n: FloatArray, motion: MotionSpans) -> float:
    rests = [float(np.linalg.norm(np.median(force_S_n[s.slice], axis=0))) for s in motion.still]
    return float(np.median(rests)) if rests else 0.0


def _other_axes(log: AlignedLog, motion: MotionSpans, force_S_n: FloatArray, names: list[str]) -> list[AxisMotion]:
    """Return the axes of S along which the tool travels in whatever direction, turning by less than ten degrees."""
    if not motion.moving or not names or orientation_spread_rad(log.orientation_BS) > _LARGEST_TURN_RAD:
        return []
    axes = []
    for name in names:
        index = AXES.index(name)
        direction_B = np.asarray(log.orientation_BS.mean().apply(np.eye(3)[index]))
        position = np.asarray((log.position_B_m - log.position_B_m[0]) @ direction_B)
        if float(np.nanmax(position) - np.nanmin(position)) > _SMALLEST_TRAVEL_M:
            axes.append(
                AxisMotion(
                    name=name,
                    direction_B=direction_B,
                    position_m=position,
                    force_n=np.array(force_S_n[:, index]),
                    spans=motion.moving,
                )
            )
    return axes
