"""What is wrong with the samples of a role, in the units of our signals."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from ..result import Finding
from ..signals.recording import FloatArray, StampArray
from .cell import PoseSource, Source, WrenchSource
from .health import frame_faults, pose_faults, stamp_faults, turn_faults, wrench_faults
from .interpret import orientation_quaternion
from .layouts import Role
from .opened import RoleSeries
from .units import ANGLE_RAD, FORCE_N, LENGTH_M, TORQUE_N_M

_Number = TypeVar("_Number", np.float64, np.int64)

_OF_A_RESTING_COMMAND = frozenset({"stuck-axis", "repeated-samples"})
_OF_A_DEADBAND = frozenset({"stuck-axis", "deadband", "coarse-steps", "repeated-samples"})
"""What a deadband does to a wrench: expected where one is declared, as is what looks like the end of a range at 0."""


def role_faults(
    role: Role,
    parts: Sequence[RoleSeries],
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
    topic = parts[0].choice.head.channel.topic
    for part, stamp_ns in zip(parts, stamps, strict=True):
        # A recording clock may start at 0; only a header stamp of 0 is one that was never set.
        told = stamp_ns - stamp_ns[:1] + 1 if stamp_ns is part.log_ns else stamp_ns
        yield from frame_faults(topic, part.frame_ids)
        yield from stamp_faults(topic, told, (part.log_ns - start_ns) / 1e9, keeps_holes=keeps_holes)
    ordered = sorted(parts, key=lambda part: int(part.log_ns[0]) if part.log_ns.size else 0)
    when = (joined([part.log_ns for part in ordered]) - start_ns) / 1e9
    values = _without_unmeasured(parts[0], joined([part.values for part in ordered]))
    if role in (Role.POSE, Role.COMMAND):
        declared = source if isinstance(source, PoseSource) else PoseSource()
        for finding in _pose_faults(topic, values, declared, when):
            # A command that stands still is no broken sensor.
            if role is Role.POSE or finding.code not in _OF_A_RESTING_COMMAND:
                yield finding
    elif role is Role.WRENCH:
        yield from _wrench_faults(topic, values, source if isinstance(source, WrenchSource) else WrenchSource(), when)
    else:
        yield from _finite_faults(topic, values, when)


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
    turns, kind = values[:, 3:], source.orientation_as
    seven = np.zeros((len(values), 7))
    seven[:, :3] = _scaled(values[:, :3], LENGTH_M[source.units.position], 1.0)
    if turns.shape[1] == 4:
        seven[:, 3:] = turns[:, [1, 2, 3, 0]] if kind == "quaternion_wxyz" else turns
    else:
        finite = np.isfinite(turns).all(axis=1)
        seven[:, 6] = np.where(finite, 1.0, np.nan)
        if turns.shape[1] == 3 and bool(np.any(finite)):
            seven[finite, 3:] = orientation_quaternion(kind, turns[finite], ANGLE_RAD[source.units.angle])
    yield from pose_faults(topic, seven, when)
    if turns.shape[1] == 3 and kind == "rotation_vector":
        yield from turn_faults(topic, turns * ANGLE_RAD[source.units.angle], when)


def _finite_faults(topic: str, values: FloatArray, when: FloatArray) -> Iterator[Finding]:
    """Yield a fault where a row is not finite, as of a pose that moves a little elsewhere."""
    seven = np.zeros((len(values), 7))
    seven[:, :3] = np.linspace(0.0, 1e-3, len(values))[:, None]
    seven[:, 6] = 1.0
    seven[~np.isfinite(values).all(axis=1), 0] = np.nan
    yield from (finding for finding in pose_faults(topic, seven, when) if finding.code == "not-finite")


def _scaled(values: FloatArray, first: float, second: float) -> FloatArray:
    if first == second == 1.0:
        return values
    return np.asarray(values * np.repeat([first, second], 3)[: values.shape[1]])


def joined(arrays: Sequence[NDArray[_Number]]) -> NDArray[_Number]:
    """Return arrays one after the other; one alone is itself, not a copy."""
    return arrays[0] if len(arrays) == 1 else np.concatenate(arrays)


def _without_unmeasured(series: RoleSeries, values: FloatArray) -> FloatArray:
    """Return the values with a count in the columns that the log does not have, which is finite and not stuck."""
    unmeasured = [path is None for path in series.choice.fields]
    if not any(unmeasured):
        return values
    values = values.copy()
    values[:, unmeasured] = 1e-6 * np.arange(float(len(values)))[:, None]
    return values
