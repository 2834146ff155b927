"""The chosen channels as one recording: which clock stamps them, whether they can be used, what they are in SI."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from problems.arrays import BoolArray, FloatArray

from ..errors import LogError
from ..result import Finding
from ..signals.recording import (
    AXES,
    AppliedDeadband,
    Frames,
    GainsSignal,
    PoseSignal,
    Recording,
    StampArray,
    TwistSignal,
    WrenchSignal,
    no_wrench,
)
from .checks.consistency import turn_findings, twist_findings
from .checks.samples import ExaminedRoles
from .checks.stamps import with_holes_once
from .containers.channel import Channel
from .messages.decode import Series
from .roles.cell import (
    ANGLE_RAD,
    FORCE_N,
    LENGTH_M,
    TORQUE_N_M,
    Cell,
    Clock,
    DeclaredDeadband,
    DesiredForceSource,
    ExertedBy,
    Frame,
    GainsSource,
    Mounting,
    PoseSource,
    TwistSource,
    WrenchSource,
)
from .roles.choose import source_of
from .roles.orientation import canonical, orientation_quaternion
from .roles.registry import ROLES, Role, is_processed_name

_MAIN = (Role.WRENCH, Role.POSE, Role.COMMAND)
_DOWN = np.array([0.0, 0.0, -1.0])
_OF_SINGLE_ROWS = frozenset({"not-finite", "quaternion-norm", "turn-unit", "length-unit", "no-rotation", "stuck-axis"})
"""Faults that a table of poses can have; the others compare neighbours in time."""


def chosen_clocks(parts: Sequence[Mapping[Role, Series]], cell: Cell) -> tuple[dict[Role, Clock], tuple[Finding, ...]]:
    """Return the clock of each role: the declared one, else the header's, else for all of them the log's.

    Raises LogError when header stamps are declared for a channel that has none.
    """
    series = {role: next((p[role] for p in parts if p[role].stamp_ns is None), parts[0][role]) for role in parts[0]}
    declared = {role: source.clock for role in series if (source := source_of(cell, role)) is not None}
    for role, clock in declared.items():
        if clock is Clock.HEADER and series[role].stamp_ns is None:
            raise LogError(
                f"Topic {series[role].topic} must have header stamps, as cell.yaml declares for the "
                f"{ROLES[role].label}, found none; declare `{ROLES[role].entry}: {{clock: log}}` or the "
                "path of its header."
            )
    bare = [role for role in _MAIN if role in series and series[role].stamp_ns is None]
    usual = Clock.LOG if bare else Clock.HEADER
    clocks = {
        role: declared.get(role) or (usual if series[role].stamp_ns is not None else Clock.LOG) for role in series
    }
    by_log = [role for role in series if clocks[role] is Clock.LOG]
    findings = []
    tables = {series[role].topic for role in _MAIN if role in series and _is_table(series[role])}
    if len(tables) > 1 and not cell.rows_are_poses:
        findings.append(
            Finding.info(
                "tables-on-one-clock",
                f"The times of {', '.join(sorted(tables))} are taken as those of one clock.",
                "Declare `clock_offset_s` where one of them counts from another instant.",
            )
        )
    # The time column of a table is what its writer took for the time; only messages have a time of recording beside.
    if bare and not all(_is_table(series[role]) for role in by_log):
        topics = ", ".join(sorted({series[role].topic for role in bare}))
        findings.append(
            Finding.warning(
                "log-clock",
                f"{topics} has no header stamps, so the time of recording is the clock of "
                f"{', '.join(ROLES[role].label for role in by_log)}.",
                "The time of recording jitters and lags; record header stamps for a delay that can be trusted.",
            )
        )
    return clocks, tuple(findings)


def sample_findings(
    parts: Sequence[Mapping[Role, Series]],
    clocks: Mapping[Role, Clock],
    cell: Cell,
    start_ns: int,
    *,
    keeps_holes: bool,
    examined: ExaminedRoles,
) -> tuple[Finding, ...]:
    """Check the samples of every role over all parts; raises LogError for the first that cannot be used."""
    found: list[Finding] = []
    for role in parts[0]:
        mine = [part[role] for part in parts]
        stamps = [_stamps(role, part, clocks, cell) for part in parts]
        found += examined.faults(role, mine, stamps, source_of(cell, role), start_ns, keeps_holes=keeps_holes)
    if cell.rows_are_poses:
        found = [finding for finding in found if finding.code in _OF_SINGLE_ROWS]
    refuse(found)
    return tuple(with_holes_once(found))


def _is_table(series: Series) -> bool:
    return series.channel.encoding == "table"


def build_recording(series: dict[Role, Series], clocks: Mapping[Role, Clock], cell: Cell) -> Recording:
    """Interpret the samples of every role, which `sample_findings` has found usable.

    `series` is emptied: of a long log never all numbers are held as they were logged and as they are meant.
    """
    frames = build_frames(cell)
    stamps = role_stamps(series, clocks, cell)
    columns = {role: replace(series.pop(role), stamp_ns=stamps[role]) for role in [*series]}
    is_relative = cell.displacement is not None
    source = cell.pose or cell.displacement or PoseSource()
    pose = interpret_pose(columns.pop(Role.POSE), source, frames, is_displacement=is_relative)
    wrench, findings = no_wrench(pose), list[Finding]()
    if Role.WRENCH in columns:
        wrench, findings = _wrench(columns.pop(Role.WRENCH), cell, frames, pose)
    command = twist = desired_force = None
    if Role.COMMAND in columns:
        source = cell.command or PoseSource()
        command = interpret_pose(columns.pop(Role.COMMAND), source, frames, is_displacement=is_relative)
    if not cell.rows_are_poses:
        findings += turn_findings(pose)
    if Role.TWIST in columns:
        twist = interpret_twist(columns.pop(Role.TWIST), cell.twist or TwistSource(), frames, pose)
        findings += twist_findings(pose, twist)
    desired = cell.desired_force or DesiredForceSource()
    asked = _constant(desired, wrench) if desired.is_known else columns.get(Role.DESIRED_FORCE)
    if asked is not None:
        axes = desired.expressed_in or Frame.SENSOR
        desired_force = interpret_wrench(asked, desired, frames, pose, expressed_in=axes, gravity_compensated=True)
    return Recording(
        wrench=wrench,
        pose=pose,
        command=command,
        twist=twist,
        gains=_gains(columns, cell, wrench),
        desired_force=desired_force,
        clocks={ROLES[role].entry: clock.value for role, clock in clocks.items()},
        findings=tuple(dict.fromkeys(findings)),
        rows_are_poses=cell.rows_are_poses,
    )


def role_stamps(series: Mapping[Role, Series], clocks: Mapping[Role, Clock], cell: Cell) -> dict[Role, StampArray]:
    """Return the stamps of each role on its clock, moved by the declared offset."""
    return {role: _stamps(role, series, clocks, cell) for role in series}


def refuse(findings: Iterable[Finding]) -> None:
    """Raise LogError for the first finding that makes a log unusable."""
    for finding in findings:
        if finding.severity == "error":
            raise LogError(f"{finding.message} {finding.advice}")


def _stamps(role: Role, series: Mapping[Role, Series], clocks: Mapping[Role, Clock], cell: Cell) -> StampArray:
    """Return the stamps of a role on its clock, moved by the declared offset.

    A role beside the main ones that has no header is stamped by the time of recording less the wrench's delay.
    """
    mine, source = series[role], source_of(cell, role)
    stamps = mine.stamp_ns if clocks[role] is Clock.HEADER and mine.stamp_ns is not None else mine.log_ns
    wrench = series.get(Role.WRENCH)
    if (
        role not in _MAIN
        and (source is None or source.clock is None)
        and mine.stamp_ns is None
        and wrench is not None
        and wrench.stamp_ns is not None
        and clocks[Role.WRENCH] is Clock.HEADER
    ):
        stamps = stamps + np.int64(np.median(wrench.stamp_ns - wrench.log_ns))
    offset_ns = round((0.0 if source is None else source.clock_offset_s) * 1e9)
    return stamps + np.int64(offset_ns) if offset_ns else stamps


def _frame(series: Series) -> str:
    return series.frame_ids[0] if series.frame_ids else ""


def _wrench(columns: Series, cell: Cell, frames: Frames, pose: PoseSignal) -> tuple[WrenchSignal, list[Finding]]:
    source = cell.wrench or WrenchSource()
    findings = []
    if source.gravity_compensated is None and is_processed_name(columns.topic):
        findings.append(
            Finding.warning(
                "wrench-may-be-processed",
                f"The name of {columns.topic} says that its wrench is not as the sensor showed it; it is taken as raw.",
                "Record the raw wrench, or declare `gravity_compensated` (true or false) and `deadband` in cell.yaml.",
            )
        )
    # The weight of a raw wrench shows in whose axes it is.
    if (
        source.gravity_compensated
        and source.expressed_in is None
        and pose.frame_id
        and _frame(columns) == pose.frame_id
    ):
        findings.append(
            Finding.warning(
                "wrench-frame-assumed",
                f"The wrench of topic {columns.topic} is taken in the sensor's axes, but its frame, {pose.frame_id}, "
                "is that of the pose.",
                "Say in whose axes it is: `wrench: {expressed_in: base}` (or sensor) in cell.yaml.",
            )
        )
    wrench = interpret_wrench(
        columns,
        source,
        frames,
        pose,
        expressed_in=source.expressed_in or Frame.SENSOR,
        gravity_compensated=bool(source.gravity_compensated),
    )
    return wrench, findings


def nameless_series(stamp_ns: StampArray, values: FloatArray) -> Series:
    """Return numbers (n, k) that are in no log, at stamps (n,)."""
    nobody = Channel(topic="", type_name="", encoding="", schema_encoding="", schema=b"")
    fields = ("",) * values.shape[1]
    return Series(channel=nobody, fields=fields, log_ns=stamp_ns, stamp_ns=stamp_ns, frame_ids=(), values=values)


def _constant(source: DesiredForceSource, wrench: WrenchSignal) -> Series:
    """Return a declared force at the wrench's stamps, of which one will do where it does not turn with the tool."""
    stamps = wrench.stamp_ns if source.expressed_in is Frame.BASE else wrench.stamp_ns[:1]
    values = np.tile([*(source.force or ()), *source.torque], (len(stamps), 1))
    return nameless_series(stamps, values)


def _gains(columns: Mapping[Role, Series], cell: Cell, wrench: WrenchSignal) -> GainsSignal | None:
    source = cell.gains or GainsSource()
    if source.mass is not None and source.damping is not None:
        gains = GainsSignal(
            topic="",
            stamp_ns=wrench.stamp_ns[:1],
            mass=np.array([source.mass]),
            damping=np.array([source.damping]),
        )
    elif Role.GAINS in columns:
        gains = interpret_gains(columns[Role.GAINS])
    else:
        return None
    return replace(gains, lead_s=source.lead, deadband=applied_deadband(source.deadband))


def build_frames(cell: Cell) -> Frames:
    """Build the rotations that a cell declares.

    The sensor frame takes the place of the flange's; the base is turned by the least turn that puts gravity along −z.
    """
    direction = np.array(cell.gravity_direction) / np.linalg.norm(cell.gravity_direction)
    axis = np.cross(direction, _DOWN)
    sine = float(np.linalg.norm(axis))
    # Gravity along ±z leaves the axis open; any horizontal one does.
    axis = np.array([1.0, 0.0, 0.0]) if sine == 0.0 else axis / sine
    angle = np.arctan2(sine, float(direction @ _DOWN))
    return Frames(R_FS=_mounted(cell.sensor), R_WB=Rotation.from_rotvec(angle * axis))


def interpret_pose(series: Series, source: PoseSource, frames: Frames, *, is_displacement: bool) -> PoseSignal:
    """Return the pose in metres, its orientation that of the sensor frame in the gravity-aligned base."""
    length = LENGTH_M[source.units.position]
    position = series.values[:, :3] * (length * np.array(source.signs))
    turns = series.values[:, 3:]
    turned: tuple[str, ...] = ()
    if turns.shape[1] and all(series.has[3:]):
        quaternion = orientation_quaternion(source.orientation_as, turns, ANGLE_RAD[source.units.angle])
        if not (_is_identity(frames.R_WB) and _is_identity(frames.R_FS)):
            quaternion = canonical((frames.R_WB * Rotation.from_quat(quaternion) * frames.R_FS).as_quat())
        turned = AXES[3:]
    else:
        quaternion = np.full((len(position), 4), np.nan)
    if not is_displacement:
        position = _turned(series.topic, frames.R_WB, position, series.has[:3])
    return PoseSignal(
        topic=series.topic,
        frame_id=_frame(series),
        stamp_ns=series.times_ns,
        position_m=position,
        quaternion_xyzw=quaternion,
        is_displacement=is_displacement,
        measured_axes=(*_measured(series.has[:3]), *turned),
    )


def interpret_wrench(
    series: Series,
    source: WrenchSource,
    frames: Frames,
    pose: PoseSignal,
    *,
    expressed_in: Frame,
    gravity_compensated: bool,
) -> WrenchSignal:
    """Return the payload's wrench on the sensor in N and N·m, in the sensor frame.

    Raises LogError when it is given in base axes and the pose lacks the orientation of the sensor.
    """
    scale = np.repeat([FORCE_N[source.units.force], TORQUE_N_M[source.units.torque]], 3) * np.array(source.signs)
    values = series.values * (scale * (-1.0 if source.exerted_by is ExertedBy.SENSOR else 1.0))
    stamps, has = series.times_ns, series.has
    if expressed_in is Frame.FLANGE:
        values = _both_turned(series, frames.R_FS.inv(), values)
    elif expressed_in is Frame.BASE and gravity_compensated and not {*AXES[3:]} & {*pose.measured_axes}:
        # The tool counts as never turned, so that the axes of the wrench are those of the position.
        values = _both_turned(series, frames.R_WB, values)
    elif expressed_in is Frame.BASE:
        inside, orientation = _orientation_at(pose, stamps, series.topic)
        stamps = stamps[inside]
        values = _both_turned(series, orientation.inv() * frames.R_WB, values[inside])
    return WrenchSignal(
        topic=series.topic,
        frame_id=_frame(series),
        stamp_ns=stamps,
        force_n=values[:, :3],
        torque_n_m=values[:, 3:],
        gravity_compensated=gravity_compensated,
        deadband=applied_deadband(source.deadband),
        measured_axes=_measured(has),
    )


def applied_deadband(declared: DeclaredDeadband | None) -> AppliedDeadband | None:
    """Return a declared deadband as signals have it."""
    if declared is None:
        return None
    return AppliedDeadband(type=declared.type.value, force_n=declared.force_n, torque_n_m=declared.torque_n_m)


def interpret_twist(series: Series, source: TwistSource, frames: Frames, pose: PoseSignal) -> TwistSignal:
    """Return the flange's twist in m/s and rad/s in the gravity-aligned base."""
    scale = np.repeat([LENGTH_M[source.units.linear], ANGLE_RAD[source.units.angular]], 3) * np.array(source.signs)
    values, stamps = series.values * scale, series.times_ns
    if source.expressed_in is Frame.BASE:
        values = _both_turned(series, frames.R_WB, values)
    else:
        inside, orientation = _orientation_at(pose, stamps, series.topic)
        if source.expressed_in is Frame.FLANGE:
            orientation = orientation * frames.R_FS.inv()
        stamps, values = stamps[inside], _both_turned(series, orientation, values[inside])
    return TwistSignal(
        topic=series.topic,
        frame_id=_frame(series),
        stamp_ns=stamps,
        linear_m_s=values[:, :3],
        angular_rad_s=values[:, 3:],
        measured_axes=_measured(series.has),
    )


def interpret_gains(series: Series) -> GainsSignal:
    """Return M_a and B_a per axis."""
    return GainsSignal(
        topic=series.topic, stamp_ns=series.times_ns, mass=series.values[:, :6], damping=series.values[:, 6:]
    )


def _mounted(mounting: Mounting) -> Rotation:
    if not mounting.orientation:
        return Rotation.identity()
    numbers = np.array([mounting.orientation])
    quaternion = orientation_quaternion(mounting.orientation_as, numbers, ANGLE_RAD[mounting.angle])
    return Rotation.from_quat(quaternion[0])


def _measured(has: Sequence[bool]) -> tuple[str, ...]:
    return tuple(axis for axis, is_there in zip(AXES, has, strict=False) if is_there)


def _is_identity(rotation: Rotation) -> bool:
    return bool(rotation.single and rotation.magnitude() == 0.0)


def _both_turned(series: Series, rotation: Rotation, values: FloatArray) -> FloatArray:
    parts = (slice(0, 3), slice(3, 6))
    return np.hstack([_turned(series.topic, rotation, values[:, part], series.has[part]) for part in parts])


def _turned(topic: str, rotation: Rotation, vectors: FloatArray, has: Sequence[bool]) -> FloatArray:
    """Turn vectors (n, 3); without a turn every bit stays as it is. A vector that is missing as a whole stays so."""
    if _is_identity(rotation) or not any(has):
        return vectors
    if not all(has):
        raise LogError(
            f"Topic {topic} must hold all three components of a vector that has to be turned into another frame; "
            "declare all of them, or the frame in which those that are there are meant."
        )
    return np.asarray(rotation.apply(vectors))


def _orientation_at(pose: PoseSignal, stamp_ns: StampArray, topic: str) -> tuple[BoolArray, Rotation]:
    """Return which stamps the pose covers, and its orientation there by slerp."""
    if pose.is_displacement or not {*AXES[3:]} <= {*pose.measured_axes}:
        raise LogError(
            f"The orientation of the sensor must be known to turn topic {topic} into its frame, found no whole pose "
            f"in topic {pose.topic}; declare the pose's orientation."
        )
    inside = (stamp_ns >= pose.stamp_ns[0]) & (stamp_ns <= pose.stamp_ns[-1])
    if not np.any(inside):
        raise LogError(f"Topics {topic} and {pose.topic} must cover the same time, found none in common.")
    start = pose.stamp_ns[0]
    slerp = Slerp((pose.stamp_ns - start) * 1e-9, Rotation.from_quat(pose.quaternion_xyzw))
    return inside, slerp((stamp_ns[inside] - start) * 1e-9)
