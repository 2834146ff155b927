"""The chosen channels as one recording: which clock stamps them, whether they can be used, what they mean."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from ..errors import LogError
from ..result import Finding
from ..signals.frames import Frames
from ..signals.recording import GainsSignal, PoseSignal, Recording, StampArray, WrenchSignal, no_wrench
from .checks.consistency import turn_findings, twist_findings
from .checks.samples import role_faults
from .roles.candidates import is_processed_name
from .roles.cell import Cell, Clock, DesiredForceSource, Frame, GainsSource, PoseSource, TwistSource, WrenchSource
from .roles.choose import RoleSeries, source_of
from .roles.interpret import (
    Columns,
    applied_deadband,
    build_frames,
    interpret_gains,
    interpret_pose,
    interpret_twist,
    interpret_wrench,
)
from .roles.registry import ROLES, Role

_MAIN = (Role.WRENCH, Role.POSE, Role.COMMAND)
_OF_SINGLE_ROWS = frozenset({"not-finite", "quaternion-norm", "turn-unit", "length-unit"})
"""Faults that a table of poses can have; the others compare neighbours in time."""


def chosen_clocks(
    parts: Sequence[Mapping[Role, RoleSeries]], cell: Cell
) -> tuple[dict[Role, Clock], tuple[Finding, ...]]:
    """Return the clock of each role: the declared one, else the header's, else for all of them the log's.

    Raises LogError when header stamps are declared for a channel that has none.
    """
    series = {role: next((p[role] for p in parts if p[role].stamp_ns is None), parts[0][role]) for role in parts[0]}
    declared = {role: source.clock for role in series if (source := source_of(cell, role)) is not None}
    for role, clock in declared.items():
        if clock is Clock.HEADER and series[role].stamp_ns is None:
            raise LogError(
                f"Topic {_topic(series[role])} must have header stamps, as cell.yaml declares for the "
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
    tables = {_topic(series[role]) for role in _MAIN if role in series and _is_table(series[role])}
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
        topics = ", ".join(sorted({_topic(series[role]) for role in bare}))
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
    parts: Sequence[Mapping[Role, RoleSeries]],
    clocks: Mapping[Role, Clock],
    cell: Cell,
    start_ns: int,
    *,
    keeps_holes: bool,
) -> tuple[Finding, ...]:
    """Check the samples of every role over all parts; raises LogError for the first that cannot be used."""
    found: list[Finding] = []
    for role in parts[0]:
        mine = [part[role] for part in parts]
        stamps = [_stamps(role, part, clocks, cell) for part in parts]
        found += role_faults(role, mine, stamps, source_of(cell, role), start_ns, keeps_holes=keeps_holes)
    if cell.rows_are_poses:
        found = [finding for finding in found if finding.code in _OF_SINGLE_ROWS]
    refuse(found)
    return tuple(found)


def _is_table(series: RoleSeries) -> bool:
    return series.choice.info.channel.encoding == "table"


def build_recording(series: dict[Role, RoleSeries], clocks: Mapping[Role, Clock], cell: Cell) -> Recording:
    """Interpret the samples of every role, which `sample_findings` has found usable.

    `series` is emptied: of a long log never all numbers are held as they were logged and as they are meant.
    """
    frames = build_frames(cell)
    stamps = role_stamps(series, clocks, cell)
    columns = {role: _columns(series[role], stamps[role]) for role in series}
    series.clear()
    is_relative = cell.displacement is not None
    source = cell.pose or cell.displacement or PoseSource()
    pose = interpret_pose(columns.pop(Role.POSE), source, frames, is_displacement=is_relative)
    wrench, findings = no_wrench(pose), list[Finding]()
    if Role.WRENCH in columns:
        wrench, findings = _wrench(columns.pop(Role.WRENCH), cell, frames, pose)
    command = twist = desired_force = None
    if Role.COMMAND in columns:
        source = cell.command or PoseSource()
        command = interpret_pose(columns[Role.COMMAND], source, frames, is_displacement=is_relative)
    if not cell.rows_are_poses:
        findings += turn_findings(pose)
    if Role.TWIST in columns:
        twist = interpret_twist(columns[Role.TWIST], cell.twist or TwistSource(), frames, pose)
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


def role_stamps(series: Mapping[Role, RoleSeries], clocks: Mapping[Role, Clock], cell: Cell) -> dict[Role, StampArray]:
    """Return the stamps of each role on its clock, moved by the declared offset."""
    return {role: _stamps(role, series, clocks, cell) for role in series}


def refuse(findings: Iterable[Finding]) -> None:
    """Raise LogError for the first finding that makes a log unusable."""
    for finding in findings:
        if finding.severity == "error":
            raise LogError(f"{finding.message} {finding.advice}")


def _topic(series: RoleSeries) -> str:
    return series.choice.info.channel.topic


def _stamps(role: Role, series: Mapping[Role, RoleSeries], clocks: Mapping[Role, Clock], cell: Cell) -> StampArray:
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


def _columns(series: RoleSeries, stamp_ns: StampArray) -> Columns:
    frame = series.frame_ids[0] if series.frame_ids else ""
    pair = series.choice.frames
    return Columns(
        topic=_topic(series),
        frame_id=pair[0] if pair else frame,
        stamp_ns=stamp_ns,
        values=series.values,
        has=tuple(path is not None for path in series.choice.fields),
    )


def _wrench(columns: Columns, cell: Cell, frames: Frames, pose: PoseSignal) -> tuple[WrenchSignal, list[Finding]]:
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
    wrench = interpret_wrench(
        columns,
        source,
        frames,
        pose,
        expressed_in=source.expressed_in or Frame.SENSOR,
        gravity_compensated=bool(source.gravity_compensated),
    )
    return wrench, findings


def _constant(source: DesiredForceSource, wrench: WrenchSignal) -> Columns:
    """Return a declared force at the wrench's stamps, of which one will do where it does not turn with the tool."""
    stamps = wrench.stamp_ns if source.expressed_in is Frame.BASE else wrench.stamp_ns[:1]
    values = np.tile([*(source.force or ()), *source.torque], (len(stamps), 1))
    return Columns(topic="", frame_id="", stamp_ns=stamps, values=values, has=(True,) * 6)


def _gains(columns: Mapping[Role, Columns], cell: Cell, wrench: WrenchSignal) -> GainsSignal | None:
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
