"""Wrench and pose on one uniform clock."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import numpy as np
from scipy.interpolate import make_interp_spline
from scipy.spatial.transform import Rotation

from problems.arrays import BoolArray, FloatArray, IntArray

from ..errors import LogError
from .medians import median
from .recording import (
    LARGEST_GAP_PERIODS,
    PoseSignal,
    Recording,
    StampArray,
    find_gaps,
    slerp,
    stamped_between,
    turned_rad,
    unmeasured,
)

_FAST_PERIOD_S = 1.5e-3
_SHORTEST_OVERLAP_S = 2.0
_FEWEST_SAMPLES = 30
_LONGEST_POSE_PERIOD_S = 0.5
_FEWEST_BETWEEN_HOLES = 4
_REGULAR_SHARE = 0.05
_MOSTLY = 0.99
_PART = 2**16
_LAG_S = 0.02


@dataclass(frozen=True, kw_only=True)
class Span:
    """Samples `start` up to, not including, `stop`."""

    start: int
    stop: int

    @property
    def slice(self) -> slice:
        """The span as an index."""
        return slice(self.start, self.stop)

    def __len__(self) -> int:
        return self.stop - self.start


def edges_of(mask: BoolArray) -> tuple[IntArray, IntArray]:
    """Return the starts and stops (m,) of the stretches in which a mask (n,) is true."""
    padded = np.concatenate([[False], mask, [False]])
    changes = np.flatnonzero(padded[1:] != padded[:-1]).astype(np.int64)
    return changes[::2], changes[1::2]


def spans_of(mask: BoolArray) -> tuple[Span, ...]:
    """Return the spans in which a mask (n,) is true."""
    starts, stops = edges_of(mask)
    return tuple(Span(start=int(a), stop=int(b)) for a, b in zip(starts, stops, strict=True))


@dataclass(frozen=True, kw_only=True)
class AlignedLog:
    """Wrench and pose on one uniform clock: `time_s` (n,) from the first wrench stamp `start_ns`.

    `force_S_n`, `torque_S_n_m` (n, 3) raw in the sensor frame; `position_B_m` (n, 3); `orientation_BS` n rotations
    base from sensor (the sensor frame is the flange's); `pose_rate_hz` limits which frequencies mean something. In
    `holes` nothing was recorded: force, torque and position are NaN there, the orientation is the last one before.
    Without `has_torque` the torque is NaN throughout.
    """

    start_ns: int
    period_s: float
    time_s: FloatArray
    force_S_n: FloatArray
    torque_S_n_m: FloatArray
    position_B_m: FloatArray
    orientation_BS: Rotation
    pose_rate_hz: float
    holes: tuple[Span, ...] = ()
    has_torque: bool = True

    def __len__(self) -> int:
        return len(self.time_s)

    @property
    def pieces(self) -> tuple[Span, ...]:
        """The spans between the holes."""
        edges = [0, *(edge for hole in self.holes for edge in (hole.start, hole.stop)), len(self)]
        return tuple(Span(start=a, stop=b) for a, b in zip(edges[::2], edges[1::2], strict=True) if b > a)

    @property
    def parts(self) -> Iterator[slice]:
        """The samples in parts: what comes between would of a long log be the most that is ever in memory."""
        return (slice(first, first + _PART) for first in range(0, len(self), _PART))

    @cached_property
    def turned_rad(self) -> FloatArray:
        """How far (n − lag,) [rad] each sample is turned `lag` later, against the noise of encoders."""
        quaternions = self.orientation_BS.as_quat()
        return turned_rad(quaternions[: -self.lag], quaternions[self.lag :])

    @property
    def lag(self) -> int:
        """Count the samples in 20 ms."""
        return max(1, round(_LAG_S / self.period_s))

    def in_sensor_frame(self, vector_B: FloatArray) -> FloatArray:
        """Return in S (n, 3) a vector (3,) of B, or that of each sample (n, 3)."""
        turned = np.empty((len(self), 3))
        for part in self.parts:
            turned[part] = self.orientation_BS[part].inv().apply(vector_B if vector_B.ndim == 1 else vector_B[part])
        return turned


def without_wrench(log: AlignedLog) -> AlignedLog:
    """Return the log with a wrench that is not known, and takes no memory."""
    left = unmeasured(len(log))
    return replace(log, force_S_n=left, torque_S_n_m=left)


def align(recording: Recording) -> AlignedLog:
    """Interpolate the pose on a uniform clock of the wrench's rate, over the time that both cover.

    The clock starts at a wrench stamp, so that a regular wrench keeps its samples: between them its noise would be
    averaged. Position by cubic spline, orientation by slerp, neither across a hole; position and torque are NaN where
    not all three of them were logged. Raises LogError when the channels do not overlap by 30 samples, or have holes
    that the recording does not keep; EstimateError when wrench or pose are not as sensor and robot show them
    (`Recording.require_raw`).
    """
    recording.require_raw()
    return on_one_clock(recording)


def on_one_clock(recording: Recording) -> AlignedLog:
    """Return the log as `align` does, of wrench and pose as they are: every number must be known."""
    wrench, pose, clock = recording.wrench, recording.pose, _clock_of(recording)
    return AlignedLog(
        start_ns=clock.start_ns,
        period_s=clock.period_s,
        time_s=clock.forces.at,
        force_S_n=clock.sampled(clock.forces, wrench.force_n, 1),
        torque_S_n_m=clock.sampled(clock.forces, wrench.torque_n_m, 1, is_whole=wrench.has_torque),
        position_B_m=clock.sampled(clock.poses, pose.position_m, 3, is_whole=pose.has_position),
        orientation_BS=clock.poses.turned(pose),
        pose_rate_hz=1.0 / clock.pose_period_s,
        holes=clock.holes,
        has_torque=wrench.has_torque,
    )


def aligned_position(recording: Recording) -> FloatArray:
    """Return the position (n, 3) of `align` alone."""
    recording.require_raw()
    clock = _clock_of(recording)
    return clock.sampled(clock.poses, recording.pose.position_m, 3, is_whole=recording.pose.has_position)


@dataclass(frozen=True, kw_only=True)
class _Clock:
    """The uniform clock of wrench and pose, what each shows on it, and where one of them shows nothing."""

    start_ns: int
    period_s: float
    pose_period_s: float
    forces: "_Pieces"
    poses: "_Pieces"
    holes: tuple[Span, ...]

    def sampled(self, pieces: "_Pieces", values: FloatArray, degree: int, *, is_whole: bool = True) -> FloatArray:
        """Return a channel on the clock, NaN in the holes."""
        if not is_whole:
            return np.full((len(pieces.at), values.shape[1]), np.nan)
        found = pieces.interpolated(values, degree) if degree > 1 else pieces.felt(values)
        if self.holes and found is values:
            found = np.array(values)
        for hole in self.holes:
            found[hole.slice] = np.nan
        return found


def _clock_of(recording: Recording) -> _Clock:
    wrench, pose = recording.wrench, recording.pose
    start = max(wrench.stamp_ns[0], pose.stamp_ns[0])
    stop = min(wrench.stamp_ns[-1], pose.stamp_ns[-1])
    if stop - start < _SHORTEST_OVERLAP_S * 1e9:
        raise LogError(
            f"Wrench and pose must cover the same time for at least {_SHORTEST_OVERLAP_S:g} s, found "
            f"{max(0.0, float(stop - start) * 1e-9):.3f} s in common ({wrench.topic}, {pose.topic}); check "
            "that both count on one clock, and of tables the unit of their times (`time_unit`)."
        )
    period = check_regular(wrench.topic, wrench.stamp_ns, keeps_holes=recording.keeps_holes)
    pose_period = check_regular(pose.topic, pose.stamp_ns, keeps_holes=recording.keeps_holes)
    if pose_period > _LONGEST_POSE_PERIOD_S:
        raise LogError(
            f"The pose must be logged as the robot moves, found samples of {pose.topic} {pose_period:.3g} s apart; "
            "record it at the control rate, check the unit of its times, or, where it is held from one to the next, "
            "give the mean wrench of each hold with its pose in one row and declare `table: {rows: poses}`."
        )
    start = wrench.stamp_ns[np.searchsorted(wrench.stamp_ns, start)]
    count = int((stop - start) * 1e-9 / period + 1e-6) + 1
    if count < _FEWEST_SAMPLES:
        raise LogError(
            f"Wrench and pose must have {_FEWEST_SAMPLES} samples in common to show rest and motion, found {count} "
            f"({wrench.topic}); record at the control rate, or, where each row of a table is the mean of a rest, "
            "declare `table: {rows: poses}` in cell.yaml."
        )
    time = np.asarray(np.arange(count) * period, dtype=np.float64)
    forces = _Pieces.of(wrench.stamp_ns, start, time)
    poses = _Pieces.of(pose.stamp_ns, start, time)
    holes = spans_of(~(forces.covered() & poses.covered()))
    return _Clock(
        start_ns=int(start), period_s=period, pose_period_s=pose_period, forces=forces, poses=poses, holes=holes
    )


def check_regular(topic: str, stamp_ns: StampArray, *, keeps_holes: bool = False) -> float:
    """Return the period [s]; raises LogError for holes in the data unless the recording keeps them."""
    if len(stamp_ns) < 3:
        raise LogError(f"Topic `{topic}` has {len(stamp_ns)} messages; at least 3 are needed.")
    gaps = np.diff(stamp_ns)
    period = median(gaps)
    worst = int(np.argmax(gaps))
    if gaps[worst] > LARGEST_GAP_PERIODS * period and not keeps_holes:
        raise LogError(
            f"Topic `{topic}` has a gap of {gaps[worst] * 1e-9:.3f} s at "
            f"{(stamp_ns[worst] - stamp_ns[0]) * 1e-9:.3f} s (its period is {period * 1e-9:.6f} s); record again "
            "without losing messages, cut the log there, or read it with `--windows 10min`."
        )
    # Free of the stamps' rounding is the mean over the log, once lost messages are counted; a hole shows none.
    gaps = gaps[gaps <= LARGEST_GAP_PERIODS * period]
    steps = gaps / period
    counts = np.round(steps)
    regular = np.abs(steps - counts) < _REGULAR_SHARE
    # Stamps that jitter, as those of a fast clock of which every few ticks are logged, have no step but a mean.
    if counts.min() > 0 and (np.mean(regular) > _MOSTLY or counts.max() == 1):
        return 1e-9 * float(gaps.sum()) / float(counts.sum())
    mean = float(gaps.mean())
    return 1e-9 * (mean if abs(mean / period - 1.0) < 1e-3 else period)


def longest_whole(recording: Recording) -> Recording:
    """Return wrench and pose of the longest time in which neither has a hole, the recording itself if it has none."""
    return whole_stretches(recording)[0]


def whole_stretches(recording: Recording) -> list[Recording]:
    """Return wrench and pose of the times in which neither has a hole, the longest first."""
    if not recording.keeps_holes:
        return [recording]
    wrench, pose = recording.wrench, recording.pose
    gaps = [
        (int(stamps[i]), int(stamps[i + 1]))
        for stamps in (wrench.stamp_ns, pose.stamp_ns)
        for i in find_gaps(stamps).tolist()
    ]
    if not gaps:
        return [recording]
    first = int(max(wrench.stamp_ns[0], pose.stamp_ns[0]))
    last = int(min(wrench.stamp_ns[-1], pose.stamp_ns[-1]))
    begins = [first, *(stop for _, stop in gaps)]
    whole = [(min([start for start, stop in gaps if stop > begin], default=last), begin) for begin in begins]
    return [
        replace(recording, wrench=stamped_between(wrench, start, stop + 1), pose=stamped_between(pose, start, stop + 1))
        for stop, start in sorted({each for each in whole if each[0] > each[1]}, key=lambda each: each[1] - each[0])
    ]


@dataclass(frozen=True, kw_only=True)
class _Pieces:
    """A channel between its holes: `time` (m,) of its messages on the clock `at` (n,), `parts` of both, in pairs."""

    time: FloatArray
    at: FloatArray
    parts: tuple[tuple[slice, slice], ...]

    @classmethod
    def of(cls, stamp_ns: StampArray, start_ns: np.int64, at: FloatArray) -> "_Pieces":
        time = np.asarray((stamp_ns - start_ns) * 1e-9)
        gaps = find_gaps(stamp_ns)
        if not gaps.size:
            return cls(time=time, at=at, parts=((slice(0, len(time)), slice(0, len(at))),))
        edges = [0, *(gaps + 1).tolist(), len(time)]
        tolerance = 0.5 * float(at[1] - at[0])
        parts = []
        for a, b in pairwise(edges):
            first, last = np.searchsorted(at, (time[a] - tolerance, time[b - 1] + tolerance)).tolist()
            if b - a >= _FEWEST_BETWEEN_HOLES and last > first:
                parts.append((slice(a, b), slice(first, last)))
        return cls(time=time, at=at, parts=tuple(parts))

    def covered(self) -> BoolArray:
        """Return where the channel shows something (n,)."""
        covered = np.zeros(len(self.at), dtype=np.bool_)
        for _, inside in self.parts:
            covered[inside] = True
        return covered

    def interpolated(self, values: FloatArray, degree: int) -> FloatArray:
        """Return (n, k) by splines within each part, NaN elsewhere; what is on the clock already is itself."""
        if len(self.parts) == 1 and self.parts[0] == (slice(0, len(values)), slice(0, len(self.at))):
            return _interpolated(self.time, values, self.at, degree=degree)
        found = np.full((len(self.at), values.shape[1]), np.nan)
        for held, inside in self.parts:
            found[inside] = _interpolated(self.time[held], values[held], self.at[inside], degree=degree)
        return found

    def felt(self, values: FloatArray) -> FloatArray:
        """Return forces (n, k) as `interpolated`: along lines between fast samples, along cubics between slow ones.

        Straight lines between slow samples take (ω h)²/12 of a force that swings, between fast ones less than its
        noise. What a deadband swallowed, and is 0 along a line, stays 0.
        """
        straight = self.interpolated(values, 1)
        if straight is values or float(self.at[1] - self.at[0]) <= _FAST_PERIOD_S:
            return straight
        return np.where(straight == 0.0, 0.0, self.interpolated(values, 3))

    def turned(self, pose: PoseSignal) -> Rotation:
        """Return n orientations by slerp within each part, elsewhere the last one before."""
        if len(self.parts) == 1 and self.parts[0][1] == slice(0, len(self.at)):
            held, _ = self.parts[0]
            return _turned(self.time[held], Rotation.from_quat(pose.quaternion_xyzw[held]), self.at)
        found, known = np.zeros((len(self.at), 4)), 0
        for held, inside in self.parts:
            orientation = Rotation.from_quat(pose.quaternion_xyzw[held])
            found[inside] = _turned(self.time[held], orientation, self.at[inside]).as_quat()
            found[known : inside.start] = found[known - 1 if known else inside.start]
            known = inside.stop
        found[known:] = found[known - 1]
        return Rotation.from_quat(found)


def _interpolated(time: FloatArray, values: FloatArray, at: FloatArray, *, degree: int) -> FloatArray:
    if len(time) == len(at) and np.max(np.abs(time - at)) < 1e-9:
        return values
    inside = np.clip(at, time[0], time[-1])
    return np.asarray(make_interp_spline(time, values, k=degree)(inside))


def _turned(time: FloatArray, orientation: Rotation, at: FloatArray) -> Rotation:
    if len(time) == len(at) and np.max(np.abs(time - at)) < 1e-9:
        return orientation
    return Rotation.from_quat(slerp(time, orientation.as_quat(), np.clip(at, time[0], time[-1])))
