"""Numbers of a message turned into signals in SI, in our frames and with our signs."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from problems.arrays import FloatArray

from ...errors import LogError
from ...signals.frames import Frames
from ...signals.recording import AXES, AppliedDeadband, GainsSignal, PoseSignal, StampArray, TwistSignal, WrenchSignal
from .cell import (
    ANGLE_RAD,
    FORCE_N,
    LENGTH_M,
    TORQUE_N_M,
    Cell,
    DeclaredDeadband,
    ExertedBy,
    Frame,
    Mounting,
    PoseSource,
    TwistSource,
    WrenchSource,
)
from .orientation import COLUMN_MAJOR, ROW_MAJOR

_DOWN = np.array([0.0, 0.0, -1.0])


@dataclass(frozen=True, kw_only=True)
class Columns:
    """The numbers of one role as logged, (n, k), NaN for axes that `has` (k) leaves out, and their stamps (n,)."""

    topic: str
    frame_id: str
    stamp_ns: StampArray
    values: FloatArray
    has: tuple[bool, ...]


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


def orientation_quaternion(kind: str, numbers: FloatArray, rad_per_unit: float = 1.0) -> FloatArray:
    """Return unit quaternions xyzw (n, 4), w not negative, from orientations (n, 3, 4 or 9) written as `kind`.

    Quaternions are expected to be of norm 1 within rounding and are normalised, matrices to be rotations likewise.
    """
    if kind == "quaternion_wxyz":
        quaternion = numbers[:, [1, 2, 3, 0]]
    elif kind == "quaternion_xyzw":
        quaternion = numbers
    elif kind == "rotation_vector":
        quaternion = Rotation.from_rotvec(numbers * rad_per_unit).as_quat()
    elif kind in (ROW_MAJOR, COLUMN_MAJOR):
        matrix = numbers.reshape(-1, 3, 3)
        quaternion = Rotation.from_matrix(matrix if kind == ROW_MAJOR else matrix.transpose(0, 2, 1)).as_quat()
    else:
        quaternion = Rotation.from_euler(kind.removeprefix("euler_"), numbers * rad_per_unit).as_quat()
    return _canonical(quaternion / np.linalg.norm(quaternion, axis=1, keepdims=True))


def make_continuous(quaternion: FloatArray) -> FloatArray:
    """Return quaternions (n, 4) with signs such that neighbours are near.

    A quaternion and its negative are one orientation, as are a rotation vector and the one that is a turn shorter:
    what flips its sign near half a turn is continuous so.
    """
    turns = np.sum(quaternion[1:] * quaternion[:-1], axis=1) < 0.0
    signs = np.concatenate([[1.0], np.where(np.cumsum(turns) % 2 == 1, -1.0, 1.0)])
    return np.asarray(quaternion * signs[: len(quaternion), None])


def interpret_pose(columns: Columns, source: PoseSource, frames: Frames, *, is_displacement: bool) -> PoseSignal:
    """Return the pose in metres, its orientation that of the sensor frame in the gravity-aligned base."""
    length = LENGTH_M[source.units.position]
    position = columns.values[:, :3] * length * np.array(source.signs)
    turns = columns.values[:, 3:]
    turned: tuple[str, ...] = ()
    if turns.shape[1] and all(columns.has[3:]):
        quaternion = orientation_quaternion(source.orientation_as, turns, ANGLE_RAD[source.units.angle])
        if not (_is_identity(frames.R_WB) and _is_identity(frames.R_FS)):
            quaternion = _canonical((frames.R_WB * Rotation.from_quat(quaternion) * frames.R_FS).as_quat())
        turned = AXES[3:]
    else:
        quaternion = np.full((len(position), 4), np.nan)
    if not is_displacement:
        position = _turned(columns.topic, frames.R_WB, position, columns.has[:3])
    return PoseSignal(
        topic=columns.topic,
        frame_id=columns.frame_id,
        stamp_ns=columns.stamp_ns,
        position_m=position,
        quaternion_xyzw=quaternion,
        is_displacement=is_displacement,
        measured_axes=(*_measured(columns.has[:3]), *turned),
    )


def interpret_wrench(
    columns: Columns,
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
    values = columns.values * scale * (-1.0 if source.exerted_by is ExertedBy.SENSOR else 1.0)
    stamps, has = columns.stamp_ns, columns.has
    if expressed_in is Frame.FLANGE:
        values = _both_turned(columns, frames.R_FS.inv(), values)
    elif expressed_in is Frame.BASE:
        inside, orientation = _orientation_at(pose, stamps, columns.topic)
        stamps = stamps[inside]
        values = _both_turned(columns, orientation.inv() * frames.R_WB, values[inside])
    return WrenchSignal(
        topic=columns.topic,
        frame_id=columns.frame_id,
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


def interpret_twist(columns: Columns, source: TwistSource, frames: Frames, pose: PoseSignal) -> TwistSignal:
    """Return the flange's twist in m/s and rad/s in the gravity-aligned base."""
    scale = np.repeat([LENGTH_M[source.units.linear], ANGLE_RAD[source.units.angular]], 3) * np.array(source.signs)
    values, stamps = columns.values * scale, columns.stamp_ns
    if source.expressed_in is Frame.BASE:
        values = _both_turned(columns, frames.R_WB, values)
    else:
        inside, orientation = _orientation_at(pose, stamps, columns.topic)
        if source.expressed_in is Frame.FLANGE:
            orientation = orientation * frames.R_FS.inv()
        stamps, values = stamps[inside], _both_turned(columns, orientation, values[inside])
    return TwistSignal(
        topic=columns.topic,
        frame_id=columns.frame_id,
        stamp_ns=stamps,
        linear_m_s=values[:, :3],
        angular_rad_s=values[:, 3:],
        measured_axes=_measured(columns.has),
    )


def interpret_gains(columns: Columns) -> GainsSignal:
    """Return M_a and B_a per axis."""
    return GainsSignal(
        topic=columns.topic, stamp_ns=columns.stamp_ns, mass=columns.values[:, :6], damping=columns.values[:, 6:]
    )


def _canonical(quaternion: FloatArray) -> FloatArray:
    return np.asarray(np.where(quaternion[:, 3:] < 0.0, -quaternion, quaternion))


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


def _both_turned(columns: Columns, rotation: Rotation, values: FloatArray) -> FloatArray:
    parts = (slice(0, 3), slice(3, 6))
    return np.hstack([_turned(columns.topic, rotation, values[:, part], columns.has[part]) for part in parts])


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


def _orientation_at(
    pose: PoseSignal, stamp_ns: StampArray, topic: str
) -> tuple[np.ndarray[tuple[int], np.dtype[np.bool_]], Rotation]:
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
