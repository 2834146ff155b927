"""The ways in which an orientation may be written: quaternions, rotation vectors, matrices, Euler angles."""

import re
from collections.abc import Sequence
from itertools import product

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from problems.arrays import FloatArray
from problems.errors import ParameterError

from ...signals.sweeps import continuous, normalised

ROW_MAJOR, COLUMN_MAJOR = "matrix_row_major", "matrix_column_major"
NORM_TOLERANCE = 1e-3
_FAR_WORSE = 3.0
_UNEXPLAINED, _FEWEST_RESTS = 0.3, 5
_BINS, _BIN_ROWS, _STILL_RAD, _SAME_RAD = 400, 8, 0.02, 0.05
_ROUNDS, _SMALLEST_N = 20, 1e-3
_EULER = re.compile(r"euler_([xyz]{3}|[XYZ]{3})")
_SEQUENCES = tuple(
    f"euler_{first}{second}{third}"
    for axes in ("xyz", "XYZ")
    for first, second, third in product(axes, repeat=3)
    if first != second != third
)
THREE_NUMBERS = ("rotation_vector", *_SEQUENCES)
"""The 25 ways to write an orientation as three numbers."""
_USUAL = ("rotation_vector", "euler_xyz", "euler_ZYX", "euler_ZYZ")
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
    return normalised(quaternion)


def make_continuous(quaternion: FloatArray) -> FloatArray:
    """Return quaternions (n, 4) with signs such that neighbours are near.

    A quaternion and its negative are one orientation, as are a rotation vector and the one that is a turn shorter:
    what flips its sign near half a turn is continuous so.
    """
    return continuous(quaternion)


def canonical(quaternion: FloatArray) -> FloatArray:
    """Return quaternions (n, 4) with w not negative: a quaternion and its negative are one orientation."""
    return np.asarray(quaternion * np.where(quaternion[:, 3:] < 0.0, -1.0, 1.0))


def read_by_weight(
    angles_rad: FloatArray, force_n: FloatArray, named: tuple[str, str], *, are_rests: bool
) -> tuple[str, str]:
    """Return how three numbers are an orientation and why, by the force at rest, which turns with the tool.

    Parameters
    ----------
    angles_rad, force_n
        The numbers and the force, (n, 3) each, row by row.
    named
        What their names say and why, kept where the force does not decide.
    are_rests
        Whether each row is the mean of a rest; else rests are looked for.

    """
    rests, loads, noise = (angles_rad, force_n, 0.0) if are_rests else _rests(angles_rad, force_n)
    if len(rests) < _FEWEST_RESTS:
        return named
    plain, turned = weight_misfits(rests, loads)
    swing = float(np.median(np.linalg.norm(loads - np.median(loads, axis=0), axis=1)))
    least = min(turned.values())
    if not least < _UNEXPLAINED * swing:
        why = f"none of {len(turned)} ways to read them explains the force at rest: gravity may have been taken off"
        return named[0], f"{named[1]}; {why}"
    limit = _FAR_WORSE * max(least, noise)
    fitting = [kind for kind, left in plain.items() if left < limit]
    with_turn = [kind for kind, left in turned.items() if left < limit and kind not in fitting]
    among = fitting or with_turn
    kind = next((each for each in (named[0], *_USUAL) if each in among), min(among, key=lambda each: turned[each]))
    why = f"leaves {turned[kind]:.2g} N of a force at rest that swings by {swing:.3g} N"
    others = [each for each in among if each != kind]
    if others:
        return kind, f"{why}, as do {', '.join(others)}: check it in the robot's manual"
    if fitting and with_turn:
        return kind, f"{why}; were the sensor a quarter turn from the flange, {', '.join(with_turn)} would too"
    following, more = min((item for item in turned.items() if item[0] != kind), key=lambda item: item[1])
    return kind, f"{why}, the next one, {following}, {more:.2g} N"


def weight_misfits(angles_rad: FloatArray, force_n: FloatArray) -> tuple[dict[str, float], dict[str, float]]:
    """Return what f = m g_S + b leaves of the middle rest's force [N] by the way to read three numbers.

    First with the sensor's axes those of the pose, then with the best of 24 quarter turns between them; the mass is of
    either sign. By least absolute misfit, so that a few rests in contact weigh little.

    Parameters
    ----------
    angles_rad, force_n
        The three numbers and the force of each rest, (n, 3).

    """
    down = np.array([0.0, 0.0, -1.0])
    gravity = [Rotation.from_quat(orientation_quaternion(kind, angles_rad)).inv().apply(down) for kind in THREE_NUMBERS]
    plain = _misfits(np.array(gravity), force_n).tolist()
    quarters = Rotation.create_group("O")
    best = [float(_misfits(np.array([turn.apply(each) for turn in quarters]), force_n).min()) for each in gravity]
    return dict(zip(THREE_NUMBERS, plain, strict=True)), dict(zip(THREE_NUMBERS, best, strict=True))


def _rests(turns: FloatArray, force: FloatArray) -> tuple[FloatArray, FloatArray, float]:
    """Return the numbers of the orientation and the force (k, 3) where the tool is at rest, and the force's noise."""
    known = np.isfinite(turns).all(axis=1) & np.isfinite(force).all(axis=1)
    turns, force = turns[known], force[known]
    bins = np.array_split(np.arange(len(turns)), min(_BINS, max(len(turns) // _BIN_ROWS, 1)))
    still = [each for each in bins if len(each) and float(np.max(np.ptp(turns[each], axis=0))) < _STILL_RAD]
    if not still:
        return turns[:0], force[:0], 0.0
    noise = float(np.median([np.linalg.norm(np.std(force[each], axis=0)) / np.sqrt(len(each)) for each in still]))
    means = np.array([turns[each].mean(axis=0) for each in still])
    loads = np.array([force[each].mean(axis=0) for each in still])
    _, place = np.unique(np.round(means / _SAME_RAD), axis=0, return_inverse=True)
    groups = [place.ravel() == number for number in range(int(np.max(place)) + 1)]
    return (
        np.array([np.median(means[group], axis=0) for group in groups]),
        np.array([np.median(loads[group], axis=0) for group in groups]),
        noise,
    )


def _misfits(gravity: FloatArray, force: FloatArray) -> FloatArray:
    """Return what f = m g + b leaves (k,) of the middle rest's force (n, 3) for gravity (k, n, 3), m of either sign."""
    weights = np.full(gravity.shape[:2], 1.0 / len(force))
    left = np.zeros_like(gravity)
    for _ in range(_ROUNDS):
        share = (weights / weights.sum(axis=1, keepdims=True))[:, :, None]
        swing = gravity - (share * gravity).sum(axis=1, keepdims=True)
        off = force - (share * force).sum(axis=1, keepdims=True)
        mass = (share * swing * off).sum(axis=(1, 2)) / np.maximum((share * swing**2).sum(axis=(1, 2)), 1e-12)
        left = off - mass[:, None, None] * swing
        weights = 1.0 / np.maximum(np.linalg.norm(left, axis=2), _SMALLEST_N)
    return np.asarray(np.median(np.linalg.norm(left, axis=2), axis=1))


def of_pose_matrix(entries: Sequence[str], kind: str) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return the paths of position (3) and rotation (9) among those of a pose that is written as a 4 by 4 matrix."""
    step, across = (4, 1) if kind == ROW_MAJOR else (1, 4)
    entry = [[entries[step * row + across * column] for column in range(4)] for row in range(3)]
    places = [(i, j) if kind == ROW_MAJOR else (j, i) for i in range(3) for j in range(3)]
    return tuple(row[3] for row in entry), tuple(entry[row][column] for row, column in places)
