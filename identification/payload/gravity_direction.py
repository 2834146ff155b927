"""Which way gravity points in the base, where the force follows the pose but not with gravity as declared."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from .static_poses import GRAVITY_B_M_S2, StaticPose

FloatArray = NDArray[np.float64]

_ROUNDS = 30
_SMALLEST_N = 1e-3
_LARGEST_CONDITION = 100.0


@dataclass(frozen=True, kw_only=True)
class LeaningGravity:
    """The direction (3,) of gravity in the frame of the poses, its angle to the declared one, and what it leaves."""

    direction_W: FloatArray
    angle_rad: float
    left_n: float


def find_leaning_gravity(poses: Sequence[StaticPose]) -> LeaningGravity | None:
    """Solve f = R_WSᵀ w + b for the weight w in W and the bias b, by least absolute deviations.

    Rests in contact weigh little that way; `left_n` is what the middle rest leaves. None where the orientations do not
    tell weight and bias apart.
    """
    to_sensor = Rotation.from_quat(np.array([pose.quaternion_xyzw for pose in poses])).inv().as_matrix()
    rows = np.concatenate([to_sensor, np.broadcast_to(np.eye(3), to_sensor.shape)], axis=2)
    force = np.array([pose.force_S_n for pose in poses])
    if np.linalg.cond(rows.reshape(-1, 6)) > _LARGEST_CONDITION:
        return None
    root, found, left = np.ones(len(poses)), np.zeros(6), np.zeros(len(poses))
    for _ in range(_ROUNDS):
        weighted = root[:, None, None] * rows
        found = np.linalg.lstsq(weighted.reshape(-1, 6), (root[:, None] * force).reshape(-1), rcond=None)[0]
        left = np.linalg.norm(force - rows @ found, axis=1)
        root = 1.0 / np.sqrt(np.maximum(left, _SMALLEST_N))
    size = float(np.linalg.norm(found[:3]))
    if size <= 0.0:
        return None
    direction = found[:3] / size
    down = GRAVITY_B_M_S2 / np.linalg.norm(GRAVITY_B_M_S2)
    angle = float(np.arctan2(np.linalg.norm(np.cross(direction, down)), direction @ down))
    return LeaningGravity(direction_W=direction, angle_rad=angle, left_n=float(np.median(left)))
