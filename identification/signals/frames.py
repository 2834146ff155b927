"""Frames that a cell declares, and unit quaternions: interpolation and angles."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from problems.arrays import FloatArray


@dataclass(frozen=True, kw_only=True)
class Frames:
    """What the cell declares: `R_FS` flange from sensor, `R_WB` our base (gravity along −z) from the log's."""

    R_FS: Rotation
    R_WB: Rotation

    @classmethod
    def plain(cls) -> "Frames":
        """Return frames that are all the same."""
        return cls(R_FS=Rotation.identity(), R_WB=Rotation.identity())


def turned_rad(before: FloatArray, after: FloatArray) -> FloatArray:
    """Return the angle [rad], 0 to π, between orientations (n, 4) or one (4,): 2 atan2(|v|, |w|) of before⁻¹ after."""
    same, across = _between(before, after)
    return np.asarray(2.0 * np.arctan2(_length(across), np.abs(same)))


def turn_vectors_rad(before: FloatArray, after: FloatArray) -> FloatArray:
    """Return the rotation vectors (n, 3) [rad], at most π long, of before⁻¹ · after, as `before` sees them."""
    same, across = _between(before, after)
    sine = _length(across)
    # Where nothing turns the angle is twice the sine, and 0/0 is left out.
    ratio = np.full(len(sine), 2.0)
    np.divide(2.0 * np.arctan2(sine, np.abs(same)), sine, out=ratio, where=sine > 0.0)
    ratio[same < 0.0] *= -1.0
    return np.column_stack([each * ratio for each in across])


def _between(before: FloatArray, after: FloatArray) -> tuple[FloatArray, tuple[FloatArray, FloatArray, FloatArray]]:
    """Return w and the three components of v of before⁻¹ · after, (n,) each."""
    x, y, z, w = before.T
    a, b, c, d = after.T
    across = (w * a - d * x - y * c + z * b, w * b - d * y - z * a + x * c, w * c - d * z - x * b + y * a)
    return w * d + x * a + y * b + z * c, across


def _length(across: tuple[FloatArray, FloatArray, FloatArray]) -> FloatArray:
    x, y, z = across
    square = x * x
    square += y * y
    square += z * z
    return np.asarray(np.sqrt(square, out=square))


def slerp(time_s: FloatArray, quaternion_xyzw: FloatArray, at_s: FloatArray) -> FloatArray:
    """Interpolate orientations (m, 4) at rising `time_s` (m,) at `at_s` (n,) within them, (n, 4).

    q = (q0 sin(1 − u)θ + q1 sin uθ)/sin θ the shorter way round (Shoemake 1985, section 3.3).
    """
    before = quaternion_xyzw[:-1]
    sign = np.where(np.einsum("ij,ij->i", before, quaternion_xyzw[1:]) < 0.0, -1.0, 1.0)
    after = sign[:, None] * quaternion_xyzw[1:]
    angle = 2.0 * np.arctan2(np.linalg.norm(after - before, axis=1), np.linalg.norm(after + before, axis=1))
    index = np.clip(np.searchsorted(time_s, at_s, side="right") - 1, 0, len(time_s) - 2)
    share = (at_s - time_s[index]) / np.diff(time_s)[index]
    turn = angle[index] / np.pi
    # sin(uθ)/sin(θ) written so that an orientation that rests is no division by zero.
    whole = np.sinc(turn)
    found = before[index]
    found *= ((1.0 - share) * np.sinc((1.0 - share) * turn) / whole)[:, None]
    found += (share * np.sinc(share * turn) / whole)[:, None] * after[index]
    return np.asarray(found)
