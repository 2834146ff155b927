"""Points of a Sobol' sequence: the digital net of Joe and Kuo (2008), scrambled as Matoušek (1998) does.

The points are those of `scipy.stats.qmc.Sobol`, which takes a quarter of a second to import.
"""

import numpy as np

from .arrays import FloatArray, IntArray

_BITS = 30
# Primitive polynomials, their bits those of the coefficients, and the first direction numbers of dimensions 2 to 24
# (S. Joe and F. Y. Kuo, Constructing Sobol sequences with better two-dimensional projections, 2008; new-joe-kuo-6).
_DIRECTIONS = (
    (3, (1,)),
    (7, (1, 3)),
    (11, (1, 3, 1)),
    (13, (1, 1, 1)),
    (19, (1, 1, 3, 3)),
    (25, (1, 3, 5, 13)),
    (37, (1, 1, 5, 5, 17)),
    (41, (1, 1, 5, 5, 5)),
    (47, (1, 1, 7, 11, 19)),
    (55, (1, 1, 5, 1, 1)),
    (59, (1, 1, 1, 3, 11)),
    (61, (1, 3, 5, 5, 31)),
    (67, (1, 3, 3, 9, 7, 49)),
    (91, (1, 1, 1, 15, 21, 21)),
    (97, (1, 3, 1, 13, 27, 49)),
    (103, (1, 1, 1, 15, 7, 5)),
    (109, (1, 3, 1, 15, 13, 25)),
    (115, (1, 1, 5, 5, 19, 61)),
    (131, (1, 3, 7, 11, 23, 15, 103)),
    (137, (1, 3, 7, 13, 13, 15, 69)),
    (143, (1, 1, 3, 13, 7, 35, 63)),
    (145, (1, 3, 5, 9, 1, 25, 53)),
    (157, (1, 3, 1, 13, 9, 35, 107)),
)


def sobol_points(width: int, count: int, *, seed: int | np.random.Generator | None) -> FloatArray:
    """Return `count` points (count, width) of [0, 1)ᵂ, scrambled by a seed or generator, unscrambled with None.

    A power of two covers every part of the cube alike.
    """
    if width > len(_DIRECTIONS) + 1:
        from scipy.stats import qmc  # noqa: PLC0415 - slow to import, and hardly ever needed

        return np.asarray(qmc.Sobol(width, scramble=seed is not None, rng=np.random.default_rng(seed)).random(count))
    directions, shift = _directions(width), np.zeros(width, dtype=np.int64)
    if seed is not None:
        directions, shift = _scrambled(directions, np.random.default_rng(seed).spawn(1)[0])
    points = np.empty((count, width), dtype=np.int64)
    if count:
        points[0] = shift
    for i in range(1, count):
        # The next of the Gray code changes the digit that is the lowest 0 of the last index.
        points[i] = points[i - 1] ^ directions[:, (~(i - 1) & i).bit_length() - 1]
    return points / 2.0**_BITS


def _directions(width: int) -> IntArray:
    """Return the direction numbers (width, _BITS), the first digit of a point in the highest bit."""
    out = np.ones((width, _BITS), dtype=np.int64)
    for row, (polynomial, first) in zip(out[1:], _DIRECTIONS, strict=False):
        degree = len(first)
        row[:degree] = first
        for j in range(degree, _BITS):
            row[j] = row[j - degree]
            for k in range(1, degree + 1):
                if polynomial >> (degree - k) & 1:
                    row[j] ^= row[j - k] << k
    return out << np.arange(_BITS - 1, -1, -1)


def _scrambled(directions: IntArray, rng: np.random.Generator) -> tuple[IntArray, IntArray]:
    """Return the direction numbers by a random lower triangular matrix over digits, and a random shift (width,)."""
    width, powers = len(directions), 1 << np.arange(_BITS)
    shift = rng.integers(2, size=(width, _BITS), dtype=np.uint32) @ powers
    mixed = np.tril(rng.integers(2, size=(width, _BITS, _BITS), dtype=np.uint32), -1) | np.eye(_BITS, dtype=np.uint32)
    digits = directions[:, None, :] >> np.arange(_BITS - 1, -1, -1)[:, None] & 1
    return np.einsum("dik,i->dk", np.matmul(mixed, digits) & 1, powers[::-1]), shift
