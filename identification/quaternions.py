"""Unit quaternions (x, y, z, w) of long logs: what a rotation library does one object at a time, by columns."""

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]


def turned_rad(before: FloatArray, after: FloatArray) -> FloatArray:
    """Return the angle [rad], 0 to π, between orientations (n, 4) each: 2 atan2(|v|, |w|) of before⁻¹ · after."""
    x, y, z, w = before.T
    a, b, c, d = after.T
    same = w * d + x * a + y * b + z * c
    square = (w * a - d * x - y * c + z * b) ** 2
    square += (w * b - d * y - z * a + x * c) ** 2
    square += (w * c - d * z - x * b + y * a) ** 2
    return np.asarray(2.0 * np.arctan2(np.sqrt(square), np.abs(same)))


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
