"""Motion along one straight axis of the sensor frame: free spans, spans led by a hand, ringing, and contacts."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy
from scipy.interpolate import make_interp_spline
from scipy.spatial.transform import Rotation

from problems.arrays import FloatArray

from ..errors import EstimateError
from ..payload.gravity import orientation_spread_rad
from ..robot.coupling import FreeMotion
from ..signals.aligned import AlignedLog, check_regular
from ..signals.recording import PoseSignal, Recording, StampArray, find_gaps
from ..signals.segments import MotionSpans, Span

AXIS_NAMES = ("x", "y", "z")
_TRAVELLING_M_S = 3e-3
_ALONG_ONE_AXIS = 0.97
_SMALLEST_TRAVEL_M = 2e-3
_CONSTANT_ORIENTATION_RAD = np.radians(2.0)
_EDGE_S = 0.12
_COVERED_SHARE = 0.9
_REST_NS = 0.3e9
_LET_GO_S = 0.025
_SHORTEST_S, _LONGEST_S = 0.25, 1.5
_BETWEEN_TAPS_S = 0.3
_TAP_SHARE = 0.3
_NOISES = 8.0
_BEHIND_S = 0.2
_MOST = 12
_LARGEST_TRAVEL_M = 2e-3
_SAME_STEP = 0.02


@dataclass(frozen=True, kw_only=True)
class AxisMotion:
    """MotionSpans along one axis of S with constant orientation.

    `position_m`, `force_n` (n,) on the log's clock, force without bias and weight; `spans` of motion along this axis.
    """

    name: str
    direction_B: FloatArray
    position_m: FloatArray
    force_n: FloatArray
    spans: tuple[Span, ...]


@dataclass(frozen=True, kw_only=True)
class Travel:
    """The axes that moved, and the share of the travel that went along none of them."""

    axes: tuple[AxisMotion, ...]
    oblique_share: float


def find_axes(log: AlignedLog, motion: MotionSpans, force_S_n: FloatArray) -> Travel:
    """Assign every span of translation to the axis of S along which it went."""
    by_axis: dict[int, list[Span]] = {}
    oblique = total = 0.0
    for span in motion.moving:
        velocity = motion.velocity_S_m_s[span.slice]
        speed = np.linalg.norm(velocity, axis=1)
        travelling = speed > _TRAVELLING_M_S
        if not np.any(travelling) or not keeps_orientation(log, span):
            continue
        axis = int(np.argmax(np.sum(np.abs(velocity), axis=0)))
        along = np.abs(velocity[travelling, axis]) > _ALONG_ONE_AXIS * speed[travelling]
        total += float(np.sum(speed[travelling]))
        oblique += float(np.sum(speed[travelling][~along]))
        if np.mean(along) > 0.5:
            by_axis.setdefault(axis, []).append(span)
    axes = [_axis_motion(log, axis, spans, force_S_n) for axis, spans in sorted(by_axis.items())]
    kept = tuple(a for a in axes if float(np.nanmax(a.position_m) - np.nanmin(a.position_m)) > _SMALLEST_TRAVEL_M)
    return Travel(axes=kept, oblique_share=oblique / total if total > 0.0 else 0.0)


def keeps_orientation(log: AlignedLog, span: Span) -> bool:
    """Return whether the tool keeps its orientation to two degrees."""
    return bool(orientation_spread_rad(log.orientation_BS[span.slice]) <= _CONSTANT_ORIENTATION_RAD)


def _axis_motion(log: AlignedLog, axis: int, spans: list[Span], force_S_n: FloatArray) -> AxisMotion:
    orientation = Rotation.concatenate([log.orientation_BS[span.slice].mean() for span in spans]).mean()
    direction_B = np.asarray(orientation.apply(np.eye(3)[axis]))
    return AxisMotion(
        name=AXIS_NAMES[axis],
        direction_B=direction_B,
        position_m=np.asarray((log.position_B_m - log.position_B_m[0]) @ direction_B),
        force_n=np.array(force_S_n[:, axis]),
        spans=tuple(spans),
    )


def unguided_spans(axis: AxisMotion) -> tuple[Span, ...]:
    """Leave out the spans in which a hand did work: a payload that nobody drives cannot push the flange along.

    ∫ F dx over a span from rest to rest is at most zero for a passive payload, touching a wall or not.
    """
    return tuple(
        s for s in axis.spans if float(np.sum(axis.force_n[s.slice][:-1] * np.diff(axis.position_m[s.slice]))) < 0
    )


def free_motions(axis: AxisMotion, spans: Sequence[Span], period_s: float) -> tuple[FreeMotion, ...]:
    """PathSegment the spans out, with a little of the rest on both sides."""
    edge = round(_EDGE_S / period_s)
    cuts = [slice(max(0, s.start - edge), min(len(axis.position_m), s.stop + edge)) for s in spans]
    return tuple(FreeMotion(position_m=axis.position_m[cut], force_n=axis.force_n[cut]) for cut in cuts)


@dataclass(frozen=True, kw_only=True)
class CommandedMotion:
    """Command and measured position along one axis on the command's clock, (n,) each, from rest.

    Without `is_uniform` the command's stamps keep no step, and it is interpolated between them as if it were smooth.
    """

    command_m: FloatArray
    position_m: FloatArray
    period_s: float
    is_uniform: bool = True


def commanded_motion(recording: Recording, command: PoseSignal, log: AlignedLog, axis: AxisMotion) -> CommandedMotion:
    """Interpolate the measured position at the command's stamps, over the part of the log in which the axis moves.

    Raises EstimateError when the command does not cover that part.
    """
    period = check_regular(command.topic, command.stamp_ns, keeps_holes=recording.keeps_holes)
    pose = recording.pose
    first, last = _moving_ns(log, axis, command.stamp_ns, pose.stamp_ns)
    inside = (command.stamp_ns >= first) & (command.stamp_ns <= last)
    covered, moving = float(np.count_nonzero(inside)) * period, float(last - first) * 1e-9
    if covered < _COVERED_SHARE * moving:
        raise EstimateError(
            f"Topic `{command.topic}` must cover the {moving:.1f} s in which the tool moves, found {covered:.1f} s; "
            "record the command with the pose, and check that both count on one clock."
        )
    stamps = command.stamp_ns[inside]
    origin = log.position_B_m[0]
    command_m = (command.position_m[inside] - origin) @ axis.direction_B
    held = slice(*np.searchsorted(pose.stamp_ns, (first, last + 1.0)).tolist()) if log.holes else slice(None)
    pose_time = (pose.stamp_ns[held] - stamps[0]) * 1e-9
    measured = (pose.position_m[held] - origin) @ axis.direction_B
    time = np.asarray((stamps - stamps[0]) * 1e-9)
    clock = np.arange(int(time[-1] / period + 0.5) + 1) * period
    is_uniform = len(clock) == len(time) and bool(np.max(np.abs(clock - time)) < _SAME_STEP * period)
    if not is_uniform:
        time, command_m = clock, make_interp_spline(time, command_m, k=3)(np.minimum(clock, time[-1]))
    return CommandedMotion(
        command_m=np.asarray(command_m),
        position_m=np.asarray(make_interp_spline(pose_time, measured, k=3)(np.minimum(time, pose_time[-1]))),
        period_s=period,
        is_uniform=is_uniform,
    )


def _moving_ns(log: AlignedLog, axis: AxisMotion, command_ns: StampArray, pose_ns: StampArray) -> tuple[float, float]:
    """Return from when to when the axis moves, with 0.3 s of rest on both sides; of a log with holes the longest part.

    A part begins at rest; after a hole, and in a log that begins in motion, that is the first span that begins 0.3 s or
    more behind it, where there is one.
    """
    spans = [
        (log.start_ns + log.time_s[s.start] * 1e9, log.start_ns + log.time_s[s.stop - 1] * 1e9) for s in axis.spans
    ]
    gaps = [(float(ns[i]), float(ns[i + 1])) for ns in (command_ns, pose_ns) for i in find_gaps(ns).tolist()]
    parts = []
    is_moved = len(axis.spans) > 1 and axis.spans[0].start == 0
    for begin in (float(log.start_ns) if is_moved else -np.inf, *(stop for _, stop in gaps)):
        end = min([start for start, _ in gaps if start > begin], default=np.inf)
        # Clipped where they run over a hole of the command that the pose does not have.
        inside = [(a, min(b, end)) for a, b in spans if begin + _REST_NS <= a < end]
        if inside:
            parts.append((sum(b - a for a, b in inside), inside[0][0] - _REST_NS, min(inside[-1][1] + _REST_NS, end)))
    if not parts:
        raise EstimateError(f"Axis {axis.name} moves from rest nowhere outside the holes of the log; record again.")
    _, first, last = max(parts)
    return max(first, float(pose_ns[0])), min(last, float(pose_ns[-1]))


def find_ringing(
    axis: AxisMotion,
    moving: Sequence[Span],
    free: Sequence[Span],
    holds: Sequence[Span],
    noise_rms_n: float,
    period_s: float,
) -> tuple[Span, ...]:
    """Return spans in which nothing may touch the payload any more, at most the 12 with most force.

    `moving` are all spans that are not at rest (a tap is one, the flange need not travel), `free` those known to be
    without a hand, `holds` the rests under force. After a tap, from 25 ms behind the highest force; after a hold, from
    where the force changes its sign: pressed, the payload pushes the flange back, drawn away it is dragged along. Where
    the flange travels 2 mm or more without a hold before, somebody leads it.
    Whether a hand was still there is for the fit to decide.
    """
    known = {(s.start, s.stop) for s in free}
    held = {hold.stop: hold for hold in holds}
    found: list[Span] = []
    for span in moving:
        if (span.start, span.stop) in known:
            continue
        hold = held.get(span.start)
        if hold is not None:
            found += _release(axis, span, hold, period_s)
        elif float(np.ptp(axis.position_m[span.slice])) < _LARGEST_TRAVEL_M:
            found += _taps(axis, span, noise_rms_n, period_s)
    found.sort(key=lambda s: -float(np.sum(axis.force_n[s.slice] ** 2)))
    return tuple(sorted(found[:_MOST], key=lambda s: s.start))


def _taps(axis: AxisMotion, span: Span, noise_rms_n: float, period_s: float) -> list[Span]:
    force = np.abs(axis.force_n[span.slice] - np.median(axis.force_n[span.slice]))
    lowest = max(_NOISES * noise_rms_n, _TAP_SHARE * float(np.max(force)))
    apart = max(1, round(_BETWEEN_TAPS_S / period_s))
    peaks = scipy.signal.find_peaks(np.pad(force, 1), height=lowest, distance=apart)[0] - 1
    last = min(span.stop + round(_BEHIND_S / period_s), len(axis.force_n))
    let_go = round(_LET_GO_S / period_s)
    edges = [*(span.start + int(peak) - let_go for peak in peaks), last]
    return [s for i, stop in enumerate(edges[1:]) for s in _span(edges[i] + 2 * let_go, stop, period_s)]


def _release(axis: AxisMotion, span: Span, hold: Span, period_s: float) -> list[Span]:
    force = axis.force_n[span.slice]
    pulled = np.flatnonzero(force * np.sign(np.median(axis.force_n[hold.slice])) < 0.0)
    if not pulled.size:
        return []
    return _span(span.start + int(pulled[0]) + round(_LET_GO_S / period_s), span.stop, period_s)


def _span(start: int, stop: int, period_s: float) -> list[Span]:
    stop = min(stop, start + round(_LONGEST_S / period_s))
    return [Span(start=start, stop=stop)] if stop - start >= _SHORTEST_S / period_s else []
