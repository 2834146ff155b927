"""The ways in which an orientation may be written: quaternions, rotation vectors, matrices, Euler angles."""

import re

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from problems.arrays import FloatArray
from problems.errors import ParameterError

ROW_MAJOR, COLUMN_MAJOR = "matrix_row_major", "matrix_column_major"
NORM_TOLERANCE = 1e-3
_EULER = re.compile(r"euler_([xyz]{3}|[XYZ]{3})")
_QUATERNIONS = ("quaternion_xyzw", "quaternion_wxyz")


def orientation_width(kind: str) -> int:
    """Count the numbers of an orientation; raise ParameterError for a kind that is not known."""
    if kind in _QUATERNIONS:
        return 4
    if kind in (ROW_MAJOR, COLUMN_MAJOR):
        return 9
    match = _EULER.fullmatch(kind)
    if kind == "rotation_vector" or (match and all(a != b for a, b in zip(match[1], match[1][1:], strict=False))):
        return 3
    must = (
        f"quaternion_xyzw, quaternion_wxyz, rotation_vector, {ROW_MAJOR}, {COLUMN_MAJOR}, or euler_ and three axes, "
        "no two neighbours alike "
        "(euler_ZYZ about the moved axes, euler_xyz about the fixed ones)"
    )
    raise ParameterError("orientation_as", kind, must)


def is_rotation(entries: FloatArray) -> NDArray[np.bool_]:
    """Return which of the matrices (n, 9), in either order, are orthonormal within rounding and no mirror."""
    matrix = entries.reshape(-1, 3, 3)
    with np.errstate(invalid="ignore", over="ignore"):
        off = np.abs(np.einsum("nij,nkj->nik", matrix, matrix) - np.eye(3)).max(axis=(1, 2))
        right_handed = np.einsum("ni,ni->n", np.cross(matrix[:, 0], matrix[:, 1]), matrix[:, 2]) > 0.0
    return np.asarray((off <= 2.0 * NORM_TOLERANCE) & right_handed)


def orientation_quaternion(kind: str, numbers: FloatArray, rad_per_unit: float = 1.0) -> FloatArray:
    """Return unit quaternions xyzw (n, 4), w not negative, from orientations (n, 3, 4 or 9) written as `kind`.

    Quaternions are expected to be of norm 1 within rounding and are normalised, matrices to be rotations likewise.
    """
    if kind == "quaternion_wxyz":
        quaternion = numbers[:, [1, 2, 3, 0]]
    elif kind == "quaternion_xyzw":
        quaternion = numbers
    elif kind == "rotation_vector":
        quaternion = Rotation.from_rotvec(numbers * rad_per_unit).as_quat()
    elif kind in (ROW_MAJOR, COLUMN_MAJOR):
        matrix = numbers.reshape(-1, 3, 3)
        quaternion = Rotation.from_matrix(matrix if kind == ROW_MAJOR else matrix.transpose(0, 2, 1)).as_quat()
    else:
        quaternion = Rotation.from_euler(kind.removeprefix("euler_"), numbers * rad_per_unit).as_quat()
    return canonical(quaternion / np.linalg.norm(quaternion, axis=1, keepdims=True))


def make_continuous(quaternion: FloatArray) -> FloatArray:
    """Return quaternions (n, 4) with signs such that neighbours are near.

    A quaternion and its negative are one orientation, as are a rotation vector and the one that is a turn shorter:
    what flips its sign near half a turn is continuous so.
    """
    turns = np.sum(quaternion[1:] * quaternion[:-1], axis=1) < 0.0
    signs = np.concatenate([[1.0], np.where(np.cumsum(turns) % 2 == 1, -1.0, 1.0)])
    return np.asarray(quaternion * signs[: len(quaternion), None])


def canonical(quaternion: FloatArray) -> FloatArray:
    """Return quaternions (n, 4) with w not negative: a quaternion and its negative are one orientation."""
    return np.asarray(np.where(quaternion[:, 3:] < 0.0, -quaternion, quaternion))
