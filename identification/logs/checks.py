"""What makes the samples of a needed channel unusable; each fault is a finding, the reader refuses on the first."""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from ..recording import FloatArray, StampArray
from ..result import Finding
from .messages import Headers

QUATERNION_NORM_TOLERANCE = 1e-3
"""A unit quaternion rounded to four digits is within this of norm 1; anything farther off is not one."""
_WRENCH_AXES = ("force x", "force y", "force z", "torque x", "torque y", "torque z")


def stamp_faults(topic: str, stamp_ns: StampArray, since_start_s: FloatArray) -> Iterator[Finding]:
    """Yield faults of header stamps: all zero, constant, backwards, duplicate; `since_start_s` tells when."""
    advice = "Record with the sensor driver's own clock in the header and one publisher per topic."
    if stamp_ns.size < 2:
        yield _fault("too-few-messages", f"Topic {topic} holds {stamp_ns.size} message(s).", "Record the whole run.")
        return
    if bool(np.all(stamp_ns == stamp_ns[0])):
        what = "zero" if stamp_ns[0] == 0 else f"the same ({stamp_ns[0] / 1e9:.9f} s)"
        yield _fault("constant-stamps", f"All {stamp_ns.size} header stamps of topic {topic} are {what}.", advice)
        return
    if bool(np.any(stamp_ns <= 0)):
        first = int(np.flatnonzero(stamp_ns <= 0)[0])
        count = np.count_nonzero(stamp_ns <= 0)
        message = f"Topic {topic} has {count} header stamps of zero or less, {_at(since_start_s[first])}."
        yield _fault("zero-stamps", message, advice)
    steps = np.diff(stamp_ns)
    for code, chosen, what in (
        ("backwards-stamps", steps < 0, "go backwards"),
        ("duplicate-stamps", steps == 0, "repeat the one before"),
    ):
        if bool(np.any(chosen)):
            first = int(np.flatnonzero(chosen)[0]) + 1
            message = f"{np.count_nonzero(chosen)} header stamps of topic {topic} {what}, {_at(since_start_s[first])}."
            yield _fault(code, message, advice)


def frame_faults(topic: str, headers: Headers) -> Iterator[Finding]:
    """Yield a fault when a needed channel changes its frame."""
    if len(headers.frame_ids) > 1:
        names = ", ".join(repr(name) for name in headers.frame_ids[:5])
        yield _fault(
            "several-frames",
            f"Topic {topic} is told in {len(headers.frame_ids)} frames: {names}.",
            "Record each frame on a topic of its own.",
        )


def wrench_faults(topic: str, values: FloatArray, since_start_s: FloatArray) -> Iterator[Finding]:
    """Yield faults of a wrench (n, 6): NaN or infinite samples, axes that never change."""
    yield from _finite_faults(topic, values, since_start_s)
    if len(values) < 2:
        return
    for axis in np.flatnonzero(np.all(values == values[:1], axis=0)):
        yield _fault(
            "stuck-axis",
            f"The {_WRENCH_AXES[axis]} axis of topic {topic} is {values[0, axis]:g} in all {len(values)} samples.",
            "Check the sensor's cable and driver and record again.",
        )


def pose_faults(topic: str, values: FloatArray, since_start_s: FloatArray) -> Iterator[Finding]:
    """Yield faults of a pose (n, 7), position and quaternion xyzw: NaN, infinity, quaternions of wrong norm."""
    yield from _finite_faults(topic, values, since_start_s)
    with np.errstate(invalid="ignore", over="ignore"):
        norm = np.sqrt(np.sum(values[:, 3:] ** 2, axis=1))
        off = np.abs(norm - 1.0) > QUATERNION_NORM_TOLERANCE
    if bool(np.any(off)):
        first = int(np.flatnonzero(off)[0])
        yield _fault(
            "quaternion-norm",
            f"{np.count_nonzero(off)} orientations of topic {topic} are no unit quaternions, "
            f"{_at(since_start_s[first])} (norm {norm[first]:.6g}).",
            "Publish orientations as unit quaternions (x, y, z, w) and record again.",
        )


def _finite_faults(topic: str, values: FloatArray, since_start_s: FloatArray) -> Iterator[Finding]:
    bad: NDArray[np.bool_] = ~np.all(np.isfinite(values), axis=1)
    if bool(np.any(bad)):
        when = since_start_s[bad]
        yield _fault(
            "not-finite",
            f"Topic {topic} holds {when.size} samples that are not finite numbers (NaN or infinite), "
            f"the first {when[0]:.3f} s and the last {when[-1]:.3f} s after the start of the log.",
            "Cut that part out of the log or record again once the driver reports no error.",
        )


def _at(seconds: float) -> str:
    return f"the first {seconds:.3f} s after the start of the log"


def _fault(code: str, message: str, advice: str) -> Finding:
    return Finding(code=code, severity="error", message=message, advice=advice)
