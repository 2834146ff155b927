"""Poses from joint positions through a URDF, where a log has no others, and beside them where it has."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np
from scipy.spatial.transform import Rotation

from problems.arrays import BoolArray, FloatArray
from problems.errors import require_extra

from ..errors import LogError, listed
from ..result import Finding
from ..signals.recording import PoseSignal, Recording, slerp
from .messages.decode import Series, Wanted
from .opened import OpenedLogs
from .recording import build_frames, interpret_pose, nameless_series
from .roles.cell import ANGLE_RAD, Cell, Clock, JointsSource, PoseSource
from .roles.choose import Choice, choose_joints
from .roles.registry import JOINT_STATE, Role

_PRISMATIC, _FIXED = "prismatic", "fixed"
_LARGEST_BYTES = 2**24
_FAR_M, _FAR_RAD = 2e-3, np.radians(0.5)
_FEWEST_SHARED = 10
_POSE = tuple(f"pose[{index}]" for index in range(7))


@dataclass(frozen=True, kw_only=True)
class Joint:
    """A joint: `T_PC` (4, 4) is its child frame at zero in that of its parent, `axis` (3,) that of its motion."""

    name: str
    kind: str
    T_PC: FloatArray
    axis: FloatArray


@dataclass(frozen=True, kw_only=True)
class Chain:
    """The joints from `base` to `tip`, in this order."""

    base: str
    tip: str
    joints: tuple[Joint, ...]

    @property
    def moving(self) -> tuple[str, ...]:
        """The names of the joints that have a position."""
        return tuple(joint.name for joint in self.joints if joint.kind != _FIXED)

    def poses(self, positions: FloatArray, rad_per_unit: float = 1.0) -> FloatArray:
        """Return the poses of the tip in the base (n, 7), position [m] and quaternion xyzw.

        `positions` (n, k) are those of the moving joints: angles in a unit of `rad_per_unit`, lengths in m. A row with
        a number that is not finite gets no pose.
        """
        found = np.full((len(positions), 7), np.nan)
        good = np.isfinite(positions).all(axis=1)
        columns = iter(positions[good].T)
        place, turn = np.zeros((int(good.sum()), 3)), Rotation.identity(int(good.sum()))
        for joint in self.joints:
            place = place + turn.apply(joint.T_PC[:3, 3])
            turn = turn * Rotation.from_matrix(joint.T_PC[:3, :3])
            if joint.kind == _PRISMATIC:
                place = place + turn.apply(next(columns)[:, None] * joint.axis)
            elif joint.kind != _FIXED:
                turn = turn * Rotation.from_rotvec(rad_per_unit * next(columns)[:, None] * joint.axis)
        found[good, :3], found[good, 3:] = place, turn.as_quat(canonical=True)
        return found


def read_chain(path: Path, tip: str, base: str | None = None) -> Chain:
    """Read the chain that ends in the link `tip`, from the link `base` or the robot's root.

    Raises LogError where the file is no URDF or has no such chain, MissingExtraError without pytransform3d.
    """
    require_extra("A URDF", "pytransform3d", "urdf")
    from pytransform3d.urdf import UrdfException, parse_urdf  # noqa: PLC0415 - an extra, and slow to import

    text = _read(path)
    try:
        # Its own parser reads what is left of a truncated file.
        tree = ET.fromstring(text)
        _, links, joints = parse_urdf(text)
    except (ET.ParseError, UrdfException, ValueError) as error:
        raise LogError(
            f"{path.name} must be a URDF, found: {error}; of a xacro make one with `xacro robot.xacro > robot.urdf`."
        ) from error
    names = [link.name for link in links]
    for what, name in (("tip", tip), ("base", base)):
        if name is not None and name not in names:
            raise LogError(f"{path.name} has no link {name!r} to be the {what}; its links are: {listed(names)}.")
    mimicking = {each.get("name") for each in tree.iter("joint") if each.find("mimic") is not None}
    above = {joint.child: joint for joint in joints}
    chain: list[Joint] = []
    link = tip
    while link != base and link in above:
        joint = above.pop(link)
        axis = np.asarray(joint.joint_axis, dtype=np.float64)
        length = float(np.linalg.norm(axis))
        if joint.joint_name in mimicking or (joint.joint_type != _FIXED and not (axis.shape == (3,) and length > 0.0)):
            what = "follows another (mimic)" if joint.joint_name in mimicking else "has no axis"
            raise LogError(f"The joint {joint.joint_name} of {path.name} {what}; name a tip before it.")
        T_PC = np.asarray(joint.child2parent, dtype=np.float64)
        chain.append(Joint(name=str(joint.joint_name), kind=joint.joint_type, T_PC=T_PC, axis=axis / (length or 1.0)))
        link = str(joint.parent)
    if base is not None and link != base:
        raise LogError(f"No chain of joints leads from {base} to {tip} in {path.name}; it begins at {link}.")
    found = Chain(base=link, tip=tip, joints=tuple(reversed(chain)))
    if not found.moving:
        raise LogError(f"No joint moves {tip} against {link} in {path.name}; name another tip.")
    return found


def _read(path: Path) -> str:
    try:
        data = path.read_bytes()
        return data[:_LARGEST_BYTES].decode()
    except OSError as error:
        raise LogError(f"{path} cannot be read: {error.strerror or error}; name an existing URDF.") from error
    except UnicodeDecodeError as error:
        raise LogError(f"{path.name} must be a URDF, found a file that is no UTF-8 text.") from error


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
            paths, only = _paths(choice, chain, cell.joints, logs)
            found[role] = replace(choice, fields=paths, only=only)
            meaning = PoseSource(clock=cell.joints.clock, clock_offset_s=cell.joints.clock_offset_s)
            cell = replace(cell, pose=meaning) if role is Role.POSE else replace(cell, command=meaning)
    return found, cell, chain


def poses_of_joints(
    parts: Sequence[dict[Role, Series]], choices: Mapping[Role, Choice], cell: Cell, chain: Chain | None
) -> None:
    """Put poses in the place of joint positions."""
    if chain is None or cell.joints is None:
        return
    for part in parts:
        for role, series in part.items():
            if choices[role].of_joints:
                values = chain.poses(series.values, ANGLE_RAD[cell.joints.angle])
                part[role] = replace(series, fields=_POSE, values=values)


def joint_findings(
    used: Choice, recording: Recording, cell: Cell, chain: Chain | None, logs: OpenedLogs
) -> tuple[Finding, ...]:
    """Compare a pose that the log has with that of its joints; `used` is the channel of the pose."""
    pose = recording.pose
    if chain is None or cell.joints is None or used.of_joints or pose.is_displacement:
        return ()
    try:
        choice = choose_joints(Role.POSE, cell.joints, logs.infos, logs.name)
        paths, only = ((), b"") if choice is None else _paths(choice, chain, cell.joints, logs)
    except LogError as error:
        return (Finding.info("joints-unread", str(error), f"The pose of {pose.topic} is used, compared with none."),)
    if choice is None:
        return ()
    header = choice.header if recording.clocks["pose"] == Clock.HEADER.value else ""
    [series] = logs.read({choice.info.channel: Wanted(fields=paths, header=header, only=only)}).values()
    stamps, values = series.times_ns, chain.poses(series.values, ANGLE_RAD[cell.joints.angle])
    other = interpret_pose(nameless_series(stamps, values), PoseSource(), build_frames(cell), is_displacement=False)
    inside = (stamps >= pose.stamp_ns[0]) & (stamps <= pose.stamp_ns[-1]) & np.isfinite(other.position_m).all(axis=1)
    if np.count_nonzero(inside) < _FEWEST_SHARED or len(pose.measured_axes) < 6:
        return ()
    return (_compared(pose, other, inside, cell.joints, choice),)


def _compared(
    pose: PoseSignal,
    other: PoseSignal,
    inside: BoolArray,
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


def _paths(choice: Choice, chain: Chain, joints: JointsSource, logs: OpenedLogs) -> tuple[tuple[str, ...], bytes]:
    """Return the paths of the chain's joints in a channel: the declared ones, or by the names in a JointState.

    With them the bytes that only messages with these joints hold, where others come in between.
    """
    topic, needed = choice.info.channel.topic, chain.moving
    declared = joints.command_positions if choice.role is Role.COMMAND else joints.positions
    if declared:
        if len(declared) != len(needed):
            raise LogError(
                f"`joints: {{positions: …}}` must name {len(needed)} numbers of topic {topic}, those of "
                f"{listed(needed)}, found {len(declared)}."
            )
        return declared, b""
    if choice.info.channel.type_name != JOINT_STATE:
        raise LogError(
            f"Topic {topic} is no JointState, so its joints have no names; declare `joints: {{positions: […]}}` in "
            f"cell.yaml in the order {listed(needed)}."
        )
    known = logs.joint_names(choice.info, needed)
    names = known.names
    missing = [name for name in needed if name not in names]
    if missing:
        raise LogError(
            f"Topic {topic} must hold the joints of {joints.urdf.name} from {chain.base} to {chain.tip}, found no "
            f"{listed(missing)}; it has {listed(names)}."
        )
    return tuple(f"position[{names.index(name)}]" for name in needed), known.only
