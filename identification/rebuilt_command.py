"""The position command that an admittance with known gains makes of the wrench, where none was logged."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from problems.arrays import FloatArray

from .joint_fit.noise import fit_smoother
from .robot.admittance_motion import rebuild_command
from .signals.aligned import AlignedLog
from .signals.recording import PoseSignal, Recording, StampArray
from .signals.segments import MotionSpans, Span


def rebuilt_command(
    recording: Recording, beside: Mapping[str, tuple[FloatArray, FloatArray]], log: AlignedLog, motion: MotionSpans
) -> PoseSignal | None:
    """Return the command that the gains make of the wrench without its noise; None without an axis in `beside`.

    What the sensor shows at rest may have driven the controller or come in behind it. Left in the command it would meet
    itself in the force that the command predicts, and the fit would choose the payload that amplifies it least; what
    Wiener's filter takes off is noise to the fit whichever it was.
    """
    if not beside:
        return None
    wrench = recording.wrench
    still, moving = (_samples(spans, log, wrench.stamp_ns) for spans in (motion.still, motion.moving))
    period_s = float(np.median(np.diff(wrench.stamp_ns))) * 1e-9
    force = np.column_stack(
        [
            _smoothed(column, moving, still, period_s) if axis in beside else column
            for axis, column in zip("xyz", wrench.force_n.T, strict=True)
        ]
    )
    return rebuild_command(replace(recording, wrench=replace(wrench, force_n=force)), beside)


def _samples(spans: Sequence[Span], log: AlignedLog, stamp_ns: StampArray) -> list[slice]:
    """Return the samples of a channel in spans of the log."""
    edges = [
        (log.start_ns + 1e9 * log.time_s[each.start], log.start_ns + 1e9 * log.time_s[each.stop - 1]) for each in spans
    ]
    return [slice(*np.searchsorted(stamp_ns, edge).tolist()) for edge in edges]


def _smoothed(force: FloatArray, moving: Sequence[slice], still: Sequence[slice], period_s: float) -> FloatArray:
    """Return a force (n,) without what it shows at rest; as it is where there is no rest to know that from."""
    smoother = fit_smoother([force[each] for each in moving], [force[each] for each in still], period_s)
    if smoother.taps is None:
        return force
    mean = float(np.mean(force))
    spline = smoother.spline(np.pad(force, smoother.half_width + 1, mode="edge"), mean)
    return np.asarray((spline[:-2] + 4.0 * spline[1:-1] + spline[2:]) / 6.0)
