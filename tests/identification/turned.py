"""Logs of a tool that turns, made from the equations of a rotation alone."""

import numpy as np
from scipy.spatial.transform import Rotation

from identification.axes.turning import AxisTurn, find_turns
from identification.payload.gravity import GravityFit
from identification.signals.aligned import align
from identification.signals.recording import PoseSignal, Recording, WrenchSignal
from identification.signals.segments import find_motion
from problems.arrays import FloatArray
from tests.identification.synthetic import ramp

RATE_HZ = 500.0
H_S = 1.0 / RATE_HZ
WORKING = Rotation.from_euler("xyz", [2.8, 0.3, 0.7])
WEIGHTLESS = GravityFit(
    mass_kg=0.0,
    mass_std_kg=0.0,
    com_S_m=np.zeros(3),
    com_std_m=np.zeros(3),
    force_bias_S_n=np.zeros(3),
    force_bias_std_n=np.zeros(3),
    torque_bias_S_n_m=np.zeros(3),
    torque_bias_std_n_m=np.zeros(3),
    covariance=np.zeros((10, 10)),
    residual_rms_n=0.0,
    torque_residual_rms_n_m=0.0,
    noise_rms_n=0.0,
    condition=1.0,
    com_condition=1.0,
    pose_count=4,
    rejected=0,
    inliers=(),
    bias_step=None,
    terms=(),
)


def to_and_fro(times: int = 2, angle: float = 0.06) -> FloatArray:
    """Rest, there, rest, back, …, rest."""
    out, rest = ramp(300), np.ones(400)
    return angle * np.concatenate([0.0 * rest, *(times * [np.concatenate([out, rest, out[::-1], 0.0 * rest])])])


def recorded(
    turns_S: FloatArray,
    *,
    centre_S_m: FloatArray | None = None,
    force: FloatArray | None = None,
    torque: FloatArray | None = None,
) -> Recording:
    """A log of a tool turned by rotation vectors (n, 3) about a point of S that stays where it is."""
    count = len(turns_S)
    stamps = 10**18 + np.round(np.arange(count) * H_S * 1e9).astype(np.int64)
    orientation = WORKING * Rotation.from_rotvec(turns_S)
    centre = np.zeros(3) if centre_S_m is None else centre_S_m
    pose = PoseSignal(
        topic="/p",
        frame_id="base",
        stamp_ns=stamps,
        position_m=np.array([0.5, 0.1, 0.4]) - orientation.apply(centre),
        quaternion_xyzw=orientation.as_quat(),
    )
    nothing = np.zeros((count, 3))
    wrench = WrenchSignal(
        topic="/w",
        frame_id="ft",
        stamp_ns=stamps,
        force_n=nothing if force is None else force,
        torque_n_m=nothing if torque is None else torque,
    )
    return Recording(wrench=wrench, pose=pose, command=pose)


def turns_of(recording: Recording) -> tuple[AxisTurn, ...]:
    log = align(recording)
    return find_turns(recording, log, find_motion(log), WEIGHTLESS)
