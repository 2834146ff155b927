"""Poses from joint positions through a URDF, where a log has no others, and beside them where it has."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from ..errors import LogError, listed
from ..result import Finding
from ..signals.frames import slerp
from ..signals.recording import PoseSignal, Recording
from .messages.decode import Wanted
from .opened import OpenedLogs
from .roles.cell import ANGLE_RAD, Cell, Clock, JointsSource, PoseSource
from .roles.choose import Choice, RoleSeries, choose_joints
from .roles.interpret import Columns, build_frames, interpret_pose
from .roles.kinematics import Chain, read_chain
from .roles.registry import JOINT_STATE, Role

_FAR_M, _FAR_RAD = 2e-3, np.radians(0.5)
_FEWEST_SHARED = 10
_POSE = tuple(f"pose[{index}]" for index in range(7))


def resolve_joints(
    choices: Mapping[Role, Choice], cell: Cell, logs: OpenedLogs
) -> tuple[dict[Role, Choice], Cell, Chain | None]:
    """Return the choices with the paths of joint positions in the order of the chain, and what they mean as a pose."""
    if cell.joints is None:
        return dict(choices), cell, None
    chain = read_chain(cell.joints.urdf, cell.joints.tip, cell.joints.base)
    found = dict(choices)
    for role, choice in choices.items():
        if choice.of_joints:
            found[role] = replace(choice, fields=_paths(choice, chain, cell.joints, logs))
            meaning = PoseSource(clock=cell.joints.clock, clock_offset_s=cell.joints.clock_offset_s)
            cell = replace(cell, pose=meaning) if role is Role.POSE else replace(cell, command=meaning)
    return found, cell, chain


def poses_of_joints(parts: Sequence[dict[Role, RoleSeries]], cell: Cell, chain: Chain | None) -> None:
    """Put poses in the place of joint positions."""
    if chain is None or cell.joints is None:
        return
    for part in parts:
        for role, series in part.items():
            if series.choice.of_joints:
                choice = replace(series.choice, fields=_POSE)
                values = chain.poses(series.values, ANGLE_RAD[cell.joints.angle])
                part[role] = replace(series, choice=choice, values=values)


def joint_findings(
    used: Choice, recording: Recording, cell: Cell, chain: Chain | None, logs: OpenedLogs
) -> tuple[Finding, ...]:
    """Compare a pose that the log has with that of its joints; `used` is the channel of the pose."""
    pose = recording.pose
    if chain is None or cell.joints is None or used.of_joints or pose.is_displacement:
        return ()
    try:
        choice = choose_joints(Role.POSE, cell.joints, logs.infos, logs.name)
        paths = () if choice is None else _paths(choice, chain, cell.joints, logs)
    except LogError as error:
        return (Finding.info("joints-unread", str(error), f"The pose of {pose.topic} is used, compared with none."),)
    if choice is None:
        return ()
    header = choice.header if recording.clocks["pose"] == Clock.HEADER.value else ""
    [series] = logs.read({choice.info.channel: Wanted(fields=paths, header=header)}).values()
    stamps = series.log_ns if series.stamp_ns is None else series.stamp_ns
    values = chain.poses(series.values, ANGLE_RAD[cell.joints.angle])
    columns = Columns(topic="", frame_id="", stamp_ns=stamps, values=values, has=(True,) * 7)
    other = interpret_pose(columns, PoseSource(), build_frames(cell), is_displacement=False)
    inside = (stamps >= pose.stamp_ns[0]) & (stamps <= pose.stamp_ns[-1]) & np.isfinite(other.position_m).all(axis=1)
    if np.count_nonzero(inside) < _FEWEST_SHARED or len(pose.measured_axes) < 6:
        return ()
    return (_compared(pose, other, inside, cell.joints, choice),)


def _compared(
    pose: PoseSignal,
    other: PoseSignal,
    inside: np.ndarray[tuple[int], np.dtype[np.bool_]],
    joints: JointsSource,
    choice: Choice,
) -> Finding:
    """Say by how much the poses differ, and by how much but for a constant offset."""
    zero = pose.stamp_ns[0]
    time, at = (pose.stamp_ns - zero) * 1e-9, (other.stamp_ns[inside] - zero) * 1e-9
    position = np.column_stack([np.interp(at, time, column) for column in pose.position_m.T])
    turn, tip = (
        Rotation.from_quat(slerp(time, pose.quaternion_xyzw, at)),
        Rotation.from_quat(other.quaternion_xyzw[inside]),
    )
    apart_m = tip.inv().apply(position - other.position_m[inside])
    apart_rad = (tip.inv() * turn).magnitude()
    far_m, far_rad = float(np.sqrt(np.mean(np.sum(apart_m**2, axis=1)))), float(np.sqrt(np.mean(apart_rad**2)))
    mean_m = apart_m.mean(axis=0)
    left_m = float(np.sqrt(np.mean(np.sum((apart_m - mean_m) ** 2, axis=1))))
    offset = ", ".join(f"{round(1e3 * float(each), 1) + 0.0}" for each in mean_m)
    message = (
        f"The pose of {pose.topic} is {1e3 * far_m:.2f} mm and {np.degrees(far_rad):.2f}° (rms) away from that of the "
        f"joints of {choice.info.channel.topic} through {joints.urdf.name} ({joints.tip}); a constant offset of "
        f"({offset}) mm in the axes of the tip leaves {1e3 * left_m:.2f} mm."
    )
    if far_m < _FAR_M and far_rad < _FAR_RAD:
        return Finding.info("joints-agree", message, "")
    return Finding.warning(
        "joints-disagree",
        message,
        f"The pose of {pose.topic} is used; check the URDF, its tip and base, and the clocks.",
    )


def _paths(choice: Choice, chain: Chain, joints: JointsSource, logs: OpenedLogs) -> tuple[str, ...]:
    """Return the paths of the chain's joints in a channel: the declared ones, or by the names in a JointState."""
    topic, needed = choice.info.channel.topic, chain.moving
    declared = joints.command_positions if choice.role is Role.COMMAND else joints.positions
    if declared:
        if len(declared) != len(needed):
            raise LogError(
                f"`joints: {{positions: …}}` must name {len(needed)} numbers of topic {topic}, those of "
                f"{listed(needed)}, found {len(declared)}."
            )
        return declared
    if choice.info.channel.type_name != JOINT_STATE:
        raise LogError(
            f"Topic {topic} is no JointState, so its joints have no names; declare `joints: {{positions: […]}}` in "
            f"cell.yaml in the order {listed(needed)}."
        )
    names = logs.joint_names(choice.info)
    missing = [name for name in needed if name not in names]
    if missing:
        raise LogError(
            f"Topic {topic} must hold the joints of {joints.urdf.name} from {chain.base} to {chain.tip}, found no "
            f"{listed(missing)}; it has {listed(names)}."
        )
    return tuple(f"position[{names.index(name)}]" for name in needed)
