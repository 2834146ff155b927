"""Motion about one axis of the sensor frame, and the same as motion along a straight axis."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from problems.arrays import FloatArray
from problems.model.axis_kind import LEVER_M

from ..errors import EstimateError
from ..payload.gravity import GravityFit
from ..payload.static_poses import GRAVITY_B_M_S2
from ..signals.aligned import AlignedLog, aligned_position
from ..signals.recording import PoseSignal, Recording
from ..signals.segments import MotionSpans, Span, low_pass
from .straight import AxisMotion

AXIS_NAMES = ("rx", "ry", "rz")

_TURNING_RAD_S = 0.015
_ABOUT_ONE_AXIS = 0.97
_SMALLEST_TURN_RAD = 0.01
_LARGEST_TURN_RAD = 0.35
_LARGEST_ASIDE_RAD = 0.03
_LARGEST_OFFSET_M = 2e-3
_FEWEST_CROSSINGS = 3.0
_RATE_BAND_HZ = 25.0
_SHORTEST_S = 0.1
_GLANCE_S = 0.02
_PART = 2**16


@dataclass(frozen=True, kw_only=True)
class AxisTurn:
    """Turning about one axis of S through a point of S that stays where it is.

    `motion` holds the angle from `reference_BS` [rad] as `position_m` and the torque about the axis without bias and
    weight [N·m] as `force_n`, on the log's clock. `weight_n_m_per_rad` is by how much the payload's weight turns back
    what is turned; the part of it that the coupling's own turning makes is left out of every model. `is_swept` says
    that the tool went to and fro without a rest in between, and not only from rest to rest.
    """

    motion: AxisMotion
    reference_BS: Rotation
    weight_n_m_per_rad: float
    is_swept: bool

    @property
    def name(self) -> str:
        """Return `rx`, `ry` or `rz`."""
        return self.motion.name

    @property
    def index(self) -> int:
        """Return 0, 1 or 2: which axis of S."""
        return AXIS_NAMES.index(self.name)

    def angle_rad(self, pose: PoseSignal) -> FloatArray:
        """Return the angle (n,) of a pose or command about the axis; raises EstimateError where it has none."""
        if not bool(np.all(np.isfinite(pose.quaternion_xyzw))):
            raise EstimateError(
                f"Axis {self.name} needs orientations, and topic {pose.topic} has none; record the whole pose."
            )
        first, angle = self.reference_BS.inv(), np.empty(len(pose.quaternion_xyzw))
        for part in (slice(start, start + _PART) for start in range(0, len(angle), _PART)):
            angle[part] = (first * Rotation.from_quat(pose.quaternion_xyzw[part])).as_rotvec()[:, self.index]
        return angle

    def unrolled(self, pose: PoseSignal) -> PoseSignal:
        """Return the pose whose position goes `LEVER_M` times the angle along the axis."""
        path = LEVER_M * self.angle_rad(pose)
        return replace(pose, position_m=path[:, None] * self.motion.direction_B)


@dataclass(frozen=True, kw_only=True)
class Unrolled:
    """A turn as motion along a straight axis, `LEVER_M` off the centre: path = lever · angle, force = torque/lever.

    K, B and M of the path are those of the angle over lever²; every threshold in N and m holds for it.
    """

    recording: Recording
    log: AlignedLog
    axis: AxisMotion


def find_turns(recording: Recording, log: AlignedLog, motion: MotionSpans, gravity: GravityFit) -> tuple[AxisTurn, ...]:
    """Return the axes of S about which the tool went to and fro, the origin of S at rest.

    Turns of more than 0.35 rad are changes of pose: they are left to the inertia tensor, and so is an axis that was
    crossed less than three times. `log` and `motion` are those of the recording; without torques nothing is known of
    a turn.
    """
    if not log.has_torque:
        return ()
    by_axis: dict[int, list[Span]] = {}
    for span in motion.moving:
        index = _turned_axis(log, span)
        if index is not None:
            by_axis.setdefault(index, []).append(span)
    turns = (_turn(recording, log, gravity, index, spans) for index, spans in sorted(by_axis.items()))
    return tuple(turn for turn in turns if turn is not None)


def unroll(turn: AxisTurn, recording: Recording, log: AlignedLog) -> Unrolled:
    """Return the turn as motion along a straight axis, for estimators that know only those."""
    axis = replace(turn.motion, position_m=LEVER_M * turn.motion.position_m, force_n=turn.motion.force_n / LEVER_M)
    command = recording.command
    straight = replace(
        recording,
        pose=turn.unrolled(recording.pose),
        command=None if command is None else turn.unrolled(command),
    )
    return Unrolled(
        recording=straight,
        log=replace(log, position_B_m=axis.position_m[:, None] * axis.direction_B),
        axis=axis,
    )


def rests_after(spans: Sequence[Span], rests: Sequence[Span]) -> tuple[Span, ...]:
    """Return the rests that begin where one of the spans ends: what is touched there was touched on its way."""
    ends = {span.stop for span in spans}
    return tuple(rest for rest in rests if rest.start in ends)


def _turned_axis(log: AlignedLog, span: Span) -> int | None:
    """Return the axis of S about which the tool turns in a span, None where it does not, or moves along too."""
    if len(span) * log.period_s < _SHORTEST_S:
        return None
    glance = slice(span.start, span.stop, max(1, round(_GLANCE_S / log.period_s)))
    first = log.orientation_BS[span.start]
    if not _SMALLEST_TURN_RAD / 2.0 < float(np.max((first.inv() * log.orientation_BS[glance]).magnitude())) < 1.0:
        return None
    orientation = log.orientation_BS[span.slice]
    away = np.asarray((orientation.mean().inv() * orientation).as_rotvec())
    if float(np.max(np.linalg.norm(away, axis=1))) > _LARGEST_TURN_RAD:
        return None
    rate = np.gradient(low_pass(away, log.period_s, _RATE_BAND_HZ), log.period_s, axis=0)
    speed = np.linalg.norm(rate, axis=1)
    turning = speed > _TURNING_RAD_S
    if not np.any(turning):
        return None
    index = int(np.argmax(np.sum(np.abs(rate), axis=0)))
    along = np.abs(rate[turning, index]) > _ABOUT_ONE_AXIS * speed[turning]
    centre = low_pass(log.position_B_m[span.slice], log.period_s, _RATE_BAND_HZ)
    moved = float(np.sqrt(np.sum(np.var(centre, axis=0))))
    return index if np.mean(along) > 0.5 and moved < _LARGEST_OFFSET_M * float(np.std(away[:, index])) else None


def _turn(
    recording: Recording,
    log: AlignedLog,
    gravity: GravityFit,
    index: int,
    spans: list[Span],
) -> AxisTurn | None:
    """Return the turn about one axis from where the longest span is, with the spans that are near it; None if few."""
    reference = log.orientation_BS[max(spans, key=len).slice].mean()
    near, crossed, widest, is_swept = [], 0.0, 0.0, False
    for span in spans:
        away = np.asarray((reference.inv() * log.orientation_BS[span.slice]).as_rotvec())
        aside = np.linalg.norm(np.delete(away, index, axis=1), axis=1)
        if float(np.max(aside)) < _LARGEST_ASIDE_RAD and float(np.max(np.abs(away))) < _LARGEST_TURN_RAD:
            near.append(span)
            steps = np.abs(np.diff(low_pass(away[:, index], log.period_s, _RATE_BAND_HZ)))
            way, width = float(np.sum(steps[steps > _TURNING_RAD_S * log.period_s])), float(np.ptp(away[:, index]))
            crossed, widest = crossed + way, max(widest, width)
            is_swept |= way >= _FEWEST_CROSSINGS * width
    if widest < _SMALLEST_TURN_RAD or crossed < _FEWEST_CROSSINGS * widest:
        return None
    moment = gravity.compensated_torque_S_n_m(log)
    turned = AxisTurn(
        motion=AxisMotion(
            name=AXIS_NAMES[index],
            direction_B=np.asarray(reference.apply(np.eye(3)[index])),
            position_m=np.empty(0),
            force_n=np.array(moment[:, index]),
            spans=tuple(near),
        ),
        reference_BS=reference,
        weight_n_m_per_rad=_weight_stiffness(gravity, reference, index),
        is_swept=is_swept,
    )
    # Position is interpolated by cubic splines, orientation by straight turns, which would flatten a fast sweep.
    along = aligned_position(replace(recording, pose=turned.unrolled(recording.pose))) @ turned.motion.direction_B
    return replace(turned, motion=replace(turned.motion, position_m=np.asarray(along / LEVER_M)))


def _weight_stiffness(gravity: GravityFit, reference: Rotation, index: int) -> float:
    """Return −m g·c across the axis with its sign: positive where the payload hangs below the axis."""
    down, arm = reference.inv().apply(GRAVITY_B_M_S2), gravity.com_S_m
    return gravity.mass_kg * float(np.delete(down, index) @ np.delete(arm, index))
