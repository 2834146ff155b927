"""Points of a Sobol' sequence."""

import numpy as np
import scipy

from .arrays import FloatArray


def sobol_points(width: int, count: int, *, seed: int | None) -> FloatArray:
    """Return `count` points (count, width) of [0, 1)ᵂ, scrambled by a seed, unscrambled with None.

    A power of two covers every part of the cube alike.
    """
    rng = None if seed is None else np.random.default_rng(seed)
    return np.asarray(scipy.stats.qmc.Sobol(width, scramble=seed is not None, rng=rng).random(count))
