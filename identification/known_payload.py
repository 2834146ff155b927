"""A payload that other rests of the same cell have shown, for a log whose own rests are too few to show it."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from problems.arrays import BoolArray

from .conventions.choice import ReadLog, read_as
from .conventions.search import Convention
from .errors import FewPosesError, PayloadChangedError
from .payload.gravity import LOCAL_GRAVITY_STD, GravityFit
from .payload.static_poses import StaticPose, collect_static_poses
from .result import Finding
from .signals.aligned import AlignedLog
from .signals.recording import Frames, Recording
from .signals.segments import MotionSpans

_ALLOWED_STDS = 4.0
# A step of the bias below this is drift (`checks.payload` counts from here too).
_ALLOWED_N = 0.5
_CHANGED_RESTS = 2


@dataclass(frozen=True, kw_only=True)
class KnownPayload:
    """Mass, centre of mass and biases with their covariance, as the rests of `source` show them.

    `start_ns` and `stop_ns` are the stamps between which these rests lie, `convention` those that they were read by
    where it was not the declared one.
    """

    source: str
    start_ns: int
    stop_ns: int
    gravity: GravityFit
    convention: Convention | None

    def allowed_n(self, pose: StaticPose) -> float:
        """Return by how much the force of a rest may differ from what this payload explains, without contradiction.

        Four deviations of weight and bias (var m |g|² + tr Σ_b + 2 g·cov), of the misfit of the known rests and of the
        mean of this one; half a newton at least.
        """
        gravity, held = pose.gravity_S_m_s2, self.gravity.covariance[np.ix_([0, 4, 5, 6], [0, 4, 5, 6])]
        rows = np.column_stack([gravity, np.eye(3)])
        # Local gravity is the same for both.
        held[0, 0] -= (LOCAL_GRAVITY_STD * self.gravity.mass_kg) ** 2
        variance = float(np.trace(rows @ held @ rows.T)) + 3.0 * self.gravity.residual_rms_n**2
        return max(_ALLOWED_STDS * float(np.sqrt(variance + 3.0 * pose.force_mean_std_n**2)), _ALLOWED_N)

    def explains(self, pose: StaticPose) -> bool:
        """Return whether this payload explains the force of a rest."""
        weight = self.gravity.mass_kg * pose.gravity_S_m_s2
        left = pose.force_S_n - weight - self.gravity.force_bias_S_n
        return float(np.linalg.norm(left)) <= self.allowed_n(pose)

    def before(self) -> "KnownPayload":
        """Return it with the biases that the sensor had before it was tared between the rests, if it was."""
        fit, step = self.gravity, self.gravity.bias_step
        if step is None:
            return self
        force, torque = fit.force_bias_S_n + step.force_before_S_n, fit.torque_bias_S_n_m + step.torque_before_S_n_m
        gravity = replace(fit, force_bias_S_n=force, torque_bias_S_n_m=torque)
        return replace(self, gravity=gravity)

    def seen_with(self, poses: Sequence[StaticPose], fits: BoolArray) -> "KnownPayload":
        """Return it with the noise of other rests, of which some fit."""
        noise = [pose.force_noise_n for pose, good in zip(poses, fits, strict=True) if good]
        gravity = replace(
            self.gravity,
            noise_rms_n=float(np.median(noise)),
            inliers=tuple(int(i) for i in np.flatnonzero(fits)),
            rejected=int(np.count_nonzero(~fits)),
            bias_step=None,
        )
        return replace(self, gravity=gravity)

    def finding(self) -> Finding:
        """Say that it was taken."""
        text = f"Payload from {self.source}: the tool rests in too few orientations here, and its force agrees."
        return Finding.info("payload-from", text, "")


def known_payload(read: ReadLog, gravity: GravityFit, source: str = "") -> KnownPayload:
    """Return what the rests of a log showed, to be used for others."""
    start, period_ns = read.log.start_ns, 1e9 * read.log.period_s
    return KnownPayload(
        source=source,
        start_ns=start,
        stop_ns=start + round(len(read.log) * period_ns),
        gravity=gravity,
        convention=read.convention,
    )


def read_with_known(
    recording: Recording,
    log: AlignedLog,
    motion: MotionSpans,
    frames: Frames | None,
    known: Sequence[KnownPayload],
) -> tuple[ReadLog, KnownPayload]:
    """Return a log read by a known payload that its force at rest agrees with, and that payload.

    The first one that explains a rest is taken. Of a payload whose sensor was tared in between, the bias is that of
    the side that lies nearer. Rests that it does not explain are contacts where it explains some before and after.

    Raises
    ------
    FewPosesError
        None explains any rest.
    PayloadChangedError
        From a rest on, or up to one, none is explained.
    """
    for each in known:
        read = _read(recording, log, motion, frames, each)
        payload = each if log.start_ns >= each.start_ns else each.before()
        fits = np.array([payload.explains(pose) for pose in read.poses], dtype=np.bool_)
        if np.any(fits):
            _check_whole(each, read, fits)
            return read, payload.seen_with(read.poses, fits)
    raise FewPosesError(
        "The tool rests in fewer than 4 clearly different orientations here, and the payload of no other window "
        "explains the force at rest; record 6 to 12 poses of 1 s each, tilted 30 to 70 degrees about two axes."
    )


def _read(
    recording: Recording, log: AlignedLog, motion: MotionSpans, frames: Frames | None, known: KnownPayload
) -> ReadLog:
    if known.convention is not None:
        return read_as(recording, known.convention, frames)
    poses = collect_static_poses(log, motion.still)
    return ReadLog(recording=recording, log=log, motion=motion, poses=poses, convention=None, findings=())


def _check_whole(known: KnownPayload, read: ReadLog, fits: BoolArray) -> None:
    """Raise PayloadChangedError where two rests or more at either end are not explained: one may be a contact."""
    first, last = int(np.argmax(fits)), int(len(fits) - 1 - np.argmax(fits[::-1]))
    if len(fits) - 1 - last >= _CHANGED_RESTS:
        before, after = last, last + 1
    elif first >= _CHANGED_RESTS:
        before, after = first - 1, first
    else:
        return
    sample = 0.5 * (read.poses[before].span.stop + read.poses[after].span.start)
    raise PayloadChangedError(
        f"The payload of {known.source} explains the force at rest on one side of {sample * read.log.period_s:.2f} s "
        "only: payload or bias changed there, or all rests beyond it are contacts.",
        "Cut the log there.",
        read.log.start_ns,
        sample * read.log.period_s,
    )
