"""Motion that an admittance with known gains asks for, beside the motion of the robot, axis by axis."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import binary_opening
from scipy.spatial.transform import Rotation, Slerp

from problems.arrays import BoolArray, FloatArray, IntArray
from problems.compiled import compiled

from ..errors import EstimateError
from ..signals.aligned import AlignedLog, check_regular, longest_whole, spans_of
from ..signals.recording import (
    AXES,
    AppliedDeadband,
    GainsSignal,
    PoseSignal,
    Recording,
    StampArray,
    WrenchSignal,
    unmeasured,
)

_SHORTEST_S, _SHORTEST_TRACE_S = 3.0, 1.0
_STEP_S = 0.01
_CLOCK_S = 0.004
_ROUNDING = 1e-3
# A robot at rest while the admittance asks for this speed is not driven by it.
_AT_REST = np.array([1e-3] * 3 + [5e-4] * 3)
_ASKED = np.array([4e-3] * 3 + [2e-3] * 3)
_SHORTEST_HALT_S = 0.4
_BEFORE_HALT_S, _AFTER_HALT_S = 0.3, 1.0
_SETTLING_S = 0.5


@dataclass(frozen=True, kw_only=True)
class AdmittanceMotion:
    """One axis of S (rotations: rad for m).

    `asked_m_s` (n,) is the velocity a + K_l da/dt of the admittance, M_a da/dt + B_a a = F + F^d, F behind the
    controller's deadband, every `period_s` from time 0; `lead_s` is K_l, None where it is not known and taken as 0.
    `moved_m_s` (m,) is the mean velocity of the logged point between the stamps `edge_s` (m + 1,); `turning_rad_s`
    (m, 2 or 0) what the tool's turning adds to it for a lever of 1 m (along the axis after next, then the next one);
    `used` (m,) is false where the robot was not driven by the admittance, and right behind that. `approach_m_s` is the
    steady velocity before a trace of one contact, None of any other log.
    """

    axis: str
    period_s: float
    asked_m_s: FloatArray
    edge_s: FloatArray
    moved_m_s: FloatArray
    turning_rad_s: FloatArray
    used: BoolArray
    halted_s: float
    lead_s: float | None = None
    approach_m_s: float | None = None

    @property
    def is_trace(self) -> bool:
        """Whether this is one contact after a steady approach, at F^d/B_a."""
        return self.approach_m_s is not None


def admittance_motions(recording: Recording) -> tuple[AdmittanceMotion, ...]:
    """Drive the admittance of the logged gains with the logged wrench, for every axis that was measured.

    The wrench is that which the controller acted on: what a deadband took off is not put back. Gains and F^d hold from
    one message to the next. A trace of a contact, a displacement, begins while F^d drives the robot steadily. Raises
    EstimateError without gains, orientation, or 3 s in common (1 s of a trace with F^d).
    """
    gains = recording.gains
    if gains is None:
        raise EstimateError(
            "Without a logged command the admittance gains M_a and B_a must be known to identify the robot's response; "
            "declare `gains` in cell.yaml (a topic with its fields, or `mass` and `damping` as numbers)."
        )
    recording, start, time = _common_clock(recording)
    wrench, pose = recording.wrench, recording.pose
    is_trace = pose.is_displacement and recording.desired_force is not None
    time, asked = _coarser(time, _asked(recording, gains, start, time))
    edge, moved = _moved(pose, start, time)
    halted = _halted(edge, moved, _mean_between(edge, time, asked))
    axes = [i for i, axis in enumerate(AXES) if axis in wrench.measured_axes and axis in pose.measured_axes]
    turned = "rx" in pose.measured_axes
    return tuple(
        AdmittanceMotion(
            axis=AXES[i],
            period_s=float(time[1] - time[0]),
            asked_m_s=np.ascontiguousarray(asked[:, i]),
            edge_s=edge - time[0],
            moved_m_s=moved[:, i],
            turning_rad_s=_turning(moved, i) if turned and i < 3 else np.zeros((len(moved), 0)),
            used=~_near_halts(edge, halted) & (is_trace | (edge[:-1] > edge[0] + _SETTLING_S)),
            halted_s=float(np.sum(np.diff(edge)[halted])),
            lead_s=None if gains.lead_s is None else gains.lead_s[i],
            approach_m_s=_approach(recording.desired_force, gains, i) if is_trace else None,
        )
        for i in axes
    )


def _common_clock(recording: Recording) -> tuple[Recording, int, FloatArray]:
    """Return the longest whole part, when wrench and pose both have begun [ns], and the wrench's clock from there."""
    recording = longest_whole(recording)
    wrench, pose = recording.wrench, recording.pose
    start, stop = max(wrench.stamp_ns[0], pose.stamp_ns[0]), min(wrench.stamp_ns[-1], pose.stamp_ns[-1])
    common_s = float(stop - start) * 1e-9
    is_trace = pose.is_displacement and recording.desired_force is not None
    shortest_s = _SHORTEST_TRACE_S if is_trace else _SHORTEST_S
    if common_s < shortest_s:
        raise EstimateError(
            f"Wrench and pose must cover the same time for {shortest_s:g} s to identify the robot's response, found "
            f"{max(common_s, 0.0):.2f} s; record longer."
        )
    period = check_regular(wrench.topic, wrench.stamp_ns)
    return recording, int(start), np.asarray(np.arange(int(common_s / period + 1e-6) + 1) * period)


def rebuild_command(recording: Recording, beside: Mapping[str, tuple[FloatArray, FloatArray]]) -> PoseSignal:
    """Return the position command that the admittance of the logged gains makes of the wrench, on the wrench's clock.

    x^d is the integral of a + K_l da/dt along the axes of S, from the first pose on; its orientation is the pose's.
    `beside` holds, by axis, times from the first common sample [s] and how far the flange is from what this command
    alone makes of the robot [m]: the command is moved by that. A weight that the log and the controller take off
    differently drives the tool away from the integral. Raises EstimateError as `admittance_motions` does.
    """
    gains = recording.gains
    if gains is None:
        raise EstimateError("Without admittance gains no command can be rebuilt; declare `gains` in cell.yaml.")
    recording, start, time = _common_clock(recording)
    pose = recording.pose
    asked = np.nan_to_num(_asked(recording, gains, start, time)[:, :3])
    for i, axis in enumerate(AXES[:3]):
        if axis in beside:
            asked[:, i] += np.gradient(np.interp(time, *beside[axis]), time)
    held = (pose.stamp_ns - start) * 1e-9
    orientation_BS = Slerp(held, Rotation.from_quat(np.array(pose.quaternion_xyzw)))(np.clip(time, held[0], held[-1]))
    velocity_B = np.asarray(orientation_BS.apply(asked))
    steps = 0.5 * (velocity_B[1:] + velocity_B[:-1]) * time[1]
    origin = np.array([np.interp(0.0, held, column) for column in pose.position_m.T])
    return PoseSignal(
        topic=recording.wrench.topic,
        frame_id=pose.frame_id,
        stamp_ns=start + np.round(time * 1e9).astype(np.int64),
        position_m=origin + np.vstack([np.zeros((1, 3)), np.cumsum(steps, axis=0)]),
        quaternion_xyzw=np.asarray(orientation_BS.as_quat()),
    )


def _approach(desired: WrenchSignal | None, gains: GainsSignal, axis: int) -> float:
    """Return the steady speed F^d/B_a at the beginning of a log, 0 without a desired force."""
    if desired is None:
        return 0.0
    return float(np.concatenate([desired.force_n[0], desired.torque_n_m[0]])[axis] / gains.damping[0, axis])


def _asked(recording: Recording, gains: GainsSignal, start_ns: int, time: FloatArray) -> FloatArray:
    """Return the admittance's velocity on all axes (n, 6), NaN where no force was measured."""
    wrench, desired = recording.wrench, recording.desired_force
    at = (wrench.stamp_ns - start_ns) * 1e-9
    felt = _behind_deadband(np.column_stack(_six(wrench.force_n, wrench.torque_n_m)), gains.deadband)
    drive = np.column_stack([np.interp(time, at, column) for column in felt.T])
    if desired is not None:
        rows = _held_rows(desired.stamp_ns, start_ns, time)
        said = np.nan_to_num(np.column_stack(_six(desired.force_n, desired.torque_n_m)))
        is_one = np.array_equal(desired.stamp_ns, wrench.stamp_ns)
        drive += np.column_stack([np.interp(time, at, column) for column in said.T]) if is_one else said[rows]
    rows = _held_rows(gains.stamp_ns, start_ns, time) if len(gains.stamp_ns) > 1 else np.zeros(len(time), np.int64)
    out = np.full((len(time), 6), np.nan)
    for i in range(6):
        mass, damping = gains.mass[rows, i], gains.damping[rows, i]
        if bool(np.all(np.isfinite(mass) & np.isfinite(damping) & (mass >= 0.0) & (damping > 0.0))):
            asked = _admittance(np.ascontiguousarray(drive[:, i]), mass, damping, float(time[1]))
            lead = 0.0 if gains.lead_s is None else gains.lead_s[i]
            out[:, i] = asked + lead * (drive[:, i] - damping * asked) / mass if lead > 0.0 else asked
    return out


def _behind_deadband(wrench: FloatArray, deadband: AppliedDeadband | None) -> FloatArray:
    """Return the wrench (n, 6) that the controller acts on; a width that is not known counts as none."""
    if deadband is None:
        return wrench
    width = np.repeat([deadband.force_n or 0.0, deadband.torque_n_m or 0.0], 3)
    beyond = np.maximum(np.abs(wrench) - width, 0.0)
    kept = beyond if deadband.type == "subtractive" else np.where(beyond > 0.0, np.abs(wrench), 0.0)
    return np.asarray(np.sign(wrench) * kept)


def _six(linear: FloatArray, angular: FloatArray) -> list[FloatArray]:
    return [*linear.T, *angular.T]


def _held_rows(stamp_ns: StampArray, start_ns: int, time: FloatArray) -> IntArray:
    """Return the message that holds at each time; the first one also before it."""
    at = (stamp_ns - start_ns) * 1e-9
    # A stamp that rounding puts just behind a time is of that time.
    return np.asarray(np.maximum(np.searchsorted(at, time + _ROUNDING * time[1], side="right") - 1, 0))


@compiled
def _admittance(force: FloatArray, mass: FloatArray, damping: FloatArray, period_s: float) -> FloatArray:
    """Return a(t) of M da/dt + B a = F at the samples, exact for a force that is linear between them; a(0) = F/B."""
    out = np.empty(len(force))
    out[0] = force[0] / damping[0]
    for k in range(len(force) - 1):
        ratio = mass[k] / (damping[k] * period_s)
        decay = np.exp(-1.0 / ratio) if ratio > 0.0 else 0.0
        rise = force[k + 1] - force[k]
        out[k + 1] = decay * out[k] + (force[k + 1] - decay * force[k] - rise * ratio * (1.0 - decay)) / damping[k]
    return out


def _coarser(time: FloatArray, values: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return means over an odd number of samples, 4 ms at most, at the middle of each: a robot sees no finer."""
    count = max(1, int(_CLOCK_S / time[1] + 1e-6))
    count -= 1 - count % 2
    blocks = len(time) // count
    return (
        time[count // 2 : blocks * count : count],
        values[: blocks * count].reshape(blocks, count, -1).mean(axis=1),
    )


def _moved(pose: PoseSignal, start_ns: int, clock: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return edges (m + 1,) about 10 ms apart, or as the pose was logged, and mean velocities between them (m, 6)."""
    time = (pose.stamp_ns - start_ns) * 1e-9
    inside = np.flatnonzero((time >= clock[0]) & (time <= clock[-1]))
    step = max(1, round(_STEP_S / float(np.median(np.diff(time)))))
    kept = inside[::step]
    edge, position = np.asarray(time[kept]), np.array(pose.position_m[kept])
    duration = np.diff(edge)[:, None]
    linear = np.diff(position, axis=0) / duration
    if pose.is_displacement:
        return edge, np.hstack([linear, np.full(linear.shape, np.nan)])
    if not np.all(np.isfinite(pose.quaternion_xyzw)):
        raise EstimateError(
            f"The pose of topic {pose.topic} has no orientation, so its motion cannot be expressed in the axes of "
            "the wrench; record the whole pose."
        )
    orientation_BS = Rotation.from_quat(np.array(pose.quaternion_xyzw[kept]))
    turn = np.asarray((orientation_BS[:-1].inv() * orientation_BS[1:]).as_rotvec())
    middle_BS = orientation_BS[:-1] * Rotation.from_rotvec(0.5 * turn)
    return edge, np.hstack([np.asarray(middle_BS.inv().apply(linear)), turn / duration])


def _turning(moved: FloatArray, axis: int) -> FloatArray:
    """Return −(ω × p) along an axis per metre of the two components of p across it, (m, 2)."""
    following, next_but_one = (axis + 1) % 3, (axis + 2) % 3
    return np.column_stack([-moved[:, 3 + following], moved[:, 3 + next_but_one]])


def _mean_between(edge: FloatArray, time: FloatArray, values: FloatArray) -> FloatArray:
    """Return the means of (n, k) between the edges by the trapezoidal rule, (m, k)."""
    summed = np.concatenate([np.zeros((1, values.shape[1])), np.cumsum(0.5 * (values[1:] + values[:-1]), axis=0)])
    at_edges = np.column_stack([np.interp(edge, time, column) for column in summed.T]) * (time[1] - time[0])
    return np.asarray(np.diff(at_edges, axis=0) / np.diff(edge)[:, None])


def _halted(edge: FloatArray, moved: FloatArray, asked: FloatArray) -> BoolArray:
    """Return the steps (m,) in which nothing moves for 0.4 s or longer although the admittance asks for it."""
    at_rest = np.all(np.nan_to_num(np.abs(moved)) < _AT_REST, axis=1)
    pushed = np.any(np.nan_to_num(np.abs(asked)) > _ASKED, axis=1)
    shortest = max(1, round(_SHORTEST_HALT_S / float(np.median(np.diff(edge)))))
    return np.asarray(binary_opening(at_rest & pushed, structure=np.ones(shortest)))


def _near_halts(edge: FloatArray, halted: BoolArray) -> BoolArray:
    """Return the steps (m,) that a halt touches: those while the robot slows down before it, and those after it."""
    touched = np.zeros(len(halted), dtype=np.bool_)
    for span in spans_of(halted):
        before, after = edge[span.start] - _BEFORE_HALT_S, edge[span.stop] + _AFTER_HALT_S
        touched |= (edge[1:] > before) & (edge[:-1] < after)
    return touched


def with_compensated_force(recording: Recording, log: AlignedLog, force_S_n: FloatArray) -> Recording:
    """Return a recording whose wrench is the force that a controller sees behind gravity compensation (n, 3).

    Torques are left out (their compensation is not identified by the force alone), as are the samples in holes.
    """
    valid = np.isfinite(force_S_n).all(axis=1)
    stamps = log.start_ns + np.round(log.time_s * 1e9).astype(np.int64)
    wrench = replace(
        recording.wrench,
        stamp_ns=stamps[valid],
        force_n=force_S_n[valid],
        torque_n_m=unmeasured(int(np.count_nonzero(valid))),
        gravity_compensated=True,
        measured_axes=("x", "y", "z"),
    )
    return replace(recording, wrench=wrench)
