"""Force and travel along each axis of the wrench, on the wrench's own stamps, of logs without a payload's mass."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.spatial.transform import Rotation

from problems.arrays import BoolArray, FloatArray

from ..result import Finding
from ..signals.aligned import longest_whole
from ..signals.contact_rule import CONTACT
from ..signals.recording import (
    AXES,
    GainsSignal,
    PoseSignal,
    Recording,
    StampArray,
    WrenchSignal,
    sampling_rate_hz,
    turn_vectors_rad,
)

_NEAR_ZERO_SHARE = 0.05
_NOISES = 6.0
_SPEED_S = 0.1
_MOVING_M_S, _CONSTANT_N = 2e-3, 1.0
_DRAG_FACTOR, _DRAG_SCATTER = 1.25, 0.2
TO_DEVIATION = float(1.4826 / np.sqrt(2.0))
_FEWEST, _FEWEST_FOR_NOISE = 4, 100
_BEGINNING_S, _STATED_N = 0.5, 0.5
# Where the flange rests at the same place, a compensated force differs by less; a held contact presses harder.
_SAME_PLACE_M, _DRIFTED_N, _HARDEST_N = 1e-3, 1.0, 5.0


@dataclass(frozen=True, kw_only=True)
class AxisSignals:
    """One axis of S: `force_n` (n,) on the flange, free of its offset, and `travel_m` (n,) of the flange.

    `time_s` (n,) counts from the first sample that wrench and pose share, `period_s` is the usual step. A force is one
    above `level_n`; `noise_n` is the deviation of one sample. `mass_kg`, `damping_n_s_per_m` and `desired_n` (n,) are
    M_a, B_a and F^d, NaN where they are not known; `lead_s` is K_l and `commanded_m` (n,) the command's travel,
    None where they are not. `offset_n` was taken off the force.
    """

    axis: str
    time_s: FloatArray
    period_s: float
    force_n: FloatArray
    travel_m: FloatArray
    level_n: float
    noise_n: float
    mass_kg: FloatArray
    damping_n_s_per_m: FloatArray
    desired_n: FloatArray
    lead_s: float | None = None
    commanded_m: FloatArray | None = None
    offset_n: float = 0.0

    @cached_property
    def rate_hz(self) -> float:
        """How often force and travel were logged."""
        return sampling_rate_hz(np.diff(self.time_s)) or 0.0

    def speed_m_s(self) -> FloatArray:
        """Return how fast the flange is along the axis, over about 0.1 s (n,)."""
        return mean_speed(self.travel_m, self.time_s)


def mean_speed(travel: FloatArray, time: FloatArray) -> FloatArray:
    """Return the mean velocity of travel (n,) or (n, k) over 0.1 s around each of the times (n,)."""
    half = max(1, round(0.5 * _SPEED_S / float(np.median(np.diff(time)))))
    at, last = np.arange(len(time)), len(time) - 1
    before, after = np.maximum(at - half, 0), np.minimum(at + half, last)
    return np.asarray(((travel[after] - travel[before]).T / (time[after] - time[before])).T)


def axis_signals(recording: Recording) -> tuple[AxisSignals, ...]:
    """Return the straight axes that wrench and pose share; none where they do not overlap.

    What the sensor shows without a load is taken off: the force in motion, where it is never zero and constant there.
    Without an orientation the pose is not in the axes of the wrench, and the travel is NaN.
    """
    recording = longest_whole(recording)
    wrench, pose = recording.wrench, recording.pose
    inside = _is_shared(recording)
    stamps = wrench.stamp_ns[inside]
    if len(stamps) < _FEWEST or len(pose.stamp_ns) < _FEWEST:
        return ()
    time, travel = np.asarray((stamps - stamps[0]) * 1e-9), _travel(pose, stamps)
    command = recording.command
    commanded = None if command is None or len(command.stamp_ns) < _FEWEST else _travel(command, stamps)
    found = []
    for i, axis in enumerate(AXES[:3]):
        if axis not in wrench.measured_axes or not np.all(np.isfinite(wrench.force_n[inside, i])):
            continue
        force = np.array(wrench.force_n[inside, i])
        offset = 0.0 if pose.is_displacement else _offset(force, travel[:, i], travel, time)
        force -= offset
        noise = sample_noise(force)
        mass, damping = gains_of(recording.gains, stamps, i)
        found.append(
            AxisSignals(
                axis=axis,
                time_s=time,
                period_s=float(np.median(np.diff(time))),
                force_n=force,
                travel_m=travel[:, i],
                level_n=_level(recording, force, noise, _drag(force, travel[:, i], time)),
                noise_n=noise,
                mass_kg=mass,
                damping_n_s_per_m=damping,
                desired_n=desired_force_of(recording.desired_force, stamps, i),
                lead_s=lead_of(recording.gains, i),
                commanded_m=None if commanded is None else commanded[:, i],
                offset_n=offset,
            )
        )
    return tuple(found)


def turn_rates(recording: Recording) -> FloatArray | None:
    """Return how fast the flange turns [rad/s] about the axes of S, (n, 3), at the times of `axis_signals`.

    None where the log has no orientation, or one too short.
    """
    recording = longest_whole(recording)
    pose, stamps = recording.pose, recording.wrench.stamp_ns[_is_shared(recording)]
    if "rx" not in pose.measured_axes or min(len(stamps), len(pose.stamp_ns)) < _FEWEST:
        return None
    time = (pose.stamp_ns - pose.stamp_ns[0]) * 1e-9
    turned = turn_vectors_rad(np.array(pose.quaternion_xyzw[:-1]), np.array(pose.quaternion_xyzw[1:]))
    between = turned / np.diff(time)[:, None]
    at, middle = (stamps - pose.stamp_ns[0]) * 1e-9, 0.5 * (time[1:] + time[:-1])
    return np.column_stack([np.interp(at, middle, column) for column in between.T])


def _is_shared(recording: Recording) -> BoolArray:
    """Return which samples of the wrench lie where there are poses too."""
    wrench, pose = recording.wrench, recording.pose
    return np.asarray((wrench.stamp_ns >= pose.stamp_ns[0]) & (wrench.stamp_ns <= pose.stamp_ns[-1]))


def sample_noise(force: FloatArray) -> float:
    """Return the deviation of one sample, from the usual step between two; a log of a blow alone shows none."""
    return TO_DEVIATION * float(np.median(np.abs(np.diff(force)))) if len(force) >= _FEWEST_FOR_NOISE else 0.0


def _level(recording: Recording, force: FloatArray, noise: float, drag: float) -> float:
    """Return the least force that counts; a trace that is declared to be a contact begins with less."""
    if recording.pose.is_displacement:
        return max(CONTACT.trace_share * float(np.max(np.abs(force))), _NOISES * noise, 1e-9)
    return max(CONTACT.smallest_n, _NOISES * noise, drag)


def _drag(force: FloatArray, travel: FloatArray, time: FloatArray) -> float:
    """Return what a level must leave to the drag: the force that opposes all motion alike, and a quarter of it."""
    speed = mean_speed(travel, time)
    moving = np.abs(speed) > _MOVING_M_S
    if not np.any(moving):
        return 0.0
    opposing = -np.sign(speed[moving]) * force[moving]
    usual = float(np.median(opposing))
    is_constant = float(np.median(np.abs(opposing - usual))) <= max(_CONSTANT_N, _DRAG_SCATTER * usual)
    return _DRAG_FACTOR * usual if usual > 0.0 and is_constant else 0.0


def _offset(force: FloatArray, along: FloatArray, travel: FloatArray, time: FloatArray) -> float:
    """Return the force in the beginning, where that is the usual one at rest and in motion, else what is shown without.

    That is the one at rest where a twentieth of the samples is near 0, else the one constant in motion, else 0: at rest
    nothing presses that lightly; behind a deadband, of which exact zeros are left, nothing shows there. `travel` (n, 3)
    counts where nothing moves along the axis, `along` (n,).
    """
    near = np.abs(force) <= CONTACT.smallest_n
    is_near = float(np.mean(near)) >= _NEAR_ZERO_SHARE
    if is_near and np.any(force[near] == 0.0):
        return 0.0
    moving = np.abs(mean_speed(along, time)) > _MOVING_M_S
    is_along = bool(np.any(moving))
    if not is_along:
        moving = np.linalg.norm(mean_speed(travel, time), axis=1) > _MOVING_M_S
    usual = _in_the_beginning(force, moving, time)
    if usual is not None:
        return usual
    if is_near:
        at_rest = force[near & ~moving]
        return float(np.median(at_rest)) if len(at_rest) >= _FEWEST_FOR_NOISE else 0.0
    return _constant(force[moving]) if is_along else 0.0


def _in_the_beginning(force: FloatArray, moving: BoolArray, time: FloatArray) -> float | None:
    """Return the force at rest of a log that begins with it, None where it is not the usual one in motion too."""
    first = float(np.median(force[time <= time[0] + _BEGINNING_S]))
    usual = [float(np.median(force[each])) if np.any(each) else np.inf for each in (moving, ~moving)]
    return usual[1] if max(abs(each - first) for each in usual) <= _CONSTANT_N else None


def _constant(force: FloatArray) -> float:
    """Return the median of a force (n,), 0 where it is not constant."""
    middle = float(np.median(force))
    return middle if float(np.median(np.abs(force - middle))) <= _CONSTANT_N else 0.0


def offset_findings(signals: Sequence[AxisSignals], topic: str) -> tuple[Finding, ...]:
    """Say which constant force was taken off a wrench whose weight had been removed, and where it was not constant."""
    taken = [f"{each.offset_n:+.2g} N along {each.axis}" for each in signals if abs(each.offset_n) >= _STATED_N]
    drifted = [text for each in signals if (text := _drift(each, signals))]
    drift = Finding.warning(
        "wrench-drift",
        f"At rest where it began, the wrench of topic {topic} shows another force: {'; '.join(drifted)}. Its zero "
        "drifts, or something touches it: forces and peaks may be off by as much, and a wall be taken for a hand.",
        "Let the sensor warm up, set it to zero before each contact, or read the log in parts with --from and --to.",
    )
    if not taken:
        return (drift,) if drifted else ()
    return (
        *((drift,) if drifted else ()),
        Finding.info(
            "wrench-offset",
            f"Without contact the wrench of topic {topic} shows {', '.join(taken)}: taken off all forces and peaks.",
            "Set the sensor to zero, or correct the load that the robot's estimate takes into account, before the run.",
        ),
    )


def _drift(axis: AxisSignals, signals: Sequence[AxisSignals]) -> str:
    """Return the force at the first and the last rest at one place as text, nothing where they agree."""
    time = axis.time_s
    rest = np.all([np.abs(mean_speed(each.travel_m, time)) <= _MOVING_M_S for each in signals], axis=0)
    first = rest & (time <= time[0] + _BEGINNING_S)
    if not np.any(first):
        return ""
    places = [np.abs(each.travel_m - np.median(each.travel_m[first])) <= _SAME_PLACE_M for each in signals]
    there = rest & np.all(places, axis=0)
    last = there & (time >= time[there][-1] - _BEGINNING_S)
    before, after = (float(np.median(axis.force_n[each])) + axis.offset_n for each in (first, last))
    if abs(after - before) < _DRIFTED_N or max(abs(before), abs(after)) > _HARDEST_N:
        return ""
    return f"{before:+.2g} N along {axis.axis} at first, {after:+.2g} N at {time[last][-1]:.1f} s"


def _travel(pose: PoseSignal, stamps: StampArray) -> FloatArray:
    """Return how far the flange has gone along the axes of S, (n, 3)."""
    at, time = (stamps - pose.stamp_ns[0]) * 1e-9, (pose.stamp_ns - pose.stamp_ns[0]) * 1e-9
    position = np.array(pose.position_m)
    if not pose.is_displacement:
        if not np.all(np.isfinite(pose.quaternion_xyzw)):
            return np.full((len(stamps), 3), np.nan)
        turned, steps = Rotation.from_quat(np.array(pose.quaternion_xyzw[:-1])).inv(), np.diff(position, axis=0)
        unknown = np.all(np.isnan(position), axis=0)
        # Of a tool that does not turn, an axis that was not logged leaves the others as they are.
        if np.any(unknown) and np.all(pose.quaternion_xyzw == pose.quaternion_xyzw[0]):
            steps[:, unknown] = 0.0
        position = np.vstack([np.zeros((1, 3)), np.cumsum(turned.apply(steps), axis=0)])
        position[:, unknown] = np.nan
    return np.column_stack([np.interp(at, time, column) for column in position.T])


def gains_of(gains: GainsSignal | None, stamps: StampArray, axis: int) -> tuple[FloatArray, FloatArray]:
    """Return M_a and B_a of the axis with that number as they hold at stamps (n,), NaN where they are not known."""
    if gains is None:
        return _one_value(np.nan, stamps), _one_value(np.nan, stamps)
    return _held(gains.stamp_ns, gains.mass[:, axis], stamps), _held(gains.stamp_ns, gains.damping[:, axis], stamps)


def lead_of(gains: GainsSignal | None, axis: int) -> float | None:
    """Return K_l [s] of the axis with that number, None where it is not known."""
    return None if gains is None or gains.lead_s is None else gains.lead_s[axis]


def desired_force_of(desired: WrenchSignal | None, stamps: StampArray, axis: int) -> FloatArray:
    """Return F^d of the axis with that number as it holds at stamps (n,), NaN where it is not known."""
    if desired is None:
        return _one_value(np.nan, stamps)
    return _held(desired.stamp_ns, desired.force_n[:, axis] if axis < 3 else desired.torque_n_m[:, axis - 3], stamps)


def _held(stamp_ns: StampArray, values: FloatArray, at_ns: StampArray) -> FloatArray:
    """Return values (k,), each from its stamp on, at stamps (n,); one that never changes takes no memory."""
    if len(values) == 1:
        return _one_value(float(values[0]), at_ns)
    return np.asarray(values[np.maximum(np.searchsorted(stamp_ns, at_ns, side="right") - 1, 0)])


def _one_value(value: float, at_ns: StampArray) -> FloatArray:
    return np.broadcast_to(value, at_ns.shape)
