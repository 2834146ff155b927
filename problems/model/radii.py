"""The spectral radii of many loops: LAPACK takes all of one size together, for a call costs as much as its work."""

from collections.abc import Sequence

import numpy as np

from ..arrays import FloatArray
from .sampled import SampledLoop, stability_matrix


def spectral_radii(loops: Sequence[SampledLoop]) -> FloatArray:
    """Return the largest |z| of each loop (m,), as `spectral_radius` finds it."""
    matrices = [stability_matrix(loop) for loop in loops]
    sizes, radii = np.array([len(each) for each in matrices]), np.empty(len(matrices))
    for size in set(sizes.tolist()):
        places = np.flatnonzero(sizes == size)
        radii[places] = np.max(np.abs(np.linalg.eigvals(np.array([matrices[i] for i in places]))), axis=-1)
    return radii
