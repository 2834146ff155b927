"""One way to read a log: signs, frames and orders, relative to the declared ones."""

from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ..signals.frames import Frames
from ..signals.recording import PoseSignal, Recording
from .weight_misfit import Reading

FloatArray = NDArray[np.float64]

_ALIKE_LOG_LIKELIHOOD = float(np.log(1000.0))
_ALIKE_RATIO = 1.2


class Pull(StrEnum):
    """What a force of the opposite sign comes from; rests alone cannot tell the latter two apart."""

    AS_DECLARED = "as declared"
    WRENCH = "the wrench is the other body's"
    GRAVITY = "gravity points the other way"


@dataclass(frozen=True, kw_only=True)
class Convention:
    """One way to read the log, relative to the declared one, and how well the weight fits it.

    `reading` says how the orientation's numbers are taken and by which quarter turn the sensor's axes are turned;
    the residuals are over the orientations that fit the best reading; `short_by` is the log likelihood that this one is
    short of it, `ratio` the larger of its residuals over those of the best one.
    """

    reading: Reading
    pull: Pull
    mass_kg: float
    residual_rms_n: float
    torque_residual_rms_n_m: float
    short_by: float
    ratio: float

    @property
    def changes(self) -> int:
        """The number of entries of cell.yaml that differ from what is declared; 0 for the declared reading."""
        reading = self.reading
        return sum((reading.order != "xyzw", reading.inverted, self.pull is not Pull.AS_DECLARED, reading.is_turned))

    @property
    def fits_best(self) -> bool:
        """Whether it is the best one, or as likely within 1 : 1000, or its residuals are no 20 % larger."""
        return self.short_by < _ALIKE_LOG_LIKELIHOOD or self.ratio < _ALIKE_RATIO

    def entries(self, frames: Frames | None = None) -> tuple[str, ...]:
        """Return what cell.yaml would have to say, given the frames that it declares now."""
        told, declared = [], Frames.plain() if frames is None else frames
        if self.reading.order != "xyzw":
            told.append("pose.orientation_as: quaternion_wxyz")
        if self.reading.inverted:
            told.append("pose.parent and pose.child: swapped (what is logged is flange from base)")
        if self.pull is Pull.WRENCH:
            told.append("wrench.exerted_by: sensor (payload where it is sensor now)")
        if self.pull is Pull.GRAVITY:
            told.append(f"gravity_direction: {numbers_text(declared.R_WB.inv().apply([0.0, 0.0, 1.0]))}")
        if self.reading.is_turned:
            told.append(f"sensor.orientation: {numbers_text((declared.R_FS * self.reading.quarter_turn).as_quat())}")
        return tuple(told) or ("as declared",)

    def apply(self, recording: Recording, frames: Frames | None = None) -> Recording:
        """Return the recording read this way: poses base from sensor with gravity along −z, the payload's wrench.

        A twist is left out where it is not known in which frame it is (an inverted pose, gravity reversed).
        """
        declared = Frames.plain() if frames is None else frames
        sign = -1.0 if self.pull is Pull.WRENCH else 1.0
        wrench = recording.wrench
        keeps_base = not self.reading.inverted and self.pull is not Pull.GRAVITY
        return replace(
            recording,
            wrench=replace(wrench, force_n=sign * wrench.force_n, torque_n_m=sign * wrench.torque_n_m),
            pose=self._read(recording.pose, declared),
            command=None if recording.command is None else self._read(recording.command, declared),
            twist=recording.twist if keeps_base else None,
        )

    def _read(self, pose: PoseSignal, frames: Frames) -> PoseSignal:
        logged = Rotation.from_quat(pose.quaternion_xyzw)
        turned = self.reading.orientation(logged, frames)
        position = np.array(pose.position_m)
        if self.reading.inverted:
            # p_BF = −R_BF p_FB, in our base on both sides.
            flange = frames.R_WB.inv() * turned * self.reading.quarter_turn.inv() * frames.R_FS.inv()
            position = -frames.R_WB.apply(flange.apply(frames.R_WB.inv().apply(position)))
        if self.pull is Pull.GRAVITY:
            over = Rotation.from_rotvec([np.pi, 0.0, 0.0])
            turned, position = over * turned, over.apply(position)
        return replace(pose, position_m=position, quaternion_xyzw=turned.as_quat(canonical=True))


def residuals_text(convention: Convention) -> str:
    """Say what a convention leaves of force and torque."""
    return f"{convention.residual_rms_n:.3g} N and {convention.torque_residual_rms_n_m:.3g} N·m"


def numbers_text(values: FloatArray) -> str:
    """Write numbers as a YAML list."""
    return "[" + ", ".join(f"{round(float(value), 6) + 0.0:g}" for value in np.asarray(values)) + "]"
