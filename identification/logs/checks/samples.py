"""Faults in the samples of a role: dead axes, constant runs, saturation, norms and units that cannot be."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from problems.arrays import FloatArray

from ...result import Finding
from ...signals.constant_runs import Runs, find_deadband, quantum, repeated_share, saturated_samples, stuck_runs
from ...signals.recording import AXES, StampArray
from ...signals.sweeps import are_unit, finite_rows, steps
from ..messages.decode import Series
from ..roles.cell import ANGLE_RAD, FORCE_N, LENGTH_M, TORQUE_N_M, PoseSource, Source, WrenchSource
from ..roles.orientation import COLUMN_MAJOR, ROW_MAJOR, is_rotation, orientation_quaternion
from ..roles.registry import Role
from .stamps import stamp_faults

QUATERNION_NORM_TOLERANCE = 1e-3
"""A unit quaternion rounded to four digits is within this of norm 1; anything farther off is not one."""
WRENCH_AXES = ("force x", "force y", "force z", "torque x", "torque y", "torque z")
_SENSOR_ADVICE = "Check the sensor's cable and driver and record again."
_POSE_AXES = ("position x", "position y", "position z")
_FEWEST_STAMPS, _ALIKE_DECADES = 16, 0.1
_LONGEST_TRAVEL_M = 20.0
_FARTHEST_M = 50.0
_LARGEST_TURN_RAD = 2.0 * np.pi * 1.01
_RESTING_SHARE = 1e-7
_REPEATED_SHARE = 0.3
_COARSE_REPEATS = 0.5
_OF_A_RESTING_COMMAND = frozenset({"stuck-axis", "repeated-samples"})
_OF_A_DEADBAND = frozenset({"stuck-axis", "deadband", "coarse-steps", "repeated-samples"})
"""What a deadband does to a wrench: expected where one is declared, as is what looks like the end of a range at 0."""


def frame_faults(topic: str, frame_ids: tuple[str, ...]) -> Iterator[Finding]:
    """Yield a fault when a needed channel changes its frame."""
    if len(frame_ids) > 1:
        names = ", ".join(repr(name) for name in frame_ids[:5])
        yield Finding.error(
            "several-frames",
            f"Topic {topic} has {len(frame_ids)} frames: {names}.",
            "Record each frame on a topic of its own.",
        )


def wrench_faults(
    topic: str, values: FloatArray, since_start_s: FloatArray, limits: Sequence[float | None] | None = None
) -> Iterator[Finding]:
    """Yield what is wrong with a wrench (n, 6): NaN, dead and stuck axes, saturation, deadband, repeats, coarse steps.

    `limits` is the declared range of each axis [N, N·m], symmetric about 0; without it a limit has to show itself.
    """
    bad = _not_finite(values)
    yield from _finite_faults(topic, bad, since_start_s)
    if len(values) < 2 or bool(np.all(bad)):
        return
    if bool(np.any(bad)):
        values, since_start_s = values[~bad], since_start_s[~bad]
    columns = np.ascontiguousarray(values.T)
    resting = np.zeros(len(values), dtype=np.bool_)
    resting[1:] = ~steps(values, 1, _RESTING_SHARE * np.ptp(columns, axis=1))
    stuck = [axis for axis, column in enumerate(columns) if bool(np.all(column == column[0]))]
    if stuck:
        yield _stuck_axes(topic, stuck, columns)
    for axis, column in enumerate(columns):
        if axis in stuck:
            continue
        limit = None if limits is None else limits[axis]
        saturated = saturated_samples(column, limit, resting)
        yield from _saturation(topic, WRENCH_AXES[axis], column, since_start_s, saturated)
        yield from _axis_faults(topic, WRENCH_AXES[axis], column[~saturated], since_start_s[~saturated])
    yield from _repeat_faults(topic, values)


def _stuck_axes(topic: str, stuck: Sequence[int], columns: FloatArray) -> Finding:
    """Name all axes of a wrench (6, n) that never change in one finding, as one declaration answers for all."""
    values = ", ".join(dict.fromkeys(f"{columns[axis, 0] + 0.0:g}" for axis in stuck))
    one = len(stuck) == 1
    within = "" if np.any(columns[stuck, 0]) else f"if {'it' if one else 'they'} stayed within a deadband, declare "
    within += "`deadband`, or, " if within else ""
    return Finding.error(
        "stuck-axis",
        f"The {', '.join(WRENCH_AXES[axis] for axis in stuck)} {'axis' if one else 'axes'} of topic {topic} "
        f"{'is' if one else 'are'} {values} in all {columns.shape[1]} samples.",
        f"Check the sensor's cable and driver and record again, or, {within}if the sensor does not measure "
        f"{'this axis' if one else 'these axes'}, leave {'it' if one else 'them'} out with "
        f"`wrench: {{left_out: [{', '.join(AXES[axis] for axis in stuck)}]}}` in cell.yaml. "
        "The payload's mass needs all three forces, its centre of mass all three torques.",
    )


def pose_faults(topic: str, values: FloatArray, since_start_s: FloatArray) -> Iterator[Finding]:
    """Yield faults of a pose (n, 7), position and quaternion xyzw: NaN, wrong norm, stuck, repeated, in millimetres."""
    bad = _not_finite(values)
    yield from _finite_faults(topic, bad, since_start_s)
    good = ~bad
    if not are_unit(values, QUATERNION_NORM_TOLERANCE):
        with np.errstate(invalid="ignore", over="ignore"):
            norm = np.sqrt(np.einsum("ij,ij->i", values[:, 3:], values[:, 3:]))
            off = np.abs(norm - 1.0) > QUATERNION_NORM_TOLERANCE
        if bool(np.any(off)):
            first = int(np.flatnonzero(off)[0])
            yield Finding.error(
                "quaternion-norm",
                f"{np.count_nonzero(off)} orientations of topic {topic} are no unit quaternions, the first "
                f"{since_start_s[first]:.3f} s after the start of the log (norm {norm[first]:.6g}).",
                "Publish orientations as unit quaternions (x, y, z, w) and record again.",
            )
        good &= ~off
    if np.count_nonzero(good) < 2:
        return
    if not bool(np.all(good)):
        values, since_start_s = values[good], since_start_s[good]
    if bool(np.all(values[-1] == values[0])) and bool(np.all(values == values[:1])):
        yield Finding.error(
            "stuck-pose",
            f"Topic {topic} holds one and the same pose in all {len(values)} samples.",
            "Check that the topic is the robot's measured pose and that the robot moves, and record again.",
        )
        return
    for axis, column in enumerate(np.ascontiguousarray(values[:, :3].T)):
        if np.any(column != column[0]):
            yield from _stuck_faults(topic, _POSE_AXES[axis], column, since_start_s)
    yield from _repeat_faults(topic, values)
    yield from _length_faults(topic, values[:, :3])


def turn_faults(topic: str, rotation_vectors: FloatArray, since_start_s: FloatArray) -> Iterator[Finding]:
    """Yield a fault when rotation vectors (n, 3) taken as radians turn by more than a whole turn: they are degrees."""
    size = np.linalg.norm(rotation_vectors, axis=1)
    over = size > _LARGEST_TURN_RAD
    if bool(np.any(over)):
        when = since_start_s[over]
        yield Finding.error(
            "turn-unit",
            f"{when.size} rotation vectors of topic {topic} are longer than one turn (up to {np.nanmax(size):.1f}), "
            f"the first {when[0]:.3f} s after the start of the log.",
            "Declare the unit of the rotation as deg if it is in degrees.",
        )


def _saturation(
    topic: str, name: str, column: FloatArray, since_start_s: FloatArray, saturated: NDArray[np.bool_]
) -> Iterator[Finding]:
    if bool(np.any(saturated)):
        when, level = since_start_s[saturated], float(np.max(np.abs(column[saturated])))
        yield Finding.error(
            "saturation",
            f"The {name} axis of topic {topic} is at the end of its range ({level:g}) in {when.size} samples, the "
            f"first {when[0]:.3f} s and the last {when[-1]:.3f} s after the start of the log.",
            "Stay within the sensor's range (slower contact, lighter payload, larger range) and record again.",
        )


def _axis_faults(topic: str, name: str, column: FloatArray, since_start_s: FloatArray) -> Iterator[Finding]:
    if len(column) < 2:
        return
    band = find_deadband(column)
    if band is None:
        yield from _stuck_faults(topic, name, column, since_start_s)
        yield from _step_faults(topic, name, column)
        return
    width = "an unknown width" if band.width is None else f"a width of roughly {band.width:.2g}"
    yield Finding.warning(
        "deadband",
        f"A {band.kind} deadband of {width} was applied to the {name} axis of topic {topic}: "
        f"{100.0 * band.zero_share:.1f} % of its samples are exactly 0.",
        "Record the sensor's wrench before gravity compensation and deadband, or declare `deadband`, and "
        "`gravity_compensated: true` if gravity was taken off too.",
    )


def _stuck_faults(topic: str, name: str, column: FloatArray, since_start_s: FloatArray) -> Iterator[Finding]:
    period = float(since_start_s[-1] - since_start_s[0]) / max(len(since_start_s) - 1, 1)
    runs = stuck_runs(column, max(period, 1e-9))
    if len(runs.starts):
        longest = float(np.max(since_start_s[runs.stops - 1] - since_start_s[runs.starts]))
        yield Finding.error(
            "stuck-axis",
            f"The {name} axis of topic {topic} stays exactly the same for up to {longest:.3f} s: "
            f"{_spans(runs, since_start_s)}.",
            _SENSOR_ADVICE,
        )


def _step_faults(topic: str, name: str, column: FloatArray) -> Iterator[Finding]:
    step = quantum(column)
    repeats = float(np.mean(column[1:] == column[:-1]))
    if step > 0.0 and repeats > _COARSE_REPEATS:
        yield Finding.warning(
            "coarse-steps",
            f"The {name} axis of topic {topic} comes in steps of {step:.3g}, coarser than its noise: "
            f"{100.0 * repeats:.0f} % of the samples equal the one before.",
            "Record floating point numbers, or set the sensor to a smaller range.",
        )


def _repeat_faults(topic: str, values: FloatArray) -> Iterator[Finding]:
    share = repeated_share(values)
    if share > _REPEATED_SHARE:
        yield Finding.warning(
            "repeated-samples",
            f"{100.0 * share:.0f} % of the messages of topic {topic} repeat the one before in every axis: "
            "it is published more often than it is measured.",
            "Publish each measurement once, with the time at which it was taken.",
        )


def _length_faults(topic: str, position: FloatArray) -> Iterator[Finding]:
    if 2.0 * max(float(np.max(position)), -float(np.min(position))) <= min(_LONGEST_TRAVEL_M, _FARTHEST_M):
        return  # none travels farther than that, or has its middle farther away
    travel = float(np.max(np.ptp(position, axis=0)))
    if travel > _LONGEST_TRAVEL_M:
        yield Finding.error(
            "length-unit",
            f"The pose of topic {topic} travels {travel:.0f} m, which no robot arm does.",
            "Declare the unit of the position as mm if it is in millimetres.",
        )
        return
    far = float(np.max(np.abs(np.median(position, axis=0))))
    if far > _FARTHEST_M:
        yield Finding.warning(
            "length-unit",
            f"The pose of topic {topic} is {far:.0f} m away from its origin.",
            "Declare the unit of the position as mm if it is in millimetres.",
        )


def _not_finite(values: FloatArray) -> NDArray[np.bool_]:
    """Return which rows of (n, k) hold a number that is not finite."""
    return np.asarray(~finite_rows(values))


def _finite_faults(topic: str, bad: NDArray[np.bool_], since_start_s: FloatArray) -> Iterator[Finding]:
    if bool(np.any(bad)):
        when = since_start_s[bad]
        yield Finding.error(
            "not-finite",
            f"Topic {topic} holds {when.size} samples that are not finite numbers (NaN or infinite), "
            f"the first {when[0]:.3f} s and the last {when[-1]:.3f} s after the start of the log.",
            "Cut that part out of the log or record again once the driver reports no error.",
        )


def _spans(runs: Runs, since_start_s: FloatArray) -> str:
    spans = [
        f"{since_start_s[a]:.3f} to {since_start_s[b - 1]:.3f} s"
        for a, b in zip(runs.starts[:3], runs.stops[:3], strict=True)
    ]
    more = f" and {len(runs.starts) - 3} times more" if len(runs.starts) > 3 else ""
    return ", ".join(spans) + more


_Number = TypeVar("_Number", np.float64, np.int64)


def role_faults(
    role: Role,
    parts: Sequence[Series],
    stamps: Sequence[StampArray],
    source: Source | None,
    start_ns: int,
    *,
    keeps_holes: bool = False,
) -> Iterator[Finding]:
    """Yield what is wrong with the samples of a role; those of severity `error` make it unusable.

    `parts` are those of one recording with their stamps: stamps are judged in each, values over all of them, since a
    robot may rest for the whole of one. `source` is what the cell declares; `start_ns` is where the log starts on the
    recording clock.
    """
    topic = parts[0].topic
    for part, stamp_ns in zip(parts, stamps, strict=True):
        # A recording clock may start at 0; only a header stamp of 0 is one that was never set.
        shifted = stamp_ns - stamp_ns[:1] + 1 if stamp_ns is part.log_ns else stamp_ns
        yield from frame_faults(topic, part.frame_ids)
        is_table = part.channel.encoding == "table"
        since_s = (part.log_ns - start_ns) / 1e9
        yield from stamp_faults(topic, shifted, since_s, keeps_holes=keeps_holes, is_table=is_table)
        yield from _stamp_unit(topic, stamp_ns, part.log_ns)
    ordered = sorted(parts, key=lambda part: int(part.log_ns[0]) if part.log_ns.size else 0)
    when = (joined([part.log_ns for part in ordered]) - start_ns) / 1e9
    values = _without_unmeasured(parts[0], joined([part.values for part in ordered]))
    if role in (Role.POSE, Role.COMMAND):
        declared = source if isinstance(source, PoseSource) else PoseSource()
        for finding in _pose_faults(topic, values, declared, when):
            # A command at rest is no broken sensor.
            if role is Role.POSE or finding.code not in _OF_A_RESTING_COMMAND:
                yield finding
    elif role is Role.WRENCH:
        yield from _wrench_faults(topic, values, source if isinstance(source, WrenchSource) else WrenchSource(), when)
    else:
        yield from _finite_faults(topic, _not_finite(values), when)


class ExaminedRoles:
    """What `role_faults` found of the roles of opened logs, which `inspect` and reading for `identify` both ask."""

    def __init__(self) -> None:
        self._seen: dict[tuple[Role, str], tuple[tuple[object, ...], tuple[NDArray[Any], ...], list[Finding]]] = {}

    def clear(self) -> None:
        """Forget the findings, and let go of the numbers that they are of."""
        self._seen.clear()

    def faults(
        self,
        role: Role,
        parts: Sequence[Series],
        stamps: Sequence[StampArray],
        source: Source | None,
        start_ns: int,
        *,
        keeps_holes: bool = False,
    ) -> list[Finding]:
        """Return the findings of `role_faults`; of the same numbers in the same memory those that it found before."""
        said = (source, start_ns, keeps_holes, *((part.frame_ids, part.has, part.channel) for part in parts))
        arrays = (*(part.values for part in parts), *(part.log_ns for part in parts), *stamps)
        key = (role, parts[0].topic)
        if key in self._seen and self._seen[key][0] == said and _are_same(self._seen[key][1], arrays):
            return self._seen[key][2]
        found = [*role_faults(role, parts, stamps, source, start_ns, keeps_holes=keeps_holes)]
        self._seen[key] = (said, arrays, found)
        return found


def _are_same(some: Sequence[NDArray[Any]], others: Sequence[NDArray[Any]]) -> bool:
    """Return whether arrays are views of the same memory, laid out alike."""

    def place(array: NDArray[Any]) -> tuple[object, ...]:
        return array.ctypes.data, array.shape, array.strides, array.dtype

    return list(map(place, some)) == list(map(place, others))


def _stamp_unit(topic: str, stamp_ns: StampArray, log_ns: StampArray) -> Iterator[Finding]:
    """Yield that stamps count thousands of seconds in a second of the recording, or a thousandth: a mistaken unit."""
    if len(stamp_ns) < _FEWEST_STAMPS or not (np.ptp(log_ns) > 0 and np.ptp(stamp_ns) > 0):
        return
    ratio = float(np.ptp(stamp_ns)) / float(np.ptp(log_ns))
    thousands = round(np.log10(ratio) / 3.0)
    if thousands and abs(np.log10(ratio) - 3.0 * thousands) < _ALIKE_DECADES:
        yield Finding.error(
            "stamp-unit",
            f"The header stamps of topic {topic} span {np.ptp(stamp_ns) * 1e-9:.6g} s, its messages came within "
            f"{np.ptp(log_ns) * 1e-9:.6g} s: a factor of 1000 is a mistaken unit (ms or µs for s).",
            "Write stamps as seconds and nanoseconds and record again, or declare `clock: log` for this channel in "
            "cell.yaml.",
        )


def _wrench_faults(topic: str, values: FloatArray, source: WrenchSource, when: FloatArray) -> Iterator[Finding]:
    range_n, range_n_m = source.saturation.force_n, source.saturation.torque_n_m
    limits = (*(range_n or (None,) * 3), *(range_n_m or (None,) * 3))
    scaled = _scaled(values, FORCE_N[source.units.force], TORQUE_N_M[source.units.torque])
    expected = _OF_A_DEADBAND if any(limits) else _OF_A_DEADBAND | {"saturation"}
    for finding in wrench_faults(topic, scaled, when, limits):
        if source.deadband is None or finding.code not in expected:
            yield finding
        elif finding.severity == "error":
            yield replace(finding, severity="warning", advice="It may be the deadband that cell.yaml declares.")


def _pose_faults(topic: str, values: FloatArray, source: PoseSource, when: FloatArray) -> Iterator[Finding]:
    """Yield the faults of a pose."""
    turns, kind, length = values[:, 3:], source.orientation_as, LENGTH_M[source.units.position]
    if kind == "quaternion_xyzw" and turns.shape[1] == 4 and length == 1.0:
        yield from pose_faults(topic, values, when)
        return
    seven = np.zeros((len(values), 7))
    seven[:, :3] = _scaled(values[:, :3], length, 1.0)
    if turns.shape[1] == 4:
        seven[:, 3:] = turns[:, [1, 2, 3, 0]] if kind == "quaternion_wxyz" else turns
    else:
        finite = np.isfinite(turns).all(axis=1)
        good = finite
        if turns.shape[1] == 9:
            good = finite & is_rotation(turns)
            yield from _matrix_faults(topic, values[:, :3], finite & ~good, when)
        seven[:, 6] = np.where(finite, 1.0, np.nan)
        if turns.shape[1] and bool(np.any(good)):
            seven[good, 3:] = orientation_quaternion(kind, turns[good], ANGLE_RAD[source.units.angle])
    yield from pose_faults(topic, seven, when)
    if turns.shape[1] == 3 and kind == "rotation_vector":
        yield from turn_faults(topic, turns * ANGLE_RAD[source.units.angle], when)


def _matrix_faults(topic: str, position: FloatArray, bad: NDArray[np.bool_], when: FloatArray) -> Iterator[Finding]:
    """Yield what is wrong with orientations written as matrices, of which `bad` (n,) are no rotations."""
    if bool(np.any(bad)):
        yield Finding.error(
            "no-rotation",
            f"{np.count_nonzero(bad)} matrices of topic {topic} are no rotations (orthonormal, determinant +1), the "
            f"first {when[bad][0]:.3f} s after the start of the log.",
            "Check which numbers `fields: {orientation: …}` in cell.yaml names, and their order.",
        )
    if not bool(np.any(position)):
        yield Finding.error(
            "matrix-order",
            f"The position of topic {topic} is 0 in all {len(position)} samples, as the last row of a matrix is.",
            f"Declare the other of {ROW_MAJOR} and {COLUMN_MAJOR} in `orientation_as`.",
        )


def _scaled(values: FloatArray, first: float, second: float) -> FloatArray:
    if first == second == 1.0:
        return values
    return np.asarray(values * np.repeat([first, second], 3)[: values.shape[1]])


def joined(arrays: Sequence[NDArray[_Number]]) -> NDArray[_Number]:
    """Return arrays one after the other; one alone is itself, not a copy."""
    return arrays[0] if len(arrays) == 1 else np.concatenate(arrays)


def _without_unmeasured(series: Series, values: FloatArray) -> FloatArray:
    """Return the values with a count in the columns that the log does not have, which is finite and not stuck."""
    unmeasured = [not has for has in series.has]
    if not any(unmeasured):
        return values
    values = values.copy()
    values[:, unmeasured] = 1e-6 * np.arange(float(len(values)))[:, None]
    return values
